"""How like windows of poses are to those that were learned from."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.smad import driving, kernel

FRAMES, STRIDE, WINDOW = 120, 2, 3


@pytest.fixture(scope="module")
def features():
    """Three numbers of two takes, one of which never changes."""
    t = np.arange(2 * FRAMES)[:, None] / 30
    return np.concatenate([np.sin(t * [2.0, 3.1] + [0.3, 0.1]), np.ones((len(t), 1))], axis=1)


@pytest.fixture(scope="module")
def first():
    return np.repeat([0, FRAMES], FRAMES)


def near(found, poses):
    return np.asarray(jax.vmap(lambda window: kernel.near(found, window))(jnp.asarray(poses, jnp.float32)))


def test_it_is_one_at_a_centre_and_falls_with_the_squared_distance(features, first):
    found = kernel.fit(jnp.asarray(features), jnp.asarray(first), window=WINDOW, stride=STRIDE, centres=2 * FRAMES)
    poses = driving.windows(features, first, WINDOW, STRIDE)
    values = near(found, poses)
    np.testing.assert_allclose(np.diag(values), 1, atol=1e-4)
    points = (poses.reshape(len(poses), -1) - np.asarray(found.mean)) @ np.asarray(found.projection, np.float64)
    apart = np.sum((points[:, None] - points[None]) ** 2, axis=-1)
    # The width is that share of the mean squared distance of two windows.
    np.testing.assert_allclose(found.width, kernel.WIDTH * apart.mean(), rtol=1e-4)
    np.testing.assert_allclose(values, np.exp(-apart / float(found.width)), atol=1e-4)
    assert near(found, poses[:1] + 50).max() < 1e-6


def test_directions_in_which_nothing_moved_are_left_out(features, first):
    found = kernel.fit(jnp.asarray(features), jnp.asarray(first), window=WINDOW, stride=STRIDE, centres=50)
    assert found.centres.shape == (50, found.projection.shape[1]) and found.projection.shape[1] <= 2 * WINDOW
    assert np.isfinite(np.asarray(found.projection)).all()
