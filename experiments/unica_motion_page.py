"""The sections of a UNICA report on movement: obedience to the keys, drift, and how the body moves."""

from __future__ import annotations

import typing

import numpy as np

from avatarjax.data.sequences import ACTIONS
from avatarjax.metrics import drift, published, responsiveness
from avatarjax.metrics.report import Report, draw_band
from avatarjax.metrics.statistics import Estimate
from experiments import unica_motion


def obedience(page: Report, folder: typing.Any, measured: dict[str, typing.Any]) -> None:
    """How the keys are answered, in the script's rollouts and in the long one, beside the paper's frames of turning."""
    page.heading("Does it obey?")
    page.media(folder / "path.png", "Root paths from above, and the controller's that made the training data.")
    page.table(
        "Answers to the keys. A turn is over when the movement direction stays within "
        f"{responsiveness.TOLERANCE_DEGREES:.0f} degrees for {responsiveness.HOLD_FRAMES} frames (ours; the paper "
        "gives no threshold). It is counted from the key, and from the first frame that is as far off the old "
        "direction. Heading error and speed are means from 25 frames after the change. One rollout each: no interval.",
        ["", "key", "speed, m/s", "heading error, degrees", "turn, degrees", "frames from the key", "from leaving"],
        [
            (
                name,
                ACTIONS[r["action"]],
                *(r.get(k) for k in ("speed", "heading_error", "turn", "turn_frames", "transition_frames")),
            )
            for name, records in measured["responses"].items()
            for r in records
        ],
    )
    rows = []
    for who, theirs in (("rollout", published.UNICA), ("controller", "ground truth")):
        answer = measured["turning"][who]
        for angle in (180, 90):
            paper = published.UNICA_D_TURNS.at(theirs, f"{angle} degrees")
            done = f"{answer[f'turns of {angle} degrees completed']} of {answer[f'turns of {angle} degrees']} completed"
            rows.append((f"{who}, {angle} degrees, from the key ({done})", answer[f"turn_frames {angle}"], paper))
            rows.append((f"{who}, {angle} degrees, from leaving", answer[f"transition_frames {angle}"], paper))
    page.comparison(
        f"Frames of turning: {measured['long_rollout']['frames']} frames under another key every {unica_motion.HOLD}, "
        "and the controller's held-out sequences; means with 95 % bootstrap intervals over completed turns. Ours is "
        "the path of the waist, which leans into a turn and settles two to three frames after the controller's ground "
        "point; the paper says neither which point it follows nor when a turn is complete.",
        rows,
    )
    page.table(
        "Heading error over all segments of the same frames, degrees",
        ["", "heading error"],
        [(who, answer["heading_error"]) for who, answer in measured["turning"].items()],
    )


def stability(
    page: Report,
    folder: typing.Any,
    measured: dict[str, typing.Any],
    rolled: unica_motion.Long,
    trends: dict[str, drift.Trend],
) -> None:
    """Curves and trends of the long rollout."""
    page.heading("Does it drift?")
    long = measured["long_rollout"]
    page.text(
        f"The long rollout, another key every {unica_motion.HOLD} frames, "
        + (
            f"kept its figure for all {long['of']} frames."
            if long["frames"] == long["of"]
            else f"lost its figure after {long['frames']} of {long['of']} frames."
        )
    )
    curves = (1000 * rolled.distance, 1000 * rolled.height)
    # A rollout that lost its figure early has no trends.
    for (name, trend), curve in zip(trends.items(), curves if trends else (), strict=True):

        def draw(axes, name=name, trend=trend, curve=curve):
            x = np.arange(len(curve))
            axes.fill_between(x, trend.line - trend.std, trend.line + trend.std, color="gray", alpha=0.2, lw=0)
            axes.plot(x, curve, lw=0.7, alpha=0.8, label=name)
            draw_band(axes, x, trend.line, trend.lower, trend.upper, "trend, 95 % band")
            axes.set(xlabel="frame", ylabel="mm")
            axes.legend()

        page.plot(draw, f"{name.capitalize()}. Grey: one standard deviation about the trend, as in UNICA Fig. 6.")
    page.table(
        "Trends of the long rollout with 95 % intervals (circular block bootstrap); no drift is 0",
        ["", "slope, mm per 1,000 frames", "one standard deviation, mm"],
        [
            (n, Estimate(*(1000 * x for x in (t.slope, *t.slope_interval)), len(t.line)), t.std)
            for n, t in trends.items()
        ],
    )
    page.media(folder / "drift.png", "The short rollout, and for comparison the controller under the same keys.")


def movement(page: Report, measured: dict[str, typing.Any]) -> None:
    """Foot slide, motion errors and spikes."""
    page.heading("Does it move as it should?")
    slides = measured["foot_slide_mm"]
    if "not measured" in slides:
        page.text(f"Foot slide was not measured: {slides['not measured']}.")
    else:
        page.table(
            "Foot slide of the long rollout and of the held-out sequences, mm a contact, on the same texels of the "
            "soles (the mean of a sole's front half: more than a skeleton's joint slides)",
            ["", "mean", "median"],
            [(who, *((s["mean"], s["median"]) if s else (None, None))) for who, s in slides.items()],
        )
    found = measured["joints"]
    if found is None:
        page.text("Motion errors were not measured: the recorded meshes have no skeleton.")
        return
    page.table(
        f"Motion error (SMAD C.3) over {unica_motion.FORECAST} frames of each held-out sequence, rolled out from its "
        f"first three, mm per frame squared: the norm over all {found['joints']} joints as printed, and the mean norm "
        "of a joint (Kanazawa et al. 2019). The truth is the skeleton; joints of a surface are regressed from it "
        f"({found['regressor_mm']:.1f} mm off). The paper estimates poses from pictures: its numbers are others.",
        ["", "all joints", "a joint"],
        [
            (name, *((e["all joints"], e["a joint"]) if e else ("lost", "lost")))
            for name, e in found.get("motion_error_mm", {}).items()
        ],
    )
    spikes = found["spikes"]
    page.table(
        f"Share of frames whose joints accelerate by more than {spikes['threshold_mm']:.1f} mm per frame squared: the "
        "controller's median + 3 x 1.4826 MAD (ours; SMAD Fig. 6 gives no threshold)",
        ["", "share of frames"],
        [(who, spikes[who]) for who in ("rollout", "controller") if who in spikes],
    )
