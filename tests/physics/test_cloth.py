"""Sewing: masses, constraints and tethers of sheets whose answers are known."""

import numpy as np
import pytest
from sheets import grid, sewn

from avatarjax.physics.cloth import Fabric

LINEN = Fabric(density=0.3, stretch=1e-7, shear=2e-5, bend=3e-3)
SILK = Fabric(density=0.1, stretch=2e-6, shear=4e-4, bend=5e-2)
ROWS, COLUMNS, SPACING = 5, 7, 0.04


def sheet(**options):
    return sewn(*grid(ROWS, COLUMNS, SPACING), **{"pinned": np.arange(COLUMNS), "fabrics": (LINEN,), **options})


def two_sheets(shift, fabrics=(LINEN, SILK)):
    """A small sheet sewn on over a larger one, `shift` (3,) metres from the larger one's middle."""
    vertices, faces, uvs = grid(ROWS, COLUMNS, SPACING)
    small, small_faces, small_uvs = grid(3, 3, SPACING)
    small = small + np.array([2 * SPACING, 0, SPACING]) + np.asarray(shift)
    return sewn(
        np.concatenate([vertices, small]).astype(np.float32),
        np.concatenate([faces, small_faces + len(vertices)]),
        np.concatenate([uvs, small_uvs]),
        [*range(COLUMNS), *range(len(vertices), len(vertices) + 3)],
        fabrics=fabrics,
        fabric_of=np.r_[np.zeros(len(faces), np.int32), np.ones(len(small_faces), np.int32)],
    )


def constraints(cloth):
    """{(p, q): (length, compliance)} of the real pairs, p < q."""
    real = cloth.pairs[..., 0] < cloth.count
    pairs = [tuple(sorted(pair)) for pair in cloth.pairs[real].tolist()]
    assert len(set(pairs)) == len(pairs)  # each pair once
    return dict(zip(pairs, zip(cloth.lengths[real], cloth.compliances[real], strict=True), strict=True))


@pytest.fixture
def shuffled():
    """Triangles in a random order, wound to random starts: nothing may depend on how a mesh lists them."""
    rng = np.random.default_rng(0)
    vertices, faces, uvs = grid(ROWS, COLUMNS, SPACING)
    order, start = rng.permutation(len(faces)), rng.integers(0, 3, len(faces))
    turn = (np.arange(3) + start[:, None]) % 3
    faces = np.take_along_axis(faces[order], turn, axis=1)
    uvs = np.take_along_axis(uvs[order], turn[..., None], axis=1)
    return sewn(vertices, faces, uvs, np.arange(COLUMNS), fabrics=(LINEN,))


def test_no_two_pairs_of_a_colour_share_a_vertex():
    for colour in two_sheets([0, 0.01, 0]).pairs:
        vertices = colour[colour[:, 0] < COLUMNS * ROWS + 9].ravel()
        assert len(set(vertices.tolist())) == len(vertices)


def test_padding_lies_outside_the_mesh():
    """Both ends, so that reads are clipped and writes dropped."""
    pairs = sheet().pairs
    padding = (pairs == ROWS * COLUMNS).any(axis=-1)
    assert (pairs[padding] == ROWS * COLUMNS).all() and pairs.max() <= ROWS * COLUMNS and pairs.min() >= 0


def test_masses_are_area_times_density():
    """All of it but the third of one corner's single triangle, which is sewn on."""
    cloth = sheet(pinned=[0])
    whole = 0.3 * (ROWS - 1) * (COLUMNS - 1) * SPACING**2
    corner = 0.3 * SPACING**2 / 2 / 3
    assert cloth.inverse_masses[0] == 0
    np.testing.assert_allclose((1 / cloth.inverse_masses[1:]).sum(dtype=np.float64), whole - corner, rtol=1e-5)


def test_a_vertex_between_six_triangles_has_the_mass_of_a_square():
    np.testing.assert_allclose(1 / sheet().inverse_masses[COLUMNS + 1], 0.3 * SPACING**2, rtol=1e-5)


def test_each_piece_has_its_own_density():
    cloth = two_sheets([0, 0.01, 0])
    middle = ROWS * COLUMNS + 4
    np.testing.assert_allclose(1 / cloth.inverse_masses[[COLUMNS + 1, middle]], [0.3 * SPACING**2, 0.1 * SPACING**2])


def test_drag_is_that_of_a_plate_of_the_fabric():
    """1.2 kg a cubic metre of air, half of it, over the mass of a square metre."""
    np.testing.assert_allclose(sheet().drag, 0.5 * 1.2 * LINEN.drag / LINEN.density, rtol=1e-5)


def expected_kind(pair):
    """What connects two vertices of the grid, by how far apart they are in rows and columns."""
    (r0, c0), (r1, c1) = (divmod(v, COLUMNS) for v in pair)
    apart = abs(r1 - r0), abs(c1 - c0)
    return {(0, 1): LINEN.stretch, (1, 0): LINEN.stretch, (1, 1): LINEN.shear}.get(apart, LINEN.bend)


@pytest.mark.parametrize("scale", [(1, 1), (3, 1), (1, 5), (-2, 0.3)])
def test_warp_and_weft_are_stiff_and_diagonals_shear(scale):
    """Whatever the scale of the texture is."""
    vertices, faces, uvs = grid(ROWS, COLUMNS, SPACING)
    cloth = sewn(vertices, faces, uvs * np.array(scale, np.float32), np.arange(COLUMNS), fabrics=(LINEN,))
    for pair, (_, compliance) in constraints(cloth).items():
        assert compliance == pytest.approx(expected_kind(pair), rel=1e-6), pair


