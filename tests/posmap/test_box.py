import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import posmap


@pytest.fixture
def points(key):
    return jax.random.normal(key, (60, 3)) * jnp.array([[1.0, 3.0, 0.5]]) + jnp.array([[5.0, -2.0, 1.0]])


def test_boxed_points_fill_the_cube_along_the_longest_axis(points):
    boxed = np.asarray(posmap.into_box(posmap.bounding_box(points), points))
    np.testing.assert_allclose(boxed.min(0), -boxed.max(0), atol=1e-6)
    assert np.ptp(boxed, axis=0).max() == pytest.approx(1, abs=1e-6)


def test_the_box_can_be_undone(points):
    box = posmap.bounding_box(points)
    np.testing.assert_allclose(posmap.into_box(box, points) * box.side + box.centre[None], points, atol=1e-5)


def test_boxed_points_do_not_know_place_and_size(points):
    boxed = posmap.into_box(posmap.bounding_box(points), points)
    moved = 3 * points + jnp.array([[10.0, 20.0, -5.0]])
    np.testing.assert_allclose(posmap.into_box(posmap.bounding_box(moved), moved), boxed, atol=1e-5)
