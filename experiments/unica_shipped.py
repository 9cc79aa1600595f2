"""A shipped avatar under the report's keys: what a fresh clone shows within a minute or two, without any training."""

from __future__ import annotations

import json
import sys
import time
import typing
from pathlib import Path

import numpy as np

from avatarjax import unica
from avatarjax.data.sequences import ACTIONS
from avatarjax.io import weights
from avatarjax.metrics import responsiveness
from avatarjax.metrics.report import Report
from experiments import pictures
from experiments.unica_rollout import SCRIPT, answers, before_each_action, roll_and_draw


def show(name: str, path: Path, folder: Path) -> Path:
    """Roll a shipped avatar out and write video, pictures and report.html into `folder`, which is returned."""
    folder.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    print(f"{name}: the shipped avatar into {folder}; --train trains it from scratch instead", flush=True)
    avatar = unica.load(path)
    made = weights.load_arrays(path)[1]["made"]
    frames = roll_and_draw(avatar, SCRIPT, folder, 0)
    paths = before_each_action(avatar, np.asarray(frames.root))
    pictures.plot_paths(folder / "path.png", {"rollout": paths})
    _page(name, folder, answers(avatar, paths, SCRIPT), made, time.monotonic() - began).write(folder / "report.html")
    print(f"{name}: {len(SCRIPT)} frames in {time.monotonic() - began:.0f} s, open {folder / 'report.html'}")
    return folder


def _page(
    name: str, folder: Path, answered: list[dict[str, typing.Any]], made: dict[str, typing.Any], seconds: float
) -> Report:
    page = Report(f"UNICA: {name}, as shipped")
    page.text("Keys: 60 frames W, 60 S, 60 A, 20 idle at 30 frames a second, from standing. Four views that follow.")
    page.media(folder / "video.mp4", "The rollout: every frame is generated from the three before it and the key.")
    page.media(folder / "contact_sheet.png", f"Frames {pictures.key_frames(SCRIPT)}, four views.")
    page.heading("Does it obey?")
    page.media(folder / "path.png", "Root path from above.")
    page.table(
        f"Answers to the keys; a turn is over when the movement direction stays within "
        f"{responsiveness.TOLERANCE_DEGREES:.0f} degrees for {responsiveness.HOLD_FRAMES} frames. One rollout.",
        ["key", "speed, m/s", "heading error, degrees", "turn, degrees", "frames from the key"],
        [
            (ACTIONS[r["action"]], *(r.get(k) for k in ("speed", "heading_error", "turn", "turn_frames")))
            for r in answered
        ],
    )
    page.heading("How it was made")
    page.code(made["command"])
    page.table("Seconds a stage took", ["stage", "seconds"], [(k, float(v)) for k, v in made["seconds"].items()])
    page.text("What was measured then, on held-out data; the run's own report explains each number.")
    page.code(json.dumps(made["metrics"], indent=1))
    page.environment("python -m experiments.unica " + " ".join(sys.argv[1:]), {"rollout and pictures": seconds})
    return page
