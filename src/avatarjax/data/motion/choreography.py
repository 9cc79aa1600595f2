"""Motion from key poses: where the figure stands, where each foot is, how the arms are held, with minimum-jerk ways
between.

Flash and Hogan 1985 ("The coordination of arm movements") found that people move between rests along the fifth-degree
polynomial used here. Feet keyed as down are planted by the foot lock; a foot may be keyed in the world or with the
body.
"""

from __future__ import annotations

import dataclasses
import typing

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from avatarjax import rotations
from avatarjax.data.body import Rig
from avatarjax.data.motion import clips, foot_plans, footlock, footsteps
from avatarjax.data.motion.locomotion import Motion

FPS = 30.0
GRAVITY = 9.81
# Directions of the left upper arm and forearm, +x out to the side, +z forward; the right arm mirrors them.
ARMS: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "low": ((0.28, -0.95, -0.02), (0.2, -0.95, 0.2)),
    "guard": ((0.35, -0.8, 0.35), (-0.3, 0.6, 0.75)),
    "wide": ((0.97, -0.2, 0.1), (0.95, -0.05, 0.3)),
    "round": ((0.65, -0.45, 0.6), (-0.5, -0.05, 0.85)),
    "back": ((0.3, -0.75, -0.6), (0.2, -0.85, -0.4)),
    "forward": ((0.25, 0.1, 0.95), (0.05, 0.35, 0.95)),
    "high": ((0.55, 0.75, 0.3), (0.15, 0.95, 0.2)),
}


@dataclasses.dataclass(frozen=True)
class Foot:
    """Where one foot is at a key: the toes' joint at `place` (x, y, z), metres, relative to the root and heading of the
    body where `with_body`, else in the world; y counts from where a standing foot's is. `yaw` and `rise` of the heel in
    radians, yaw in the same frame; a foot that is `down` is planted until its next key with `down` false."""

    place: tuple[float, float, float]
    yaw: float = 0.0
    rise: float = 0.0
    down: bool = True
    with_body: bool = False


@dataclasses.dataclass
class Score:
    """Keys (frame, value) by channel; between keys each channel moves along a minimum-jerk way.

    body: (x, z, heading, hips, pitch, roll) in metres and radians, `hips` being the height against standing; flights:
    (first, last) frames in which the hips fly under gravity from key to key; arms: names of ARMS, left and right.
    """

    frames: int
    body: list[tuple[float, tuple[float, ...]]] = dataclasses.field(default_factory=list)
    left: list[tuple[float, Foot]] = dataclasses.field(default_factory=list)
    right: list[tuple[float, Foot]] = dataclasses.field(default_factory=list)
    arms: list[tuple[float, tuple[str, str]]] = dataclasses.field(default_factory=list)
    flights: list[tuple[float, float]] = dataclasses.field(default_factory=list)


def _way(u: np.ndarray) -> np.ndarray:
    u = np.clip(u, 0, 1)
    return u**3 * (10 - 15 * u + 6 * u * u)


