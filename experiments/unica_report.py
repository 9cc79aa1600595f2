"""The report of a UNICA run: every stage beside a trivial baseline on held-out data, pictures, and what is poor."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
import typing

import jax
import jax.numpy as jnp
import numpy as np

from avatarjax import unica
from avatarjax.data.dataset import Dataset
from avatarjax.data.sequences import ACTIONS
from avatarjax.io import atomic
from avatarjax.metrics import drift, responsiveness
from avatarjax.metrics.report import Report
from avatarjax.metrics.statistics import Estimate, bootstrap, paired_t_test
from avatarjax.unica import batches, evaluate, forecast, image_quality
from avatarjax.unica.appearance import BaseAttributes
from avatarjax.unica.config import AppearanceName
from experiments import pictures, unica_images, unica_motion, unica_motion_page
from experiments.unica_rollout import before_each_action

if typing.TYPE_CHECKING:
    from experiments.unica import Experiment

GROUPS = 400


def write(
    experiment: Experiment,
    data: Dataset,
    built: dict[str, unica.Avatar],
    dressed: dict[AppearanceName, unica.Avatar],
    base: BaseAttributes,
    frames: unica.Frame,
    script: tuple[int, ...],
) -> None:
    """Measure, plot and write metrics.json and report.html into the run's folder.

    `built` are the avatars by their dynamics, `dressed` by what dresses them, `base` the attributes of the base stage.
    """
    folder, driver, seed = experiment.folder, experiment.config.dynamics, experiment.args.seed
    avatar = built[driver]
    plain = avatar.replace(base=base)
    yaw, moves = unica_motion.asked(data, experiment.config.actions)
    paths = {driver: before_each_action(avatar, np.asarray(frames.root))}
    paths |= {name: _path(one, script, seed) for name, one in built.items() if name != driver}
    truth = np.asarray(data.truth.roots)
    answers = {name: responsiveness.responses(p, np.asarray(script), yaw, moves) for name, p in paths.items()}
    answers["controller"] = responsiveness.responses(truth, np.asarray(script), yaw, moves)

    rolled = unica_motion.roll_long(avatar, data, seed)
    nearest = _nearest(avatar, data, frames)
    measured_on = experiment.args.avatar, folder / "data"
    measured: dict[str, typing.Any] = {
        "responses": answers,
        "stages": _stages(experiment, data, built, dressed, plain),
        "turning": unica_motion.answers(data, avatar, rolled),
        "drift_mm": {n: bootstrap(x) for n, x in nearest.items()},
        "long_rollout": {"frames": len(rolled.actions), "of": unica_motion.LONG},
        "foot_slide_mm": unica_motion.slides(data, rolled),
        # Recorded meshes come without a skeleton.
        "joints": None if experiment.meshes else unica_motion.joint_motion(*measured_on, seed, data, built, rolled),
        "images": unica_images.measure(experiment, data, dressed, plain, frames),
        "seconds": experiment.clock.seconds,
    }
    trends = unica_motion.trends(rolled)
    measured["trends_mm_a_frame"] = {n: {"slope": t.slope, "interval": t.slope_interval} for n, t in trends.items()}
    _, chosen = _held_out(experiment, data)
    measured["components_mm"] = evaluate.components(avatar, data, chosen)
    atomic.write_text(folder / "metrics.json", json.dumps(_plain(measured), indent=2))

    pictures.plot_paths(folder / "path.png", {"controller": truth, **paths})
    pictures.plot_lines(folder / "drift.png", nearest, "frame", "distance to the nearest training frame, mm")
    _page(experiment, measured, script, rolled, trends).write(folder / "report.html")


def _held_out(experiment: Experiment, data: Dataset) -> tuple[batches.Windows, np.ndarray]:
    """The groups of the held-out data, and which of them are measured."""
    windows = batches.windows(data.held_out, 4, experiment.config.turn_window)
    return windows, np.unique(np.linspace(0, len(windows.first) - 1, GROUPS).astype(int))


def _stages(
    experiment: Experiment,
    data: Dataset,
    built: dict[str, unica.Avatar],
    dressed: dict[AppearanceName, unica.Avatar],
    plain: unica.Avatar,
) -> list[dict[str, typing.Any]]:
    """Each stage beside what costs nothing, on the same held-out items: see `_against`."""
    windows, chosen = _held_out(experiment, data)
    sequence = np.asarray(data.held_out.sequence)[windows.first[chosen]]
    rows = []
    for name, one in built.items():
        error = evaluate.one_step(one, data, chosen, jax.random.key(experiment.args.seed + 11))
        for part, keep in (("all groups", np.ones(len(chosen), bool)), ("turning groups", error["turning"])):
            for guess in ("copy last", "constant velocity"):
                what = f"{name}, next frame, {part}, against {guess}"
                rows.append(_against(what, error["model"][keep], error[guess][keep], sequence[keep], "mm"))
    if "unet" in built:
        each = evaluate.reconstruction(built["unet"], data, chosen)
        rows.append(
            _against("autoencoder, against the mean map", each["autoencoder"], each["mean map"], sequence, "mm")
        )

    def psnr(one: unica.Avatar, images: typing.Any, refined: bool) -> np.ndarray:
        return image_quality.appearance_quality(one, images, refined=refined).psnr

    standing, held = data.standing_images, data.held_out_images
    fresh, base = psnr(image_quality.untrained_base(plain, standing), standing, False), psnr(plain, standing, False)
    what = "base attribute map, standing pose, against untrained attributes"
    rows.append(_against(what, base, fresh, np.arange(base.size), "dB", higher=True))
    without = psnr(plain, held, False)
    pose = np.repeat(np.arange(len(without)), without.shape[1])
    for name, one in dressed.items():
        what = f"{name.replace('_', ' ')}, against the base attribute map"
        rows.append(_against(what, psnr(one, held, True), without, pose, "dB", higher=True))
    return rows


def _against(
    what: str, ours: np.ndarray, baseline: np.ndarray, groups: np.ndarray, unit: str, *, higher: bool = False
) -> dict[str, typing.Any]:
    """Both means with intervals over groups, and the p-value of a paired t-test of the groups' means."""
    ours, baseline = np.ravel(ours), np.ravel(baseline)
    pairs = [(ours[groups == k].mean(), baseline[groups == k].mean()) for k in np.unique(groups)]
    p = paired_t_test(*np.array(pairs).T).p
    better = bool((ours.mean() > baseline.mean()) == higher)
    clear = math.isnan(p) or p < 0.05
    return {
        "what": what,
        "unit": unit,
        "ours": bootstrap(ours, groups),
        "baseline": bootstrap(baseline, groups),
        "p": p,
        "verdict": ("beats it" if better else "does not") if clear else "no clear difference",
        "good": better if clear else None,
    }


