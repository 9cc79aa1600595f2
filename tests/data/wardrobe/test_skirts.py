"""Skirts hang clear of the legs, and kilts of capes."""

import numpy as np

from avatarjax.data.wardrobe import (
    capes,
    skirts,
)
from avatarjax.data.wardrobe.bones import share
from avatarjax.data.wardrobe.ground import Ground


def test_a_skirt_is_outside_the_legs_in_the_rest_pose(woman):
    rig, skin = woman
    trunk = skin.vertices[share(rig, skin.weights, "Arm", "Hand") < 0.3]
    piece = skirts.skirt(rig, trunk, top=1.0, bottom=0.5)
    centre = np.array([0, rig.heads[0, 2]])
    angle = lambda p: np.arctan2(p[:, 0] - centre[0], p[:, 2] - centre[1])  # noqa: E731
    reach = lambda p: np.hypot(p[:, 0] - centre[0], p[:, 2] - centre[1])  # noqa: E731
    legs = trunk[(trunk[:, 1] > 0.52) & (trunk[:, 1] < 0.98)]
    cloth = piece.vertices
    for point, at, far in zip(legs[::40], angle(legs)[::40], reach(legs)[::40], strict=True):
        turned = np.abs((angle(cloth) - at + np.pi) % (2 * np.pi) - np.pi)
        near = np.argmin(turned * 0.3 + np.abs(cloth[:, 1] - point[1]))
        assert reach(cloth)[near] > far - 0.005
    assert (piece.reach[:66] == 0).all() and (piece.reach[-66:] > 0.5).all()


def test_a_kilt_and_a_cape_do_not_touch(man):
    rig, skin, _ = man
    trunk = skin.vertices[share(rig, skin.weights, "Arm", "Hand") < 0.3]
    kilt = skirts.kilt(rig, trunk, top=1.06, bottom=0.54)
    cape = capes.cape(rig, [skin, kilt], top=1.4, free=1.34, bottom=0.3)
    assert Ground.of([skin, kilt]).clearance(cape.vertices)[0].min() > 0.004
    down = np.diff(cape.vertices[:, 1].reshape(-1, 52), axis=0)
    assert (down[6:] < 0).all()
