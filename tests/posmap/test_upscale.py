import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import posmap


def test_constants_stay_constant(atlas):
    upscaler = posmap.build_upscaler(atlas, 128)
    values = posmap.upscale(upscaler, jnp.full((len(atlas.rows), 2), 0.37))
    np.testing.assert_allclose(values, 0.37, atol=1e-6)


def test_every_texel_becomes_a_block(atlas):
    upscaler = posmap.build_upscaler(atlas, 128)
    assert len(upscaler.rows) == 16 * len(atlas.rows)
    fine = np.zeros((128, 128), bool)
    fine[np.asarray(upscaler.rows), np.asarray(upscaler.cols)] = True
    np.testing.assert_array_equal(fine, np.kron(np.asarray(atlas.mask), np.ones((4, 4), bool)))


def test_inside_one_view_it_is_plain_bilinear_interpolation(atlas):
    """Away from silhouettes the result equals the textbook formula on a linear ramp, which it must reproduce."""
    upscaler = posmap.build_upscaler(atlas, 128)
    ramp = jnp.stack([atlas.rows, atlas.cols], -1).astype(jnp.float32)
    fine = np.asarray(posmap.upscale(upscaler, ramp))
    expected = (np.stack([upscaler.rows, upscaler.cols], -1) + 0.5) / 4 - 0.5
    four_neighbours = (np.asarray(upscaler.weights) > 0).sum(-1).ravel() == 4
    assert four_neighbours.mean() > 0.3
    np.testing.assert_allclose(fine[four_neighbours], expected[four_neighbours], atol=1e-4)


def test_views_never_mix(atlas):
    label = np.zeros((atlas.size, atlas.size), np.float32)
    for k, w in enumerate(posmap.windows(atlas.size)):
        label[w.row : w.row + w.height, w.col : w.col + w.width] = k
    upscaler = posmap.build_upscaler(atlas, 128)
    fine = posmap.upscale(upscaler, posmap.from_map(atlas, jnp.asarray(label)[..., None]))
    distance_to_a_label = np.abs(fine - np.round(fine))
    assert distance_to_a_label.max() < 1e-5


def test_sizes_that_do_not_divide_are_refused(atlas):
    with pytest.raises(ValueError, match="multiple"):
        posmap.build_upscaler(atlas, 100)
