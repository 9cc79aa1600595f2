"""Several takes of one person as a single series of small pictures, cameras and poses: what Gaussians are fitted to."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from avatarjax.cameras import Camera
from avatarjax.data.body import Rig
from avatarjax.data.recording import MonocularVideo
from avatarjax.gaussians import Gaussians
from avatarjax.smad import driving, skeletal, views
from avatarjax.smad.driving import Pose
from avatarjax.splat import RenderOutput, SplatConfig, l1, required_capacity

# One frame of so many is never trained on, the third of each group.
HELD_OUT, _WHICH = 5, 2
# Room for Gaussians that grow or gather: so many times what some need at the start, in so many frames.
GROWTH, _LOOKS = 3, 16
# Joints of one person in two takes may differ by a millimetre.
_SAME = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Footage:
    """f frames of all takes, one take after another, seen in the body frame.

    rgba (f, h, w, 4): colours multiplied by alpha, and alpha, which tells the person from the background. cameras (f,)
    and poses (f,) of all frames; rig: the skeleton, or None; takes: how many frames each take has.
    """

    rgba: UInt8[np.ndarray, "f h w 4"]
    cameras: Camera
    poses: Pose
    rig: Rig | None
    takes: tuple[int, ...]

    def pose(self, take: int, frame: int) -> Pose:
        """The pose of a frame of a take, for example the canonical one."""
        at = sum(self.takes[:take]) + frame
        return jax.tree.map(lambda x: x[at], self.poses)

    @property
    def held_out(self) -> Bool[np.ndarray, " f"]:
        """Which frames are there to be measured on only: the third of every five of a take."""
        return np.concatenate([np.arange(frames) % HELD_OUT == _WHICH for frames in self.takes])


def gather(videos: Sequence[MonocularVideo], shrink: int = 1) -> Footage:
    """Decode takes once, each picture shrunk by a whole factor to the means of its blocks of pixels.

    Rows and columns that fill no block are cut off at the bottom and the right. Raises ValueError for no takes, a take
    without frames, with no person in any mask or with another number of pictures than masks, for pictures of different
    sizes, and for skeletons that differ.
    """
    if not videos:
        raise ValueError("no takes: give at least one video")
    if shrink < 1:
        raise ValueError(f"shrink is {shrink}: it must be 1 or more")
    sizes = {(video.camera.height, video.camera.width) for video in videos}
    if len(sizes) > 1:
        raise ValueError(f"pictures of sizes {sorted(sizes)} (height, width): all takes must have one size")
    if min(sizes.pop()) < shrink:
        raise ValueError(f"shrink {shrink} leaves nothing of pictures of {videos[0].camera.width} pixels")
    for k, video in enumerate(videos):
        if not len(video):
            raise ValueError(f"take {k} has no frames")
        if not video.masks.any():
            raise ValueError(f"all {len(video)} masks of take {k} are empty: foreground must be True")
    rig = _skeleton(videos)
    cameras = [_shrunk_camera(views.of_video(video, np.arange(len(video))), shrink) for video in videos]
    return Footage(
        np.concatenate([_decode(k, video, shrink) for k, video in enumerate(videos)]),
        jax.tree.map(lambda *x: np.concatenate(x), *cameras),
        jax.tree.map(lambda *x: jnp.concatenate(x), *(driving.recorded(video.poses) for video in videos)),
        rig,
        tuple(len(video) for video in videos),
    )


def over(rgba: UInt8[Array, "*b h w 4"], background: Float[Array, "3"]) -> Float[Array, "*b h w 3"]:
    """Pictures of the footage before a background, in 0..1."""
    shown = rgba.astype(jnp.float32) / 255
    return shown[..., :3] + (1 - shown[..., 3:]) * jnp.expand_dims(background, tuple(range(rgba.ndim - 1)))


def missed(
    out: RenderOutput, rgba: UInt8[Array, "h w 4"], background: Float[Array, "3"]
) -> dict[str, Float[Array, ""]]:
    """By how much what was drawn before a background misses a picture of the footage: `photometric` and `silhouette`,
    mean absolute errors of colours and of alphas, and `dropped`, what the renderer had no room for."""
    return {
        "photometric": l1(out.image, over(rgba, background)),
        "silhouette": l1(out.alpha[..., None], rgba[..., 3:].astype(jnp.float32) / 255),
        "dropped": jnp.sum(out.info.dropped).astype(jnp.float32),
    }


def room(
    takes: Footage, cloud_at: Callable[[int], Gaussians], frames: Iterable[int] | None = None, growth: int = GROWTH
) -> SplatConfig:
    """A renderer's configuration with room for `growth` times what the clouds of some frames need, by default of a few
    evenly spaced ones that are trained on."""
    trained = np.flatnonzero(~takes.held_out)
    some = trained[np.linspace(0, len(trained) - 1, _LOOKS).astype(int)].tolist()
    needed = 0
    for frame in some if frames is None else frames:
        camera = jax.tree.map(lambda x, k=frame: jnp.asarray(x[k]), takes.cameras)
        needed = max(needed, required_capacity(cloud_at(frame), camera))
    return SplatConfig(capacity=min(2**24, growth * needed), depth=False)


def _decode(take: int, video: MonocularVideo, shrink: int) -> UInt8[np.ndarray, "f h w 4"]:
    height, width = video.camera.height // shrink, video.camera.width // shrink
    pictures = np.empty((len(video), height, width, 4), np.uint8)
    count = 0
    for count, frame in enumerate(video.frames(), start=1):
        if count <= len(video):
            alpha = video.mattes[count - 1, ..., None]
            premultiplied = np.round(frame * (alpha / np.float32(255))).astype(np.uint8)
            pictures[count - 1] = _shrunk(np.concatenate([premultiplied, alpha], axis=-1), shrink)
    if count != len(video):
        raise ValueError(f"take {take} has {count} pictures and {len(video)} masks: give one for each frame")
    return pictures


def _shrunk(picture: UInt8[np.ndarray, "h w c"], shrink: int) -> UInt8[np.ndarray, "k l c"]:
    height, width = (side // shrink for side in picture.shape[:2])
    blocks = picture[: height * shrink, : width * shrink].reshape(height, shrink, width, shrink, -1)
    return np.round(blocks.mean((1, 3), dtype=np.float32)).astype(np.uint8)


def _shrunk_camera(camera: Camera, shrink: int) -> Camera:
    """The camera of the shrunk picture. Pixel centres lie at +0.5, so that coordinates shrink by the factor alone."""
    intrinsics = np.asarray(camera.intrinsics) / np.array([shrink, shrink, 1], np.float32)[:, None]
    return Camera(np.asarray(camera.world_to_camera), intrinsics, camera.width // shrink, camera.height // shrink)


def _skeleton(videos: Sequence[MonocularVideo]) -> Rig | None:
    first = videos[0].poses
    known = [video.poses.joints is not None and video.poses.parents is not None for video in videos]
    for k, video in enumerate(videos):
        poses = video.poses
        if poses.rotations.shape[1] != first.rotations.shape[1] or known[k] != known[0]:
            raise ValueError(
                f"take {k} has {poses.rotations.shape[1]} joints, {'' if known[k] else 'not '}placed, the first "
                f"{first.rotations.shape[1]}, {'' if known[0] else 'not '}placed: all takes need one skeleton"
            )
        if known[k] and (
            poses.parents != first.parents or np.abs(np.subtract(poses.joints, first.joints)).max() > _SAME
        ):
            raise ValueError(f"the skeleton of take {k} is not that of the first: all takes must show one person")
    return skeletal.rig_of(first) if known[0] else None
