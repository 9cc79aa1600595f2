"""The ghost lady: dress, sleeves, veil and hair move."""

import numpy as np
import pytest

from avatarjax.data import avatars
from tests.data.looks import rest_checks


@pytest.fixture(scope="module")
def ghostlady():
    return avatars.build("ghostlady")


def test_her_cloth_is_ready_to_be_simulated(ghostlady):
    rest_checks.check(ghostlady)


def test_what_moves(ghostlady):
    moving = {n for n in ghostlady.part_names if (ghostlady.reach[rest_checks.part(ghostlady, n)] > 0).any()}
    assert moving == {"skirt", "left sleeve", "right sleeve", "veil", "left hair", "right hair"}


def test_the_dress_hangs_to_just_above_the_ground(ghostlady):
    skirt = ghostlady.vertices[rest_checks.part(ghostlady, "skirt")].astype(np.float64)
    assert 0.015 < skirt[:, 1].min() < 0.06
    hem = skirt[skirt[:, 1] < skirt[:, 1].min() + 1e-4]
    assert np.linalg.norm(np.roll(hem, -1, 0) - hem, axis=1).sum() > 2.2


def test_both_sides_of_her_hair_and_sleeves_are_alike(ghostlady):
    for name in ("hair", "sleeve"):
        left, right = (ghostlady.vertices[rest_checks.part(ghostlady, f"{s} {name}")] for s in ("left", "right"))
        np.testing.assert_allclose(left * [-1, 1, 1], right, atol=2e-3)


def test_the_face_is_between_the_hair_and_the_veil_behind_it(ghostlady):
    eye = ghostlady.vertices[rest_checks.part(ghostlady, "eyes")]
    hair = ghostlady.vertices[rest_checks.part(ghostlady, "left hair")]
    veil = ghostlady.vertices[rest_checks.part(ghostlady, "veil")]
    beside = hair[np.abs(hair[:, 1] - eye[:, 1].mean()) < 0.03]
    assert beside[:, 0].min() > eye[eye[:, 0] > 0, 0].mean()
    assert veil[:, 2].max() < eye[:, 2].min()
    assert veil[:, 1].min() < ghostlady.rig.heads[ghostlady.rig.index("LeftUpLeg"), 1]
