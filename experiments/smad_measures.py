"""What a SMAD avatar does on takes: pictures of it and of baselines beside the recording, and errors of its nodes."""

from __future__ import annotations

import functools
import itertools
import time
import typing
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree

from avatarjax import smad
from avatarjax.cameras import Camera
from avatarjax.data import MonocularVideo, capture
from avatarjax.data.mesh_renderer import MeshRenderer
from avatarjax.gaussians import Gaussians
from avatarjax.io import weights
from avatarjax.metrics import image, lpips
from avatarjax.metrics.statistics import Estimate, bootstrap
from avatarjax.smad import driving, dynamics
from avatarjax.smad.avatar import wear
from avatarjax.smad.driving import Pose
from avatarjax.smad.train_dynamics import Take
from avatarjax.splat import SplatConfig, render, required_capacity

EVERY = 5  # one frame of so many is drawn and measured
SETTLE = 15  # frames after the start that no measure counts: the recording does not begin at rest
NOVEL = (np.pi / 2, np.pi)  # azimuths of cameras that did not film, which stood at 0
LOOSE = 0.3  # the share of nodes that are furthest from skinning in training


class Moved(typing.NamedTuple):
    """What a method makes of a take: world Gaussians and nodes (t, n, 3) in the body frames of frames 1 to t."""

    gaussians: typing.Callable[[int], Gaussians]
    nodes: Float[np.ndarray, "t n 3"]


def move(avatar: smad.Avatar, poses: Pose) -> dict[str, Moved]:
    """All methods on the poses of a take."""
    after = jax.tree.map(lambda x: x[1:], poses)
    _, frames = _rollout(avatar, _reset(avatar, poses), after)
    driven, settled = dynamics.without_swing(avatar.config, avatar.params, avatar.system, poses)
    found = {"ours": Moved(lambda k: jax.tree.map(lambda x: x[k - 1], frames.gaussians), np.asarray(frames.nodes))}
    for name, nodes in (("equilibrium alone", settled[1:]), ("skinning", driven[1:])):
        dressed = functools.partial(_dressed, avatar, nodes, after)
        found[name] = Moved(dressed, np.asarray(nodes))
    return found


def frames_a_second(avatar: smad.Avatar, poses: Pose) -> float:
    """Of a rollout with all Gaussians, not drawn, under all poses but the first: the median of three, after one that
    compiles where `move` has not."""
    after, times = jax.tree.map(lambda x: x[1:], poses), []
    for _ in range(4):
        began = time.perf_counter()
        jax.block_until_ready(_rollout(avatar, _reset(avatar, poses), after))
        times.append(time.perf_counter() - began)
    return len(after.root_translation) / float(np.median(times[1:]))


def follow(avatar: smad.Avatar, take: Take) -> Moved:
    """The avatar on the nodes of a track."""
    after = jax.tree.map(lambda x: x[1:], take)
    return Moved(functools.partial(_dressed, avatar, after.positions, after.poses), np.asarray(after.positions))


class View(typing.NamedTuple):
    """What a camera sees of a take of so many frames: of each a camera, the picture (h, w, 3) in 0..1 with what is not
    the person black, and the mask."""

    frames: int
    at: typing.Callable[[int], tuple[Camera, jax.Array, Bool[np.ndarray, "h w"]]]


def recorded_view(take: MonocularVideo) -> View:
    """What the camera that filmed saw."""

    def at(frame):
        return take.camera_at(frame), over_black(take.images()[frame], take.mattes[frame]), take.masks[frame]

    return View(len(take), at)


def novel_views(take: MonocularVideo, texture: UInt8[np.ndarray, "h w 3"]) -> list[View]:
    """What cameras would have seen that did not film: from the left of the figure and from behind, where it faces the
    one that did. None of takes whose meshes are not known."""
    path = Path(take.folder) / capture.MESHES
    if not path.is_file():
        return []
    tree = weights.load_arrays(path)[0]
    roots = np.asarray(take.poses.root_translation)
    renderer = MeshRenderer(tree["faces"], tree["uvs"], texture)

    @functools.lru_cache(1)
    def mesh(frame):
        return renderer.pose(tree["vertices"][frame].astype(np.float32) + roots[frame])

    def seen(azimuth):
        cameras = capture.following_camera(roots, take.masks.shape[1], azimuth)

        def at(frame):
            camera = jax.tree.map(lambda x: x[frame], cameras)
            picture, matte = capture.photograph(mesh(frame), camera)
            return camera, over_black(picture, matte), matte > 127

        return View(len(take), at)

    return [seen(azimuth) for azimuth in NOVEL]


def picture_errors(
    views: Sequence[View], moved: dict[str, Moved], perceptual: lpips.Network | None
) -> dict[str, dict[str, Estimate]]:
    """What `picture_values` are on average; those of one frame count together."""
    values = picture_values(views, moved, perceptual)
    groups = np.repeat(measured_frames(views[0].frames), len(views))
    return {name: {what: bootstrap(found, groups) for what, found in kinds.items()} for name, kinds in values.items()}


