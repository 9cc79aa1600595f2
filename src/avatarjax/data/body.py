"""The shipped human body: a MakeHuman mesh that macro targets shape, with the `mixamo` rig that follows the shape."""

from __future__ import annotations

import dataclasses
import functools
import typing
from collections.abc import Mapping
from pathlib import Path

import flax.struct
import numpy as np
from jaxtyping import Array, Float, Int
from scipy import optimize

from avatarjax.io import weights

ASSET = Path(__file__).parent.parent / "assets" / "human.safetensors"
# Positions are stored as int16 multiples of this many metres.
QUANTUM = 5e-5
# Points of the skin this close to the ground in the rest pose count as the sole.
_SOLE_HEIGHT = 0.03


@typing.no_type_check
@flax.struct.dataclass
class Rig:
    """A skeleton in its rest pose: heads and tails (j, 3) in metres, names and parents (-1 for the hips) as static
    tuples.

    Parents come before their children. soles (2, s, 3) are points under the left and the right foot in the rest pose,
    which say how far the figure is from the ground; their first half moves with the foot, the rest with the toes.
    """

    heads: Float[Array, "j 3"]
    tails: Float[Array, "j 3"]
    soles: Float[Array, "2 s 3"]
    names: tuple[str, ...] = flax.struct.field(pytree_node=False)
    parents: tuple[int, ...] = flax.struct.field(pytree_node=False)

    def index(self, name: str) -> int:
        """The joint number of a bone name; raises ValueError that names the bones there are."""
        if name not in self.names:
            raise ValueError(f"no bone {name!r}; the rig has {', '.join(self.names)}")
        return self.names.index(name)


@dataclasses.dataclass(frozen=True, eq=False)
class Body:
    """The unshaped body as NumPy arrays, metres: what `shape` needs and what stays the same for every shape.

    vertices (v, 3); joints (j, 2, 3) head and tail of each bone; faces (q, 4) quads; uvs (u, 2) in [0, 1] with v up;
    uv_faces (q, 4) into uvs; parts (q,) index into groups; skin_weights (v, j), rows sum to 1; targets: name -> (v, 3)
    vertex offsets; target_joints: name -> (j, 2, 3) joint offsets.
    """

    vertices: Float[np.ndarray, "v 3"]
    joints: Float[np.ndarray, "j 2 3"]
    faces: Int[np.ndarray, "q 4"]
    uvs: Float[np.ndarray, "u 2"]
    uv_faces: Int[np.ndarray, "q 4"]
    parts: Int[np.ndarray, "q"]
    skin_weights: Float[np.ndarray, "v j"]
    targets: dict[str, np.ndarray]
    target_joints: dict[str, np.ndarray]
    names: tuple[str, ...]
    parents: tuple[int, ...]
    groups: tuple[str, ...]


@functools.cache
def load_body() -> Body:
    """The shipped body (ASSETS.md says where it is from). Treat its arrays as read-only."""
    arrays, metadata = weights.load_arrays(ASSET)
    skin = np.zeros((len(arrays["vertices"]), len(metadata["names"])), np.float32)
    np.put_along_axis(skin, arrays["skin_bones"].astype(np.int64), arrays["skin_weights"].astype(np.float32), axis=1)
    prefix = "targets/"
    targets = {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
    return Body(
        vertices=arrays["vertices"].astype(np.float32) * np.float32(QUANTUM),
        joints=arrays["joints"],
        faces=arrays["faces"].astype(np.int32),
        uvs=arrays["uvs"].astype(np.float32) / np.float32(65535),
        uv_faces=arrays["uv_faces"].astype(np.int32),
        parts=arrays["parts"].astype(np.int32),
        skin_weights=skin / skin.sum(1, keepdims=True),
        targets={k: v.astype(np.float32) * np.float32(QUANTUM) for k, v in targets.items()},
        target_joints={k: arrays[f"target_joints/{k}"] for k in targets},
        names=tuple(metadata["names"]),
        parents=tuple(metadata["parents"]),
        groups=tuple(metadata["groups"]),
    )


def shape(body: Body, macro: Mapping[str, float]) -> tuple[Float[np.ndarray, "v 3"], Rig]:
    """Rest vertices (v, 3) and the rig of the body under weighted macro targets, metres, soles on the ground y = 0.

    `macro` is {target: weight}; MakeHuman means one target of race, sex and age to have weight 1 and those that start
    with `universal` to vary build. Raises ValueError for a target that is not shipped.
    """
    unknown = sorted(set(macro) - set(body.targets))
    if unknown:
        raise ValueError(f"unknown targets {unknown}; the body has {sorted(body.targets)}")
    vertices, joints = body.vertices.copy(), body.joints.copy()
    for name, weight in macro.items():
        vertices += np.float32(weight) * body.targets[name]
        joints += np.float32(weight) * body.target_joints[name]
    skin = body.faces[body.parts == body.groups.index("body")]
    ground = np.array([0.0, vertices[skin, 1].min(), 0.0], np.float32)
    vertices, joints = vertices - ground, joints - ground
    return vertices, Rig(joints[:, 0], joints[:, 1], _soles(body, vertices), body.names, body.parents)


def fit(body: Body, heads: Float[np.ndarray, "j 3"]) -> dict[str, float]:
    """The macro weights, none below zero, with which `shape` brings the joints nearest to given ones (j, 3), in metres
    and in the order of the body's, wherever their ground is; targets of no weight are left out.

    Least squares. Raises ValueError for another number of joints.
    """
    if heads.shape != body.joints[:, 0].shape:
        raise ValueError(f"{heads.shape} joints: the body has {len(body.names)}, {', '.join(body.names)}")
    names = sorted(body.targets)
    up = np.tile([0.0, 1.0, 0.0], len(heads))
    columns = [*(body.target_joints[name][:, 0].ravel() for name in names), up, -up]
    found, _ = optimize.nnls(np.stack(columns, axis=1).astype(np.float64), (heads - body.joints[:, 0]).ravel())
    return {name: float(weight) for name, weight in zip(names, found, strict=False) if weight > 0}


def _soles(body: Body, vertices: np.ndarray) -> np.ndarray:
    """Eight extreme points of each foot and of each toe part, spread over directions in the ground plane."""
    angles = np.arange(8) * np.pi / 4
    directions = np.stack([np.cos(angles), np.sin(angles)])
    soles = []
    for side in ("Left", "Right"):
        points = []
        for bone in ("Foot", "ToeBase"):
            mostly = body.skin_weights[:, body.names.index(side + bone)] > 0.5
            low = vertices[mostly & (vertices[:, 1] < _SOLE_HEIGHT)]
            points.append(low[np.argmax(low[:, [0, 2]] @ directions, axis=0)])
        soles.append(np.concatenate(points))
    return np.stack(soles).astype(np.float32)
