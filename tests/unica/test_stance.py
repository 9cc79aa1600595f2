"""Feet that stay where they stand: what is corrected, by how much, and what is left alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.posmap.pca import PCA
from avatarjax.unica import stance

POINTS, COUNT = 40, 5


@pytest.fixture(scope="module")
def figure():
    """A basis about a pose whose first eight texels lie on the ground and the next eight a foot's height above it."""
    rng = np.random.default_rng(0)
    mean = rng.normal(size=(POINTS, 3))
    mean[:16, 1] = np.repeat([0.0, 0.3], 8)
    basis = 0.1 * rng.normal(size=(COUNT, POINTS, 3))
    basis[:, :16, 1] = 0.0
    pca = PCA(*(jnp.asarray(x.reshape(*x.shape[:-2], -1), jnp.float32) for x in (mean, basis)), jnp.ones(COUNT))
    spread = rng.normal(size=(COUNT + 3, COUNT + 3)) * 0.01
    soles = jnp.arange(16).reshape(2, 8)
    held = stance.Stance(soles, jnp.asarray(stance.square_root(spread @ spread.T), jnp.float32), jnp.asarray(0.0))
    rng = np.random.default_rng(1)
    before, after = (jnp.asarray(0.1 * rng.normal(size=(3, COUNT)), jnp.float32) for _ in range(2))
    return pca, held, before, after, jnp.asarray(0.01 * rng.normal(size=(3, 3)), jnp.float32)


def middles(pca, soles, pose, step):
    """Ground positions (b, 2, 2) of both soles."""
    points = (pose @ pca.basis + pca.mean[None]).reshape(len(pose), -1, 3)[:, soles]
    x, z = points[..., 0], points[..., 2]
    c, s = (f(step[:, 2])[:, None, None] for f in (jnp.cos, jnp.sin))
    ground = jnp.stack([c * x + s * z, c * z - s * x], -1).mean(2)
    return ground + step[:, None, :2]


def test_a_foot_on_the_ground_stays_and_the_other_moves_on(figure):
    pca, held, before, after, step = figure
    stood = middles(pca, held.soles, before, jnp.zeros((3, 3)))
    slid = jnp.linalg.norm(middles(pca, held.soles, after, step) - stood, axis=-1)
    assert (slid > 1e-3).all()
    pose, moved = stance.hold(held, pca, before, after, step)
    still = jnp.linalg.norm(middles(pca, held.soles, pose, moved) - stood, axis=-1)
    resting = slid[:, 0] < stance.SWING
    assert resting.any()
    # Exact but for the turn, which is not linear.
    assert (still[resting, 0] < 0.02 * slid[resting, 0]).all()
    assert (still[:, 1] > 1e-3).all()


def test_slack_says_how_much_is_believed(figure):
    pca, held, before, after, step = figure
    stood = middles(pca, held.soles, before, jnp.zeros((3, 3)))

    def slide(slack):
        pose, moved = stance.hold(held.replace(slack=jnp.asarray(slack)), pca, before, after, step)
        return jnp.linalg.norm(middles(pca, held.soles, pose, moved) - stood, axis=-1)[:, 0].sum()

    loose, middle, tight = slide(1e3), slide(0.01), slide(0.0)
    assert tight < middle < loose
    pose, moved = stance.hold(held.replace(slack=jnp.asarray(1e3)), pca, before, after, step)
    np.testing.assert_allclose(pose, after, atol=1e-6)
    np.testing.assert_allclose(moved, step, atol=1e-6)


def test_only_what_is_uncertain_is_changed(figure):
    pca, held, before, after, step = figure
    root_only = jnp.zeros_like(held.spread).at[-3:, -3:].set(0.01 * jnp.eye(3))
    pose, moved = stance.hold(held.replace(spread=root_only), pca, before, after, step)
    np.testing.assert_array_equal(pose, after)
    assert (jnp.abs(moved - step).max(1) > 1e-4).any()


def test_nothing_changes_in_the_air(figure):
    pca, held, before, after, step = figure
    above = pca.replace(mean=pca.mean.reshape(-1, 3).at[:, 1].add(1.0).reshape(-1))
    pose, moved = stance.hold(held, above, before, after, step)
    np.testing.assert_array_equal(pose, after)
    np.testing.assert_array_equal(moved, step)


def test_a_swinging_foot_is_not_held(figure):
    pca, held, before, after, step = figure
    far = step.at[:, 0].add(10 * stance.SWING)
    pose, moved = stance.hold(held, pca, before, after, far)
    np.testing.assert_array_equal(pose, after)
    np.testing.assert_array_equal(moved, far)


def test_it_has_gradients(figure):
    pca, held, before, after, step = figure
    gradient = jax.grad(lambda x: jnp.sum(stance.hold(held, pca, before, x, step)[0] ** 2))(after)
    assert jnp.isfinite(gradient).all() and (gradient != 0).any()


def walker():
    """A figure of 40 points that walks: 0 to 9 its left sole, 10 to 19 its right, 20 to 29 a hem that drags."""
    frames, stride = 120, 10
    rng = np.random.default_rng(2)
    standing = rng.uniform(-0.1, 0.1, (POINTS, 3))
    standing[:, 1] = 1.0
    standing[:30, 1] = 0.0
    standing[:10, 0], standing[10:20, 0] = 0.1, -0.1
    time = np.arange(frames)
    roots = np.stack([0 * time, 1 + 0 * time, 0.1 * time], -1).astype(np.float32)
    world = standing[None] + roots[:, None] * [1, 0, 1]
    for foot, phase in ((slice(0, 10), 0), (slice(10, 20), stride)):
        cycle = (time + phase) // stride
        down = cycle % 2 == 0
        place = 0.1 * (cycle * stride - phase)
        world[:, foot, 2] = standing[None, foot, 2] + np.where(down, place, roots[:, 2])[:, None]
        world[:, foot, 1] = np.where(down, 0.0, 0.1)[:, None]
    return (world - roots[:, None]).astype(np.float32), roots, np.zeros(frames, np.int32), standing


def test_soles_are_found_and_a_dragging_hem_is_not():
    soles, slack = stance.find_soles(*walker())
    assert set(soles[0]) <= set(range(10)) and set(soles[1]) <= set(range(10, 20))
    assert slack < 1e-5


@pytest.mark.parametrize("left, right, found", [(8, 8, 8), (10, 5, 5), (4, 3, 3), (2, 8, None)])
def test_soles_of_few_points_are_soles(left, right, found):
    texels, roots, sequence, standing = walker()
    texels[:, left:10, 1] += 0.1
    texels[:, 10 + right : 20, 1] += 0.1
    soles = stance.find_soles(texels, roots, sequence, standing)
    assert (None if soles is None else soles[0].shape) == (None if found is None else (2, found))


def test_a_figure_that_floats_has_no_soles():
    texels, roots, sequence, standing = walker()
    assert stance.find_soles(texels, roots + np.float32([0, 0.5, 0]), sequence, standing) is None


def test_square_root():
    rng = np.random.default_rng(3)
    factor = rng.normal(size=(6, 4))
    root = stance.square_root(factor @ factor.T)
    np.testing.assert_allclose(root @ root, factor @ factor.T, atol=1e-10)
    np.testing.assert_allclose(root, root.T)
