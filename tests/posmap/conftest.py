"""A small figure for the position-map tests: an ellipsoid body with two arms, about twice as tall as wide."""

import numpy as np
import pytest
import trimesh

from avatarjax import posmap


@pytest.fixture(scope="session")
def figure():
    body = trimesh.creation.icosphere(subdivisions=3)
    body.apply_scale([0.2, 0.85, 0.15])
    body.apply_translation([0, 0.85, 0])
    arms = [trimesh.creation.box((0.25, 0.08, 0.08)).apply_translation([x, 1.2, 0.02]) for x in (-0.28, 0.28)]
    mesh = trimesh.util.concatenate([body, *arms])
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)


@pytest.fixture(scope="session")
def atlas(figure):
    return posmap.build_atlas(*figure, 32)
