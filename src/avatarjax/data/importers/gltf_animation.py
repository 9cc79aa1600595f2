"""glTF clips: the tree of nodes, keyframes sampled in time, and world matrices of nodes and joints.

Interpolation is the specification's (glTF 2.0, 3.11 and appendix C): LINEAR, spherical for rotations; STEP;
CUBICSPLINE. Outside its keys a channel holds its first or last value.
"""

from __future__ import annotations

import dataclasses
import os
import typing
from pathlib import Path

import numpy as np
from jaxtyping import Float

from avatarjax.data.importers import gltf_file
from avatarjax.data.importers.gltf_file import GltfFile

FPS = 30.0


@typing.no_type_check
@dataclasses.dataclass(frozen=True, eq=False)
class SkeletonAnimation:
    """Joints over f frames in our axes.

    names (j,); parents (j,) with -1 for a root, parents before children; transforms (f, j, 4, 4) joint to world,
    metres, which keep the scale that the file's nodes have; fps frames a second; clip is its name in the file, or "".
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    transforms: Float[np.ndarray, "f j 4 4"]
    fps: float
    clip: str

    @property
    def positions(self) -> Float[np.ndarray, "f j 3"]:
        """Joint positions in the world, metres."""
        return self.transforms[..., :3, 3]

    @property
    def rotations(self) -> Float[np.ndarray, "f j 3 3"]:
        """World rotations without the scale: the orthogonal factors of the matrices (polar decomposition)."""
        u, _, vt = np.linalg.svd(self.transforms[..., :3, :3])
        return u @ vt

    @property
    def local_rotations(self) -> Float[np.ndarray, "f j 3 3"]:
        """Rotations of each joint relative to its parent; those of roots relative to the world."""
        world = self.rotations
        local = world.copy()
        for j, parent in enumerate(self.parents):
            if parent >= 0:
                local[:, j] = np.swapaxes(world[:, parent], -1, -2) @ world[:, j]
        return local


def load_gltf_animation(path: str | os.PathLike, *, clip: str | None = None, fps: float = FPS) -> SkeletonAnimation:
    """The joints of a .glb or .gltf file under one of its clips, sampled `fps` times a second from its first key.

    `clip` names the animation, the first by default. Joints are those of all skins; in a file without skins, all nodes.
    A file without animations gives its rest pose as one frame. Raises ValueError that names the file and what is wrong,
    or lists its clips.
    """
    file = gltf_file.read(Path(path))
    with gltf_file.damage(path):
        times, tracks, name = sample_clip(file, clip, fps)
        return skeleton(file, world_matrices(file, tracks, len(times)), fps, name)


def node_order(file: GltfFile) -> tuple[list[int], dict[int, int]]:
    """All nodes with parents before children, depth first, and the parent of each node that has one.

    Raises ValueError for a node with two parents or a cycle.
    """
    parents: dict[int, int] = {}
    for index, node in enumerate(file.entries("nodes")):
        for child in node.get("children", []):
            file.entry("nodes", child)
            if child in parents:
                raise ValueError(f"{file.path}: node {child} has two parents: export it again")
            parents[child] = index
    order = [index for index in range(len(file.entries("nodes"))) if index not in parents][::-1]
    ordered = []
    while order:
        index = order.pop()
        ordered.append(index)
        order += file.entries("nodes")[index].get("children", [])[::-1]
    if len(ordered) != len(file.entries("nodes")):
        raise ValueError(f"{file.path}: its nodes form a cycle: export it again")
    return ordered, parents


def node_name(file: GltfFile, index: int) -> str:
    """The name of a node, or node_INDEX."""
    return str(file.entries("nodes")[index].get("name") or f"node_{index}")


def choose_clip(file: GltfFile, clip: str | None) -> dict[str, typing.Any] | None:
    """The animation of that name, the first for None, None where the file has none; ValueError lists the clips."""
    clips = file.entries("animations")
    if clip is None:
        return clips[0] if clips else None
    for animation in clips:
        if animation.get("name") == clip:
            return animation
    names = ", ".join(repr(animation.get("name", "")) for animation in clips)
    raise ValueError(f"{file.path} has no clip {clip!r}: choose one of {names or 'none: it has no animation'}")


def sample_clip(
    file: GltfFile, clip: str | None, fps: float
) -> tuple[np.ndarray, dict[tuple[int, str], np.ndarray], str]:
    """Sample times (f,) in seconds, values (f, width) by (node, path), and the clip's name.

    The last sample is the last that lies within the clip. Raises ValueError for a damaged clip.
    """
    if not fps > 0:
        raise ValueError(f"fps must be positive, got {fps}")
    animation = choose_clip(file, clip)
    if animation is None:
        return np.zeros(1), {}, ""
    channels = []
    for channel in animation.get("channels", []):
        # A channel without a node belongs to an extension.
        if "node" not in channel["target"]:
            continue
        sampler = animation["samplers"][channel["sampler"]]
        keys = file.accessor(sampler["input"])[:, 0]
        if (np.diff(keys) <= 0).any():
            raise ValueError(f"{file.path}: a channel's keys do not increase in time: export the clip again")
        output = file.accessor(sampler["output"])
        interpolation = sampler.get("interpolation", "LINEAR")
        if interpolation not in ("LINEAR", "STEP", "CUBICSPLINE"):
            raise ValueError(f"{file.path}: unknown interpolation {interpolation!r}: export the clip again")
        path = channel["target"]["path"]
        if path == "weights":
            output = output.reshape(len(keys) * (3 if interpolation == "CUBICSPLINE" else 1), -1)
        elif len(output) != len(keys) * (3 if interpolation == "CUBICSPLINE" else 1):
            raise ValueError(f"{file.path}: {len(output)} values for {len(keys)} keys of a channel: export it again")
        channels.append(((channel["target"]["node"], path), keys, output, interpolation))
    if not channels:
        return np.zeros(1), {}, str(animation.get("name", ""))
    start = min(keys[0] for _, keys, _, _ in channels)
    end = max(keys[-1] for _, keys, _, _ in channels)
    # Keys are float32: a clip of two seconds may end a rounding error before 2.
    times = start + np.arange(int(np.floor((end - start) * fps + 1e-3)) + 1) / fps
    tracks = {
        target: interpolate(keys, output, times, interpolation, rotation=target[1] == "rotation")
        for target, keys, output, interpolation in channels
    }
    return times, tracks, str(animation.get("name", ""))


def interpolate(
    keys: Float[np.ndarray, " k"],
    values: Float[np.ndarray, "n w"],
    times: Float[np.ndarray, " f"],
    interpolation: str,
    rotation: bool = False,
) -> Float[np.ndarray, "f w"]:
    """Values (f, w) at `times`; `values` (k, w), or (3 k, w) as in-tangent, value, out-tangent for CUBICSPLINE.

    Rotations are quaternions and stay unit: spherical interpolation on the shorter arc (glTF 2.0, appendix C).
    """
    cubic = interpolation == "CUBICSPLINE"
    points = values[1::3] if cubic else values
    if rotation:
        points = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-12)
    last = len(keys) - 1
    before = np.clip(np.searchsorted(keys, times + 1e-9, side="right") - 1, 0, last)
    after = np.minimum(before + 1, last)
    if interpolation == "STEP" or last == 0:
        return points[before]
    span = np.where(after > before, keys[after] - keys[before], 1.0)
    s = np.clip((times - keys[before]) / span, 0.0, 1.0)[:, None]
    if cubic:
        leave, arrive = values[2::3][before] * span[:, None], values[0::3][after] * span[:, None]
        result = (
            (2 * s**3 - 3 * s**2 + 1) * values[1::3][before]
            + (s**3 - 2 * s**2 + s) * leave
            + (-2 * s**3 + 3 * s**2) * values[1::3][after]
            + (s**3 - s**2) * arrive
        )
        return result / np.maximum(np.linalg.norm(result, axis=1, keepdims=True), 1e-12) if rotation else result
    a, b = points[before], points[after]
    if not rotation:
        return a + s * (b - a)
    dot = (a * b).sum(axis=1, keepdims=True)
    b, dot = np.where(dot < 0, -b, b), np.minimum(np.abs(dot), 1.0)
    angle = np.arccos(dot)
    sine = np.sin(angle)
    near = sine < 1e-6
    safe = np.where(near, 1.0, sine)
    result = np.where(near, 1 - s, np.sin((1 - s) * angle) / safe) * a + np.where(near, s, np.sin(s * angle) / safe) * b
    return result / np.linalg.norm(result, axis=1, keepdims=True)


def world_matrices(
    file: GltfFile, tracks: dict[tuple[int, str], np.ndarray], frames: int
) -> Float[np.ndarray, "f n 4 4"]:
    """Node-to-world matrices (f, n, 4, 4) of all nodes, in the file's node order."""
    order, parents = node_order(file)
    world = np.zeros((frames, len(order), 4, 4))
    for index in order:
        local = local_matrices(file.entries("nodes")[index], index, tracks, frames)
        world[:, index] = world[:, parents[index]] @ local if index in parents else local
    return world


