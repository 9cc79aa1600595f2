"""Cameras: where they stand, where they look, where points land."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import look_at, orbit
from avatarjax.cameras import project

SIZE = {"width": 40, "height": 30}


def test_position_is_the_eye():
    camera = look_at((1.0, 2.0, 3.0), (0.0, 1.0, 0.0), **SIZE)
    np.testing.assert_allclose(camera.position, [1, 2, 3], atol=1e-6)


def test_rotation_is_proper():
    rotation = look_at((1.0, 2.0, 3.0), (0.0, 1.0, 0.0), **SIZE).world_to_camera[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=1e-6)


def points_in_front(offsets):
    camera = look_at((0.0, 1.0, 4.0), (0.0, 1.0, 0.0), **SIZE)
    return project(camera, jnp.asarray([[0.0, 1.0, 0.0]]) + jnp.asarray(offsets, jnp.float32))


def test_target_lands_in_the_middle_at_its_distance():
    pixels, depths = points_in_front([[0.0, 0.0, 0.0]])
    np.testing.assert_allclose(pixels, [[20, 15]], atol=1e-5)
    np.testing.assert_allclose(depths, [4], atol=1e-6)


def test_left_of_a_figure_that_faces_the_camera_is_right_in_the_image_and_up_is_up():
    pixels, _ = points_in_front([[0.5, 0.0, 0.0], [0.0, 0.5, 0.0]])
    assert pixels[0, 0] > 20 and pixels[1, 1] < 15


def test_vertical_field_of_view_spans_the_image():
    top = 4 * np.tan(0.35)
    pixels, _ = points_in_front([[0.0, top, 0.0], [0.0, -top, 0.0]])
    np.testing.assert_allclose(pixels[:, 1], [0, 30], atol=1e-4)


@pytest.mark.parametrize(("eye", "target"), [((0, 1, 0), (0, 1, 0)), ((0, 5, 0), (0, 1, 0))])
def test_camera_without_a_direction_is_refused(eye, target):
    with pytest.raises(ValueError, match="no view direction"):
        look_at(eye, target, **SIZE)


def test_empty_image_is_refused():
    with pytest.raises(ValueError, match="0x30"):
        look_at((0, 0, 1), (0, 0, 0), width=0, height=30)


def test_orbit_starts_in_front_and_turns_to_positive_x():
    cameras = orbit([0.0, np.pi / 2], target=(0.0, 1.0, 0.0), distance=3.0, heights=0.5, **SIZE)
    np.testing.assert_allclose(cameras.position, [[0, 1.5, 3], [3, 1.5, 0]], atol=1e-5)


def test_batch_of_cameras_is_one_pytree_of_static_size():
    cameras = orbit(np.linspace(0, 6, 5), target=(0, 0, 0), distance=2.0, **SIZE)
    assert jax.tree.map(jnp.shape, cameras).world_to_camera == (5, 4, 4)
    assert (cameras.width, cameras.height) == (40, 30)
    assert len(jax.tree.leaves(cameras)) == 2
