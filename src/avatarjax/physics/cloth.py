"""Cloth as constraints: a triangle mesh with fabrics becomes the constants of a simulation.

The constraints of extended position-based dynamics (Macklin, Mueller and Chentanez 2016) are distances between pairs of
vertices: along the threads (stretch), across them (shear), between opposite corners of neighbouring triangles (bend),
and braces that a mesh names itself. A colouring puts pairs that share no vertex together, so that a whole colour is
solved at once and colours follow each other as in Gauss and Seidel's method.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Sequence

import flax.struct
import numpy as np
from jaxtyping import Array, Float, Int
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

# An edge closer than this (tangent of the angle, in the uv plane) to an axis runs along a thread.
_ALONG_THREAD = 0.41
# How much longer than the way along the cloth a tether is: it only catches what the edges let through.
_TETHER_SLACK = 1.02
# Metres: a vertex is worn over another that lies below it no further aside than this.
_COVERED = 0.04
# Metres: no vertex is kept further from the body than this, and none nearer.
_CLEARANCE = (0.001, 0.006)


@dataclasses.dataclass(frozen=True)
class Fabric:
    """A sheet: density (kg a square metre); compliances (metres a newton) of pairs along the threads (stretch), across
    them (shear) and of opposite corners of neighbouring triangles (bend); drag: how strongly air holds it, relative to
    a flat plate; friction on skin and clothes (Coulomb)."""

    density: float = 0.2
    stretch: float = 1e-7
    shear: float = 1e-4
    bend: float = 1e-2
    drag: float = 0.6
    friction: float = 0.15


@typing.no_type_check
@flax.struct.dataclass
class Cloth:
    """Constants of n vertices.

    inverse_masses (n,) 1 / kg, 0 where a vertex is sewn on; rest (n, 3) the pattern, metres; faces (f, 3); pairs
    (c, m, 2) vertices of the distance constraints of each colour, n where there is none; lengths and compliances
    (c, m); tether (n,) the sewn vertex that a vertex hangs from and tether_length (n,) how far it may be from it;
    reach (n,) metres from where the skeleton would carry it; clearance (n,) metres kept from solid surfaces; drag (n,)
    1 / metres: half the air's density times area and coefficient over mass; friction (n,); pieces: how many vertices
    each piece has, those that are worn over others after them; covering: for each piece the vertices (c,) that lie
    over an earlier one.
    """

    inverse_masses: Float[Array, " n"]
    rest: Float[Array, "n 3"]
    faces: Int[Array, "f 3"]
    pairs: Int[Array, "c m 2"]
    lengths: Float[Array, "c m"]
    compliances: Float[Array, "c m"]
    tether: Int[Array, " n"]
    tether_length: Float[Array, " n"]
    reach: Float[Array, " n"]
    clearance: Float[Array, " n"]
    drag: Float[Array, " n"]
    friction: Float[Array, " n"]
    covering: tuple[Int[Array, " c"], ...]
    pieces: tuple[int, ...] = flax.struct.field(pytree_node=False)

    @property
    def count(self) -> int:
        """How many vertices there are."""
        return self.rest.shape[0]


def sew(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "f 3"],
    uvs: Float[np.ndarray, "f 3 2"],
    fabric_of: Int[np.ndarray, " f"],
    fabrics: Sequence[Fabric],
    reach: Float[np.ndarray, " n"],
    braces: Int[np.ndarray, "b 2"],
    distance: Float[np.ndarray, " n"],
) -> Cloth:
    """The constants of a mesh (n, 3), (f, 3) whose triangles have uvs along the threads and one of `fabrics` each.

    The triangles of one fabric number are a piece; their vertices follow each other, and a piece is worn over those of
    lower numbers wherever it lies over them in this pose. Vertices with `reach` 0 are sewn on. `distance` (n,) is how
    far each lies from solid surfaces in this pose, metres: a layer that rests closer than usual is allowed to stay so.
    Raises ValueError where a free part of the cloth hangs from nothing, where a triangle has no area, or where the
    vertices of pieces are mixed.
    """
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ValueError(f"faces name vertices {faces.min()} to {faces.max()}, there are {len(vertices)}")
    areas = np.linalg.norm(np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))), axis=1) / 2
    if (areas <= 1e-10).any():
        raise ValueError(f"{(areas <= 1e-10).sum()} triangles of the cloth have no area, the first is {areas.argmin()}")

    def spread(of_face: np.ndarray) -> np.ndarray:
        """Sums over the triangles around each vertex of a third of their value."""
        return np.bincount(faces.ravel(), np.repeat(of_face / 3, 3), len(vertices))

    table = {f: np.array([getattr(fabric, f) for fabric in fabrics]) for f in Fabric.__dataclass_fields__}
    mass = spread(areas * table["density"][fabric_of])
    area = np.maximum(spread(areas), 1e-12)
    drag = spread(areas * table["drag"][fabric_of]) / area
    friction = spread(areas * table["friction"][fabric_of]) / area
    free = reach > 0
    inverse = np.where(free, 1 / np.maximum(mass, 1e-6), 0.0)

    owner = np.zeros(len(vertices), np.int64)
    owner[faces] = fabric_of[:, None]
    if (np.diff(owner) < 0).any() or (owner[faces] != fabric_of[:, None]).any():
        raise ValueError("the vertices of a piece of cloth must follow each other, in the order of the pieces")
    pieces = tuple(int(n) for n in np.unique(owner, return_counts=True)[1])
    pairs, compliances = _constraints(vertices, faces, uvs, fabric_of, table, braces)
    moving = free[pairs].any(axis=1)
    pairs, compliances = pairs[moving], compliances[moving]
    lengths = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
    tether, tether_length = _tethers(vertices, faces, free)
    chosen = _padded(_colour(pairs, len(vertices)))
    # The padding's pairs are outside the mesh, where reads are clipped and writes are dropped.
    real = chosen < len(pairs)
    padded_pairs = np.where(real[..., None], np.r_[pairs, [[0, 0]]][chosen], len(vertices))
    arrays = {
        "inverse_masses": inverse,
        "rest": vertices,
        "lengths": np.where(real, np.r_[lengths, 0][chosen], 0),
        "compliances": np.where(real, np.r_[compliances, 1][chosen], 1),
        "tether_length": tether_length,
        "reach": reach,
        "clearance": np.clip(distance, *_CLEARANCE),
        "drag": 0.5 * 1.2 * drag * area / np.maximum(mass, 1e-6),
        "friction": friction,
    }
    return Cloth(
        pieces=pieces,
        covering=_covering(vertices, faces, pieces),
        faces=faces.astype(np.int32),
        pairs=padded_pairs.astype(np.int32),
        tether=tether.astype(np.int32),
        **{name: np.asarray(value, np.float32) for name, value in arrays.items()},
    )


def _constraints(vertices, faces, uvs, fabric_of, table, braces) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (p, 2) with their compliances: edges, opposite corners over an inner edge, braces."""
    corners = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    opposite = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]])
    threads = np.concatenate([uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 1], uvs[:, 0] - uvs[:, 2]])
    owner = np.tile(fabric_of, 3)
    along = _along_threads(vertices, corners, threads, owner)
    keys = np.sort(corners, axis=1) @ np.array([len(vertices), 1])
    order = np.argsort(keys, kind="stable")
    keys, corners, opposite, owner, along = (a[order] for a in (keys, corners, opposite, owner, along))
    first = np.r_[True, keys[1:] != keys[:-1]]
    edges = corners[first]
    edge_compliance = np.where(along, table["stretch"][owner], table["shear"][owner])[first]
    # Two triangles with one edge follow each other in the order; a third one on the same edge is left alone.
    twin = np.flatnonzero(first[:-1] & ~first[1:])
    bends = np.stack([opposite[twin], opposite[twin + 1]], axis=1)
    # Over the diagonal of a square the opposite corners are the other diagonal: that is shear again.
    bend_compliance = np.where(along[twin], table["bend"][owner[twin]], table["shear"][owner[twin]])
    brace_compliance = np.full(len(braces), table["stretch"].min())
    pairs = np.concatenate([edges, bends, braces])
    compliances = np.concatenate([edge_compliance, bend_compliance, brace_compliance])
    different = pairs[:, 0] != pairs[:, 1]
    return pairs[different], compliances[different]


