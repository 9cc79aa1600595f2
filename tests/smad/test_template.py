"""The body template: it lies inside the clothes, wears the colours of the pictures, and needs its own skeleton."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import cameras, rotations
from avatarjax.data import body as bodies
from avatarjax.data import capture, skinning
from avatarjax.data.motion import performances
from avatarjax.data.recording import MonocularVideo
from avatarjax.smad import driving, template
from avatarjax.smad.template import TemplateConfig
from tests.smad import swaying

MACRO = {"caucasian-male-young": 1.0, "universal-male-young-maxmuscle-averageweight": 0.4}
FRAMES = 12
RED, BLUE = np.array([220, 40, 30]), np.array([20, 60, 210])


@pytest.fixture(scope="module")
def person():
    """The naked body itself, which turns: its vertices in the world, and a film in which its skin is not seen at all:
    all that is lower than its hips is blue, the rest red."""
    body = bodies.load_body()
    vertices, rig = bodies.shape(body, MACRO)
    whole = performances.perform(rig, "turn", 0)
    motion = jax.device_get(jax.tree.map(lambda x: x[:: len(whole.headings) // FRAMES][:FRAMES], whole))
    basis = skinning.skinning_basis(jnp.asarray(vertices), jnp.asarray(body.skin_weights))
    skin = np.unique(body.faces[body.parts == body.groups.index("body")])
    moved = np.asarray(jax.vmap(lambda t: skinning.skin(basis, t))(jnp.asarray(motion.transforms)))[:, skin]
    camera = cameras.look_at((0, 1, 4.5), (0, 0.9, 0), width=64, height=64, fov_y=0.6)
    low = (np.mgrid[:64, :64][0] + 0.5)[..., None] > float(
        cameras.project(camera, jnp.asarray(motion.hips[:1], jnp.float32))[0][0, 1]
    )
    pictures = np.broadcast_to(np.where(low, BLUE, RED), (FRAMES, 64, 64, 3)).astype(np.uint8)
    poses = capture.poses_of(rig, motion)
    video = MonocularVideo(
        Path("."), np.full((FRAMES, 64, 64), 255, np.uint8), camera, poses, 30.0, lambda: iter(pictures)
    )
    return video, moved


def test_it_is_the_body_of_the_first_frame_in_the_body_frame(person):
    video, moved = person
    pose = jax.tree.map(lambda x: x[0], driving.recorded(video.poses))
    vertices, faces = template.posed(video)
    np.testing.assert_allclose(vertices, driving.to_body(pose, jnp.asarray(moved[0])), atol=2e-3)
    assert faces.max() == len(vertices) - 1


def test_a_camera_that_is_turned_with_the_world_changes_nothing(person):
    """The body frame knows no heading."""
    video, _ = person
    turn = np.asarray(rotations.yaw_matrix(jnp.asarray(1.0)))
    poses = dataclasses.replace(
        video.poses,
        root_rotation=(turn @ video.poses.root_rotation).astype(np.float32),
        root_translation=(video.poses.root_translation @ turn.T).astype(np.float32),
    )
    turned = template.posed(dataclasses.replace(video, poses=poses))[0]
    np.testing.assert_allclose(turned, template.posed(video)[0], atol=1e-5)


def test_gaussians_lie_on_the_body_and_wear_what_is_seen_of_it(person):
    video, _ = person
    cloud = template.initialise(video, TemplateConfig(points=8000, gaussians=600))
    assert 500 < len(cloud) < 700
    vertices, _ = template.posed(video)
    apart = np.linalg.norm(np.asarray(cloud.means)[:, None] - vertices[None, ::3], axis=-1).min(1)
    assert np.quantile(apart, 0.9) < 0.03
    height = np.asarray(cloud.means)[:, 1]
    for here, color in ((height > 0.1, RED), (height < -0.1, BLUE)):
        assert np.abs(np.asarray(cloud.colors)[here] - color / 255).mean() < 0.03


def box():
    import trimesh

    mesh = trimesh.creation.box((1.0, 2.0, 4.0))
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def test_points_are_spread_by_area_with_normals_that_point_out():
    points, normals = template.sample(*box(), 6000)
    np.testing.assert_allclose(np.abs(points / [0.5, 1.0, 2.0]).max(1), 1, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)
    np.testing.assert_allclose((normals * points / [0.5, 1.0, 2.0]).sum(1), 1, atol=1e-9)
    shares = np.abs(normals).mean(0)
    np.testing.assert_allclose(shares, np.array([8, 4, 2]) / 14, atol=0.02)


def test_the_same_points_come_every_time():
    np.testing.assert_array_equal(template.sample(*box(), 50)[0], template.sample(*box(), 50)[0])


def test_a_skeleton_that_is_not_the_bodys_is_refused():
    film, _ = swaying.take(frames=4, skeleton=True)
    with pytest.raises(ValueError, match="are not those of the body, Hips"):
        template.initialise(film)
    bare, _ = swaying.take(frames=4, skeleton=False)
    with pytest.raises(ValueError, match="without joints and parents"):
        template.posed(bare)


@pytest.mark.parametrize("changes, message", [({"opacity": 1.0}, "opacity 1.0"), ({"points": 3}, "points is 3")])
def test_wrong_sizes_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        TemplateConfig(**changes)
