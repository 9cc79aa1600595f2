"""An avatar's whole mesh over a motion: skin and props by linear blend skinning, cloth and hair by simulation.

The cloth starts in its rest pose, where it hangs free of the body, and the body moves from there into the first frame
of the motion within a second that is not recorded: so nothing begins in the wrong side of a leg.
"""

from __future__ import annotations

import functools
import typing
from collections.abc import Callable, Iterator

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import cKDTree

from avatarjax.data import skinning
from avatarjax.data.body import Rig
from avatarjax.data.wardrobe.assembly import AvatarMesh, vertex_normals
from avatarjax.physics import cloth as cloths
from avatarjax.physics import xpbd
from avatarjax.physics.contacts import Capsules, Surface

# Cloth collides with so many points of each of these groups of limbs, 2 to 3 cm apart.
_POINTS = 512
_LIMBS = ("LeftUpLeg LeftLeg LeftFoot LeftToe", "RightUpLeg RightLeg RightFoot RightToe", "Arm", "")
# Thin and quick: cloth that a hand has pressed against the body would go right through it.
_INTANGIBLE = "Hand"
# Where along the bones bars lie between the legs, and how thick they are against the leg.
_BARS = {"UpLeg": (0.3, 0.5, 0.7, 0.9), "Leg": (0.1, 0.35, 0.6, 0.85)}
_BAR_RADIUS = 0.9
# Frames that one call of a compiled function simulates; as many, a second, pass before the first one.
_CHUNK = 30
# Frames of standing after which all hangs still.
_SETTLING = 65


@typing.no_type_check
@flax.struct.dataclass
class Outfit:
    """Constants of one avatar's simulation: skinning bases (4 j, v) of the whole mesh, (4 j, n) of the cloth, (4 j,
    g m) of the solid surface's points and normals, (4 j, 2 c) of the ends of the c bars between the legs, of radii
    bar_radii (c,); cloth; own (n,) the cloth's vertices in the mesh; hips: the bone."""

    basis: Float[Array, "k v"]
    cloth_basis: Float[Array, "k n"]
    point_basis: Float[Array, "k p"]
    normal_basis: Float[Array, "k p"]
    bar_basis: Float[Array, "k b"]
    bar_radii: Float[Array, " c"]
    cloth: cloths.Cloth
    own: Int[Array, " n"]
    hips: Float[Array, " 3"]


@functools.lru_cache(maxsize=8)
def outfit(avatar: AvatarMesh) -> Outfit:
    """What `simulate` needs of an avatar; the same object every time. Takes about a second."""
    simulated = np.zeros(len(avatar.part_names), bool)
    simulated[np.unique(avatar.parts[(avatar.reach[avatar.faces] > 0).any(axis=1)])] = True
    solid = np.array(avatar.solid) & ~simulated
    points, normals, bones = _surface(avatar, solid)
    chosen = np.isin(avatar.parts, np.flatnonzero(simulated))
    own, faces = np.unique(avatar.faces[chosen], return_inverse=True)
    place = np.full(len(avatar.vertices), -1)
    place[own] = np.arange(len(own))
    tree = cKDTree(points)
    _, near = tree.query(avatar.vertices[own])
    distance = ((avatar.vertices[own] - points[near]) * normals[near]).sum(1)
    cloth = cloths.sew(
        avatar.vertices[own],
        faces.reshape(-1, 3),
        avatar.uvs[chosen],
        avatar.parts[chosen],
        avatar.fabrics,
        avatar.reach[own],
        place[avatar.braces],
        distance,
    )
    weights = jnp.asarray(avatar.weights)
    picked = _spread_out(points, bones, avatar.rig)
    skin = skinning.skinning_basis(jnp.asarray(avatar.vertices), weights)
    bone_weights = jnp.asarray(bones[picked])
    bars, bar_weights, radii = _bars(avatar.rig, points, bones)
    return Outfit(
        basis=skin,
        cloth_basis=skin[:, own],
        point_basis=skinning.skinning_basis(jnp.asarray(points[picked]), bone_weights),
        normal_basis=skinning.skinning_basis(jnp.asarray(normals[picked]), bone_weights, direction=True),
        bar_basis=skinning.skinning_basis(jnp.asarray(bars), jnp.asarray(bar_weights)),
        bar_radii=jnp.asarray(radii),
        cloth=jax.tree.map(jnp.asarray, cloth),
        own=jnp.asarray(own, jnp.int32),
        hips=jnp.asarray(avatar.rig.heads[avatar.rig.index("Hips")]),
    )