def _along_threads(vertices, corners, threads, owner) -> np.ndarray:
    """Whether an edge runs along u or v: its uv vector, scaled to metres for each fabric, is near an axis."""
    length = np.linalg.norm(vertices[corners[:, 0]] - vertices[corners[:, 1]], axis=1)
    scaled = np.zeros_like(threads, dtype=np.float64)
    for fabric in np.unique(owner):
        mine = owner == fabric
        squares = np.abs(np.linalg.lstsq(threads[mine].astype(np.float64) ** 2, length[mine] ** 2, rcond=None)[0])
        scaled[mine] = np.abs(threads[mine]) * np.sqrt(squares)
    return scaled.min(axis=1) <= _ALONG_THREAD * scaled.max(axis=1)


def _tethers(vertices, faces, free) -> tuple[np.ndarray, np.ndarray]:
    """Each vertex's nearest sewn vertex along the edges, and the way there (Kim, Chentanez and Mueller 2012)."""
    own = np.arange(len(vertices))
    if not free.any():
        return own, np.zeros(len(vertices))
    corners = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    lengths = np.linalg.norm(vertices[corners[:, 0]] - vertices[corners[:, 1]], axis=1)
    # A pair of neighbouring triangles names an edge twice, and the sparse matrix would add its lengths up.
    corners, first = np.unique(np.sort(corners, axis=1), axis=0, return_index=True)
    graph = sparse.coo_matrix((lengths[first], (corners[:, 0], corners[:, 1])), shape=(len(vertices),) * 2).tocsr()
    sewn = np.flatnonzero(~free)
    if not len(sewn):
        raise ValueError("the cloth is sewn on nowhere: give some vertices the reach 0")
    way, _, source = csgraph.dijkstra(graph, directed=False, indices=sewn, min_only=True, return_predecessors=True)
    if not np.isfinite(way).all():
        raise ValueError(f"{(~np.isfinite(way)).sum()} vertices of the cloth hang from nothing: sew each part on")
    return np.where(free, source, own), way * _TETHER_SLACK


