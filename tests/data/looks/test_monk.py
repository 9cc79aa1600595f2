"""The monk: habit, sleeves, hood and rope ends move; beads and sandals ride on him."""

import numpy as np
import pytest

from avatarjax.data import avatars
from tests.data.looks import rest_checks


@pytest.fixture(scope="module")
def monk():
    return avatars.build("monk")


def test_his_cloth_is_ready_to_be_simulated(monk):
    rest_checks.check(monk)


def test_what_moves_and_what_rides_on_the_bones(monk):
    moving = {n for n in monk.part_names if (monk.reach[rest_checks.part(monk, n)] > 0).any()}
    assert moving == {"skirt", "left sleeve", "right sleeve", "hood"}
    assert {"beads", "belt", "left sandal", "right sandal"} < set(monk.part_names)


def test_the_habit_ends_at_the_ankles_and_is_wide_enough_to_stride(monk):
    skirt = monk.vertices[rest_checks.part(monk, "skirt")].astype(np.float64)
    bottom = skirt[:, 1].min()
    assert 0.03 < bottom < monk.rig.heads[monk.rig.index("LeftFoot"), 1] + 0.03
    hem = skirt[skirt[:, 1] < bottom + 1e-4]
    assert np.linalg.norm(np.roll(hem, -1, 0) - hem, axis=1).sum() > 2.2


def test_the_rope_ends_are_tied_to_the_cloth_behind_them(monk):
    length = np.linalg.norm(monk.vertices[monk.braces[:, 0]] - monk.vertices[monk.braces[:, 1]], axis=1)
    assert length.min() > 0.004 and length.max() < 0.2
    assert np.isin(monk.braces, np.concatenate([rest_checks.part(monk, n) for n in ("skirt", "hood")])).all()


def test_the_beads_hang_on_the_chest_outside_the_habit(monk):
    beads = monk.vertices[rest_checks.part(monk, "beads")].astype(np.float64)
    neck = monk.rig.heads[monk.rig.index("Neck"), 1]
    assert neck - 0.35 < beads[:, 1].min() < neck - 0.18
    count = len(beads) // 30
    centres = beads.reshape(count, 30, 3).mean(1)
    assert (centres[:, 2] > 0.05).sum() >= 12
    body = monk.faces[monk.parts == monk.part_names.index("body")]
    front = centres[centres[:, 2] > 0.05]
    assert rest_checks.clearance(front, monk.vertices, body).min() > 0.01
    # Every bead is rigid.
    weights = monk.weights[rest_checks.part(monk, "beads")].reshape(count, 30, -1)
    np.testing.assert_array_equal(weights, weights[:, :1].repeat(30, axis=1))


def test_the_hood_lies_on_the_back(monk):
    hood = monk.vertices[rest_checks.part(monk, "hood")]
    tip = hood[hood[:, 1].argmin()]
    assert abs(tip[0]) < 0.02 and tip[2] < -0.05
    assert hood[:, 1].max() > monk.rig.heads[monk.rig.index("Neck"), 1]
