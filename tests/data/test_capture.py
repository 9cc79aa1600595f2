"""Cameras that follow a figure: from the front, and from elsewhere."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import cameras
from avatarjax.data import capture

PATH = np.stack([np.linspace(0, 3, 40), np.ones(40), np.linspace(0, -2, 40)], axis=1)


@pytest.mark.parametrize(("azimuth", "side"), [(0.0, (0, 1)), (np.pi / 2, (1, 0)), (np.pi, (0, -1))])
def test_a_camera_follows_on_its_side_and_looks_at_the_figure(azimuth, side):
    following = capture.following_camera(PATH, 64, azimuth)
    for frame in (0, 20, 39):
        camera = jax.tree.map(lambda x, k=frame: x[k], following)
        rotation, shift = np.asarray(camera.world_to_camera)[:3, :3], np.asarray(camera.world_to_camera)[:3, 3]
        away = -rotation.T @ shift - PATH[frame]
        np.testing.assert_allclose(away[[0, 2]] / np.linalg.norm(away[[0, 2]]), side, atol=0.3)
        seen = np.asarray(cameras.project(camera, jnp.asarray(PATH[frame : frame + 1], jnp.float32))[0])[0]
        assert (np.abs(seen[:2] - 32) < 12).all()


def test_the_next_take_is_made_while_one_is_used_and_a_failure_loses_none_before_it():
    takes = [capture.Take(f"take-{k}", lambda: None) for k in range(3)]
    begun = threading.Event()

    def work(take):
        if take is takes[1]:
            begun.set()
        if take is takes[2]:
            raise ValueError("the third cannot be made")
        return take.folder

    made = capture._ahead(work, takes)
    assert next(made) == "take-0"
    assert begun.wait(10), "nobody asked for the second yet"
    assert next(made) == "take-1"
    with pytest.raises(ValueError, match="third"):
        next(made)
    assert list(capture._ahead(work, [])) == []
