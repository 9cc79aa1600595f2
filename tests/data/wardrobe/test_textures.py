"""Painting an atlas: texels show the surface points that map to them."""

import numpy as np

from avatarjax.data.mesh_renderer import sample_texture
from avatarjax.data.wardrobe import textures

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def painted(place_low, place_high, size=64):
    own = SQUARE[FACES][..., :2]
    uvs = place_low + own * (np.array(place_high, np.float32) - place_low)
    normals = np.tile(np.array([[0, 0, 1]], np.float32), (4, 1))
    paint = lambda p, n, uv: p * 255  # noqa: E731
    parts = np.zeros(2, np.int32)
    return textures.paint_atlas(SQUARE, normals, FACES, uvs.astype(np.float32), own, parts, [paint], size), uvs


def test_a_texel_shows_its_own_place_on_the_surface():
    atlas, _ = painted([0.25, 0.25], [0.75, 0.75])
    colour = sample_texture(atlas, np.array([[0.5, 0.6]], np.float32))[0]
    np.testing.assert_allclose(colour / 255, [0.5, 0.7, 0.0], atol=0.02)


def test_the_border_is_filled_from_the_nearest_texel():
    atlas, _ = painted([0.25, 0.25], [0.75, 0.75])
    np.testing.assert_allclose(atlas[32, 2], atlas[32, 16], atol=1)


def test_noise_is_the_same_every_time_and_bounded():
    points = np.random.default_rng(0).normal(size=(50, 3))
    first = textures.noise(points, 0.1, 4)
    np.testing.assert_array_equal(first, textures.noise(points, 0.1, 4))
    assert np.abs(first).max() <= 1 and np.ptp(first) > 0.3
