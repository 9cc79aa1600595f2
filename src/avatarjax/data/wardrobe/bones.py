"""Which bones carry a piece: skinning weights from names of bones or from a body near by, and places along limbs."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe.garments import smoothstep


def share(rig: Rig, weights: Float[np.ndarray, "v j"], *words: str) -> Float[np.ndarray, " v"]:
    """How much of each vertex's skinning weights (v, j) is on bones whose names contain one of the words: (v,)."""
    return weights[:, [i for i, name in enumerate(rig.names) if any(word in name for word in words)]].sum(1)


def one_bone(rig: Rig, name: str, count: int) -> np.ndarray:
    """Skinning weights (count, j) that are all on one bone."""
    weights = np.zeros((count, len(rig.names)), np.float32)
    weights[:, rig.index(name)] = 1
    return weights


def nearest_weights(
    points: Float[np.ndarray, "n 3"], body: Float[np.ndarray, "v 3"], weights: Float[np.ndarray, "v j"], count: int = 12
) -> Float[np.ndarray, "n j"]:
    """Skinning weights (n, j) of points near a body: means of its nearest vertices' weights."""
    _, nearest = cKDTree(body).query(points, k=count)
    mean = weights[nearest].mean(axis=1)
    return (mean / mean.sum(1, keepdims=True)).astype(np.float32)


def head_then_chest(rig: Rig, vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v j"]:
    """Skinning weights (v, j) of what hangs from the head: on the head, blending to the chest below the chin."""
    neck = rig.heads[rig.index("Neck"), 1]
    on_head = smoothstep(vertices[:, 1], neck - 0.06, neck + 0.06)
    weights = one_bone(rig, "Head", len(vertices)) * on_head[:, None]
    weights[:, rig.index("Spine2")] += 1 - on_head
    return weights.astype(np.float32)


@dataclasses.dataclass(frozen=True, eq=False)
class Limb:
    """A bone of the left arm or leg: its joint (3,), metres, and the unit direction (3,) to where it ends. Points on
    the right are measured as their mirror images."""

    joint: Float[np.ndarray, "3"]
    direction: Float[np.ndarray, "3"]

    def along(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Metres (n,) from the joint along the limb; negative before it."""
        return (np.stack([np.abs(p[:, 0]), p[:, 1], p[:, 2]], axis=1) - self.joint) @ self.direction


def limb(rig: Rig, start: str, end: str, joint: str | None = None) -> Limb:
    """The left limb from the joint `start` to `end`, as in ("Arm", "ForeArm"); measured from `joint`, or from its
    start."""
    a, b, at = (rig.heads[rig.index("Left" + name)].astype(np.float64) for name in (start, end, joint or start))
    return Limb(at, (b - a) / np.linalg.norm(b - a))