def _page(
    experiment: Experiment,
    measured: dict[str, typing.Any],
    script: tuple[int, ...],
    rolled: unica_motion.Long,
    trends: dict[str, drift.Trend],
) -> Report:
    folder, config = experiment.folder, experiment.config
    page = Report(f"UNICA: {experiment.args.avatar}, preset {experiment.args.preset}")
    page.text(
        f"Keys: 60 frames W, 60 S, 60 A, 20 idle at 30 frames a second, from standing. Dynamics: {config.dynamics}. "
        "Views: front, left side, back and right side; the camera follows, squares are half a metre."
    )
    page.media(folder / "video.mp4", "The rollout: every frame is generated from the three before it and the key.")
    page.media(folder / "contact_sheet.png", f"Frames {pictures.key_frames(script)}, four views.")
    unica_motion_page.obedience(page, folder, measured)
    unica_images.section(page, experiment, measured["images"])

    page.heading("Each stage against what costs nothing")
    page.table(
        "On held-out data: means with 95 % intervals from a bootstrap over sequences (of pictures: over poses; of the "
        "standing pose: over views), n in so many of them. p: two-sided paired t-test of their means. Errors in mm, "
        "pictures in dB.",
        ["stage", "ours", "trivial baseline", "p", "verdict"],
        [(r["what"], r["ours"], r["baseline"], r["p"], r["verdict"]) for r in measured["stages"]],
        verdicts=[r["good"] for r in measured["stages"]],
    )
    components = np.asarray(list(measured["components_mm"].items()))
    page.plot(
        lambda axes: pictures.draw_lines(
            axes, {"held-out maps": components}, "components kept", "error, mm", logy=True
        ),
        "Alignment error against the number of components (as UNICA Fig. B).",
    )
    unica_motion_page.stability(page, folder, measured, rolled, trends)
    unica_motion_page.movement(page, measured)
    page.heading("What is poor")
    for line in _poor(measured):
        page.text(line)

    page.heading("Training")
    for plot in sorted((folder / "checkpoints").glob("*.png")):
        page.media(plot, f"Loss of {plot.stem}")
    page.environment("python -m experiments.unica " + " ".join(sys.argv[1:]), experiment.clock.seconds)
    page.heading("Configuration")
    page.code(json.dumps(dataclasses.asdict(config), indent=2))
    return page


