"""The cowgirl: two braids before her shoulders and a slung belt of cartridges."""

import numpy as np
import pytest

from avatarjax.data import avatars
from tests.data.looks import rest_checks


@pytest.fixture(scope="module")
def cowgirl():
    return avatars.build("cowgirl")


def test_her_cloth_is_ready_to_be_simulated(cowgirl):
    rest_checks.check(cowgirl)


def test_the_braids_are_each_others_mirror_and_hang_to_the_chest(cowgirl):
    left, right = (cowgirl.vertices[rest_checks.part(cowgirl, n)] for n in ("left braid", "right braid"))
    np.testing.assert_allclose(left.mean(0), right.mean(0) * [-1, 1, 1], atol=4e-3)
    assert left[:, 1].min() < cowgirl.rig.heads[cowgirl.rig.index("Spine2"), 1]
    assert left[np.argmin(left[:, 1]), 2] > cowgirl.rig.heads[cowgirl.rig.index("Neck"), 2]


def test_the_belt_is_slung_on_cloth_that_does_not_move(cowgirl):
    belt, skirt = (rest_checks.part(cowgirl, n) for n in ("bullet belt", "skirt"))
    bottom = cowgirl.vertices[belt, 1].min()
    held = skirt[cowgirl.vertices[skirt, 1] > bottom]
    assert cowgirl.reach[held].max() == 0
    side = cowgirl.vertices[belt]
    assert side[side[:, 0] > 0.12, 1].mean() > side[side[:, 0] < -0.12, 1].mean() + 0.03