def test_the_order_of_triangles_does_not_matter(shuffled):
    assert constraints(shuffled) == constraints(sheet())


def test_every_square_has_both_diagonals_and_every_inner_edge_bends():
    """(edges + diagonals) of the grid, less the row that is sewn on; opposite corners over each inner edge."""
    kinds = [expected_kind(pair) for pair in constraints(sheet())]
    squares = (ROWS - 1) * (COLUMNS - 1)
    assert kinds.count(LINEN.stretch) == (ROWS - 1) * (COLUMNS - 1) + (ROWS - 1) * COLUMNS
    assert kinds.count(LINEN.shear) == 2 * squares
    assert kinds.count(LINEN.bend) == (ROWS - 2) * (COLUMNS - 1) + (ROWS - 1) * (COLUMNS - 2)


def test_lengths_are_those_of_the_pattern():
    cloth = sheet()
    for (p, q), (length, _) in constraints(cloth).items():
        assert length == pytest.approx(np.linalg.norm(cloth.rest[p] - cloth.rest[q]), rel=1e-6)


def test_pairs_between_sewn_vertices_are_left_out():
    assert not any(q < COLUMNS for _, q in constraints(sheet()))


def test_braces_are_as_stiff_as_the_stiffest_thread():
    pair = (COLUMNS, ROWS * COLUMNS - 1)
    found = constraints(sheet(braces=[pair]))
    assert found[pair][1] == pytest.approx(LINEN.stretch)
    assert found.keys() - constraints(sheet()).keys() == {pair}


def test_tethers_follow_the_threads_to_the_nearest_sewn_vertex():
    """A column of a sheet that hangs from its first row is the straight way up; a tether has 2 % slack."""
    cloth = sheet()
    row, column = np.divmod(np.arange(ROWS * COLUMNS), COLUMNS)
    np.testing.assert_array_equal(cloth.tether, column)
    np.testing.assert_allclose(cloth.tether_length, 1.02 * SPACING * row, rtol=1e-5)


def test_tethers_go_around_along_the_cloth():
    """A strip bent at a right angle hangs from one end: the tether is the way along it, not through the air."""
    vertices, faces, uvs = grid(2, 11, 0.1)
    over = np.maximum(vertices[:, 0] - 0.5, 0)
    bent = np.stack([np.minimum(vertices[:, 0], 0.5), -over, vertices[:, 2]], axis=1)
    cloth = sewn(bent, faces, uvs, [0, 11])
    np.testing.assert_allclose(cloth.tether_length, 1.02 * vertices[:, 0], rtol=1e-5)


def test_clearance_is_the_distance_in_the_pattern_between_1_and_6_mm():
    wanted = {-0.01: 0.001, 0.003: 0.003, 0.5: 0.006}
    for distance, clearance in wanted.items():
        np.testing.assert_allclose(sheet(distance=distance).clearance, clearance, rtol=1e-6)


def test_a_sheet_over_another_covers_it():
    cloth = two_sheets([0, 0.01, 0])
    assert cloth.pieces == (ROWS * COLUMNS, 9)
    assert [c.tolist() for c in cloth.covering] == [[], list(range(ROWS * COLUMNS, ROWS * COLUMNS + 9))]


@pytest.mark.parametrize("shift", [[0, -0.01, 0], [1.0, 0.01, 0]])
def test_a_sheet_beneath_or_aside_covers_nothing(shift):
    assert all(len(c) == 0 for c in two_sheets(shift).covering)


def test_cloth_that_hangs_from_nothing_is_refused():
    with pytest.raises(ValueError, match="sewn on nowhere"):
        sheet(pinned=[])
    vertices, faces, uvs = grid(ROWS, COLUMNS, SPACING)
    loose = np.concatenate([vertices, vertices + np.array([0, 0, 9], np.float32)])
    with pytest.raises(ValueError, match=f"{len(vertices)} vertices of the cloth hang from nothing"):
        sewn(loose, np.concatenate([faces, faces + len(vertices)]), np.concatenate([uvs, uvs]), [0])


def test_a_triangle_without_area_is_named():
    vertices, faces, uvs = grid(3, 3, SPACING)
    faces[5] = [0, 1, 2]
    with pytest.raises(ValueError, match=r"1 triangles of the cloth have no area, the first is 5"):
        sewn(vertices, faces, uvs, [0])


@pytest.mark.parametrize("index", [-1, 9])
def test_a_triangle_of_unknown_vertices_is_refused(index):
    vertices, faces, uvs = grid(3, 3, SPACING)
    faces[2, 1] = index
    with pytest.raises(ValueError, match=r"faces name vertices .*there are 9"):
        sewn(vertices, faces, uvs, [0])


@pytest.mark.parametrize("fabric_of", [[0, 1] * 4, [1] * 4 + [0] * 4])
def test_mixed_pieces_are_refused(fabric_of):
    with pytest.raises(ValueError, match="must follow each other"):
        sewn(*grid(3, 3, SPACING), [0], fabrics=(LINEN, SILK), fabric_of=np.array(fabric_of, np.int32))
