"""Bodies that are dressed in the tests, and a ball that is cut and covered."""

import numpy as np
import pytest

from avatarjax.data import body as bodies
from avatarjax.data.wardrobe.garments import Piece, grid_faces
from avatarjax.data.wardrobe.skin import body_piece


@pytest.fixture(scope="session")
def man():
    """Rig, skin and a close shell of a man."""
    body = bodies.load_body()
    vertices, rig = bodies.shape(body, {"caucasian-male-young": 1.0})
    skin, shell = (body_piece(body, vertices, (g,), g) for g in ("body", "helper-tights"))
    return rig, skin, shell


@pytest.fixture(scope="session")
def woman():
    """Rig and skin of a woman."""
    body = bodies.load_body()
    vertices, rig = bodies.shape(body, {"asian-female-young": 1.0})
    return rig, body_piece(body, vertices, ("body",), "body")


@pytest.fixture(scope="session")
def round_piece():
    """A ball of radius 1 with holes at its poles, on two bones."""
    tilt, turn = np.linspace(0.05, np.pi - 0.05, 12), np.arange(18) * np.pi / 9
    points = np.stack(
        [
            np.sin(tilt)[:, None] * np.sin(turn),
            np.broadcast_to(np.cos(tilt)[:, None], (12, 18)),
            np.sin(tilt)[:, None] * np.cos(turn),
        ],
        axis=-1,
    )
    faces, uvs = grid_faces(12, 18, closed=True)
    weights = np.stack([0.5 + 0.5 * points[..., 1].ravel(), 0.5 - 0.5 * points[..., 1].ravel()], axis=1)
    return Piece("ball", points.reshape(-1, 3).astype(np.float32), faces, uvs, weights.astype(np.float32))
