import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from avatarjax.nets import functional
from avatarjax.nets.point_transformer import Block, CurveConvolution, PointTransformer, PointTransformerConfig
from tests.parameters import random_module, random_params

CONFIG = PointTransformerConfig(
    inputs=5,
    encoder_channels=(8, 12),
    encoder_depths=(1, 1),
    encoder_heads=(2, 2),
    strides=(2,),
    decoder_channels=(8,),
    decoder_depths=(1,),
    decoder_heads=(2,),
    patch=16,
    grid=16,
    expansion=2,
)
POINTS = 50  # neither a multiple of the patch nor of the pooled group


@pytest.fixture(scope="module")
def params():
    return random_params(PointTransformer, CONFIG)


@pytest.fixture(scope="module")
def cloud():
    """Points in distinct voxels, and features."""
    rng = np.random.default_rng(0)
    voxel = np.stack(np.unravel_index(rng.choice(16**3, POINTS, replace=False), (16, 16, 16)), -1)
    return jnp.asarray((voxel + 0.5) / 16, jnp.float32), jnp.asarray(rng.normal(size=(POINTS, 5)), jnp.float32)


@functools.partial(jax.jit, static_argnums=0)
def run(config, params, points, features):
    return functional.bind(PointTransformer, config, params)(points, features)


def test_the_order_of_the_points_does_not_matter(params, cloud):
    shuffled = jax.random.permutation(jax.random.key(1), POINTS)
    expected = run(CONFIG, params, *cloud)[shuffled]
    np.testing.assert_allclose(run(CONFIG, params, cloud[0][shuffled], cloud[1][shuffled]), expected, atol=1e-5)


def test_features_reach_other_points(params, cloud):
    points, features = cloud
    moved = run(CONFIG, params, points, features.at[0].add(1.0)) - run(CONFIG, params, points, features)
    assert (np.abs(moved) > 1e-6).any(1).sum() > POINTS // 4


@pytest.mark.parametrize("count", [3, 16, 33])
def test_any_number_of_points_has_one_output_each(params, cloud, count):
    shape = jax.eval_shape(lambda p, f: run(CONFIG, params, p, f), cloud[0][:count], cloud[1][:count]).shape
    assert shape == (count, CONFIG.decoder_channels[0])


def test_gradients_are_finite_and_reach_every_parameter(params, cloud):
    gradient = jax.jit(jax.grad(lambda p: jnp.sum(run(CONFIG, p, *cloud) ** 2)))(params)
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        assert np.isfinite(leaf).all(), path
        assert np.any(leaf != 0), path


def test_curve_convolution_equals_numpys_in_every_channel():
    module = random_module(lambda: CurveConvolution(3, rngs=nnx.Rngs(0)))
    x = np.random.default_rng(0).normal(size=(9, 3))
    kernel, bias = np.asarray(module.kernel[...]), np.asarray(module.bias[...])
    expected = [np.convolve(x[:, c], kernel[::-1, c], mode="same") + bias[c] for c in range(3)]
    np.testing.assert_allclose(module(jnp.asarray(x, jnp.float32)), np.stack(expected, -1), atol=1e-5)


@pytest.mark.parametrize("count", [3, 11])
def test_attention_stays_inside_patches_and_the_last_one_is_moved_back(count):
    """Against a loop: patches of 4 along the order, the last one over the last points, whose values it gives."""
    block = random_module(lambda: Block(8, 2, 4, 2, rngs=nnx.Rngs(0)))
    rng = np.random.default_rng(count)
    x = jnp.asarray(rng.normal(size=(count, 8)), jnp.float32)
    order = jnp.asarray(rng.permutation(count))

    @jax.jit
    def by_hand(x):
        patches = -(-count // 4)
        size = -(-count // patches)
        y = x[order]
        y = y + block.position(y)
        tokens, attended = block.norm1(y), jnp.zeros_like(y)
        for k in range(patches):
            start = min(k * size, count - size)
            attended = attended.at[start : start + size].set(block.attention(tokens[None, start : start + size])[0])
        y = y + attended
        return y + block.down(jax.nn.gelu(block.up(block.norm2(y))))

    np.testing.assert_allclose(jax.jit(block)(x, order)[order], by_hand(x), atol=1e-5)


def test_tuples_of_the_wrong_length_are_refused():
    with pytest.raises(ValueError, match="2 encoder stages need 2 entries"):
        PointTransformerConfig(encoder_channels=(8, 16), encoder_depths=(1,))


def test_the_papers_network_has_14_million_parameters():
    """PTv3 has 46 million; attention and MLPs are 14 of them, the rest its sparse convolutions, which ours replaces."""
    count = functional.count(functional.shapes(PointTransformer, PointTransformerConfig()))
    print(f"paper point transformer: {count / 1e6:.1f} million parameters")
    assert 13e6 < count < 15e6
