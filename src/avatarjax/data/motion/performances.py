"""Free-form performances beside the keyboard's: a slow turn for the canonical capture and five dynamic sequences.

They stand for the monocular capture of SMAD: one turntable and five free motions an avatar. All are procedural and, for
one seed, always the same.
"""

from __future__ import annotations

import functools
import typing
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from avatarjax import rotations
from avatarjax.data import skinning
from avatarjax.data.body import Rig
from avatarjax.data.motion import choreography, clips, locomotion
from avatarjax.data.motion.choreography import Foot, Score
from avatarjax.data.motion.locomotion import Motion

NAMES = ("turn", "arcs", "spins", "kicks", "jumps", "dance")
FRAMES = 270
TURN_FRAMES = 240
# Where the toes' joints of a standing figure are, beside and before its root, metres.
_APART, _AHEAD = 0.12, 0.09


def perform(rig: Rig, name: str, seed: int = 0) -> Motion:
    """The performance `name` of NAMES on a rig: 30 frames a second, starting near the origin, facing +z.

    `turn` has TURN_FRAMES frames, the others FRAMES. Raises ValueError for an unknown name.
    """
    if name not in NAMES:
        raise ValueError(f"unknown performance {name!r}; there are {', '.join(NAMES)}")
    rng = np.random.default_rng([NAMES.index(name), seed])
    return {"turn": _turn, "arcs": _arcs, "spins": _spins, "kicks": _kicks, "jumps": _jumps, "dance": _dance}[name](
        rig, rng
    )


def _turn(rig: Rig, rng: np.random.Generator) -> Motion:
    """The figure stands still, arms a little away, and turns once like a statue on a turntable: the feet turn too."""
    idle = clips.load_clip("idle", rig)
    quats = np.asarray(idle.quats[0]).copy()
    for side in ("Left", "Right"):
        quats[[rig.index(side + "Arm"), rig.index(side + "ForeArm")]] = choreography.arm_quats(rig, "low", side)
    yaws = jnp.arange(TURN_FRAMES) * (2 * jnp.pi / TURN_FRAMES)
    turn = rotations.from_axis_angle(yaws[:, None] * jnp.array([[0.0, 1.0, 0.0]]))
    local = jnp.broadcast_to(jnp.asarray(quats), (TURN_FRAMES, *quats.shape))
    local = local.at[:, 0].set(rotations.multiply(turn, local[:, 0]))
    hips = jnp.einsum("fab,b->fa", rotations.to_matrix(turn), idle.hips[0])
    transforms = _kinematics(rig, local, hips)
    lift = -jax.vmap(lambda t: skinning.sole_points(rig, t))(transforms)[..., 1].min()
    zero = jnp.zeros(TURN_FRAMES)
    return Motion(
        local,
        hips.at[:, 1].add(lift),
        transforms.at[..., 1, 3].add(lift),
        jnp.zeros((TURN_FRAMES, 3)),
        yaws,
        zero,
    )


@jax.jit
def _kinematics(rig: Rig, quats: typing.Any, hips: typing.Any) -> typing.Any:
    return jax.vmap(skinning.forward_kinematics, in_axes=(None, 0, 0))(rig, quats, hips)


def _arcs(rig: Rig, rng: np.random.Generator) -> Motion:
    """A run along curves to both sides, faster on the straights."""
    t = np.arange(FRAMES) / FRAMES
    side = rng.choice([-1.0, 1.0])
    bends = rng.uniform(1.6, 2.1), rng.uniform(0.3, 0.6)
    headings = side * (bends[0] * np.sin(2 * np.pi * 1.5 * t) ** 2 * np.sign(np.sin(2 * np.pi * 1.5 * t)))
    headings = headings + side * bends[1] * (1 - np.cos(2 * np.pi * t))
    looping = clips.load_clips(rig)
    pace = 0.82 + 0.16 * np.cos(2 * np.pi * (2 * t + rng.uniform()))
    speeds = jnp.asarray(pace, jnp.float32) * looping.run_speed
    return locomotion.follow(rig, looping, jnp.asarray(headings, jnp.float32), speeds, float(rng.uniform()))


def _dance(rig: Rig, rng: np.random.Generator) -> Motion:
    """The dance of the asset, left twice for a few steps to a side and taken up again, facing another way."""
    config = locomotion.LocomotionConfig(emotes=("dance",))
    looping = clips.load_clips(rig, config.emotes)
    first, second = rng.permutation([3, 4, 1])[:2]
    a, b = rng.integers(78, 96), rng.integers(70, 84)
    steps = [(5, a), (first, 9), (5, b), (second, 9), (5, FRAMES)]
    actions = np.concatenate([np.full(n, action) for action, n in steps])[:FRAMES]
    return locomotion.simulate(rig, looping, jnp.asarray(actions), jax.random.key(int(rng.integers(2**31))), config)


