"""From a file's axes and unit to ours: metres, y up, figure facing +z, left at +x, right-handed."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

# Up, the direction the figure faces, handedness. A glTF asset faces +z (its specification); a figure modelled in
# Blender faces its front view, -y; an Unreal actor faces +x, and the skeletal mesh inside it +y.
PRESETS = {
    "gltf": ("y", "z", "right"),
    "blender": ("z", "-y", "right"),
    "unreal": ("z", "x", "left"),
    "unreal-mesh": ("z", "y", "left"),
}
_FORWARD = {("y", "right"): "z", ("y", "left"): "z", ("z", "right"): "-y", ("z", "left"): "x"}
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
HEIGHTS = (0.5, 3.0)
_AXES = ("x", "y", "z")
# A figure clearly stands where its height exceeds both other extents by this factor; with its arms spread it is a draw.
_CLEAR = 1.25
# Two feet or a hem spread wider than a crown, by this factor where it is clear which end is which.
_WIDER = 1.7


def _direction(name: str, what: str) -> Float[np.ndarray, "3"]:
    axis = name.lower().removeprefix("+").removeprefix("-")
    if axis not in _AXES:
        raise ValueError(f"{what}={name!r} is no axis: choose one of x, y, z, -x, -y, -z")
    return np.eye(3)[_AXES.index(axis)] * (-1.0 if name.startswith("-") else 1.0)


def matrix(up: str, forward: str | None = None, handedness: str = "right") -> Float[np.ndarray, "3 3"]:
    """The matrix (3, 3) that takes a file's coordinates to our axes, without the unit.

    `up` and `forward` are signed axes of the file, such as "z" and "-y"; by default a figure faces +z of a y-up file,
    -y of a z-up one, +x of a left-handed z-up one. Raises ValueError for unknown or parallel axes.
    """
    if handedness not in ("left", "right"):
        raise ValueError(f"handedness={handedness!r} is unknown: choose 'left' or 'right'")
    forward = forward or _FORWARD.get((up.lower().lstrip("+-"), handedness), "z")
    above, ahead = _direction(up, "up"), _direction(forward, "forward")
    if abs(above @ ahead) > 0:
        raise ValueError(f"a figure cannot face {forward!r} with {up!r} up: pass another forward")
    left = np.cross(above, ahead) * (1.0 if handedness == "right" else -1.0)
    return np.stack([left, above, ahead])


def choose(
    vertices: Float[np.ndarray, "v 3"],
    *,
    up: str = "auto",
    forward: str | None = None,
    handedness: str = "right",
    axes: str | None = None,
    check: bool = True,
    source: str = "the mesh",
) -> Float[np.ndarray, "3 3"]:
    """The matrix to our axes for a figure whose first frame has these vertices (v, 3).

    `axes` is one of PRESETS and replaces the other three. With up="auto" the longest extent is the height; where two
    are alike (arms spread), the one along which the figure is not mirror-symmetric. The head's end is the slimmer one.
    Raises ValueError that names `source` and the fix where a stated axis contradicts a clearly standing figure, unless
    `check` is False.
    """
    if axes is not None:
        if axes not in PRESETS:
            raise ValueError(f"axes={axes!r} is unknown: choose one of {', '.join(PRESETS)}, or pass up and forward")
        if up != "auto" or forward is not None:
            raise ValueError(f"axes={axes!r} already says up and forward: pass either axes, or up and forward")
        up, forward, handedness = PRESETS[axes]
    elif up == "auto":
        return matrix(_standing_up(vertices), forward, handedness)
    chosen = matrix(up, forward, handedness)
    extents = np.ptp(vertices, axis=0)
    longest = int(np.argmax(extents))
    clear = extents[longest] > _CLEAR * np.delete(extents, longest).max()
    if check and clear and _AXES[longest] != up.lstrip("+-").lower():
        shown = ", ".join(f"{axis} {extent:.3g}" for axis, extent in zip(_AXES, extents, strict=True))
        raise ValueError(
            f"{source}: {up!r} is said to be up, but its first frame stands along {_AXES[longest]} (extents {shown}): "
            f"pass up={_AXES[longest]!r} and no axes, or check=False when the figure really lies down"
        )
    heights = vertices @ chosen[1]
    if check and clear and _slim(heights, vertices) * _WIDER < _slim(-heights, vertices):
        flipped = up[1:] if up.startswith("-") else f"-{up.lstrip('+')}"
        raise ValueError(
            f"{source}: with {up!r} up the figure stands on its head: pass up={flipped!r}, or check=False when it does"
        )
    return chosen


def _standing_up(vertices: np.ndarray) -> str:
    extents = np.ptp(vertices, axis=0)
    candidates = np.flatnonzero(extents > extents.max() / _CLEAR)
    lopsided = [_asymmetry(vertices[:, axis]) for axis in candidates]
    axis = int(candidates[np.argmax(lopsided)]) if len(candidates) > 1 else int(candidates[0])
    heights = vertices[:, axis]
    upside_down = _slim(heights, vertices) * _WIDER < _slim(-heights, vertices)
    return f"{'-' if upside_down else ''}{_AXES[axis]}"


def _asymmetry(values: np.ndarray) -> float:
    """How far the distribution of coordinates is from its mirror image, 0 to 2."""
    histogram, _ = np.histogram(values, bins=24)
    return float(np.abs(histogram - histogram[::-1]).sum() / len(values))


def _slim(heights: np.ndarray, vertices: np.ndarray) -> float:
    """Spread of the vertices within the lowest 3 % of the height: two feet or a hem, against one crown."""
    low = heights.min()
    return float(vertices[heights <= low + 0.03 * (heights.max() - low)].std(axis=0).max())


def metres(height: float, unit: str | float = "auto", *, check: bool = True, source: str = "the mesh") -> float:
    """Metres in one unit of a file in which the standing figure is `height` units tall.

    "auto" finds which of m, cm and mm gives a height of 0.5 to 3 m; a number is taken as it is. Raises ValueError that
    names `source` for an unknown unit, where no unit fits, or where the stated one gives another height, unless `check`
    is False.
    """
    low, high = HEIGHTS
    fitting = [name for name, size in UNITS.items() if low <= height * size <= high]
    if unit == "auto":
        if not fitting:
            raise ValueError(
                f"{source}: a figure {height:.4g} units tall is {low} to {high} m in none of {', '.join(UNITS)}: pass "
                "unit=METRES_IN_ONE_UNIT with check=False, or see whether its export was scaled"
            )
        return UNITS[fitting[0]]
    if isinstance(unit, str) and unit not in UNITS:
        raise ValueError(f"unit={unit!r} is unknown: choose 'auto', one of {', '.join(UNITS)}, or a number of metres")
    size = UNITS[unit] if isinstance(unit, str) else float(unit)
    if not (np.isfinite(size) and size > 0):
        raise ValueError(f"unit={unit!r} must be a positive number of metres")
    if check and not low <= height * size <= high:
        fix = f"pass unit={fitting[0]!r}" if fitting else "pass the right number of metres"
        raise ValueError(
            f"{source}: with unit={unit!r} the figure is {height * size:.4g} m tall, not {low} to {high}: {fix}, or "
            "check=False"
        )
    return size


def outward(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "g 3"], uvs: Float[np.ndarray, "g 3 2"] | None
) -> tuple[Int[np.ndarray, "g 3"], Float[np.ndarray, "g 3 2"] | None]:
    """Faces and their corners' texture coordinates with counter-clockwise winding seen from outside.

    All are turned where the mesh encloses a negative volume: left-handed exporters do not agree on the winding.
    """
    a, b, c = (vertices[faces[:, k]].astype(np.float64) - vertices.mean(axis=0) for k in range(3))
    if np.einsum("gc,gc->", a, np.cross(b, c)) >= 0:
        return faces, uvs
    return faces[:, ::-1].copy(), None if uvs is None else uvs[:, ::-1].copy()
