"""The close-fitting upper part of a robe or dress, painted and let out on the skin: where it ends."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe.bones import Limb, limb
from avatarjax.data.wardrobe.garments import smoothstep


@dataclasses.dataclass(frozen=True, eq=False)
class Bodice:
    """A bodice from the neck to height `waist`, with sleeves `sleeve` metres long from the shoulder joint.

    arm is the left upper arm; neck the height of the neck joint; dip how far the neckline is below it in front. Metres
    in the rest pose; left and right are alike.
    """

    arm: Limb
    neck: float
    waist: float
    sleeve: float
    dip: float = 0.03

    def along(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Metres from the shoulder joint along the upper arm, on the arm; minus one elsewhere."""
        return down_the_arm(self.arm, p)

    def taper(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """1 on the trunk, 0 where the sleeves end: how thick cloth is that goes on as a separate sleeve."""
        return smoothstep(self.along(p), self.sleeve, self.sleeve - 0.09)

    def collar(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Metres above the neckline, which is lower in front than behind and runs over the shoulders."""
        level = self.neck - 0.008 - self.dip * smoothstep(p[:, 2], -0.02, 0.07)
        return p[:, 1] - level - 0.8 * np.clip(np.abs(p[:, 0]) - 0.055, 0, None)

    def covered(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """1 where the bodice is, 0 on bare skin."""
        along = self.along(p)
        inside = smoothstep(self.collar(p), 0.003, -0.003) * smoothstep(along, self.sleeve + 0.005, self.sleeve - 0.005)
        return inside * np.where(along > -0.5, 1.0, smoothstep(p[:, 1], self.waist - 0.06, self.waist - 0.05))


def fit(rig: Rig, *, waist: float, sleeve: float, dip: float = 0.03) -> Bodice:
    """The bodice for a skeleton; lengths in metres."""
    return Bodice(limb(rig, "Arm", "ForeArm"), float(rig.heads[rig.index("Neck"), 1]), waist, sleeve, dip)


def down_the_arm(arm: Limb, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Metres (n,) from the shoulder joint along the upper `arm`, on the arm; minus one elsewhere."""
    x, (side, level, _) = np.abs(p[:, 0]), arm.joint
    return np.where(x > side - 0.01 + 0.35 * np.clip(level - p[:, 1], 0, None), arm.along(p), -1.0)