def _world(place: tuple[float, float, float], x: float, z: float, heading: float) -> tuple[float, float, float]:
    c, s = np.cos(heading), np.sin(heading)
    return (x + c * place[0] + s * place[2], place[1], z + c * place[2] - s * place[0])


def _stance(x: float, z: float, heading: float, apart: float = _APART) -> dict[str, Foot]:
    """Both feet down under a root at (x, z), a little turned out."""
    return {
        side: Foot(_world((sign * apart, 0.0, _AHEAD), x, z, heading), heading + 0.12 * sign)
        for side, sign in (("left", 1.0), ("right", -1.0))
    }


def _stand(score: Score, frame: float, feet: dict[str, Foot], body: Sequence[float | int], arms: str) -> None:
    """One key in every channel."""
    score.body.append((frame, tuple(float(v) for v in body)))
    score.left.append((frame, feet["left"]))
    score.right.append((frame, feet["right"]))
    score.arms.append((frame, (arms, arms)))


def _spins(rig: Rig, rng: np.random.Generator) -> Motion:
    """Pirouettes to both sides on the ball of one foot, the other drawn up to the knee, with a stop after each."""
    score = Score(FRAMES)
    x = z = heading = 0.0
    feet = _stance(x, z, heading)
    _stand(score, 0.0, feet, (x, z, heading, -0.01, 0, 0), "low")
    frame = float(rng.uniform(6, 10))
    sign = float(rng.choice([-1, 1]))
    while frame < FRAMES - 58:
        support, free = ("left", "right") if sign > 0 else ("right", "left")
        turn = sign * 2 * np.pi
        # Wind up over both feet, weight to the ball of the one that carries.
        down = feet[support]
        px, pz = down.place[0], down.place[2]
        _stand(score, frame, feet, (x, z, heading, -0.01, 0, 0), "low")
        mid = (0.6 * px + 0.4 * x, 0.6 * pz + 0.4 * z)
        wind = -sign * rng.uniform(0.15, 0.3)
        score.body.append((frame + 10, (*mid, heading + wind, -0.07, 0.08, 0)))
        score.arms.append((frame + 10, ("wide", "wide")))
        getattr(score, support).append((frame + 12, down))
        getattr(score, free).append((frame + 12, feet[free]))
        # Round on the ball: root above it, the free foot carried with the body.
        length = round(rng.uniform(28, 33))
        start, end = frame + 12, frame + 12 + length
        side = 1.0 if free == "left" else -1.0
        up = Foot((0.12 * side, 0.3, 0.12), 0.35 * side, 0.7, down=False, with_body=True)
        score.body.append((start + 6, (px, pz, heading + wind, 0.01, 0, 0)))
        score.body.append((end, (px, pz, heading + turn, 0.01, 0, 0)))
        score.arms += [(start + 9, ("round", "round")), (end - 4, ("round", "round"))]
        score.left += [] if support == "left" else [(start + 9, up), (end - 3, up)]
        score.right += [] if support == "right" else [(start + 9, up), (end - 3, up)]
        raised = Foot(down.place, down.yaw + wind, 0.45)
        spun = Foot(down.place, down.yaw + turn, 0.45)
        getattr(score, support).extend([(start + 6, raised), (end, spun)])
        # Down again beside it, and stand.
        heading += turn
        x, _, z = _world((side * _APART, 0.0, -_AHEAD), px, pz, heading)
        feet = _stance(x, z, heading)
        feet[support] = Foot(down.place, down.yaw + turn)
        frame = end + 11
        _stand(score, frame, feet, (x, z, heading, -0.05, 0.04, 0), "wide")
        frame += float(rng.uniform(8, 12))
        sign = -sign
    _stand(score, frame, feet, (x, z, heading, -0.01, 0, 0), "low")
    _stand(score, FRAMES + 1.0, feet, (x, z, heading, -0.01, 0, 0), "low")
    return choreography.play(rig, score)