def _poor(measured: dict[str, typing.Any]) -> list[str]:
    lines = [
        f"{r['what']}: {r['ours']:.3g} against {r['baseline']:.3g} {r['unit']} ({r['verdict']})."
        for r in measured["stages"]
        if not r["good"]
    ]
    for name, records in measured["responses"].items():
        for r in records:
            if r.get("heading_error", 0.0) > 15:
                lines.append(
                    f"{name}: {r['heading_error']:.0f} degrees off the wanted direction under {ACTIONS[r['action']]}."
                )
            if "turn" in r and r["start"] and r["turn_frames"] is None:
                lines.append(f"{name}: never settles into the direction of {ACTIONS[r['action']]}.")
    if measured["long_rollout"]["frames"] < measured["long_rollout"]["of"]:
        lines.append(f"The long rollout is lost after {measured['long_rollout']['frames']} frames.")
    for name, trend in measured["trends_mm_a_frame"].items():
        low, high = (1000 * bound for bound in trend["interval"])
        if low > 0 or high < 0:
            lines.append(
                f"The {name} drifts by {1000 * trend['slope']:.3g} [{low:.3g}, {high:.3g}] mm in 1,000 frames."
            )
    return lines or ["Nothing fell behind its baseline, and every key was answered; see the numbers for how well."]


def _plain(tree: typing.Any) -> typing.Any:
    """The measured numbers as JSON has them."""
    if isinstance(tree, Estimate):
        return {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in tree._asdict().items()}
    if isinstance(tree, dict):
        return {k: _plain(v) for k, v in tree.items()}
    return [_plain(v) for v in tree] if isinstance(tree, (list, tuple)) else tree


def _path(avatar: unica.Avatar, script: tuple[int, ...], seed: int) -> np.ndarray:
    roll = jax.jit(unica.rollout, static_argnames="gaussians")
    state = unica.reset(avatar, jax.random.fold_in(jax.random.key(seed), 7))
    return before_each_action(avatar, np.asarray(roll(avatar, state, jnp.asarray(script), gaussians=False)[1].root))


def _nearest(avatar: unica.Avatar, data: Dataset, frames: unica.Frame) -> dict[str, np.ndarray]:
    """Distance in mm of the frames of the rollout and of the controller to the nearest training frame."""
    training = np.asarray(data.train.texels)
    rollout = np.asarray(forecast.surfaces(avatar.atlas, frames))
    return {
        "rollout": 1000 * drift.nearest_distance(rollout, training),
        "controller, same keys": 1000 * drift.nearest_distance(np.asarray(data.truth.texels), training),
    }
