"""The warp of canonical points: what it does before training, how codes share time, and how Gaussians turn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import rotations
from avatarjax.smad import driving, skeletal
from avatarjax.smad import warp as warps
from avatarjax.smad.warp import WarpConfig
from tests.parameters import random_like
from tests.smad import swaying

# Compiled as a whole these are faster, also for a single call.
positions, move, nearest_turn, to_matrix = map(
    jax.jit, (warps.positions, warps.move, warps.nearest_turn, rotations.to_matrix)
)
pose_points, code_at, bind = jax.jit(skeletal.pose_points), jax.jit(warps.code), jax.jit(skeletal.bind)
TINY = WarpConfig(octaves=2, code=4, knot=4, width=8, layers=2)
POINTS = swaying.doll(40).means


def free(takes=(9, 6), config=TINY, seed=None):
    """A warp without skeleton; with a seed, one that moves things."""
    warp = warps.init(config, takes, None, jax.random.key(0))
    if seed is None:
        return warp
    return warp.replace(network=random_like(warp.network, seed), codes=random_like(warp.codes, seed + 1, 1.0))


def skinned(frames=5, bend=0.8, points=POINTS):
    told = swaying.poses(frames, bend)
    poses = swaying.pose(told, np.arange(frames))
    rig = skeletal.rig_of(told)
    skin = warps.skinning(rig, swaying.pose(told, 1), points, poses)
    return warps.init(TINY, (frames,), skin, jax.random.key(0)), rig, poses


def test_without_a_skeleton_nothing_moves_before_training():
    warp = free()
    for frame in (0, 8, 14):
        np.testing.assert_allclose(positions(warp, POINTS, frame), POINTS, atol=5e-3)


def test_with_a_skeleton_it_is_skinning_before_training():
    warp, rig, poses = skinned()
    canonical = jax.tree.map(lambda x: x[1], poses)
    skin = bind(rig, canonical, POINTS)
    still = warp.replace(network=jax.tree.map(jnp.zeros_like, warp.network))
    for frame in range(5):
        expected = pose_points(skin, jax.tree.map(lambda x, k=frame: x[k], poses))
        np.testing.assert_allclose(positions(still, POINTS, frame), expected, atol=2e-6)
        np.testing.assert_allclose(positions(warp, POINTS, frame), expected, atol=5e-3)
    np.testing.assert_allclose(positions(still, POINTS, 1), POINTS, atol=2e-6)
    assert np.abs(positions(still, POINTS, 2) - POINTS).max() > 0.1


def test_codes_are_linear_between_knots():
    warp = free((9,), seed=3)
    at = [np.asarray(code_at(warp, frame)) for frame in range(9)]
    for knot in range(3):
        np.testing.assert_allclose(at[4 * knot], warp.codes[knot])
    for frame in range(1, 4):
        np.testing.assert_allclose(at[frame], at[0] + frame / 4 * (at[4] - at[0]), atol=1e-6)


@pytest.mark.parametrize("takes", [(9, 6), (1, 1), (4, 5, 8), (10, 2)])
def test_no_frame_depends_on_codes_of_another_take(takes):
    """Which knots a frame's code has a derivative to: those of its take alone, and all knots are of use to some."""
    warp = free(takes, seed=0)
    reach = jax.jit(jax.vmap(jax.jacobian(lambda c, k: warps.code(warp.replace(codes=c), k).sum()), (None, 0)))
    touched = np.asarray(jnp.any(reach(warp.codes, jnp.arange(sum(takes))) != 0, axis=-1))
    sets = [set(np.flatnonzero(part.any(0))) for part in np.split(touched, np.cumsum(takes)[:-1])]
    assert sum(map(len, sets)) == len(set().union(*sets))
    assert (touched.sum(1) <= 2).all() and (touched.sum(1) >= 1).all()
    assert (np.asarray(warp.shares) <= 1).all() and (np.asarray(warp.shares) >= 0).all()


def test_parts_of_the_first_layer_add_up():
    """The split layer is one layer of all inputs, in float64."""
    warp = free(seed=1)
    net, points, code = warp.network, np.float64(POINTS), np.float64(code_at(warp, 6))
    waves = [f(np.pi * 2.0**k * points) for f in (np.sin, np.cos) for k in range(TINY.octaves)]
    inputs = np.concatenate([points, *waves, np.tile(code, (len(points), 1))], axis=1)
    x = inputs @ np.concatenate([net["point"]["kernel"], net["code"]["kernel"]]) + np.float64(net["point"]["bias"])
    hidden = np.maximum(x, 0) @ np.float64(net["layers"][0]["kernel"]) + np.float64(net["layers"][0]["bias"])
    offset = np.maximum(hidden, 0) @ np.float64(net["leave"]["kernel"]) + np.float64(net["leave"]["bias"])
    np.testing.assert_allclose(positions(warp, POINTS, 6), points + TINY.unit * offset, atol=1e-5)


