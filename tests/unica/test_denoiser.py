import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.nets import functional
from avatarjax.unica.denoiser import Denoiser, DenoiserConfig
from tests.parameters import random_params

CONFIG = DenoiserConfig(channels=(16, 16), residual_blocks=1, head_width=8, action_features=8)
TIME = jnp.array([10, 700])


@jax.jit
def predict(params, z, time, action):
    return functional.bind(Denoiser, CONFIG, params)(z, time, action)


@pytest.fixture(scope="module")
def params():
    return random_params(Denoiser, CONFIG)


@pytest.fixture(scope="module")
def z():
    return jax.random.normal(jax.random.key(0), (2, 4, 4, 4, 4))


def without_cross_attention(params):
    """What cross attention adds is set to zero."""

    def silence(path, leaf):
        names = [getattr(part, "key", None) for part in path]
        return jnp.zeros_like(leaf) if "cross" in names and "out" in names else leaf

    return jax.tree_util.tree_map_with_path(silence, params)


def test_one_frame_of_noise_comes_out(params, z):
    assert predict(params, z, TIME, jnp.array([1, 2])).shape == (2, 4, 4, 4)


def test_each_sample_answers_its_own_action(params, z):
    one, other = predict(params, z, TIME, jnp.array([1, 2])), predict(params, z, TIME, jnp.array([1, 3]))
    np.testing.assert_allclose(one[0], other[0], atol=1e-4)
    assert np.abs(one[1] - other[1]).max() > 1e-3


def test_no_action_is_a_row_of_its_own(params, z):
    assert CONFIG.null_action == 5
    assert params["action_table"]["embedding"].shape == (6, 8)
    nobody = predict(params, z, TIME, jnp.array([5, 5]))
    assert all(np.abs(nobody - predict(params, z, TIME, jnp.array([k, k]))).max() > 1e-3 for k in (0, 4))


def test_the_action_works_through_cross_attention_only(params, z):
    silent = without_cross_attention(params)
    one, other = (predict(silent, z, TIME, jnp.array([k, k])) for k in (1, 2))
    np.testing.assert_array_equal(one, other)


def test_every_context_frame_and_the_time_matter(params, z):
    action = jnp.array([1, 2])
    before = predict(params, z, TIME, action)
    for frame in range(4):
        assert np.abs(predict(params, z.at[:, frame].add(1.0), TIME, action) - before).max() > 1e-4
    assert np.abs(predict(params, z, TIME + 100, action) - before).max() > 1e-4


def test_frames_are_told_apart(params, z):
    swapped = z[:, jnp.array([1, 0, 2, 3])]
    action = jnp.array([1, 2])
    assert np.abs(predict(params, swapped, TIME, action) - predict(params, z, TIME, action)).max() > 1e-4


def test_samples_of_a_batch_do_not_mix(params, z):
    action = jnp.array([1, 2])
    other = predict(params, z.at[1].set(0.0), TIME, action)
    np.testing.assert_allclose(other[0], predict(params, z, TIME, action)[0], atol=1e-4)


@pytest.mark.parametrize("context", [1, 2])
def test_with_fewer_context_frames_it_takes_so_many_and_one(context, z):
    config = dataclasses.replace(CONFIG, context=context)
    params = random_params(Denoiser, config)
    assert params["frame_table"]["embedding"].shape[0] == context + 1
    run = jax.jit(lambda z: functional.bind(Denoiser, config, params)(z, TIME, jnp.array([1, 2])))
    few = z[:, : context + 1]
    before = run(few)
    assert before.shape == (2, 4, 4, 4)
    for frame in range(context + 1):
        assert np.abs(run(few.at[:, frame].add(1.0)) - before).max() > 1e-4


@pytest.mark.parametrize("context", [0, 4])
def test_another_number_of_context_frames_is_refused(context):
    with pytest.raises(ValueError, match=f"1, 2 or 3 context frames, not {context}"):
        dataclasses.replace(CONFIG, context=context)
