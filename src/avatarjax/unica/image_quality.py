"""How much renders of an avatar look like pictures of the meshes it learned from, all seen over black.

Three questions: its appearance alone, on poses it is given (`appearance_quality`); the next frame as UNICA 4.2 asks,
from three true frames and the key (`next_frame_quality`); and the video of a rollout (`video`, for
`avatarjax.metrics.fvd`).
"""

from __future__ import annotations

import dataclasses
import functools
import typing
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, UInt8
from tqdm import tqdm

from avatarjax import posmap
from avatarjax.cameras import Camera
from avatarjax.data.dataset import Images, cardinal_cameras, cylinder_cameras
from avatarjax.data.sequences import Recording
from avatarjax.gaussians import Gaussians
from avatarjax.metrics import image, lpips
from avatarjax.splat import SplatConfig, render
from avatarjax.unica import appearance, photometric
from avatarjax.unica.avatar import Avatar, in_box, wear, wear_base
from avatarjax.unica.forecast import state_at
from avatarjax.unica.rollout import step
from avatarjax.unica.train_appearance import boxed_points

CONTEXT = 3


class Quality(typing.NamedTuple):
    """Of every picture (p, k): PSNR in dB, SSIM, and LPIPS, or None without the network's weights."""

    psnr: Float[np.ndarray, "p k"]
    ssim: Float[np.ndarray, "p k"]
    lpips: Float[np.ndarray, "p k"] | None


def appearance_quality(
    avatar: Avatar, images: Images, perceptual: lpips.Network | None = None, *, refined: bool = True
) -> Quality:
    """Of pictured poses (p) in k views each, with the appearance network or with base attributes alone."""
    drawn = _pose_renderer(avatar, images, refined)
    poses = zip(images.texels, images.view, images.rgba, strict=True)
    return _judge(((drawn(x, v), truth) for x, v, truth in poses), perceptual, len(images.texels))


def beside_truth(avatar: Avatar, images: Images, pose: int) -> UInt8[np.ndarray, "h w 3"]:
    """Two views of a pictured pose, each render with the picture of the mesh on its right."""
    drawn = _pose_renderer(avatar, images, True)(images.texels[pose], images.view[pose, :2])
    pairs = zip(drawn, photometric.over(images.rgba[pose, :2], 0.0), strict=True)
    strip = jnp.concatenate([x for pair in pairs for x in pair], axis=1)
    return np.asarray(jnp.round(255 * strip), np.uint8)


def _pose_renderer(avatar: Avatar, images: Images, refined: bool):
    """A function from texels (t, 3) of a pose and ids of views (k,) to renders (k, h, w, 3) over black."""
    cameras = cylinder_cameras(images.rgba.shape[-2])
    splat = _splat_config(avatar, images.texels[0], cameras)

    def drawn(texels, views):
        return _posed(avatar, jnp.asarray(texels), photometric.pick_views(cameras, views), refined, splat)

    return drawn


@functools.partial(jax.jit, static_argnames=("refined", "splat"))
def _posed(
    avatar: Avatar, texels: Float[Array, "t 3"], views: Camera, refined: bool, splat: SplatConfig
) -> Float[Array, "k h w 3"]:
    cloud = wear(avatar, texels) if refined else wear_base(avatar, texels)
    box = posmap.bounding_box(posmap.upscale(avatar.upscaler, texels))
    return _draw(in_box(cloud, box), views, splat)


def untrained_base(avatar: Avatar, images: Images) -> Avatar:
    """The avatar with the base attributes from which its base stage started on the standing pose's pictures."""
    points, side = boxed_points(avatar.upscaler, jnp.asarray(images.texels[0]))
    return avatar.replace(base=appearance.initial_base(points, side))


def next_frame_quality(
    avatar: Avatar,
    recording: Recording,
    pictures: UInt8[np.ndarray, "f v h w 4"],
    frames: Int[np.ndarray, "g"],
    key: Key[Array, ""],
    perceptual: lpips.Network | None = None,
) -> Quality:
    """Of the frames of these numbers (at least 3), each made from the three true frames before it (UNICA 4.2).

    `pictures` show the first frames of the recording from `data.dataset.cardinal_cameras` that follow its root. The
    cameras stay there: an avatar in the wrong place is a wrong picture.
    """
    if frames.min() < CONTEXT or frames.max() >= len(pictures):
        raise ValueError(f"frames must be from {CONTEXT} to {len(pictures) - 1}, got {frames.min()} to {frames.max()}")
    cameras = cardinal_cameras(pictures.shape[2])
    splat = _splat_config(avatar, np.asarray(avatar.standing), cameras)

    @jax.jit
    def drawn(avatar, texels, roots, action, key, place):
        frame = step(avatar, state_at(avatar, texels, roots, key), action)[1]
        return _draw(_seen_from(frame.gaussians, place), cameras, splat)

    def all_drawn():
        for k, one in zip(frames, jax.random.split(key, len(frames)), strict=True):
            known = slice(k - CONTEXT, k)
            inputs = recording.texels[known], recording.roots[known], recording.actions[k - 1]
            yield drawn(avatar, *map(jnp.asarray, inputs), one, jnp.asarray(recording.roots[k])), pictures[k]

    return _judge(all_drawn(), perceptual, len(frames))


