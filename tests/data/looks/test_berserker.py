"""The berserker: kilt, cape, beard and locks move; his chest is bare."""

import numpy as np
import pytest

from avatarjax.data import avatars
from tests.data.looks import rest_checks


@pytest.fixture(scope="module")
def berserker():
    return avatars.build("berserker")


def test_his_cloth_is_ready_to_be_simulated(berserker):
    rest_checks.check(berserker)


def test_the_kilt_ends_at_the_knees_and_the_cape_on_the_calves(berserker):
    low = {n: berserker.vertices[rest_checks.part(berserker, n), 1].min() for n in ("kilt", "cape", "beard")}
    joint = {n: berserker.rig.heads[berserker.rig.index(n), 1] for n in ("LeftLeg", "LeftFoot", "Spine1", "Neck")}
    assert joint["LeftLeg"] - 0.05 < low["kilt"] < joint["LeftLeg"] + 0.08
    assert joint["LeftFoot"] + 0.1 < low["cape"] < joint["LeftLeg"] - 0.05
    assert joint["Spine1"] < low["beard"] < joint["Neck"] - 0.1


def test_the_cape_is_outside_the_kilt(berserker):
    cape, kilt = (berserker.vertices[rest_checks.part(berserker, n)] for n in ("cape", "kilt"))
    behind = cape[np.abs(cape[:, 1] - kilt[:, 1].min()) < 0.05]
    assert (behind[np.abs(behind[:, 0]) < 0.1, 2] < kilt[:, 2].min() - 0.004).all()


def test_no_two_locks_of_hair_share_a_vertex(berserker):
    hair = berserker.parts == berserker.part_names.index("hair")
    boundary = berserker.braces[np.isin(berserker.braces[:, 0], rest_checks.part(berserker, "hair"))]
    lock = (berserker.faces[hair] - berserker.faces[hair].min()) // (18 * 8)
    assert (lock == lock[:, :1]).all()
    assert len(boundary) > 100
