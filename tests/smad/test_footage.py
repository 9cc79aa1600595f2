"""Takes as one series: what shrinking keeps, where cameras then look, and which takes do not go together."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import cameras
from avatarjax.smad import driving, footage, views
from tests.smad import swaying, turning


@pytest.fixture(scope="module")
def film():
    return turning.video(frames=8, size=30)


def test_pictures_are_kept_as_they_are_inside_of_the_mask(film):
    takes = footage.gather([film])
    np.testing.assert_array_equal(takes.rgba[..., 3], 255 * film.masks)
    np.testing.assert_array_equal(takes.rgba[..., :3], film.images() * film.masks[..., None])
    half = dataclasses.replace(film, mattes=np.where(film.masks, 128, 0).astype(np.uint8))
    rgba = footage.gather([half]).rgba
    np.testing.assert_array_equal(rgba[..., 3], half.mattes)
    np.testing.assert_allclose(rgba[..., :3], film.images() * (half.mattes[..., None] / 255), atol=0.51)
    assert takes.rgba.dtype == np.uint8 and takes.takes == (8,) and takes.rig is None


def test_shrinking_takes_means_of_blocks(film):
    takes = footage.gather([film], shrink=4)
    whole = np.concatenate([film.images() * film.masks[..., None], 255 * film.masks[..., None]], -1).astype(float)
    blocks = whole[:, :28, :28].reshape(8, 7, 4, 7, 4, 4).mean((2, 4))
    assert takes.rgba.shape == (8, 7, 7, 4)
    np.testing.assert_allclose(takes.rgba, blocks, atol=0.51)


def test_a_point_lies_in_the_pixel_that_holds_its_old_one(film):
    """Pixel k of the small picture is made of old ones from s k to s (k + 1), in coordinates that begin at a corner."""
    takes = footage.gather([film], shrink=3)
    points = jnp.asarray([[0.1, 0.2, 0.1], [-0.2, -0.4, 0.0]])
    for frame, seen in enumerate(jax.tree.map(np.asarray, views.of_video(film, np.arange(8))).world_to_camera):
        old = film.camera.replace(world_to_camera=seen)
        new = jax.tree.map(lambda x, k=frame: x[k], takes.cameras)
        assert (new.width, new.height) == (10, 10)
        (found, _), (expected, _) = cameras.project(new, points), cameras.project(old, points)
        np.testing.assert_allclose(found, expected / 3, rtol=1e-5)


def test_takes_follow_each_other(film):
    other = turning.video(frames=4, size=30, sway=0.2)
    takes = footage.gather([film, turning.moving_camera(other)])
    assert (
        takes.takes == (8, 4) and len(takes.rgba) == len(takes.cameras.intrinsics) == len(takes.poses.rotations) == 12
    )
    np.testing.assert_array_equal(takes.rgba[8:], footage.gather([other]).rgba)
    np.testing.assert_allclose(takes.pose(1, 2).root_rotation, other.poses.root_rotation[2])
    assert isinstance(takes.pose(0, 0), driving.Pose)


def test_every_fifth_frame_of_a_take_is_held_out(film):
    takes = footage.gather([film, turning.video(frames=4, size=30)])
    assert np.flatnonzero(takes.held_out).tolist() == [2, 7, 8 + 2]


@pytest.fixture(scope="module")
def jointed(film):
    return dataclasses.replace(film, poses=swaying.poses(8))


def test_a_skeleton_is_kept(jointed):
    rig = footage.gather([jointed]).rig
    assert rig is not None and rig.parents == swaying.PARENTS


def changed(film, **poses):
    return dataclasses.replace(film, poses=dataclasses.replace(film.poses, **poses))


def test_takes_that_do_not_go_together_are_refused(film, jointed):
    moved = swaying.JOINTS + np.float32([[0], [0], [0.02], [0]])
    cases = {
        "no takes": [],
        r"sizes \[\(12, 12\), \(30, 30\)\]": [film, turning.video(frames=2, size=12)],
        "all 3 masks of take 1 are empty": [film, turning.video(frames=3, size=30, empty=True)],
        "take 0 has no frames": [dataclasses.replace(film, mattes=film.mattes[:0])],
        "take 0 has 8 pictures and 6 masks": [dataclasses.replace(film, mattes=film.mattes[:6])],
        "take 1 has 4 joints, placed, the first 1, not placed": [film, jointed],
        "take 1 has 4 joints, not placed, the first 4, placed": [jointed, changed(jointed, joints=None)],
        "the skeleton of take 1 is not that of the first": [jointed, changed(jointed, joints=moved)],
    }
    for message, videos in cases.items():
        with pytest.raises(ValueError, match=message):
            footage.gather(videos)
    for shrink, message in ((0, "shrink is 0"), (31, "shrink 31 leaves nothing")):
        with pytest.raises(ValueError, match=message):
            footage.gather([film], shrink)


def test_a_picture_stands_before_its_background():
    rgba = np.zeros((2, 3, 4, 4), np.uint8)
    rgba[1] = [51, 102, 0, 127.5]
    found = footage.over(jnp.asarray(rgba), jnp.array([0.2, 0.4, 1.0]))
    np.testing.assert_allclose(found[0], np.broadcast_to([0.2, 0.4, 1.0], (3, 4, 3)), atol=1e-6)
    clear = 1 - 127 / 255
    np.testing.assert_allclose(found[1, 0, 0], [0.2 + 0.2 * clear, 0.4 + 0.4 * clear, clear], atol=1e-6)


def test_there_is_room_for_the_frame_that_needs_most():
    video, _ = swaying.take(frames=10, skeleton=False)
    takes, cloud = footage.gather([video]), swaying.doll()
    larger = cloud.replace(log_scales=cloud.log_scales + 1)

    def room(*fat, growth=1):
        return footage.room(takes, lambda k: larger if k in fat else cloud, [3, 4], growth).capacity

    assert room(4) == room(3) > room() > 0
    assert room(7) == room() and room(growth=2) == 2 * room()
