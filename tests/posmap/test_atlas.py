import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import posmap


@pytest.mark.parametrize("size", [32, 64, 128])
def test_windows_tile_the_map_exactly(size):
    cover = np.zeros((size, size), int)
    for w in posmap.windows(size):
        cover[w.row : w.row + w.height, w.col : w.col + w.width] += 1
    assert (cover == 1).all()


def test_windows_at_128_are_the_public_layout():
    named = {w.name: (w.row, w.col, w.height, w.width) for w in posmap.windows(128)}
    assert named["back"] == (0, 0, 96, 48)
    assert named["front"] == (0, 48, 96, 48)
    assert named["right"] == (0, 96, 96, 32)
    assert named["left"] == (96, 0, 32, 96)
    assert named["below"] == (96, 96, 16, 32)
    assert named["above"] == (112, 96, 16, 32)


def test_encoding_the_a_pose_gives_the_reference_points(figure, atlas):
    np.testing.assert_allclose(posmap.encode(atlas, jnp.asarray(figure[0])), atlas.reference, atol=1e-6)


def test_texels_lie_on_the_surface_that_their_view_sees(atlas):
    for w in posmap.windows(atlas.size):
        inside = (
            (atlas.rows >= w.row)
            & (atlas.rows < w.row + w.height)
            & (atlas.cols >= w.col)
            & (atlas.cols < w.col + w.width)
        )
        points = np.asarray(atlas.reference)[np.asarray(inside)]
        axis, sign = {"back": (2, -1), "front": (2, 1), "right": (0, -1), "left": (0, 1), "below": (1, -1)}.get(
            w.name, (1, 1)
        )
        centre = {0: 0.0, 1: 0.85, 2: 0.0}[axis]
        assert np.mean((points[:, axis] - centre) * sign > -1e-4) > 0.9, w.name


def test_front_view_runs_left_to_right_along_x_and_top_to_bottom(atlas):
    front = next(w for w in posmap.windows(atlas.size) if w.name == "front")
    picture = np.asarray(posmap.to_map(atlas, atlas.reference))[: front.height, front.col : front.col + front.width]
    mask = np.asarray(atlas.mask)[: front.height, front.col : front.col + front.width]
    rows, cols = np.nonzero(mask)
    points = picture[rows, cols]
    assert np.corrcoef(cols, points[:, 0])[0, 1] > 0.99
    assert np.corrcoef(rows, points[:, 1])[0, 1] < -0.99


def test_views_are_isotropic(atlas):
    front = next(w for w in posmap.windows(atlas.size) if w.name == "front")
    picture = np.asarray(posmap.to_map(atlas, atlas.reference))[: front.height, front.col : front.col + front.width]
    mask = np.asarray(atlas.mask)[: front.height, front.col : front.col + front.width]
    rows, cols = np.nonzero(mask)
    across = np.polyfit(cols, picture[rows, cols, 0], 1)[0]
    down = -np.polyfit(rows, picture[rows, cols, 1], 1)[0]
    assert across == pytest.approx(down, rel=1e-3)


def test_longest_axis_becomes_seven_tenths(figure, atlas):
    assert float(atlas.scale) * np.ptp(figure[0], axis=0).max() == pytest.approx(0.7, rel=1e-6)


@pytest.mark.parametrize("size", [0, 16, 48, 100])
def test_other_sizes_are_refused(size):
    with pytest.raises(ValueError, match="multiple of 32"):
        posmap.windows(size)


def test_empty_and_non_finite_meshes_are_refused(figure):
    vertices, faces = figure
    with pytest.raises(ValueError, match="0 faces"):
        posmap.build_atlas(vertices, faces[:0], 32)
    with pytest.raises(ValueError, match="finite"):
        posmap.build_atlas(np.where(vertices > 0, np.nan, vertices), faces, 32)
