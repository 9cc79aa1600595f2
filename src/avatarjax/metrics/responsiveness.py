"""Does the avatar obey its keys? Turning frames and heading errors from root paths (UNICA D.4)."""

from __future__ import annotations

import typing

import numpy as np
from jaxtyping import Float, Int

TOLERANCE_DEGREES = 12.0
HOLD_FRAMES = 8


def movement_directions(roots: Float[np.ndarray, "f 3"]) -> Float[np.ndarray, "g"]:
    """Yaw (f - 1,) in radians of the ground step from each frame to the next; roots (f, 3) in metres, y up."""
    step = np.diff(np.asarray(roots, np.float64), axis=0)
    return np.arctan2(step[:, 0], step[:, 2])


def angle_between(a: typing.Any, b: typing.Any) -> np.ndarray | np.floating:
    """Absolute difference of angles in radians, at most pi."""
    return np.asarray(np.abs((np.asarray(a) - np.asarray(b) + np.pi) % (2 * np.pi) - np.pi))


def turn_frames(
    directions: Float[np.ndarray, "g"],
    change: int,
    wanted: float,
    *,
    tolerance: float = TOLERANCE_DEGREES,
    hold: int = HOLD_FRAMES,
) -> int | None:
    """Frames from a key change at frame `change` until the movement direction has settled; None where it never does.

    Settled means within `tolerance` degrees of `wanted` (radians) for `hold` frames on end. The paper defines turning
    frames without a threshold (UNICA D.4): the two numbers belong beside every result.
    """
    near = angle_between(directions, wanted) < np.deg2rad(tolerance)
    for frame in range(change, len(near) - hold + 1):
        if near[frame : frame + hold].all():
            return int(frame - change)
    return None


def responses(
    roots: Float[np.ndarray, "f 3"],
    actions: Int[np.ndarray, "f"],
    yaw: Float[np.ndarray, "a"],
    moves: Float[np.ndarray, "a"],
    *,
    fps: float = 30.0,
    settle: int = 25,
) -> list[dict[str, typing.Any]]:
    """One record for each segment of equal actions: what was asked, and how the root path answered.

    `roots` (f, 3) metres; `yaw` (a,) the world heading an action asks for and `moves` (a,) whether it moves. A record
    has the segment's `start` and `action`, its mean `speed` (m/s) and, for moving actions, `heading_error` (degrees,
    mean over the frames after `settle`), the `turn` asked for (degrees, None from standing) and its `turn_frames`.
    """
    directions = movement_directions(roots)
    speed = np.linalg.norm(np.diff(np.asarray(roots, np.float64)[:, [0, 2]], axis=0), axis=1) * fps
    starts = np.flatnonzero(np.append(True, actions[1:] != actions[:-1]))
    records = []
    for start, end in zip(starts, np.append(starts[1:], len(actions)), strict=True):
        action = int(actions[start])
        # A path of f frames has f - 1 steps: a key pressed at the last frame has none, and gets the last one there is.
        end = min(end, len(speed))
        late = slice(min(start + settle, end - 1), end)
        record = {"start": int(start), "action": action, "speed": float(speed[late].mean())}
        if moves[action]:
            record["heading_error"] = float(np.rad2deg(angle_between(directions[late], yaw[action])).mean())
            before = int(actions[start - 1]) if start else None
            from_motion = before is not None and bool(moves[before])
            turn = float(np.rad2deg(angle_between(yaw[before], yaw[action]))) if from_motion else None
            record["turn"] = turn
            record["turn_frames"] = turn_frames(directions[:end], int(start), float(yaw[action])) if start else None
        records.append(record)
    return records
