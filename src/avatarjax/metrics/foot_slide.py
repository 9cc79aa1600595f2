"""How far feet slide while they touch the ground, from points of the soles alone."""

from __future__ import annotations

import typing

import numpy as np
from jaxtyping import Bool, Float, Int

from avatarjax.metrics import checks

# A foot touches the ground while the lowest point under its toes is lower than this, metres.
CONTACT_HEIGHT = 0.015
# Surface points this close to the height of the lowest one of their foot count as its sole, metres.
SOLE_HEIGHT = 0.03


def contacts(toes: Float[np.ndarray, "f 2 p 3"], *, height: float = CONTACT_HEIGHT) -> Bool[np.ndarray, "f 2"]:
    """Which foot, left and right, touches the ground y = 0 in each frame: its lowest toe point is below `height`.

    `toes` (f, 2, p, 3) are points under the toes of both feet in the world, metres.
    """
    return checks.finite("toes", toes, (None, 2, None, 3))[..., 1].min(axis=2) < height


def foot_slides(
    toes: Float[np.ndarray, "f 2 p 3"], balls: Float[np.ndarray, "g 2 3"], *, height: float = CONTACT_HEIGHT
) -> Float[np.ndarray, " n"]:
    """Horizontal path length of the ball of the foot, metres, in each of the n contacts of a motion.

    A contact is a maximal run of at least two frames in which one foot touches the ground (`contacts`). `balls`
    (f, 2, 3) are the joints at the base of the toes, which move neither when the heel rises nor when the foot pivots on
    them; a path length counts every to and fro. Nothing but the geometry enters, in particular no flag of a foot lock;
    a swinging foot that brushes along the ground counts as a slide. Left contacts come first, each foot's in order of
    time. Raises ValueError for shapes that do not fit or points that are not finite.
    """
    touching = contacts(toes, height=height)
    balls = checks.finite("balls", balls, (len(touching), 2, 3))
    slides = []
    for side in range(2):
        steps = np.linalg.norm(np.diff(balls[:, side][:, [0, 2]], axis=0), axis=1)
        edges = np.flatnonzero(np.diff(np.r_[False, touching[:, side], False]))
        slides += [steps[a : b - 1].sum() for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 1]
    return np.array(slides, np.float32)


class SurfaceFeet(typing.NamedTuple):
    """Which surface points stand for the front of the left and the right sole: (2, p)."""

    toes: Int[np.ndarray, "2 p"]

    def slides(self, points: Float[np.ndarray, "f t 3"], *, height: float = CONTACT_HEIGHT) -> Float[np.ndarray, " n"]:
        """`foot_slides` of world surface points (f, t, 3), metres, where no skeleton is known.

        The ball of the foot is the mean of the sole's front half and not the joint at the base of the toes. It moves a
        few millimetres when the heel rises or the foot pivots, and the lowest of a few surface points is higher than
        the lowest of a skeleton's sole: compare with slides measured in this way only.
        """
        toes = checks.finite("points", points, (None, None, 3), None)[:, self.toes]
        return foot_slides(toes, toes.mean(axis=2), height=height)


def surface_feet(standing: Float[np.ndarray, "t 3"], *, height: float = SOLE_HEIGHT) -> SurfaceFeet:
    """The soles among the surface points (t, 3) of a standing figure that faces +z, metres.

    Left is +x. A sole is made of the points at most `height` above its foot's lowest one, as many for either foot, the
    lowest; its front half (by z) counts as toes. Clothes that hang to the ground would count as soles too. Raises
    ValueError where one side has fewer than two such points, or the points are not finite.
    """
    standing = checks.finite("standing", standing, (None, 3))
    x, y, z = standing.T
    sides = []
    for name, side in (("left", x > 0), ("right", x < 0)):
        members = np.flatnonzero(side)
        members = members[y[members] < y[members].min(initial=np.inf) + height]
        if len(members) < 2:
            raise ValueError(f"the {name} foot (x {'>' if name == 'left' else '<'} 0) has {len(members)} sole points")
        sides.append(members[np.argsort(y[members], kind="stable")])
    count = min(map(len, sides))
    fronts = [lowest[np.argsort(z[lowest], kind="stable")][count // 2 :] for lowest in (s[:count] for s in sides)]
    return SurfaceFeet(np.stack(fronts))
