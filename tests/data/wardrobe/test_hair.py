"""Tubes of hair keep clear of the ground, face outwards, and are braced."""

import numpy as np

from avatarjax.data.wardrobe import (
    hair,
)
from avatarjax.data.wardrobe.ground import Ground


def test_a_braid_hangs_before_the_chest_with_its_root_sewn(man):
    rig, skin, _ = man
    knots = np.array([[0.07, 1.55, -0.02], [0.09, 1.45, 0.1], [0.09, 1.25, 0.2]])
    braid = hair.braid(rig, "braid", knots, Ground.of([skin]))
    free = braid.reach > 0.02
    assert Ground.of([skin]).clearance(braid.vertices[free])[0].min() > 0.004
    assert braid.reach[:10].max() == 0 and braid.reach.max() > 0.2
    a, b, c = (braid.vertices[braid.faces[:, k]] for k in range(3))
    # Six times the volume that the triangles enclose.
    assert (a * np.cross(b, c)).sum() > 0


def test_braces_join_opposite_sides_of_a_ring():
    rows, columns = 6, 8
    path = np.stack([np.zeros(rows), np.linspace(1, 0, rows), np.zeros(rows)], axis=1)
    ones = np.ones(rows)
    aside = np.array([1.0, 0, 0])
    tube = hair.strands("t", path, aside, 0.02 * ones, 0.01 * ones, np.ones((rows, 1)), 0 * ones, columns=columns)
    across = tube.braces[: rows * columns // 2]
    middle = tube.vertices[across].mean(1)
    np.testing.assert_allclose(middle, np.repeat(path, columns // 2, axis=0), atol=1e-6)
