"""The point of a moving figure that everything is relative to: its waist by default (UNICA 3.3)."""

from __future__ import annotations

import typing

import numpy as np
from jaxtyping import Float, Int

from avatarjax.data.importers.gltf_animation import SkeletonAnimation
from avatarjax.posmap.atlas import WAIST_BAND

# How far from the axis of the body a vertex may be, as a share of the height: hands and sleeves do not count.
_NEAR_AXIS = 0.12
# A frame counts as standing from this share of the tallest frame's height, so that a raised arm does not define it.
_STANDING = 0.8
# A coarse mesh may have few vertices in the band: this many, the closest in height, then make the set.
_FEWEST = 8


def roots(
    vertices: Float[np.ndarray, "f v 3"],
    faces: Int[np.ndarray, "g 3"],
    root: typing.Any = "waist",
    joints: SkeletonAnimation | None = None,
    *,
    source: str = "the mesh",
) -> Float[np.ndarray, "f 3"]:
    """The root (f, 3) of each frame, metres: the mean of one fixed set of vertices, or a joint's position.

    `root` is "waist" (`waist_vertices`, weighted by the surface around them, so that a finely meshed belt does not pull
    it aside), vertex indices, or the name of a joint. Raises ValueError that names `source` for an unknown joint or
    vertices that do not exist.
    """
    if isinstance(root, str) and root != "waist":
        if joints is None:
            raise ValueError(f"{source} has no joints: root={root!r} must be 'waist' or vertex indices")
        if root not in joints.names:
            raise ValueError(f"{source} has no joint {root!r}: choose one of {', '.join(joints.names)}, or 'waist'")
        return np.ascontiguousarray(joints.positions[:, joints.names.index(root)])
    indices = waist_vertices(vertices, source=source) if isinstance(root, str) else np.asarray(root)
    count = vertices.shape[1]
    if indices.ndim != 1 or not indices.size or indices.dtype.kind not in "iu":
        raise ValueError(f"{source}: root must be 'waist', a joint's name or a list of vertex indices, got {root!r}")
    if indices.min() < 0 or indices.max() >= count:
        raise ValueError(f"{source}: root uses vertices {indices.min()} to {indices.max()}, the mesh has {count}")
    weights = np.ones(len(indices))
    if isinstance(root, str):
        a, b, c = (vertices[0, faces[:, k]].astype(np.float64) for k in range(3))
        areas = np.bincount(faces.ravel(), np.repeat(np.linalg.norm(np.cross(b - a, c - a), axis=1), 3), count)
        weights = areas[indices] if areas[indices].sum() > 0 else weights
    return np.einsum("fkc,k->fc", vertices[:, indices], weights / weights.sum()).astype(np.float32)


def waist_vertices(vertices: Float[np.ndarray, "f v 3"], *, source: str = "the mesh") -> Int[np.ndarray, " k"]:
    """Indices (k,) of the vertices at the waist: 55 to 61 % of the height and near the axis of the body.

    Chosen in the first frame whose height is at least 0.8 of the tallest frame's. Where fewer than eight lie there, the
    eight closest in height are taken. Raises ValueError where no vertex near the axis is within a tenth of the height.
    """
    heights = np.ptp(vertices[..., 1], axis=1)
    figure = vertices[int(np.argmax(heights >= _STANDING * heights.max()))]
    low, height = figure[:, 1].min(), np.ptp(figure[:, 1])
    level = (figure[:, 1] - low) / max(float(height), 1e-9)
    torso = figure[(level > 0.5) & (level < 0.75)]
    axis = np.median(torso[:, [0, 2]], axis=0) if len(torso) else figure[:, [0, 2]].mean(axis=0)
    near = np.linalg.norm(figure[:, [0, 2]] - axis, axis=1) < _NEAR_AXIS * height
    found = np.flatnonzero((level > WAIST_BAND[0]) & (level < WAIST_BAND[1]) & near)
    if len(found) < _FEWEST:
        away = np.where(near, np.abs(level - sum(WAIST_BAND) / 2), np.inf)
        # Vertices of one height stay together, so that the set does not lean to one side.
        reach = np.sort(away)[min(_FEWEST, len(away)) - 1] + 1e-4
        found = np.flatnonzero(away <= min(reach, 0.1))
    if not len(found):
        raise ValueError(f"{source}: no vertex lies at the waist of its first standing frame: pass root=VERTEX_INDICES")
    return found
