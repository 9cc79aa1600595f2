import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import posmap
from avatarjax.unica import batches


@pytest.fixture(scope="module")
def windows(tiny_data):
    return batches.windows(tiny_data.train, 4, (0, 25))


def test_groups_are_normalised_as_the_paper_does(tiny_data, windows):
    chosen = np.array([0, 30, 57, 500])
    groups, actions = windows.groups(chosen, float(tiny_data.atlas.scale))
    train = tiny_data.train
    for k, group in zip(chosen, groups, strict=True):
        rows = windows.first[k] + np.arange(4)
        world = (train.texels[rows] + train.roots[rows][:, None]).astype(np.float32)
        expected, _ = posmap.normalize_group(tiny_data.atlas, jnp.asarray(world))
        np.testing.assert_allclose(group, expected, atol=1e-5)
    np.testing.assert_array_equal(actions, train.actions[windows.first[chosen] + 2])


def test_windows_stay_in_their_sequence(tiny_data, windows):
    frames = windows.frames(np.arange(len(windows.first)))
    assert frames.shape == (20 * 57, 4)
    sequence = tiny_data.train.sequence[frames]
    assert (sequence == sequence[:, :1]).all()


def test_a_window_turns_when_its_last_frame_does(tiny_data, windows):
    train = tiny_data.train
    turn = np.array([np.flatnonzero(train.actions[s : s + 60] != train.actions[s])[0] for s in range(0, 1200, 60)])
    last = windows.first + 3
    since = last % 60 - turn[last // 60]
    np.testing.assert_array_equal(windows.turning, (since >= 1) & (since <= 25))


@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.7, 1.0])
def test_special_windows_are_drawn_with_their_fraction(fraction):
    special = np.arange(100) < 10
    allowed = np.arange(100) % 2 == 0
    drawn = batches.draw(allowed, special, fraction, 4000, np.random.default_rng(0))
    assert allowed[drawn].all()
    assert special[drawn].mean() == pytest.approx(fraction, abs=0.03)
    assert len(set(drawn)) == {0.0: 45, 1.0: 5}.get(fraction, 50)


def test_without_allowed_special_windows_the_others_are_drawn():
    special = np.arange(100) < 10
    drawn = batches.draw(~special, special, 0.7, 500, np.random.default_rng(0))
    assert not special[drawn].any() and len(drawn) == 500


def test_a_steps_random_numbers_depend_on_seed_and_step_alone():
    draws = [batches.generator(seed, step).random() for seed, step in ((1, 5), (1, 5), (1, 6), (2, 5))]
    assert draws[0] == draws[1] and len(set(draws)) == 3


def test_frame_images_are_displaced_in_normalised_space(tiny_data):
    texels, roots = tiny_data.train.texels[:2], np.array([[0.0, 0, 0], [0.1, 0.2, -0.3]], np.float32)
    images = batches.frame_images(texels, roots, 0.5)
    np.testing.assert_allclose(images, 0.5 * (texels + roots[:, None]) + 0.5, atol=1e-6)
