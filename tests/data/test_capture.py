"""Cameras that follow a figure: from the front, and from elsewhere."""

import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import cameras
from avatarjax.data import capture
from avatarjax.data.mesh_renderer import MeshRenderer
from avatarjax.io import weights
from avatarjax.physics.xpbd import XPBDConfig

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


def test_a_photograph_has_the_colour_of_the_mesh_alone_wherever_there_is_any():
    corners = np.array([[-0.5, 0, 0], [0.5, 0.1, 0], [0, 1.2, 0]], np.float32)
    grey = np.full((2, 2, 3), 90, np.uint8)
    mesh = MeshRenderer(np.array([[0, 1, 2]]), np.full((1, 3, 2), 0.5, np.float32), grey).pose(corners)
    camera = cameras.look_at((0.0, 0.6, 3.0), (0.0, 0.6, 0.0), width=24, height=24)
    picture, matte = capture.photograph(mesh, camera)
    assert ((matte > 0) & (matte < 255)).any(), "no pixel at the edge is covered in part"
    inside = picture[matte == 255]
    np.testing.assert_allclose(picture[matte > 0], np.broadcast_to(inside[0], picture[matte > 0].shape), atol=2)
    assert (picture[matte == 0] == picture[0, 0]).all() and (picture[0, 0] != inside[0]).all()


def test_the_next_is_made_while_one_is_used_and_a_failure_loses_none_before_it():
    begun = threading.Event()

    def items():
        yield "first"
        begun.set()
        yield "second"
        raise ValueError("the third cannot be made")

    made = capture._ahead(items())
    assert next(made) == "first"
    assert begun.wait(10), "nobody asked for the second yet"
    assert next(made) == "second"
    with pytest.raises(ValueError, match="third"):
        next(made)
    assert list(capture._ahead(iter([]))) == []


def test_films_of_other_settings_are_missing(tmp_path):
    takes = [capture.Take(tmp_path / name, lambda: None) for name in ("filmed", "older", "never")]
    known = capture._settings(48, XPBDConfig(substeps=4))
    for take, metadata in zip(takes, ({"film": known}, {}), strict=False):
        weights.save_tree(Path(take.folder) / capture.MESHES, {"vertices": np.zeros((1, 3, 3), np.float16)}, **metadata)
    assert capture.missing(takes, size=48, config=XPBDConfig(substeps=4)) == takes[1:]
    assert capture.missing(takes, size=96, config=XPBDConfig(substeps=4)) == takes
    assert capture.missing(takes, size=48, config=XPBDConfig(substeps=8)) == takes
