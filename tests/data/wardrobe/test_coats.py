"""An open coat: cut to its lines, its skirt around what is under it, and a pack strapped over it."""

import numpy as np
import pytest

from avatarjax.data import body as bodies
from avatarjax.data.wardrobe import assembly, capes, coats, props, tailoring


@pytest.fixture(scope="module")
def figure():
    body = bodies.load_body()
    vertices, rig = bodies.shape(body, {"caucasian-male-young": 1.0})
    skin, shell = (assembly.body_piece(body, vertices, (g,), g) for g in ("body", "helper-tights"))
    return rig, skin, shell


@pytest.fixture(scope="module")
def coat(figure):
    rig, _, shell = figure
    return coats.coat_top(rig, shell, waist=1.05, neck=1.48)


def test_the_coat_is_outside_the_skin_between_waist_and_wrists(figure, coat):
    rig, skin, _ = figure
    # But for the armpits, where the shell bridges a fold.
    assert np.percentile(tailoring.Ground.of([skin]).clearance(coat.vertices)[0], 3) > 0.008
    assert 1.03 < coat.vertices[:, 1].min() < 1.07
    assert coats.sleeve_end(rig, coat.vertices.astype(np.float64), 0.012).min() > -0.02
    chest = coat.vertices[(coat.vertices[:, 2] > 0.08) & (coat.vertices[:, 1] > 1.15) & (coat.vertices[:, 1] < 1.4)]
    assert np.abs(chest[np.abs(chest[:, 0]) < 0.2, 0]).min() > 0.06


def test_the_skirt_of_a_coat_hangs_free_below_the_waist(figure, coat):
    rig, skin, _ = figure
    legs = skin.vertices[skin.weights[:, tailoring.bones(rig, "Arm", "Hand")].sum(1) < 0.3]
    skirt = coats.coat_skirt(rig, legs, coat, start=1.08, waist=1.04, bottom=0.4)
    assert (skirt.reach[skirt.vertices[:, 1] > 1.04] == 0).all()
    assert skirt.reach.max() == pytest.approx(1.5 * 0.625, rel=0.02)
    assert tailoring.Ground.of([skin]).clearance(skirt.vertices[skirt.reach > 0])[0].min() > 0.008


def test_a_backpack_rides_on_the_back_and_is_closed_outwards(figure, coat):
    rig, _, _ = figure
    pack = props.backpack(rig, coat, centre=np.array([0.0, 1.26, -0.2]))
    bag = props.rounded_box(rig, "bag", "Spine2", np.zeros(3), np.array([0.1, 0.2, 0.05]))
    a, b, c = (bag.vertices[bag.faces[:, k]] for k in range(3))
    assert (a * np.cross(b, c)).sum() / 6 == pytest.approx(0.8 * 8 * 0.1 * 0.2 * 0.05, rel=0.1)
    rigid = pack.weights[:, rig.index("Spine2")] == 1
    assert rigid.mean() > 0.7
    assert pack.uvs.min() >= 0 and pack.uvs.max() <= 1


def test_a_kilt_and_a_cape_do_not_touch(figure):
    rig, skin, _ = figure
    trunk = skin.vertices[skin.weights[:, tailoring.bones(rig, "Arm", "Hand")].sum(1) < 0.3]
    kilt = capes.kilt(rig, trunk, top=1.06, bottom=0.54)
    cape = capes.cape(rig, [skin, kilt], top=1.4, free=1.34, bottom=0.3)
    assert tailoring.Ground.of([skin, kilt]).clearance(cape.vertices)[0].min() > 0.004
    down = np.diff(cape.vertices[:, 1].reshape(-1, 52), axis=0)
    assert (down[6:] < 0).all()
