"""Cameras about a still body see what the camera of the world sees of the moving one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import cameras, rotations
from avatarjax.smad import driving, views
from tests.smad import turning


@pytest.mark.parametrize("moving", [False, True], ids=["one camera", "a camera a frame"])
def test_a_body_point_is_seen_in_the_same_pixel(moving):
    film = turning.video(frames=6, size=16)
    tilt = np.asarray(rotations.to_matrix(rotations.from_axis_angle(jnp.asarray([0.3, 0.0, -0.2]))))
    poses = dataclasses.replace(film.poses, root_rotation=film.poses.root_rotation @ tilt)
    film = dataclasses.replace(turning.moving_camera(film) if moving else film, poses=poses)
    chosen = np.array([1, 4])
    point = jnp.asarray([[0.2, -0.1, 0.3]])
    seen = views.of_video(film, chosen)
    for k, frame in enumerate(chosen.tolist()):
        arrays = (jnp.asarray(x[frame]) for x in (poses.rotations, poses.root_rotation, poses.root_translation))
        expected = cameras.project(film.camera_at(frame), driving.to_world(driving.Pose(*arrays), point))
        found = cameras.project(jax.tree.map(lambda x, k=k: x[k], seen), point)
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4)


def test_frames_are_spread_and_none_comes_twice():
    assert views.spread(5, 9).tolist() == [0, 1, 2, 3, 4]
    assert views.spread(101, 3).tolist() == [0, 50, 100]
