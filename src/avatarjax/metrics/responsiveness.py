"""Does the avatar obey its keys? Turning frames and heading errors from root paths (UNICA D.4)."""

from __future__ import annotations

import typing

import numpy as np
from jaxtyping import Float, Int

from avatarjax.metrics import checks

TOLERANCE_DEGREES = 12.0
HOLD_FRAMES = 8


def movement_directions(roots: Float[np.ndarray, "f 3"]) -> Float[np.ndarray, "g"]:
    """Yaw (f - 1,) in radians of the ground step from each frame to the next; roots (f, 3) in metres, y up.

    Raises ValueError for roots that are not finite.
    """
    step = np.diff(checks.finite("roots", roots, (None, 3)), axis=0)
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
    frames without a threshold (UNICA D.4): the two numbers belong beside every result. It also leaves open whether the
    count starts at the key or where the direction begins to change. This one starts at the key, because the paper
    expects more frames under interactive control, where a turn cannot begin while both feet are off the ground;
    `transition_frames` is the other reading.
    """
    near = angle_between(checks.finite("directions", directions, (None,)), wanted) < np.deg2rad(tolerance)
    for frame in range(change, len(near) - hold + 1):
        if near[frame : frame + hold].all():
            return int(frame - change)
    return None


def transition_frames(
    directions: Float[np.ndarray, "g"],
    change: int,
    old: float,
    wanted: float,
    *,
    tolerance: float = TOLERANCE_DEGREES,
    hold: int = HOLD_FRAMES,
) -> int | None:
    """Frames of the turn itself: from the first one after the key change whose movement direction is at least
    `tolerance` degrees off `old` (radians) until it has settled; None where it never does.

    The other reading of UNICA D.4 ("the number of frames required for this directional transition to complete"): the
    wait between key and turn is left out. Never more than `turn_frames`.
    """
    settled = turn_frames(directions, change, wanted, tolerance=tolerance, hold=hold)
    if settled is None:
        return None
    left = np.flatnonzero(angle_between(directions[change : change + settled], old) >= np.deg2rad(tolerance))
    return settled - int(left[0]) if len(left) else 0


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
    mean over the frames after `settle`), the `turn` asked for (degrees, None from standing), its `turn_frames` and its
    `transition_frames` (None from standing). Raises ValueError for roots that are not finite, another number of
    actions than roots, and actions that `yaw` and `moves` do not have.
    """
    roots = checks.finite("roots", roots, (None, 3))
    checks.finite("actions", actions, (len(roots),))
    yaw = checks.finite("yaw", yaw, (None,))
    moves = checks.finite("moves", moves, yaw.shape)
    if actions.min() < 0 or actions.max() >= len(yaw):
        raise ValueError(f"actions must be 0 to {len(yaw) - 1}, got {actions.min()} to {actions.max()}")
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
            wanted = float(yaw[action])
            record["turn_frames"] = turn_frames(directions[:end], int(start), wanted) if start else None
            record["transition_frames"] = (
                transition_frames(directions[:end], int(start), float(yaw[before]), wanted) if from_motion else None
            )
        records.append(record)
    return records
