import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from jax.ad_checkpoint import print_saved_residuals

from avatarjax.nets import functional, levels, point_transformer
from avatarjax.nets.point_transformer import (
    PatchAttention,
    PointTransformer,
    PointTransformerConfig,
    Projection,
    VoxelConvolution,
)
from tests.parameters import random_module, random_params

CONFIG = PointTransformerConfig(
    inputs=5,
    encoder_channels=(8, 8, 12),
    encoder_depths=(1, 1, 1),
    encoder_heads=(2, 2, 2),
    strides=(1, 2),
    decoder_channels=(8, 8),
    decoder_depths=(1, 1),
    decoder_heads=(2, 2),
    patch=16,
    grid=16,
    expansion=2,
)
POINTS = 50  # not a multiple of the patch


@pytest.fixture(scope="module")
def params():
    return random_params(PointTransformer, CONFIG)


@pytest.fixture(scope="module")
def cloud():
    """Points in distinct voxels, some of which share one twice as wide, and features."""
    return random_cloud(0)


def random_cloud(seed):
    rng = np.random.default_rng(seed)
    voxel = np.stack(np.unravel_index(rng.choice(6**3, POINTS, replace=False), (6, 6, 6)), -1) + 3
    return jnp.asarray((voxel + 0.5) / 16, jnp.float32), jnp.asarray(rng.normal(size=(POINTS, 5)), jnp.float32)


@functools.partial(jax.jit, static_argnums=0)
def run(config, params, points, features, key=None):
    return functional.bind(PointTransformer, config, params)(points, features, key)


@functools.partial(jax.jit, static_argnums=0)
def gradients(config, params, points, features):
    return jax.grad(lambda p, x: jnp.sum(run(config, p, points, x) ** 2), argnums=(0, 1))(params, features)


@pytest.mark.parametrize("seed", [None, 3])
def test_the_order_of_the_points_does_not_matter(params, cloud, seed):
    key = None if seed is None else jax.random.key(seed)
    shuffled = jax.random.permutation(jax.random.key(1), POINTS)
    expected = run(CONFIG, params, *cloud, key)[shuffled]
    np.testing.assert_allclose(run(CONFIG, params, cloud[0][shuffled], cloud[1][shuffled], key), expected, atol=1e-5)


def test_features_reach_other_points(params, cloud):
    points, features = cloud
    moved = run(CONFIG, params, points, features.at[0].add(1.0)) - run(CONFIG, params, points, features)
    assert (np.abs(moved) > 1e-6).any(1).sum() > POINTS // 4


@pytest.mark.parametrize("count", [1, 33])
def test_any_number_of_points_has_one_output_each(params, cloud, count):
    out = run(CONFIG, params, cloud[0][:count], cloud[1][:count])
    assert out.shape == (count, CONFIG.decoder_channels[0])
    assert np.isfinite(out).all()


def test_points_may_share_a_voxel(params, cloud):
    """Two points at one place with the same features are told the same."""
    points, features = (jnp.concatenate([x, x[:1]]) for x in cloud)
    config = dataclasses.replace(CONFIG, patch=64)
    out = run(config, params, points, features)
    np.testing.assert_allclose(out[-1], out[0], atol=1e-5)


@pytest.mark.parametrize("patch", [16, 48])
def test_room_to_spare_changes_neither_outputs_nor_gradients(params, cloud, patch):
    """With patches that the points of the coarsest level fill, and with one that they do not."""
    points, _ = cloud
    roomy = dataclasses.replace(CONFIG, patch=patch, fill=9.0)
    tight = dataclasses.replace(CONFIG, patch=patch, fill=0.7)
    coarsest = [levels.build(points, c.grid, c.strides, c.fill)[1][-1] for c in (tight, roomy)]
    assert int(coarsest[0].count) < coarsest[0].orders.shape[1] < coarsest[1].orders.shape[1]
    assert int(point_transformer.overflow(tight, points)) == 0
    np.testing.assert_allclose(run(tight, params, *cloud), run(roomy, params, *cloud), atol=1e-5)
    found, expected = (gradients(c, params, *cloud) for c in (tight, roomy))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3), found, expected)


def test_too_little_room_is_counted_and_harms_no_gradient(params, cloud):
    config = dataclasses.replace(CONFIG, fill=0.1)
    assert int(point_transformer.overflow(config, cloud[0])) > 0
    assert np.isfinite(run(config, params, *cloud)).all()
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradients(config, params, *cloud)))


def test_many_clouds_at_once_equal_one_after_the_other(params):
    clouds = [random_cloud(seed) for seed in (0, 1)]
    together = jax.vmap(lambda p, x: run(CONFIG, params, p, x))(*(jnp.stack(x) for x in zip(*clouds, strict=True)))
    for one, cloud in zip(together, clouds, strict=True):
        np.testing.assert_allclose(one, run(CONFIG, params, *cloud), atol=1e-5)


def test_gradients_are_finite_and_reach_every_parameter(params, cloud):
    gradient, to_features = gradients(CONFIG, params, *cloud)
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        assert np.isfinite(leaf).all(), path
        assert np.any(leaf != 0), path
    assert np.isfinite(to_features).all() and (to_features != 0).any(1).all()


