"""Image quality of an avatar against pictures whose answer is known: those it drew itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import posmap, unica
from avatarjax.data.dataset import Images, cardinal_cameras, cylinder_cameras
from avatarjax.unica import image_quality
from avatarjax.unica.avatar import in_box, wear_base
from avatarjax.unica.forecast import state_at
from tests.unica.test_photometric import untrained_network

SIZE = 32


def opaque(pictures):
    """Pictures (..., h, w, 3) in [0, 1] as straight-alpha files keep them."""
    rgb = np.round(255 * np.asarray(pictures)).astype(np.uint8)
    return np.concatenate([rgb, np.full_like(rgb[..., :1], 255)], axis=-1)


@pytest.fixture(scope="module")
def one(avatars):
    return avatars["coefficients"]


@pytest.fixture(scope="module")
def frames(one):
    """A short rollout with Gaussians."""
    return jax.jit(unica.rollout)(one, unica.reset(one, jax.random.key(0)), jnp.asarray([1, 1, 1]))[1]


def test_a_video_shows_every_frame_from_four_sides(one, frames):
    video = image_quality.video(one, frames.gaussians, frames.root, SIZE)
    assert video.shape == (4, 3, SIZE, SIZE, 3) and video.dtype == np.uint8
    assert ((video > 0).any(-1).mean((2, 3)) > 0.02).all(), "there is a figure in every picture"


def test_the_cameras_follow_along_the_ground(one, frames):
    """Wherever it runs a figure looks the same; when it jumps it moves in the picture."""

    def moved(by):
        by = jnp.asarray(by)
        shifted = frames.gaussians.replace(means=frames.gaussians.means + by[:, None])
        return image_quality.video(one, shifted, frames.root + by, SIZE).astype(int)

    before = image_quality.video(one, frames.gaussians, frames.root, SIZE).astype(int)
    assert np.abs(moved([[3.0, 0.0, -2.0]]) - before).mean() < 0.05
    assert np.abs(moved([[0.0, 0.5, 0.0]]) - before).mean() > 1


def test_its_own_pictures_are_the_best_there_are(one, tiny_data):
    """Drawn by hand from known poses, with the appearance network and without."""
    images = tiny_data.train_images
    plain = image_quality.appearance_quality(one, images, refined=False)
    refined = image_quality.appearance_quality(one, images)
    assert plain.psnr.shape == images.view.shape == refined.ssim.shape and plain.lpips is None
    assert np.abs(plain.psnr - refined.psnr).max() > 0.01, "the network changes something"

    cameras = cylinder_cameras(SIZE)
    splat = image_quality._splat_config(one, images.texels[0], cameras)

    def own(texels, views):
        texels = jnp.asarray(texels)
        box = posmap.bounding_box(posmap.upscale(one.upscaler, texels))
        cloud = in_box(wear_base(one, texels), box)
        return image_quality._draw(cloud, jax.tree.map(lambda x: x[views], cameras), splat)

    drawn = opaque([own(t, v) for t, v in zip(images.texels, images.view, strict=True)])
    found = image_quality.appearance_quality(one, Images(images.texels, images.view, drawn), refined=False)
    assert found.psnr.min() > 50 and found.ssim.min() > 0.999


def test_the_next_frame_is_made_from_the_three_before_and_the_key(one, tiny_data):
    truth, key = tiny_data.truth, jax.random.key(4)
    chosen = np.array([3, 7])
    splat = image_quality._splat_config(one, np.asarray(one.standing), cardinal_cameras(SIZE))
    pictures = np.zeros((8, 4, SIZE, SIZE, 4), np.uint8)
    for k, own in zip(chosen, jax.random.split(key, 2), strict=True):
        known = jnp.asarray(truth.texels[k - 3 : k]), jnp.asarray(truth.roots[k - 3 : k])
        frame = unica.step(one, state_at(one, *known, own), int(truth.actions[k - 1]))[1]
        place = jnp.asarray(truth.roots[k])
        seen = image_quality._draw(image_quality._seen_from(frame.gaussians, place), cardinal_cameras(SIZE), splat)
        pictures[k] = opaque(seen)
    found = image_quality.next_frame_quality(one, truth, pictures, chosen, key)
    assert found.psnr.shape == (2, 4) and found.psnr.min() > 45
    other = image_quality.next_frame_quality(one, truth, pictures[::-1], chosen[:1], key)
    assert other.psnr.max() < found.psnr.min()
    with pytest.raises(ValueError, match="frames must be from 3 to 7, got 2 to 3"):
        image_quality.next_frame_quality(one, truth, pictures, np.array([2, 3]), key)


def test_the_truth_is_shown_like_the_avatar():
    pictures = np.random.default_rng(0).integers(0, 256, (5, 4, 16, 16, 4)).astype(np.uint8)
    video = image_quality.truth_video(pictures)
    assert video.shape == (4, 5, 16, 16, 3)
    expected = pictures[3, 2, ..., :3] / 255 * pictures[3, 2, ..., 3:] / 255
    np.testing.assert_allclose(video[2, 3] / 255, expected, atol=0.6 / 255)


def test_lpips_comes_with_its_network(one, tiny_data):
    images = tiny_data.train_images
    found = image_quality.appearance_quality(one, images, untrained_network(), refined=False)
    assert found.lpips.shape == images.view.shape and (found.lpips > 0).all()
    expected = image_quality.appearance_quality(one, images, refined=False)
    np.testing.assert_allclose(found.psnr, expected.psnr, rtol=1e-5)
