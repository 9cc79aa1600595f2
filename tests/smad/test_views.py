"""Cameras about a still body see what the camera of the world sees of the moving one."""

import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import cameras
from avatarjax.smad import views
from tests.smad import turning


@pytest.mark.parametrize("moving", [False, True])
def test_a_body_point_is_seen_in_the_same_pixel(moving):
    film = turning.video(frames=6, size=16)
    film = turning.moving_camera(film) if moving else film
    chosen = np.array([1, 4])
    point = np.array([0.2, -0.1, 0.3], np.float32)
    seen = views.of_video(film, chosen)
    for k, frame in enumerate(chosen):
        world = film.poses.root_rotation[frame] @ point + film.poses.root_translation[frame]
        expected = cameras.project(film.camera_at(int(frame)), jnp.asarray(world)[None])
        camera = seen.replace(world_to_camera=seen.world_to_camera[k], intrinsics=seen.intrinsics[k])
        found = cameras.project(camera, jnp.asarray(point)[None])
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5)


def test_frames_are_spread_and_none_comes_twice():
    assert views.spread(5, 9).tolist() == [0, 1, 2, 3, 4]
    assert views.spread(101, 3).tolist() == [0, 50, 100]
