"""An open coat: cut to its lines, its skirt around what is under it, and a pack strapped over it."""

import numpy as np
import pytest

from avatarjax.data.wardrobe import (
    backpacks,
    coats,
    skirts,
)
from avatarjax.data.wardrobe.bones import share
from avatarjax.data.wardrobe.ground import Ground


@pytest.fixture(scope="module")
def coat(man):
    rig, _, shell = man
    return coats.coat_top(rig, shell, waist=1.05, neck=1.48)


def test_the_coat_is_outside_the_skin_between_waist_and_wrists(man, coat):
    rig, skin, _ = man
    # But for the armpits, where the shell bridges a fold.
    assert np.percentile(Ground.of([skin]).clearance(coat.vertices)[0], 3) > 0.008
    assert 1.03 < coat.vertices[:, 1].min() < 1.07
    assert coats.sleeve_end(rig, coat.vertices.astype(np.float64), 0.012).min() > -0.02
    chest = coat.vertices[(coat.vertices[:, 2] > 0.08) & (coat.vertices[:, 1] > 1.15) & (coat.vertices[:, 1] < 1.4)]
    assert np.abs(chest[np.abs(chest[:, 0]) < 0.2, 0]).min() > 0.06


def test_the_skirt_of_a_coat_hangs_free_below_the_waist(man, coat):
    rig, skin, _ = man
    legs = skin.vertices[share(rig, skin.weights, "Arm", "Hand") < 0.3]
    skirt = skirts.coat_skirt(rig, legs, coat, start=1.08, waist=1.04, bottom=0.4)
    assert (skirt.reach[skirt.vertices[:, 1] > 1.04] == 0).all()
    assert skirt.reach.max() == pytest.approx(1.5 * 0.625, rel=0.02)
    assert Ground.of([skin]).clearance(skirt.vertices[skirt.reach > 0])[0].min() > 0.008


def test_a_backpack_rides_on_the_back_and_is_closed_outwards(man, coat):
    rig, _, _ = man
    pack = backpacks.backpack(rig, coat, centre=np.array([0.0, 1.26, -0.2]))
    bag = backpacks.rounded_box(rig, "bag", "Spine2", np.zeros(3), np.array([0.1, 0.2, 0.05]))
    a, b, c = (bag.vertices[bag.faces[:, k]] for k in range(3))
    assert (a * np.cross(b, c)).sum() / 6 == pytest.approx(0.8 * 8 * 0.1 * 0.2 * 0.05, rel=0.1)
    rigid = pack.weights[:, rig.index("Spine2")] == 1
    assert rigid.mean() > 0.7
    assert pack.uvs.min() >= 0 and pack.uvs.max() <= 1
