"""Boots move with the legs in them."""

import pytest

from avatarjax.data.wardrobe import (
    footwear,
)


@pytest.mark.parametrize("side", ["Left", "Right"])
def test_a_boot_moves_with_its_own_leg(woman, side):
    rig, skin = woman
    boot = footwear.boot(rig, side, skin.vertices, skin.weights, top=0.3)
    own = [i for i, n in enumerate(rig.names) if n in (f"{side}Leg", f"{side}Foot", f"{side}ToeBase")]
    assert boot.weights[:, own].sum(1).min() > 0.98
    assert boot.vertices[:, 1].min() > -0.02