def _covering(vertices: np.ndarray, faces: np.ndarray, pieces: tuple[int, ...]) -> tuple[np.ndarray, ...]:
    """For each piece the vertices that lie over the nearest vertex of an earlier piece in the pattern."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    flat = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    normals = np.stack([np.bincount(faces.ravel(), flat[:, k], len(vertices)) for k in range(3)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    covering, start = [np.zeros(0, np.int32)], pieces[0]
    for count in pieces[1:]:
        own = np.arange(start, start + count, dtype=np.int32)
        _, near = cKDTree(vertices[:start]).query(vertices[own])
        offset = vertices[own] - vertices[near]
        height = (offset * normals[near]).sum(1)
        covering.append(own[(height > 0) & ((offset**2).sum(1) - height**2 < _COVERED**2)])
        start += count
    return tuple(covering)


def _colour(pairs: np.ndarray, count: int) -> list[list[int]]:
    """Pairs by colour such that no two of a colour share a vertex; colours of nearly equal size."""
    used = [0] * count
    members: list[list[int]] = []
    for k, (p, q) in enumerate(pairs.tolist()):
        taken = used[p] | used[q]
        open_to = [c for c in range(len(members)) if not taken >> c & 1]
        if open_to:
            colour = min(open_to, key=lambda c: len(members[c]))
        else:
            colour = len(members)
            members.append([])
        members[colour].append(k)
        used[p] |= 1 << colour
        used[q] |= 1 << colour
    return members


def _padded(members: list[list[int]]) -> np.ndarray:
    """The members (c, m) of each colour, filled up with a number that is none of them."""
    if not members:
        return np.zeros((0, 0), np.int64)
    none = sum(len(m) for m in members)
    width = max(len(m) for m in members)
    return np.array([m + [none] * (width - len(m)) for m in members])
