"""The warp of canonical Gaussians: what it does before training, how splines share time, and what moves with what."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline

from avatarjax import rotations
from avatarjax.smad import driving, graph, skeletal
from avatarjax.smad import warp as warps
from tests.smad import swaying

# Compiled as a whole these are faster, also for a single call.
nodes, move, offsets = map(jax.jit, (warps.nodes, warps.move, warps.offsets))
pose_points = jax.jit(skeletal.pose_points)
CLOUD = swaying.doll(80)
NET = graph.of_gaussians(CLOUD, graph.GraphConfig(40, 6))


def free(takes=(9, 6), seed=None, size=0.05):
    """A warp without skeleton; with a seed, one that moves things."""
    warp = warps.init(NET, CLOUD, takes, 4)
    if seed is None:
        return warp
    wild = size * np.random.default_rng(seed).normal(size=warp.offsets.shape)
    return warp.replace(offsets=jnp.asarray(wild, jnp.float32))


def skinned(frames=5, bend=0.8):
    told = swaying.poses(frames, bend)
    poses = swaying.pose(told, np.arange(frames))
    rig = skeletal.rig_of(told)
    return warps.skinned(warps.init(NET, CLOUD, (frames,), 4), rig, swaying.pose(told, 1), poses), rig, poses


def test_without_a_skeleton_nothing_moves_before_training():
    warp = free()
    for frame in (0, 8, 14):
        moved = move(warp, CLOUD, frame)
        np.testing.assert_allclose(moved.means, CLOUD.means, atol=1e-5)
        np.testing.assert_allclose(rotations.to_matrix(moved.quats), np.tile(np.eye(3), (80, 1, 1)), atol=1e-4)


def test_with_a_skeleton_it_is_skinning_before_training():
    warp, rig, poses = skinned()
    skin = skeletal.bind(rig, jax.tree.map(lambda x: x[1], poses), warp.graph.positions)
    for frame in range(5):
        expected = pose_points(skin, jax.tree.map(lambda x, k=frame: x[k], poses))
        np.testing.assert_allclose(nodes(warp, frame), expected, atol=2e-6)
    np.testing.assert_allclose(nodes(warp, 1), warp.graph.positions, atol=2e-6)
    assert np.abs(nodes(warp, 2) - warp.graph.positions).max() > 0.1


def test_offsets_are_those_of_a_cubic_spline():
    """SciPy's of the same control values, with knots at every fourth frame."""
    warp = free((19,), seed=3)
    spline = BSpline(np.arange(-3, len(warp.offsets) + 1), np.asarray(warp.offsets, np.float64), 3)
    for frame in range(19):
        np.testing.assert_allclose(offsets(warp, frame), spline(frame / 4), atol=1e-6)


@pytest.mark.parametrize("takes", [(9, 6), (1, 1), (4, 5, 8), (10, 2)])
def test_no_frame_depends_on_another_take(takes):
    """Which control values a frame has a derivative to: those of its take alone, and all are of use to some frame."""
    warp = free(takes, seed=0)
    reach = jax.jit(jax.vmap(jax.jacobian(lambda c, k: warps.offsets(warp.replace(offsets=c), k)[0, 0]), (None, 0)))
    touched = np.asarray(reach(warp.offsets, jnp.arange(sum(takes)))[:, :, 0, 0]) != 0
    sets = [set(np.flatnonzero(part.any(0))) for part in np.split(touched, np.cumsum(takes)[:-1])]
    assert sum(map(len, sets)) == len(set().union(*sets))
    assert (touched.sum(1) <= 4).all() and (touched.sum(1) >= 3).all()
    assert (np.asarray(warp.shares) <= 1).all() and (np.asarray(warp.shares) >= 0).all()


def test_gaussians_turn_with_their_bone():
    """Far down the shin one bone has all the weight; the doll's own upper half stays."""
    warp, _, poses = skinned()
    moved = move(warp, CLOUD, 3)
    bend = poses.rotations[3, 2] @ poses.rotations[1, 2].T
    low, high = np.argmin(CLOUD.means[:, 1]), np.argmax(CLOUD.means[:, 1])
    np.testing.assert_allclose(rotations.to_matrix(moved.quats[low]), bend, atol=0.05)
    np.testing.assert_allclose(rotations.to_matrix(moved.quats[high]), np.eye(3), atol=0.02)


def test_gaussians_go_where_their_nodes_go():
    warp = free(seed=5)
    shift = jnp.asarray([0.3, -0.1, 0.2])
    pushed = move(warp.replace(offsets=warp.offsets + shift[None, None]), CLOUD, 7)
    moved = move(warp, CLOUD, 7)
    np.testing.assert_allclose(pushed.means, moved.means + shift[None], atol=1e-5)
    np.testing.assert_allclose(pushed.quats, moved.quats, atol=1e-4)
    np.testing.assert_array_equal(moved.log_scales, CLOUD.log_scales)


def test_walking_and_turning_change_nothing_in_the_body_frame():
    warp, rig, poses = skinned()
    yaw = rotations.yaw_matrix(jnp.asarray(1.3))
    elsewhere = poses.replace(
        root_rotation=yaw[None] @ poses.root_rotation, root_translation=poses.root_translation + 2.0
    )
    assert not np.allclose(driving.yaw(elsewhere.root_rotation), driving.yaw(poses.root_rotation))
    again = warps.skinned(warp, rig, jax.tree.map(lambda x: x[1], elsewhere), elsewhere)
    np.testing.assert_allclose(again.skinning.bones, warp.skinning.bones, atol=1e-6)


def test_gradients_reach_all_that_is_learned():
    warp = free((9,), seed=2)

    def cost(learned, means):
        cloud = warps.move(warp.replace(offsets=learned), CLOUD.replace(means=means), 6)
        return jnp.sum(jnp.sin(7 * cloud.means)) + jnp.sum(cloud.quats[:, 1:])

    slopes = jax.jit(jax.grad(cost, (0, 1)))(warp.offsets, CLOUD.means)
    assert all(np.isfinite(slope).all() for slope in slopes)
    # Frame 6 of knots of four lies between the first and the second, so that control values 1 to 4 count.
    assert (np.abs(slopes[0]).max((1, 2)) > 0).tolist() == [False, True, True, True, True]
    assert (np.abs(slopes[1]).max(1) > 0).all()


def test_frames_that_are_not_there_are_refused():
    warp = free((9, 6))
    assert warps.index(warp, 1, 5) == 14
    for take, frame in ((0, 9), (1, -1), (2, 0)):
        with pytest.raises(ValueError, match=rf"take {take} has no frame {frame}: the takes have \(9, 6\)"):
            warps.index(warp, take, frame)
    with pytest.raises(ValueError, match="at least one take of one frame"):
        warps.init(NET, CLOUD, (3, 0), 4)
    _, rig, poses = skinned()
    with pytest.raises(ValueError, match=r"5 poses for takes of \(4,\)"):
        warps.skinned(warps.init(NET, CLOUD, (4,), 4), rig, jax.tree.map(lambda x: x[1], poses), poses)
