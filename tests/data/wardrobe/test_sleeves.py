"""Sleeves hang around arms."""

import numpy as np

from avatarjax.data.wardrobe import (
    assembly,
    sleeves,
)
from avatarjax.data.wardrobe.ground import Ground


def test_a_sleeve_is_sewn_to_the_arm_hangs_below_the_wrist_and_faces_outwards(woman):
    rig, skin = woman
    lie_on = Ground.at((skin.vertices, assembly.vertex_normals(skin.vertices, skin.faces)))
    for side, sign in (("Left", 1), ("Right", -1)):
        sleeve = sleeves.sleeve_bell(rig, side, lie_on, skin.weights, start=0.08, drop=0.2, columns=36)
        assert sleeve.reach is not None
        rings = sleeve.vertices.reshape(-1, 36, 3)
        assert np.abs(lie_on.height(rings[0])[0]).max() < 0.006
        assert (sleeve.reach.reshape(-1, 36)[:2] == 0).all() and sleeve.reach.max() > 0.2
        wrist = rig.heads[rig.index(side + "Hand")]
        assert rings[-1, :, 1].min() < wrist[1] - 0.15
        assert (sign * sleeve.vertices[:, 0]).min() > 0
        normals = assembly.vertex_normals(sleeve.vertices, sleeve.faces).reshape(rings.shape)
        assert ((rings - rings.mean(1, keepdims=True)) * normals).sum(-1).mean() > 0
        of_arm = [rig.index(n) for n in rig.names if n.startswith(side) and ("Arm" in n or "Hand" in n)]
        assert sleeve.weights[:, of_arm].sum(1).min() > 0.6