def test_a_key_takes_the_curves_in_another_order(params, cloud):
    plain = run(CONFIG, params, *cloud)
    shuffled = [run(CONFIG, params, *cloud, jax.random.key(seed)) for seed in range(3)]
    assert all(np.abs(out - plain).max() > 1e-4 for out in shuffled)
    assert np.abs(shuffled[0] - shuffled[1]).max() > 1e-4


def test_pooling_takes_the_maximum_of_each_voxel(cloud):
    points, _ = cloud
    along_z, (_, fine, coarse) = levels.build(points, CONFIG.grid, CONFIG.strides, 9.0)
    module = random_module(lambda: Projection(5, 7, rngs=nnx.Rngs(0)))
    x = jnp.asarray(np.random.default_rng(1).normal(size=(POINTS, 5)), jnp.float32)
    voxel = np.floor(np.asarray(points[along_z]) * 8).astype(int)
    _, cluster = np.unique(voxel, axis=0, return_inverse=True)
    expected = np.stack([np.asarray(module.linear(x))[cluster == c].max(0) for c in range(int(coarse.count))])
    # NumPy's clusters go by x, y, z, ours along the z curve: a point of each says which is which.
    first = np.array([np.flatnonzero(np.asarray(fine.parent) == c)[0] for c in range(int(coarse.count))])
    found = jax.jit(module)(x, fine, coarse)
    np.testing.assert_allclose(
        found[: int(coarse.count)], jax.nn.gelu(module.norm(expected[cluster[first]])), rtol=1e-4, atol=1e-5
    )


def test_the_convolution_sees_the_mean_of_the_points_of_a_voxel():
    points = jnp.asarray([[0.1, 0.1, 0.1], [0.11, 0.1, 0.1], [0.9, 0.1, 0.1]])
    _, (level, _, _) = levels.build(points, CONFIG.grid, CONFIG.strides, 9.0)
    module = random_module(lambda: VoxelConvolution(4, rngs=nnx.Rngs(0)))
    x = jnp.asarray(np.random.default_rng(1).normal(size=(3, 4)), jnp.float32)
    expected = jnp.stack([x[:2].mean(0), x[2]]) @ module.kernel[...][13] + module.bias[...][None]
    np.testing.assert_allclose(jax.jit(module)(x, level)[:2], expected, atol=1e-5)


@pytest.mark.parametrize("count, room", [(3, 3), (11, 11), (11, 19), (3, 9), (4, 8)])
def test_attention_stays_inside_patches_and_the_last_one_borrows(count, room):
    """Against a loop: patches of 4 along the order, the last one over the last points, whose values it gives."""
    module = random_module(lambda: PatchAttention(8, 2, 4, rngs=nnx.Rngs(0)))
    rng = np.random.default_rng(count)
    x = jnp.asarray(rng.normal(size=(room, 8)), jnp.float32)
    order = jnp.asarray(np.append(rng.permutation(count), np.arange(count, room)))
    y, expected = x[order], jnp.zeros((count, 8))
    for start in range(0, count, 4):
        last = min(start + 4, count)
        seen = module.attention(y[None, max(last - 4, 0) : last])[0]
        expected = expected.at[start:last].set(seen[start - last :])
    found = jax.jit(module)(x, jnp.asarray(count), order, jnp.argsort(order))
    np.testing.assert_allclose(found[order][:count], expected, atol=1e-5)


def test_tuples_of_the_wrong_length_are_refused():
    with pytest.raises(ValueError, match="2 encoder stages need 2 entries"):
        PointTransformerConfig(encoder_channels=(8, 16), encoder_depths=(1,))


@pytest.mark.parametrize("stride", [0, 3])
def test_strides_that_are_no_powers_of_two_are_refused(stride):
    with pytest.raises(ValueError, match="strides must be powers of two"):
        PointTransformerConfig(strides=(1, 2, 2, stride))


def test_a_grid_too_fine_for_its_codes_is_refused():
    with pytest.raises(ValueError, match=r"2 to 1024 voxels an edge.*not 2000"):
        PointTransformerConfig(grid=2000)


def test_the_papers_network_has_46_million_parameters():
    """PTv3 gives 46.2 million for these sizes; its stem and head are a convolution and a classifier."""
    count = functional.count(functional.shapes(PointTransformer, PointTransformerConfig()))
    print(f"paper point transformer: {count / 1e6:.2f} million parameters")
    assert 45e6 < count < 47e6


def test_recomputed_attention_has_the_same_gradients(params, cloud):
    kept = dataclasses.replace(CONFIG, recompute=False)
    again = dataclasses.replace(CONFIG, recompute=True)
    for a, b in zip(*(jax.tree.leaves(gradients(c, params, *cloud)) for c in (kept, again)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("recompute", [False, True])
def test_recomputed_attention_keeps_no_weights(recompute, capsys):
    attention = PatchAttention(8, 2, 32, recompute, rngs=nnx.Rngs(0))
    order = jnp.arange(96)
    print_saved_residuals(lambda x: attention(x, jnp.asarray(96), order, order), jnp.ones((96, 8)))
    assert ("32,32]" in capsys.readouterr().out) is not recompute
