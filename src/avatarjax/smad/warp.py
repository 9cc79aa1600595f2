"""Where canonical Gaussians are in every frame of every take: they ride on nodes, each of which moves on a spline of
its own (ours; the forward counterpart of the deformable field of SMAD 3, "Baselines").

A node with the canonical place x is at S_f(x) + u(f) in frame f. S_f is linear blend skinning with weights that are
bound once, or the identity for poses without a skeleton: then all motion in the body frame is the spline's. u is a
uniform cubic B-spline in time of learned offsets, one of a take for each so many frames: tracks are smooth, with
accelerations that are continuous, and a frame that was never seen lies between its neighbours. Gaussians follow the
nodes as they follow those of the dynamics later (`embedded`).

A network of place and a code for each frame, which shares what it learns, could not follow fast cloth (docs/smad.md).
"""

from __future__ import annotations

import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from avatarjax.data.body import Rig
from avatarjax.gaussians import Gaussians
from avatarjax.smad import embedded, skeletal
from avatarjax.smad.driving import Pose
from avatarjax.smad.embedded import Binding
from avatarjax.smad.graph import Graph

_ORDER = 4  # control values of a cubic spline that a frame depends on


@typing.no_type_check
@flax.struct.dataclass
class Skinning:
    """Linear blend skinning of n nodes: their weights (n, j), where they are at rest (n, 3), and what carries the bones
    from rest to the body frame of every frame (f, j, 3, 4)."""

    weights: Float[Array, "n j"]
    rest: Float[Array, "n 3"]
    bones: Float[Array, "f j 3 4"]


@typing.no_type_check
@flax.struct.dataclass
class Warp:
    """The motion of canonical Gaussians through all f frames of several takes, which are counted one after another.

    offsets (k, n, 3), metres in the body frame, are what is learned: the control values of all takes, of which frame i
    depends on four from rows[i] on, at shares[i] of the way to the next. takes: how many frames each take has.
    """

    graph: Graph
    binding: Binding
    offsets: Float[Array, "k n 3"]
    rows: Int[Array, " f"]
    shares: Float[Array, " f"]
    skinning: Skinning | None
    takes: tuple[int, ...] = flax.struct.field(pytree_node=False)


def init(graph: Graph, gaussians: Gaussians, takes: tuple[int, ...], knot: int) -> Warp:
    """A warp that moves nothing, with a control value for each `knot` frames; `skinned` gives it bones.

    Raises ValueError for takes without frames.
    """
    if not takes or min(takes) < 1:
        raise ValueError(f"takes of {takes} frames: at least one take of one frame is needed")
    rows, shares, first = [], [], 0
    for frames in takes:
        spans = max(1, -(-(frames - 1) // knot))
        row = np.minimum(np.arange(frames) // knot, spans - 1)
        rows.append(first + row)
        shares.append(np.arange(frames) / knot - row)
        first += spans + _ORDER - 1
    return Warp(
        graph=graph,
        binding=embedded.bind(gaussians, graph),
        offsets=jnp.zeros((first, len(graph.positions), 3)),
        rows=jnp.asarray(np.concatenate(rows), jnp.int32),
        shares=jnp.asarray(np.concatenate(shares), jnp.float32),
        skinning=None,
        takes=takes,
    )


def skinned(warp: Warp, rig: Rig, canonical: Pose, poses: Pose) -> Warp:
    """The warp on a skeleton: nodes that lie in the body frame of the canonical pose, bones in all frames (f poses).

    Raises ValueError where the number of poses is not that of the frames.
    """
    if len(poses.root_translation) != sum(warp.takes):
        raise ValueError(f"{len(poses.root_translation)} poses for takes of {warp.takes}: give one for each frame")
    return warp.replace(skinning=_skinning(rig, canonical, warp.graph.positions, poses))


def index(warp: Warp, take: int, frame: int) -> int:
    """The number among all frames of a frame of a take; raises ValueError where there is no such frame."""
    if not 0 <= take < len(warp.takes) or not 0 <= frame < warp.takes[take]:
        raise ValueError(f"take {take} has no frame {frame}: the takes have {warp.takes} frames, counted from 0")
    return sum(warp.takes[:take]) + frame


def offsets(warp: Warp, frame: Int[Array, ""] | int) -> Float[Array, "n 3"]:
    """How far the nodes are from where skinning has them in a frame, by its number among all frames."""
    controls = jax.lax.dynamic_slice_in_dim(warp.offsets, jnp.asarray(warp.rows)[frame], _ORDER)
    return jnp.tensordot(_basis(jnp.asarray(warp.shares)[frame]), controls, 1)


def nodes(warp: Warp, frame: Int[Array, ""] | int) -> Float[Array, "n 3"]:
    """Where the nodes are in a frame, in its body frame, metres."""
    here = warp.graph.positions
    if warp.skinning is not None:
        bones = jnp.asarray(warp.skinning.bones)[frame]
        blend = (warp.skinning.weights @ bones.reshape(len(bones), 12)).reshape(-1, 3, 4)
        here = _carry(blend, warp.skinning.rest)
    return here + offsets(warp, frame)


def move(warp: Warp, gaussians: Gaussians, frame: Int[Array, ""] | int) -> Gaussians:
    """Canonical Gaussians, those that were bound wherever training has moved them, in the body frame of a frame."""
    return embedded.carry(warp.binding, gaussians, warp.graph, nodes(warp, frame))


@jax.jit
def _skinning(rig: Rig, canonical: Pose, points: Float[Array, "n 3"], poses: Pose) -> Skinning:
    """`skeletal.pose_points` of many frames, with all that does not change between them computed once."""
    weights = skeletal.bind(rig, canonical, points).basis[3::4].T
    bones = skeletal.bones(rig, canonical)
    back = (weights @ bones.reshape(len(bones), 12)).reshape(-1, 3, 4)
    inverse = jnp.linalg.inv(back[..., :3])
    rest = jnp.sum(inverse * (points - back[..., 3])[:, None], axis=-1)
    return Skinning(weights, rest, jax.vmap(skeletal.bones, in_axes=(None, 0))(rig, poses))


def _basis(t: Float[Array, ""]) -> Float[Array, "4"]:
    """The weights of four control values of a uniform cubic B-spline at t in 0..1 of a span."""
    return jnp.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]) / 6


def _carry(transforms: Float[Array, "n 3 4"], points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    return jnp.sum(transforms[..., :3] * points[:, None], axis=-1) + transforms[..., 3]
