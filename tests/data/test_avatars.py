"""The avatars: proportions, coverage and identity of the dressed mesh."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.data import avatars


@pytest.fixture(scope="module", params=avatars.names())
def avatar(request):
    return avatars.build(request.param)


def test_an_unknown_name_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match="cowgirl"):
        avatars.build("cow")


def test_the_a_pose_is_about_twice_as_tall_as_wide(avatar):
    extent = np.ptp(avatars.a_pose(avatar), axis=0)
    assert 0.3 < extent[0] / extent[1] <= 0.5
    assert 1.4 < extent[1] < 2.1


def test_weights_of_every_vertex_sum_to_one(avatar):
    np.testing.assert_allclose(avatar.weights.sum(1), 1, atol=1e-5)
    assert avatar.weights.min() >= 0
    assert avatar.lag.min() >= 0 and avatar.lag.max() <= 1


def test_uvs_are_inside_the_texture(avatar):
    assert avatar.uvs.min() >= 0 and avatar.uvs.max() <= 1
    assert avatar.uvs.shape == (*avatar.faces.shape, 2)


def test_parts_do_not_share_texels(avatar):
    boxes = [avatar.uvs[avatar.parts == k].reshape(-1, 2) for k in range(len(avatar.part_names))]
    boxes = [(b.min(0), b.max(0)) for b in boxes]
    for i, (low, high) in enumerate(boxes):
        for other_low, other_high in boxes[:i]:
            assert (low >= other_high).any() or (other_low >= high).any()


def test_the_mesh_is_of_a_size_that_trains_on_a_cpu(avatar):
    assert 12_000 <= len(avatar.vertices) <= 18_000
    assert len(np.unique(avatar.faces)) == len(avatar.vertices)


def test_the_rest_transforms_give_the_rest_mesh(avatar):
    rest = np.broadcast_to(np.eye(3, 4, dtype=np.float32), (1, len(avatar.rig.names), 3, 4))
    np.testing.assert_allclose(avatars.pose_vertices(avatar, rest, rest)[0], avatar.vertices, atol=2e-5)


def test_a_rigid_motion_of_all_bones_is_a_rigid_motion_of_the_mesh(avatar):
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn[:, 0] *= np.linalg.det(turn)
    move = np.concatenate([turn, [[0.3], [-0.2], [2.0]]], axis=1).astype(np.float32)
    transforms = np.broadcast_to(move, (1, len(avatar.rig.names), 3, 4))
    want = avatar.vertices @ turn.T + move[:, 3]
    np.testing.assert_allclose(avatars.pose_vertices(avatar, transforms, transforms)[0], want, atol=1e-4)


def test_chunks_do_not_change_the_poses(avatar):
    noise = 0.01 * jax.random.normal(jax.random.key(0), (131, len(avatar.rig.names), 3, 4))
    transforms = noise + jnp.eye(3, 4)[None, None]
    whole = avatars.pose_vertices(avatar, transforms, transforms)
    last = avatars.pose_vertices(avatar, transforms[-1:], transforms[-1:])
    np.testing.assert_allclose(whole[-1], last[0], atol=1e-5)


def test_standing_puts_the_feet_on_the_ground(avatar):
    standing = avatars.standing_pose(avatar)
    assert standing[:, 1].min() == pytest.approx(0, abs=1e-6)
    assert np.abs(standing[:, [0, 2]].mean(0)).max() < 0.15