def local_matrices(
    node: dict[str, typing.Any], index: int, tracks: dict[tuple[int, str], np.ndarray], frames: int
) -> Float[np.ndarray, "f 4 4"]:
    """Node-to-parent matrices (f, 4, 4): translation, rotation and scale, animated or at rest, or its own matrix."""
    animated = any((index, path) in tracks for path in ("translation", "rotation", "scale"))
    if "matrix" in node and not animated:
        return np.broadcast_to(np.array(node["matrix"], np.float64).reshape(4, 4).T, (frames, 4, 4))
    rest = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}
    offset, quat, scale = (
        tracks[index, path] if (index, path) in tracks else np.tile(np.array(node.get(path, value), float), (frames, 1))
        for path, value in rest.items()
    )
    x, y, z, w = (quat / np.maximum(np.linalg.norm(quat, axis=1, keepdims=True), 1e-12)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrices = np.zeros((frames, 4, 4))
    matrices[:, :3, :3] = np.moveaxis(np.array(rows), -1, 0) * scale[:, None, :]
    matrices[:, :3, 3], matrices[:, 3, 3] = offset, 1.0
    return matrices


def skeleton(file: GltfFile, world: Float[np.ndarray, "f n 4 4"], fps: float, clip: str) -> SkeletonAnimation:
    """The joints of all skins, or all nodes of a file without skins, with their nearest ancestors among them."""
    order, parents = node_order(file)
    skinned = {joint for skin in file.entries("skins") for joint in skin["joints"]}
    chosen = [index for index in order if index in skinned] if skinned else order
    if not chosen:
        raise ValueError(f"{file.path} has no nodes: export the armature with its animation")
    place = {index: k for k, index in enumerate(chosen)}

    def ancestor(index: int) -> int:
        while index in parents:
            index = parents[index]
            if index in place:
                return place[index]
        return -1

    return SkeletonAnimation(
        tuple(node_name(file, index) for index in chosen),
        tuple(ancestor(index) for index in chosen),
        world[:, chosen].astype(np.float32),
        fps,
        clip,
    )