def _between(times: np.ndarray, frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each frame: the key before, the key after, and how far along the way (f,)."""
    t = np.arange(frames)
    after = np.clip(np.searchsorted(times, t, side="right"), 1, len(times) - 1)
    before = after - 1
    span = np.maximum(times[after] - times[before], 1e-6)
    return before, after, _way((t - times[before]) / span)


def _body(score: Score) -> np.ndarray:
    times = np.array([t for t, _ in score.body], float)
    values = np.array([v for _, v in score.body], float)
    before, after, w = _between(times, score.frames)
    track = values[before] * (1 - w[:, None]) + values[after] * w[:, None]
    t = np.arange(score.frames)
    for first, last in score.flights:
        # A free fall from key to key; the push before it and the landing after it join with its speed.
        off, on = np.argmin(np.abs(times - first)), np.argmin(np.abs(times - last))
        start, end = values[off, 3], values[on, 3]
        inside = (t >= first) & (t <= last)
        s, whole = (t[inside] - first) / FPS, (last - first) / FPS
        speed = (end - start) / whole + GRAVITY * whole / 2
        track[inside, 3] = start + speed * s - GRAVITY * s * s / 2
        for a, b, rates in ((off - 1, off, (0.0, speed)), (on, on + 1, (speed - GRAVITY * whole, 0.0))):
            inside = (t >= times[a]) & (t <= times[b])
            whole_side = (times[b] - times[a]) / FPS
            u = (t[inside] - times[a]) / (times[b] - times[a])
            blend = u * u * (3 - 2 * u)
            bend = u * (1 - u) ** 2 * rates[0] - u * u * (1 - u) * rates[1]
            track[inside, 3] = values[a, 3] * (1 - blend) + values[b, 3] * blend + bend * whole_side
    return track


def _turned(yaw: np.ndarray, place: np.ndarray) -> np.ndarray:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * place[..., 0] + s * place[..., 2], place[..., 1], c * place[..., 2] - s * place[..., 0]], -1)


def _foot(keys: list[tuple[float, Foot]], body: np.ndarray) -> tuple[np.ndarray, ...]:
    """Place (f, 3), yaw (f,), rise (f,) and contact (f,) of one foot in the world."""
    frames = len(body)
    times = np.array([t for t, _ in keys], float)
    before, after, w = _between(times, frames)
    places, yaws = [], []
    for _, key in keys:
        place, yaw = np.broadcast_to(np.array(key.place, float), (frames, 3)), np.full(frames, key.yaw)
        if key.with_body:
            place = _turned(body[:, 2], place) + np.stack([body[:, 0], np.zeros(frames), body[:, 1]], 1)
            yaw = yaw + body[:, 2]
        places.append(place)
        yaws.append(yaw)
    t = np.arange(frames)
    place = np.stack(places)[before, t] * (1 - w[:, None]) + np.stack(places)[after, t] * w[:, None]
    yaw = np.stack(yaws)[before, t] * (1 - w) + np.stack(yaws)[after, t] * w
    rises = np.array([k.rise for _, k in keys])
    rise = rises[before] * (1 - w) + rises[after] * w
    down = np.array([k.down for _, k in keys])
    contact = down[before] & (down[after] | (t == times[before]))
    still = np.linalg.norm(np.stack(places)[before, t] - np.stack(places)[after, t], axis=1) < 1e-3
    stepping = down[before] & down[after] & ~still & (t > times[before]) & (t < times[after])
    # A step from stand to stand lifts the foot.
    u = np.clip((t - times[before]) / np.maximum(times[after] - times[before], 1e-6), 0, 1)
    far = np.linalg.norm(np.stack(places)[before, t] - np.stack(places)[after, t], axis=1)
    place[:, 1] += np.where(stepping, np.clip(0.3 * far, 0.04, 0.12) * np.sin(np.pi * u) ** 2, 0)
    rise = rise + np.where(stepping, 0.35 * np.sin(np.pi * u) ** 2, 0)
    return place, yaw, rise, contact & ~stepping


def _arc(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    q = np.array([1 + a @ b, *np.cross(a, b)])
    return q / np.linalg.norm(q)


def _multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.array([a[0] * b[0] - a[1:] @ b[1:], *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))])


def arm_quats(rig: Rig, name: str, side: str) -> Float[np.ndarray, "2 4"]:
    """Local rotations (2, 4) of upper arm and forearm that point them as ARMS[name] says."""
    mirror = np.array([1.0 if side == "Left" else -1.0, 1.0, 1.0])
    upper, fore = (np.array(d) * mirror for d in ARMS[name])
    arm, forearm = (rig.index(side + part) for part in ("Arm", "ForeArm"))
    rest = [np.asarray(rig.tails[j] - rig.heads[j], float) for j in (arm, forearm)]
    first = _arc(rest[0], upper)
    back = first * np.array([1.0, -1, -1, -1])
    inside = _multiply(_multiply(back, np.array([0.0, *fore])), first)[1:]
    return np.stack([first, _arc(rest[1], inside)])


def play(rig: Rig, score: Score) -> Motion:
    """The motion (f frames) that a score describes; the body breathes as in the idle clip.

    Raises ValueError where a channel has fewer than two keys.
    """
    for channel in ("body", "left", "right", "arms"):
        if len(getattr(score, channel)) < 2:
            raise ValueError(f"a score needs at least two keys of {channel!r}")
    f = score.frames
    body = _body(score)
    idle = clips.load_clip("idle", rig)
    base = np.asarray(idle.quats)[np.arange(f) % len(idle.quats)].copy()
    before, after, w = _between(np.array([t for t, _ in score.arms], float), f)
    for k, side in enumerate(footlock.SIDES):
        poses = np.stack([arm_quats(rig, names[k], side) for _, names in score.arms])
        flips = np.where((poses[before] * poses[after]).sum(-1, keepdims=True) < 0, -1.0, 1.0)
        held = poses[before] * (1 - w[:, None, None]) + flips * poses[after] * w[:, None, None]
        bones = [rig.index(side + "Arm"), rig.index(side + "ForeArm")]
        base[:, bones] = held / np.linalg.norm(held, axis=-1, keepdims=True)

    def axis(k: int, angle: np.ndarray) -> Array:
        return rotations.from_axis_angle(jnp.asarray(np.eye(3)[k][None] * angle[:, None], jnp.float32))

    tilt = rotations.multiply(axis(2, body[:, 5]), axis(0, body[:, 4]))
    frame = rotations.multiply(axis(1, body[:, 2]), tilt)
    quats = jnp.asarray(base, jnp.float32)
    quats = quats.at[:, 0].set(rotations.multiply(frame, quats[:, 0]))
    height = float(np.asarray(idle.hips)[0, 1]) - 0.012
    hips = np.stack([body[:, 0], height + body[:, 3], body[:, 1]], 1)

    flat = np.asarray(foot_plans.ball_heights(rig))
    feet = [_foot(keys, body) for keys in (score.left, score.right)]
    balls = np.stack([place for place, *_ in feet], 1)
    balls[..., 1] += flat
    turns = foot_plans.level(
        jnp.asarray(np.stack([yaw for _, yaw, *_ in feet], 1), jnp.float32),
        jnp.asarray(np.stack([rise for *_, rise, _ in feet], 1), jnp.float32),
    )
    contacts = np.stack([c for *_, c in feet], 1)
    toes = np.zeros((f, 2, 4), np.float32)
    toes[..., 0] = 1
    plan = foot_plans.Plan(
        balls=jnp.asarray(balls, jnp.float32),
        balls_before=_earlier(jnp.asarray(balls, jnp.float32)),
        turns=turns,
        turns_before=_earlier(turns),
        toes=jnp.asarray(toes),
        contacts=jnp.asarray(contacts),
        until=jnp.asarray(foot_plans.frames_until(contacts, looping=False)),
        tolerance=jnp.full(f, jnp.inf, jnp.float32),
        pivot_lag=jnp.zeros(f, jnp.float32),
    )
    quats, hips, transforms = footsteps.lock_feet(rig, quats, jnp.asarray(hips, jnp.float32), plan)
    roots = np.stack([body[:, 0], np.zeros(f), body[:, 1]], 1)
    velocity = np.gradient(roots[:, [0, 2]], axis=0) * FPS
    along = np.stack([np.sin(body[:, 2]), np.cos(body[:, 2])], 1)
    return Motion(
        quats,
        hips,
        transforms,
        jnp.asarray(roots, jnp.float32),
        jnp.asarray(body[:, 2], jnp.float32),
        jnp.asarray((velocity * along).sum(1), jnp.float32),
    )


def _earlier(x: typing.Any) -> Array:
    return jnp.concatenate([x[:1], x[:-1]])