def _surface(avatar: AvatarMesh, solid: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, unit normals and skinning weights of the parts that are solid."""
    faces = avatar.faces[np.isin(avatar.parts, np.flatnonzero(solid))]
    used, own = np.unique(faces, return_inverse=True)
    normals = vertex_normals(avatar.vertices[used], own.reshape(-1, 3))
    hand = np.array([_INTANGIBLE in name for name in avatar.rig.names])
    kept = ~hand[avatar.weights[used].argmax(1)]
    return avatar.vertices[used][kept], normals[kept], avatar.weights[used][kept]


def _spread_out(points: np.ndarray, weights: np.ndarray, rig: Rig) -> np.ndarray:
    """Indices (g m,) of points spread evenly over each group of limbs: farthest point sampling."""
    bone = weights.argmax(1)
    left = np.ones(len(points), bool)
    chosen = []
    for limb in _LIMBS:
        bones = [j for j, name in enumerate(rig.names) if any(part in name for part in limb.split()) or not limb]
        mine = np.flatnonzero(left & np.isin(bone, bones))
        left[mine] = False
        own = points[mine]
        picked = [0]
        away = np.full(len(mine), np.inf)
        for _ in range(_POINTS - 1):
            away = np.minimum(away, ((own - own[picked[-1]]) ** 2).sum(1))
            picked.append(int(away.argmax()))
        chosen.append(mine[picked])
    return np.concatenate(chosen)


def _bars(rig: Rig, points: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ends (2 c, 3), skinning weights (2 c, j) and radii (c,) of bars from the left to the right leg, at places along
    the thighs and shins: what hangs around both legs then never gets between them, where they would tear at it."""
    ends, bones, radii = [], [], []
    for bone in ("UpLeg", "Leg"):
        for share in _BARS[bone]:
            for side in ("Left", "Right"):
                j = rig.index(side + bone)
                axis = rig.tails[j] - rig.heads[j]
                length = np.linalg.norm(axis)
                place = rig.heads[j] + share * axis
                offset = points[weights.argmax(1) == j] - place
                along = offset @ axis / length
                near = offset[np.abs(along) < 0.03] - along[np.abs(along) < 0.03, None] * axis / length
                ends.append(place)
                bones.append(j)
            radii.append(_BAR_RADIUS * np.median(np.linalg.norm(near, axis=1)))
    return (
        np.array(ends, np.float32),
        np.eye(len(rig.names), dtype=np.float32)[bones],
        np.array(radii, np.float32),
    )


def drive(outfit: Outfit, transforms: Float[Array, "j 3 4"]) -> xpbd.Drive:
    """Where the cloth of one frame would hang if it were stiff, and the solid surface, from bone transforms
    (j, 3, 4)."""
    shape = (len(_LIMBS), _POINTS, 3)
    points = skinning.skin(outfit.point_basis, transforms).reshape(shape)
    normals = skinning.skin(outfit.normal_basis, transforms).reshape(shape)
    bars = skinning.skin(outfit.bar_basis, transforms).reshape(-1, 2, 3)
    capsules = Capsules(bars[:, 0], bars[:, 1], outfit.bar_radii)
    return xpbd.Drive(skinning.skin(outfit.cloth_basis, transforms), Surface(points, normals), capsules)


_drives = jax.jit(jax.vmap(drive, in_axes=(None, 0)))
_advance = jax.jit(xpbd.simulate, static_argnames="config")


def dress(
    outfit: Outfit, transforms: Float[Array, "j 3 4"], velocity: Float[Array, " 3"], config: xpbd.XPBDConfig
) -> xpbd.ClothState:
    """The cloth on a body in one pose that moves with a velocity (3,), metres a second: put on in the rest pose, after
    which the body takes the pose within a second while all of it moves along."""
    return _advance(outfit.cloth, *_put_on(outfit, transforms, velocity, config), config)[0]


@functools.partial(jax.jit, static_argnames="config")
def _put_on(
    outfit: Outfit, transforms: Array, velocity: Array, config: xpbd.XPBDConfig
) -> tuple[xpbd.ClothState, xpbd.Drive]:
    """The cloth in the rest pose, and what carries it into the first frame."""
    # The rest pose turned to where the body faces, and set where it stands.
    ahead = transforms[0, :, 2]
    length = jnp.sqrt(ahead[0] ** 2 + ahead[2] ** 2 + 1e-12)
    sine, cosine = ahead[0] / length, ahead[2] / length
    zero, one = jnp.zeros(()), jnp.ones(())
    yaw = jnp.array([[cosine, zero, sine], [zero, one, zero], [-sine, zero, cosine]])
    hips = transforms[0, :, :3] @ outfit.hips + transforms[0, :, 3]
    shift = (hips - yaw @ outfit.hips) * jnp.array([1.0, 0.0, 1.0])
    rest = jnp.broadcast_to(jnp.concatenate([yaw, shift[:, None]], axis=1), transforms.shape)
    begin, end = drive(outfit, rest), drive(outfit, transforms)

    time = jnp.arange(_CHUNK + 1, dtype=jnp.float32)
    share = jnp.minimum(time / (_CHUNK * 2 / 3), 1)
    share = share * share * (3 - 2 * share)
    along = velocity[None] * ((time - _CHUNK) / config.fps)[:, None]

    def between(a: Array, b: Array) -> Array:
        s = share.reshape((-1,) + (1,) * a.ndim)
        return a[None] * (1 - s) + b[None] * s

    drives = jax.tree.map(between, begin, end)

    def moved(points: Array) -> Array:
        return points + along.reshape(-1, *(1,) * (points.ndim - 2), 3)

    surface, capsules = drives.surface, drives.capsules
    drives = xpbd.Drive(
        moved(drives.targets),
        surface.replace(points=moved(surface.points)),
        capsules.replace(begin=moved(capsules.begin), end=moved(capsules.end)),
    )
    return xpbd.ClothState(drives.targets[0], jnp.broadcast_to(velocity, drives.targets[0].shape)), drives


@jax.jit
def _whole(outfit: Outfit, transforms: Array, cloth: Array) -> Array:
    vertices = jax.vmap(skinning.skin, in_axes=(None, 0))(outfit.basis, transforms)
    return vertices.at[:, outfit.own].set(cloth)


def simulate(
    avatar: AvatarMesh,
    transforms: Float[Array | np.ndarray, "f j 3 4"],
    config: xpbd.XPBDConfig = xpbd.XPBDConfig(),
    *,
    progress: Callable[[int], typing.Any] | None = None,
) -> Float[np.ndarray, "f v 3"]:
    """World vertices (f, v, 3) of an avatar whose bones have the transforms (f, j, 3, 4), 30 frames a second, metres.

    Deterministic. `progress` is called with the number of frames that were finished since the last call.
    """
    frames = np.empty((len(transforms), len(avatar.vertices), 3), np.float32)
    done = 0
    for chunk in chunks(avatar, transforms, config):
        frames[done : done + len(chunk)] = chunk
        done += len(chunk)
        if progress:
            progress(len(chunk))
    return frames


def chunks(
    avatar: AvatarMesh, transforms: Float[Array | np.ndarray, "f j 3 4"], config: xpbd.XPBDConfig = xpbd.XPBDConfig()
) -> Iterator[Float[np.ndarray, "c v 3"]]:
    """What `simulate` gives, as it is made: the first frame, then some at a time, always as many for the compiler, so
    that all motions share one program."""
    own = outfit(avatar)
    transforms = jnp.asarray(transforms)
    count = len(transforms)
    hips = transforms[: min(count, 2), 0, :, :3] @ own.hips + transforms[: min(count, 2), 0, :, 3]
    velocity = (hips[-1] - hips[0]) * config.fps * jnp.array([1.0, 0.0, 1.0])
    state = dress(own, transforms[0], velocity, config)
    yield np.asarray(_whole(own, transforms[:1], state.positions[None]))
    for start in range(0, count - 1, _CHUNK):
        # The last chunk is filled up with the last frame.
        chunk = transforms[np.minimum(np.arange(start, start + _CHUNK + 1), count - 1)]
        state, cloth = _advance(own.cloth, state, _drives(own, chunk), config)
        yield np.asarray(_whole(own, chunk[1:], cloth))[: count - 1 - start]


def settle(
    avatar: AvatarMesh, transforms: Float[Array | np.ndarray, "j 3 4"], config: xpbd.XPBDConfig = xpbd.XPBDConfig()
) -> Float[np.ndarray, "v 3"]:
    """World vertices (v, 3) of an avatar that has stood still in one pose, transforms (j, 3, 4), for a while."""
    still = jnp.broadcast_to(jnp.asarray(transforms), (_SETTLING, *np.shape(transforms)))
    return simulate(avatar, still, config)[-1]