def video_quality(
    video: UInt8[np.ndarray, "v f h w 3"],
    pictures: UInt8[np.ndarray, "f v h w 4"],
    frames: Int[np.ndarray, "g"],
    perceptual: lpips.Network | None = None,
) -> Quality:
    """Of these frames of a video, as `video` makes it, of the very motion that is pictured."""
    pairs = ((jnp.asarray(video[:, k] / np.float32(255)), pictures[k]) for k in frames)
    return _judge(pairs, perceptual, len(frames))


def video(
    avatar: Avatar, gaussians: Gaussians, roots: Float[Array | np.ndarray, "f 3"], size: int
) -> UInt8[np.ndarray, "v f h w 3"]:
    """World Gaussians of f frames from the four cardinal views, the cameras following the root, over black."""
    cameras = cardinal_cameras(size)
    splat = _splat_config(avatar, np.asarray(avatar.standing), cameras)

    @jax.jit
    def drawn(gaussians, root):
        return jnp.round(255 * _draw(_seen_from(gaussians, root), cameras, splat)).astype(jnp.uint8)

    each = (jax.tree.map(lambda x, k=k: jnp.asarray(x[k]), (gaussians, roots)) for k in _bar(roots))
    return np.stack([np.asarray(drawn(*inputs)) for inputs in each], axis=1)


def truth_video(pictures: UInt8[np.ndarray, "f v h w 4"]) -> UInt8[np.ndarray, "v f h w 3"]:
    """The pictures of the meshes as `video` shows the avatar."""
    over_black = [np.asarray(jnp.round(255 * photometric.over(x, 0.0)), np.uint8) for x in pictures]
    return np.stack(over_black, axis=1)


def _bar(frames: typing.Any) -> typing.Any:
    return tqdm(range(len(frames)), desc="pictures", unit="frame", leave=False)


def _splat_config(avatar: Avatar, texels: Float[np.ndarray, "t 3"], cameras: Camera) -> SplatConfig:
    """Room for the cloud of one pose, wherever its cameras are: a box of two metres fills their pictures."""
    points, side = boxed_points(avatar.upscaler, jnp.asarray(texels))
    near = cylinder_cameras(cameras.width)
    needed = photometric.splat_config(appearance.coarse_gaussians(avatar.base, points, side), near)
    # Rounded to a power of two, so that avatars and poses share compiled programs.
    return dataclasses.replace(needed, capacity=2 ** int(np.ceil(np.log2(needed.capacity))))


def _seen_from(gaussians: Gaussians, place: Float[Array, "3"]) -> Gaussians:
    """World Gaussians with the ground under `place` as the origin."""
    return gaussians.replace(means=gaussians.means - place.at[1].set(0.0)[None])


def _draw(gaussians: Gaussians, views: Camera, splat: SplatConfig) -> Float[Array, "k h w 3"]:
    return jax.lax.map(lambda camera: jnp.clip(render(gaussians, camera, config=splat).image, 0, 1), views)


def _judge(pairs: Iterable[tuple[Array, np.ndarray]], perceptual: lpips.Network | None, count: int) -> Quality:
    """Compare renders (k, h, w, 3) with straight-alpha pictures (k, h, w, 4), one pose after another."""
    found = []
    for drawn, truth in tqdm(pairs, desc="image quality", unit="pose", total=count, leave=False):
        both = drawn, photometric.over(truth, 0.0)
        perceived = () if perceptual is None else (lpips.distance(perceptual, *both),)
        found.append([np.asarray(x) for x in (image.psnr(*both), image.ssim(*both), *perceived)])
    columns = [np.stack(x) for x in zip(*found, strict=True)]
    return Quality(columns[0], columns[1], columns[2] if perceptual is not None else None)