def measured_frames(count: int) -> range:
    """The frames of a take of so many that are drawn."""
    return range(SETTLE, count, EVERY)


def picture_values(
    views: Sequence[View], moved: dict[str, Moved], perceptual: lpips.Network | None
) -> dict[str, dict[str, list[float]]]:
    """PSNR of the whole picture over black and inside the mask, SSIM and LPIPS of each method, for every view of one
    measured frame after the other."""
    values: dict[str, dict[str, list[float]]] = {name: {} for name in moved}
    for frame, view in itertools.product(measured_frames(views[0].frames), views):
        camera, truth, inside = view.at(frame)
        drawn = jnp.clip(jnp.stack([draw(method.gaussians(frame), camera) for method in moved.values()]), 0, 1)
        pairs = drawn, jnp.broadcast_to(truth, drawn.shape)
        found = {
            "PSNR": image.psnr(*pairs),
            "PSNR in the mask": image.masked_psnr(*pairs, jnp.asarray(inside[None, ..., None], jnp.float32)),
            "SSIM": image.ssim(*pairs),
        }
        if perceptual is not None:
            found["LPIPS"] = lpips.distance(perceptual, drawn, truth)
        for what, each in found.items():
            for name, value in zip(moved, np.asarray(each), strict=True):
                values[name].setdefault(what, []).append(float(value))
    return values


def over_black(picture: UInt8[np.ndarray, "h w 3"], matte: UInt8[np.ndarray, "h w"]) -> jax.Array:
    """A picture (h, w, 3) in 0..1 with what is not the person black."""
    return jnp.asarray(picture / 255 * (matte[..., None] / 255), jnp.float32)


def draw(gaussians: Gaussians, camera: Camera) -> jax.Array:
    """A cloud over black (h, w, 3)."""
    out = _draw(gaussians, camera, SplatConfig(depth=False))
    if out.info.dropped:
        out = _draw(gaussians, camera, SplatConfig(capacity=required_capacity(gaussians, camera), depth=False))
    return out.image


def true_nodes(avatar: smad.Avatar, canonical: MonocularVideo, take: MonocularVideo) -> np.ndarray | None:
    """Where the vertices nearest to the nodes in the canonical pose are in a take (t, n, 3), in its body frames; None
    for takes of which no meshes are known."""
    found = [_vertices(video) for video in (canonical, take)]
    if found[0] is None or found[1] is None:
        return None
    _, nearest = cKDTree(found[0][0]).query(np.asarray(avatar.system.graph.positions))
    return found[1][:, nearest]


def loose_nodes(avatar: smad.Avatar, truths: list[np.ndarray], poses: list[Pose]) -> Int[np.ndarray, " m"]:
    """The nodes that skinning is furthest from on takes that were trained on."""
    apart = []
    for truth, pose in zip(truths, poses, strict=True):
        driven = np.asarray(dynamics.without_swing(avatar.config, avatar.params, avatar.system, pose)[0])
        offset = truth - driven
        # Nodes lie a little beside the vertices that stand for them: what counts is how that changes.
        apart.append(np.linalg.norm(offset - offset.mean(0), axis=-1))
    mean = np.concatenate(apart).mean(0)
    return np.argsort(mean)[-max(1, int(LOOSE * len(mean))) :]


def node_errors(truth: np.ndarray, moved: dict[str, Moved], chosen: Int[np.ndarray, " m"]) -> dict[str, Estimate]:
    """Mean distance in mm of chosen nodes to their true places, over frames; neighbouring frames count together."""
    found = {}
    for name, method in moved.items():
        apart = np.linalg.norm(method.nodes[:, chosen] - truth[1:, chosen], axis=-1).mean(1)[SETTLE:]
        found[name] = bootstrap(1000 * apart, np.arange(len(apart)) // 15)
    return found


def _vertices(video: MonocularVideo) -> np.ndarray | None:
    path = Path(video.folder) / capture.MESHES
    if not path.is_file():
        return None
    vertices = weights.load_arrays(path)[0]["vertices"].astype(np.float32)
    pose = driving.recorded(video.poses)
    # Relative to the root already: only the heading is left to take away.
    pose = pose.replace(root_translation=jnp.zeros_like(pose.root_translation))
    return np.asarray(driving.to_body(pose, jnp.asarray(vertices)))


@jax.jit
def _reset(avatar, poses):
    return smad.reset(avatar, jax.tree.map(lambda x: x[0], poses))


@jax.jit
def _rollout(avatar, state, poses):
    return smad.rollout(avatar, state, poses)


@jax.jit
def _dressed(avatar, nodes, poses, frame):
    return wear(avatar, nodes[frame - 1], jax.tree.map(lambda x: x[frame - 1], poses))


@functools.partial(jax.jit, static_argnames="config")
def _draw(gaussians, camera, config):
    return render(gaussians, camera, config=config)
