"""Where canonical points are in every frame of every take: skinned, where there is a skeleton, and corrected by a
network that is told the frame (ours; the forward counterpart of the deformable field of SMAD 3, "Baselines").

A point x of the canonical pose lies in frame f at S_f(x) + u(x, z_f). S_f is linear blend skinning with weights that
are bound once, or the identity for poses without a skeleton: then all motion in the body frame is the network's. z_f is
a learned code, interpolated in time between knots, so that a frame that was never seen lies between its neighbours.
"""

from __future__ import annotations

import dataclasses
import itertools
import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float, Int, Key

from avatarjax import rotations
from avatarjax.data.body import Rig
from avatarjax.gaussians import Gaussians
from avatarjax.nets import functional
from avatarjax.nets.blocks import octaves
from avatarjax.nets.functional import Params
from avatarjax.smad import skeletal
from avatarjax.smad.driving import Pose

# Before training the network moves nothing by more than some tenths of a millimetre, but passes gradients on.
_HEAD_SCALE = 1e-3
# Squarings of a 4x4 matrix, after which its first eigenvector is all that is left of it.
_SQUARINGS = 4


@dataclasses.dataclass(frozen=True)
class WarpConfig:
    """Sizes of the network. octaves: of sines and cosines of a canonical position, the lowest two metres long. code:
    numbers that are learned of each knot; knot: frames from one to the next. width, layers: of the hidden layers. unit:
    metres that an output of one stands for."""

    octaves: int = 3
    code: int = 16
    knot: int = 4
    width: int = 64
    layers: int = 3
    unit: float = 0.3

    def __post_init__(self):
        for name in ("octaves", "code", "knot", "width", "layers"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: at least 1 is needed")
        if self.unit <= 0:
            raise ValueError(f"unit {self.unit} must be positive")


class Offsets(nnx.Module):
    """Offsets (n, 3) of canonical points in one frame."""

    def __init__(self, config: WarpConfig, *, rngs: nnx.Rngs):
        widths = [config.width] * config.layers
        self.point = nnx.Linear(3 * (1 + 2 * config.octaves), config.width, rngs=rngs)
        self.code = nnx.Linear(config.code, config.width, use_bias=False, rngs=rngs)
        self.layers = nnx.List([nnx.Linear(a, b, rngs=rngs) for a, b in itertools.pairwise(widths)])
        self.leave = nnx.Linear(config.width, 3, kernel_init=nnx.initializers.normal(_HEAD_SCALE), rngs=rngs)
        self.octaves, self.unit = config.octaves, config.unit

    def __call__(self, points: Float[Array, "n 3"], code: Float[Array, " c"]) -> Float[Array, "n 3"]:
        # The first layer is linear: the part of the code, which all points share, is computed once.
        x = jax.nn.relu(self.point(octaves(points, self.octaves)) + self.code(code)[None])
        for layer in self.layers:
            x = jax.nn.relu(layer(x))
        return self.unit * self.leave(x)


@typing.no_type_check
@flax.struct.dataclass
class Skinning:
    """Linear blend skinning of n points: their weights (n, j), what carries each from the canonical pose to rest
    (n, 3, 4), and what carries the bones from rest to the body frame of every frame (f, j, 3, 4)."""

    weights: Float[Array, "n j"]
    to_rest: Float[Array, "n 3 4"]
    bones: Float[Array, "f j 3 4"]


@typing.no_type_check
@flax.struct.dataclass
class Warp:
    """The motion of canonical points through all f frames of several takes, which are counted one after another.

    codes (k, c) are those of all knots; frame i lies between the knots rows[i] and rows[i] + 1, by shares[i] of the
    way. takes: how many frames each take has. Parameters are the network's and the codes; all else is fixed.
    """

    network: Params
    codes: Float[Array, "k c"]
    rows: Int[Array, " f"]
    shares: Float[Array, " f"]
    skinning: Skinning | None
    takes: tuple[int, ...] = flax.struct.field(pytree_node=False)
    config: WarpConfig = flax.struct.field(pytree_node=False)


def init(config: WarpConfig, takes: tuple[int, ...], skinning: Skinning | None, key: Key[Array, ""]) -> Warp:
    """A warp that does nothing but skin; raises ValueError for takes without frames, and where their number is not that
    of the frames of the skinning."""
    if not takes or min(takes) < 1:
        raise ValueError(f"takes of {takes} frames: at least one take of one frame is needed")
    if skinning is not None and len(skinning.bones) != sum(takes):
        raise ValueError(f"bones of {len(skinning.bones)} frames for takes of {takes}: give one pose for each frame")
    rows, shares, first = [], [], 0
    for frames in takes:
        # At least two knots, and the last one not before the last frame: no frame looks into the next take.
        knots = max(2, -(-(frames - 1) // config.knot) + 1)
        row = np.minimum(np.arange(frames) // config.knot, knots - 2)
        rows.append(first + row)
        shares.append(np.arange(frames) / config.knot - row)
        first += knots
    return Warp(
        network=functional.init(Offsets, config, key),
        codes=_smooth_codes(first, config.code),
        rows=jnp.asarray(np.concatenate(rows), jnp.int32),
        shares=jnp.asarray(np.concatenate(shares), jnp.float32),
        skinning=skinning,
        takes=takes,
        config=config,
    )


@jax.jit
def skinning(rig: Rig, canonical: Pose, points: Float[Array, "n 3"], poses: Pose) -> Skinning:
    """Bind points that lie in the body frame of the canonical pose, and pose the bones in all frames (f poses).

    `skeletal.pose_points` with weights that stay where points move: what training moves by a centimetre hangs on the
    same bones.
    """
    weights = skeletal.bind(rig, canonical, points).basis[3::4].T
    back = _blend(weights, skeletal.bones(rig, canonical))
    inverse = jnp.linalg.inv(back[..., :3])
    shift = -jnp.sum(inverse * back[:, None, :, 3], axis=-1)
    posed = jax.vmap(skeletal.bones, in_axes=(None, 0))(rig, poses)
    return Skinning(weights, jnp.concatenate([inverse, shift[..., None]], axis=-1), posed)


def index(warp: Warp, take: int, frame: int) -> int:
    """The number among all frames of a frame of a take; raises ValueError where there is no such frame."""
    if not 0 <= take < len(warp.takes) or not 0 <= frame < warp.takes[take]:
        raise ValueError(f"take {take} has no frame {frame}: the takes have {warp.takes} frames, counted from 0")
    return sum(warp.takes[:take]) + frame


def code(warp: Warp, frame: Int[Array, ""] | int) -> Float[Array, " c"]:
    """What the network is told of a frame, by its number among all frames."""
    row, share = warp.rows[frame], warp.shares[frame]
    return (1 - share) * warp.codes[row] + share * warp.codes[row + 1]


def positions(warp: Warp, points: Float[Array, "n 3"], frame: Int[Array, ""] | int) -> Float[Array, "n 3"]:
    """Where canonical points are in a frame, in its body frame, metres; `frame` is a number among all frames.

    With skinning the n points are those that were bound, wherever training has moved them.
    """
    moved = points
    if warp.skinning is not None:
        rest = _carry(warp.skinning.to_rest, points)
        moved = _carry(_blend(warp.skinning.weights, warp.skinning.bones[frame]), rest)
    return moved + functional.bind(Offsets, warp.config, warp.network)(points, code(warp, frame))


def move(warp: Warp, gaussians: Gaussians, frame: Int[Array, ""] | int) -> Gaussians:
    """Canonical Gaussians in the body frame of a frame: means move, and each turns as the space around its mean does.

    That turn is the rotation nearest to the gradient of the motion, of skinning and network together; stretch and shear
    leave the sizes as they are. Training takes the turn as given: its derivative would be a second one of the motion.
    """
    still, means = jax.lax.stop_gradient((warp, gaussians.means))
    _, push = jax.linearize(lambda x: positions(still, x, frame), means)
    axes = jnp.broadcast_to(jnp.eye(3)[:, None], (3, *means.shape))
    turn = nearest_turn(jnp.moveaxis(jax.vmap(push)(axes), 0, -1))
    return gaussians.replace(
        means=positions(warp, gaussians.means, frame), quats=rotations.multiply(turn, gaussians.quats)
    )


def nearest_turn(matrices: Float[Array, "n 3 3"]) -> Float[Array, "n 4"]:
    """Unit quaternions of the rotations nearest to matrices of positive determinant, in the sense of least squares.

    They are the eigenvectors to the largest eigenvalues of symmetric 4x4 matrices (Davenport's solution of Wahba's
    problem, Keat 1977), which repeated squaring brings out: a batched SVD takes a hundred times as long on a CPU.
    """
    size = jnp.sqrt(jnp.mean(jnp.sum(matrices**2, axis=-1), axis=-1))
    m = matrices / jnp.maximum(size, 1e-12)[:, None, None]
    trace = jnp.trace(m, axis1=-2, axis2=-1)[:, None]
    axis = jnp.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], axis=-1)
    square = m + jnp.swapaxes(m, -1, -2) - trace[..., None] * jnp.eye(3)[None]
    top = jnp.concatenate([trace, axis], axis=-1)[:, None]
    k = jnp.concatenate([top, jnp.concatenate([axis[..., None], square], axis=-1)], axis=1) + jnp.eye(4)[None]
    for _ in range(_SQUARINGS):
        k = jnp.sum(k[..., None] * k[:, None], axis=2)
        k = k / jnp.trace(k, axis1=-2, axis2=-1)[:, None, None]
    best = jnp.argmax(jnp.diagonal(k, axis1=-2, axis2=-1), axis=-1)
    return rotations.normalize(jnp.take_along_axis(k, best[:, None, None], axis=1)[:, 0])


def _smooth_codes(knots: int, count: int) -> Float[Array, "k c"]:
    """Waves along the knots, from one of twice their number to one of four knots.

    Codes that start alike are slow to tell frames apart, and random ones make tracks jump where pictures do not say
    otherwise: in depth.
    """
    rates = np.pi / knots * max(1.0, knots / 2) ** np.linspace(0, 1, -(-count // 2))
    angles = np.arange(knots)[:, None] * rates[None]
    return jnp.asarray(np.concatenate([np.sin(angles), np.cos(angles)], axis=1)[:, :count], jnp.float32)


def _blend(weights: Float[Array, "n j"], bones: Float[Array, "j 3 4"]) -> Float[Array, "n 3 4"]:
    return (weights @ bones.reshape(len(bones), 12)).reshape(-1, 3, 4)


def _carry(transforms: Float[Array, "n 3 4"], points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    return jnp.sum(transforms[..., :3] * points[:, None], axis=-1) + transforms[..., 3]