def test_the_nearest_turn_is_that_of_the_polar_decomposition():
    rng = np.random.default_rng(0)
    turns = np.asarray(to_matrix(jnp.asarray(rng.normal(size=(200, 4)), jnp.float32)), np.float64)
    mixed = rng.normal(size=(200, 3, 3))
    matrices = turns @ (mixed @ mixed.swapaxes(1, 2) * 0.1 + np.eye(3))
    u, _, vt = np.linalg.svd(matrices)
    found = to_matrix(nearest_turn(jnp.asarray(matrices, jnp.float32)))
    np.testing.assert_allclose(found, u @ vt, atol=2e-3)
    np.testing.assert_allclose(to_matrix(nearest_turn(jnp.asarray(turns, jnp.float32))), turns, atol=2e-6)


def test_gaussians_turn_with_their_bone():
    """Far down the shin one bone has all the weight; the doll's own upper half stays."""
    points = POINTS.at[:2].set(jnp.asarray([[0.002, -0.35, 0.0], [0.002, 0.3, 0.0]]))
    warp, _, poses = skinned(points=points)
    still = warp.replace(network=jax.tree.map(jnp.zeros_like, warp.network))
    cloud = swaying.doll(40).replace(means=points)
    moved = move(still, cloud, 3)
    bend = poses.rotations[3, 2] @ poses.rotations[1, 2].T
    np.testing.assert_allclose(to_matrix(moved.quats[0]), bend, atol=2e-2)
    np.testing.assert_allclose(to_matrix(moved.quats[1]), np.eye(3), atol=2e-2)


def test_gaussians_turn_with_what_the_network_does():
    """The turn is the nearest to the gradient by finite differences in float64; sizes and colours stay."""
    warp, cloud = free(seed=5), swaying.doll(40)
    warp = warp.replace(network=jax.tree.map(lambda x: 0.7 * x, warp.network))
    moved = move(warp, cloud, 7)
    np.testing.assert_allclose(moved.means, positions(warp, cloud.means, 7), atol=1e-6)
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x, warp)
        steps = 1e-6 * np.eye(3)
        ends = [[positions(wide, jnp.float64(cloud.means) + s * d, 7) for s in (1, -1)] for d in steps[:, None]]
        gradient = np.stack([(a - b) / 2e-6 for a, b in ends], -1)
    u, _, vt = np.linalg.svd(gradient)
    assert (np.linalg.det(gradient) > 0).all() and np.abs(u @ vt - np.eye(3)).max() > 0.05
    np.testing.assert_allclose(to_matrix(moved.quats), u @ vt, atol=2e-3)
    np.testing.assert_array_equal(moved.log_scales, cloud.log_scales)


def test_walking_and_turning_change_nothing_in_the_body_frame():
    warp, rig, poses = skinned()
    yaw = rotations.yaw_matrix(jnp.asarray(1.3))
    elsewhere = poses.replace(
        root_rotation=yaw[None] @ poses.root_rotation, root_translation=poses.root_translation + 2.0
    )
    assert not np.allclose(driving.yaw(elsewhere.root_rotation), driving.yaw(poses.root_rotation))
    again = warps.skinning(rig, jax.tree.map(lambda x: x[1], elsewhere), POINTS, elsewhere)
    np.testing.assert_allclose(again.bones, warp.skinning.bones, atol=1e-6)


def test_gradients_reach_all_that_is_learned():
    warp = free((9,), seed=2)

    def cost(learned, points):
        cloud = warps.move(warp.replace(**learned), swaying.doll(40).replace(means=points), 6)
        return jnp.sum(jnp.sin(7 * cloud.means)) + jnp.sum(cloud.quats**2)

    slopes = jax.jit(jax.grad(cost, (0, 1)))({"network": warp.network, "codes": warp.codes}, POINTS)
    for slope in jax.tree.leaves(slopes):
        assert np.isfinite(slope).all() and np.abs(slope).max() > 0


def test_frames_that_are_not_there_are_refused():
    warp = free((9, 6))
    assert warps.index(warp, 1, 5) == 14
    for take, frame in ((0, 9), (1, -1), (2, 0)):
        with pytest.raises(ValueError, match=rf"take {take} has no frame {frame}: the takes have \(9, 6\)"):
            warps.index(warp, take, frame)
    with pytest.raises(ValueError, match="at least one take of one frame"):
        warps.init(TINY, (3, 0), None, jax.random.key(0))
    with pytest.raises(ValueError, match=r"bones of 5 frames for takes of \(4,\)"):
        warps.init(TINY, (4,), skinned()[0].skinning, jax.random.key(0))
    with pytest.raises(ValueError, match="knot is 0"):
        WarpConfig(knot=0)
