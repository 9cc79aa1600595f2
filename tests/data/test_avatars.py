"""The avatars: proportions, coverage and identity of the dressed mesh."""

import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.data import avatars, skinning


@pytest.fixture(scope="module", params=avatars.names())
def avatar(request):
    return avatars.build(request.param)


def posed(avatar, transforms):
    basis = skinning.skinning_basis(jnp.asarray(avatar.vertices), jnp.asarray(avatar.weights))
    return np.asarray(skinning.skin(basis, transforms))


def test_an_unknown_name_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match="cowgirl"):
        avatars.build("cow")


def test_weights_of_every_vertex_sum_to_one(avatar):
    np.testing.assert_allclose(avatar.weights.sum(1), 1, atol=1e-5)
    assert avatar.weights.min() >= 0
    assert avatar.reach.min() == 0 and avatar.reach.max() > 0.2


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
    assert 12_000 <= len(avatar.vertices) <= 22_000
    assert len(np.unique(avatar.faces)) == len(avatar.vertices)


def test_every_avatar_has_a_texture_of_1024(avatar):
    assert avatar.texture.shape == (1024, 1024, 3)
    assert avatar.texture.reshape(-1, 3).std(0).min() > 10


def test_the_rest_transforms_give_the_rest_mesh(avatar):
    rest = avatars.rest_pose(avatar.rig)
    np.testing.assert_allclose(posed(avatar, rest), avatar.vertices, atol=2e-5)


def test_a_rigid_motion_of_all_bones_is_a_rigid_motion_of_the_mesh(avatar):
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn[:, 0] *= np.linalg.det(turn)
    move = np.concatenate([turn, [[0.3], [-0.2], [2.0]]], axis=1).astype(np.float32)
    transforms = jnp.broadcast_to(move, (len(avatar.rig.names), 3, 4))
    want = avatar.vertices @ turn.T + move[:, 3]
    np.testing.assert_allclose(posed(avatar, transforms), want, atol=1e-4)


def test_the_a_pose_is_about_twice_as_tall_as_wide(avatar):
    extent = np.ptp(posed(avatar, avatars.a_pose(avatar.rig)), axis=0)
    assert 0.3 < extent[0] / extent[1] <= 0.55
    assert 1.4 < extent[1] < 2.1


def test_standing_puts_the_feet_on_the_ground(avatar):
    transforms = avatars.standing_pose(avatar.rig)
    assert float(skinning.sole_points(avatar.rig, transforms)[..., 1].min()) == pytest.approx(0, abs=1e-6)
    assert np.abs(posed(avatar, transforms)[:, [0, 2]].mean(0)).max() < 0.15
