"""How many frames of context a model needs (UNICA Fig. 8): the same training with one, two and three."""

from __future__ import annotations

import dataclasses
import typing
from pathlib import Path

from avatarjax import unica
from avatarjax.data import dataset
from avatarjax.unica import train
from avatarjax.unica.config import DynamicsName, UnicaConfig
from experiments import unica_motion
from experiments.tables.finished import Finished
from experiments.tables.table import Notebook, Table

FRAMES = (1, 2, 3)


def context(runs: list[Finished], notebook: Notebook, folder: Path, dynamics: DynamicsName) -> Table:
    """UNICA Fig. 8 in numbers; what is trained goes below `folder`."""
    run = runs[0]
    rows = []
    for count in FRAMES:
        place = folder / "context" / run.name / f"{dynamics}-{count}"
        name = f"{run.mark(dynamics)}, context {count}"
        found = notebook.measured(name, lambda p=place, c=count: _measured(run, _trained(run, dynamics, c, p)))
        rows.append([str(count), *(found[key] for key in _COLUMNS.values())])
    return Table(
        f"Frames of context, {dynamics} model, {run.name}, {run.folder.name} (UNICA Fig. 8)",
        "The same training for each. Errors of the next frame on held-out groups, mm; motion error of forecasts of "
        f"{unica_motion.FORECAST} frames, mm a frame squared; share of frames of a rollout of {unica_motion.LONG} in "
        "which joints jerk as in 2 % of the controller's; its heading error in degrees, distance to the nearest "
        "training frame and foot slide, mm. The paper shows pictures: bent poses and disordered limbs with one and two "
        "frames.",
        ["frames", *_COLUMNS],
        rows,
    )


_COLUMNS = {
    "next frame": "all",
    "in turns": "turning",
    "motion error": "motion",
    "spiking frames": "spikes",
    "heading error": "heading",
    "distance": "distance",
    "foot slide": "slide",
}


def _trained(run: Finished, dynamics: DynamicsName, count: int, folder: Path) -> unica.Avatar:
    """The run's avatar with a model of so many frames of context in the place of its own."""
    avatar, data = run.avatar(dynamics), run.data
    config = with_context(avatar.config, count)
    place = train.Run(folder, 0, dataset.fingerprint(run.folder / "data"))
    if dynamics == "coefficients":
        model = train.train_coefficients(config, data, place)
    else:
        own = dataclasses.replace(place, folder=run.folder / "checkpoints")
        model = train.train_unet(config, data, place, train.train_vae(config, data, own, avatar.dynamics))
    return avatar.replace(dynamics=model, config=config)


def with_context(config: UnicaConfig, count: int) -> UnicaConfig:
    """The configuration with models that look at the newest `count` frames."""
    denoiser = dataclasses.replace(config.latent.denoiser, context=count)
    return dataclasses.replace(
        config,
        latent=dataclasses.replace(config.latent, denoiser=denoiser),
        coefficients=dataclasses.replace(config.coefficients, context=count),
    )


def _measured(run: Finished, avatar: unica.Avatar) -> dict[str, typing.Any]:
    data = run.data
    rolled = unica_motion.roll_long(avatar, data, 0)
    slides = unica_motion.slides(data, rolled).get("rollout")
    joints = unica_motion.joint_motion(run.name, run.folder / "data", 0, data, {"model": avatar}, rolled)
    return {
        **run.next_frames(avatar),
        "motion": joints["motion_error_mm"]["model"]["all joints"],
        "spikes": joints["spikes"].get("rollout"),
        "heading": unica_motion.answers(data, avatar, rolled)["rollout"]["heading_error"],
        "distance": float(1000 * rolled.distance.mean()) if len(rolled.distance) else None,
        "slide": slides and slides["mean"],
    }