def _kicks(rig: Rig, rng: np.random.Generator) -> Motion:
    """Front and side kicks from guard, left and right in turn: weight over, knee up, out, back, down."""
    score = Score(FRAMES)
    feet = _stance(0.0, 0.0, 0.0, 0.14)
    _stand(score, 0.0, feet, (0, 0, 0, -0.05, 0.04, 0), "guard")
    sides = [("left", "right", 1.0), ("right", "left", -1.0)]
    frame, count = float(rng.uniform(6, 12)), int(rng.integers(2))
    while frame < FRAMES - 52:
        kick, support, sign = sides[count % 2]
        front = (count // 2) % 2 == 0
        high = rng.uniform(0.9, 1.05)
        over = -sign * 0.11
        _stand(score, frame, feet, (0, 0, 0, -0.05, 0.04, 0), "guard")
        lean = (-0.18, 0.06 * sign) if front else (0.0, 0.42 * sign * high)
        chamber = (0.09 * sign, 0.4, 0.2) if front else (0.2 * sign, 0.4, 0.14)
        out = (0.08 * sign, 0.78 * high, 0.66) if front else (0.8 * sign, 0.66 * high, 0.06)
        angles = (0.5, -0.75) if front else (0.35, -0.1)
        outward = 0.0 if front else -0.5 * sign
        near = Foot(chamber, outward, angles[0], down=False, with_body=True)
        far = Foot(out, outward, angles[1], down=False, with_body=True)
        score.body += [
            (frame + 9, (over, 0.0, 0, -0.05, 0.02, 0)),
            (frame + 16, (over, 0.03, 0, -0.03, lean[0] / 2, lean[1] / 2)),
            (frame + 22, (over, 0.05, 0, -0.02, *lean)),
            (frame + 25, (over, 0.05, 0, -0.02, *lean)),
            (frame + 32, (over, 0.02, 0, -0.04, lean[0] / 2, lean[1] / 2)),
        ]
        getattr(score, kick).extend(
            [(frame + 8, feet[kick]), (frame + 16, near), (frame + 22, far), (frame + 24, far), (frame + 31, near)]
        )
        getattr(score, support).append((frame + 30, feet[support]))
        score.arms += [
            (frame + 16, ("guard", "guard")),
            (frame + 22, ("low", "guard") if sign > 0 else ("guard", "low")),
        ]
        score.arms.append((frame + 32, ("guard", "guard")))
        frame += 41
        _stand(score, frame, feet, (0, 0, 0, -0.06, 0.05, 0), "guard")
        frame += float(rng.uniform(3, 8))
        count += 1
    _stand(score, frame, feet, (0, 0, 0, -0.05, 0.04, 0), "guard")
    _stand(score, FRAMES + 1.0, feet, (0, 0, 0, -0.05, 0.04, 0), "guard")
    return choreography.play(rig, score)


def _jumps(rig: Rig, rng: np.random.Generator) -> Motion:
    """Standing jumps, up, forward and with a turn: crouch, push, free flight, landing that gives."""
    score = Score(FRAMES)
    x = z = heading = 0.0
    feet = _stance(x, z, heading)
    _stand(score, 0.0, feet, (x, z, heading, -0.01, 0, 0), "low")
    frame, count = float(round(rng.uniform(5, 9))), 0
    while frame < FRAMES - 62:
        air = float(round(rng.uniform(12, 15)))
        ahead = (0.0, 0.45, 0.15)[count % 3] * rng.uniform(0.8, 1.1)
        turn = (0.0, 0.0, np.pi / 2 * rng.choice([-1.0, 1.0]))[count % 3]
        _stand(score, frame, feet, (x, z, heading, -0.01, 0, 0), "low")
        crouch, off = frame + 15, frame + 21
        on = off + air
        _stand(score, crouch, feet, (x, z, heading, -0.3, 0.55, 0), "back")
        tiptoe = {side: Foot(foot.place, foot.yaw, 0.9) for side, foot in feet.items()}
        near = _world((0.0, 0.0, 0.08 * (ahead > 0.2)), x, z, heading)
        _stand(score, off, tiptoe, (near[0], near[2], heading, 0.06, 0.1, 0), "high")
        # The arms swing up through the take-off and into the flight.
        score.arms[-1] = (off + 5, ("high", "high"))
        x, _, z = _world((0.0, 0.0, ahead), x, z, heading)
        heading += turn
        tuck = 0.14 + air * 0.012
        for side, sign in (("left", 1.0), ("right", -1.0)):
            up = Foot((sign * _APART, tuck, -0.02), 0.1 * sign, 0.6, down=False, with_body=True)
            getattr(score, side).append((off + 0.5 * air, up))
        feet = _stance(x, z, heading)
        _stand(score, on, feet, (x, z, heading, -0.04, 0.12, 0), "wide")
        score.flights.append((off, on))
        _stand(score, on + 7, feet, (x, z, heading, -0.27, 0.45, 0), "forward")
        frame = on + 7 + float(round(rng.uniform(16, 20)))
        count += 1
    _stand(score, frame, feet, (x, z, heading, -0.01, 0, 0), "low")
    _stand(score, FRAMES + 1.0, feet, (x, z, heading, -0.01, 0, 0), "low")
    return choreography.play(rig, score)


@functools.cache
def frame_count(name: str) -> int:
    """Frames of a performance."""
    return TURN_FRAMES if name == "turn" else FRAMES
