"""The survivor: his coat hangs open and clear of him, and the backpack sits on its back."""

import numpy as np
import pytest

from avatarjax.data import avatars
from tests.data.looks import rest_checks


@pytest.fixture(scope="module")
def survivor():
    return avatars.build("survival")


def test_his_cloth_is_ready_to_be_simulated(survivor):
    rest_checks.check(survivor)


def test_the_coat_ends_on_the_calves_and_is_open_in_front(survivor):
    skirt = survivor.vertices[rest_checks.part(survivor, "coat skirt")]
    joint = survivor.rig.heads[:, 1]
    knee, ankle = joint[survivor.rig.index("LeftLeg")], joint[survivor.rig.index("LeftFoot")]
    assert ankle + 0.1 < skirt[:, 1].min() < knee - 0.1
    assert np.abs(skirt[skirt[:, 2] > 0.12, 0]).min() > 0.05


def test_the_backpack_is_behind_the_coat_and_its_straps_before_it(survivor):
    pack = survivor.vertices[rest_checks.part(survivor, "backpack")]
    coat = survivor.vertices[rest_checks.part(survivor, "coat")]
    assert pack[:, 2].min() < coat[:, 2].min() - 0.1
    chest = np.abs(pack[:, 0]) < 0.15
    assert pack[chest, 2].max() > 0.1
    assert survivor.reach[rest_checks.part(survivor, "backpack")].max() == 0
