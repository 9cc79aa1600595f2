import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import rotations
from avatarjax.gaussians import Gaussians
from avatarjax.unica import align


@pytest.fixture
def points(key):
    return jax.random.normal(key, (60, 3)) * jnp.array([[1.0, 3.0, 0.5]]) + jnp.array([[5.0, -2.0, 1.0]])


@pytest.fixture
def cloud(points, key):
    a, b = jax.random.split(key)
    quats = jax.random.normal(a, (60, 4))
    return Gaussians(points, jax.random.normal(b, (60, 3)) - 4, quats, jnp.zeros(60), jnp.full((60, 3), 0.5))


def test_placing_finds_a_known_similarity(cloud):
    """Means, covariances and sizes move together."""
    rotation = np.asarray(rotations.to_matrix(rotations.from_axis_angle(jnp.array([0.3, -1.2, 0.5]))), np.float64)
    scale, shift = 1.7, np.array([3.0, 0.2, -1.0])
    target = scale * np.asarray(cloud.means, np.float64) @ rotation.T + shift
    placed = align.place(cloud, jnp.asarray(target, jnp.float32))

    def covariances(g):
        axes = np.asarray(rotations.to_matrix(g.quats), np.float64)
        return np.einsum("nij,nj,nkj->nik", axes, np.exp(2 * np.asarray(g.log_scales, np.float64)), axes)

    np.testing.assert_allclose(placed.means, target, atol=1e-4)
    expected = scale**2 * np.einsum("ij,njk,lk->nil", rotation, covariances(cloud), rotation)
    np.testing.assert_allclose(covariances(placed), expected, atol=1e-4 * expected.max())
    np.testing.assert_array_equal(placed.colors, cloud.colors)


def test_placing_keeps_a_refined_shape(cloud, key):
    """Targets that no similarity reaches: the cloud keeps its shape, only moved."""
    target = cloud.means + 0.1 * jax.random.normal(key, (60, 3))
    placed = align.place(cloud, target)
    before = np.linalg.norm(np.asarray(cloud.means)[:, None] - np.asarray(cloud.means)[None], axis=-1)
    after = np.linalg.norm(np.asarray(placed.means)[:, None] - np.asarray(placed.means)[None], axis=-1)
    ratio = after[before > 0.1] / before[before > 0.1]
    np.testing.assert_allclose(ratio, ratio.mean(), rtol=1e-3)
