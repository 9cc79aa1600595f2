"""Make a trained avatar part of the package: half precision, with the command, seed, time and metrics that made it.

    python -m experiments.unica --avatar cowgirl --train      # the run
    python -m experiments.ship runs/unica/cowgirl/small       # writes src/avatarjax/assets/avatars/cowgirl.safetensors

Says how far a rollout in half precision is from the trained one, and refuses what obeys its keys worse.
"""

from __future__ import annotations

import json
import sys
import typing
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from avatarjax import unica
from avatarjax.metrics import environment
from avatarjax.unica import files
from experiments.unica_rollout import SCRIPT, answers, before_each_action

# A shipped avatar may be off its course by so many degrees more than the one it was made from.
_WORSE = 1.0


def headings(avatar: unica.Avatar) -> np.ndarray:
    """Heading errors in degrees of the moving segments of the report's script."""
    state = unica.reset(avatar, jax.random.key(7))
    frames = jax.jit(unica.rollout, static_argnames="gaussians")(avatar, state, jnp.asarray(SCRIPT), gaussians=False)[1]
    roots = before_each_action(avatar, np.asarray(frames.root))
    return np.array([r["heading_error"] for r in answers(avatar, roots, SCRIPT) if "heading_error" in r])


def ship(run: Path, /, seed: int = 0) -> Path:
    """Write the avatar of a finished run; returns its file. `seed` is the one that the run was made with.

    Raises ValueError where the run is not finished, and where half precision does harm.
    """
    if not (run / "metrics.json").is_file():
        raise ValueError(f"{run} has no metrics.json: let the run write its report first")
    avatar = unica.load(run, dynamics="coefficients")
    measured = json.loads((run / "metrics.json").read_text())
    name = run.parent.name
    path = files.SHIPPED / f"{name}.safetensors"
    made: dict[str, typing.Any] = {
        "command": f"python -m experiments.unica --avatar {name} --train --preset {run.name} --seed {seed}",
        "seconds": measured["seconds"],
        "environment": environment.describe(),
        "metrics": {key: measured[key] for key in ("images", "turning", "stages", "foot_slide_mm")},
    }
    candidate = path.with_suffix(".candidate")
    try:
        files.save(candidate, avatar, half=True, made=made)
        before, after = headings(avatar), headings(unica.load(candidate))
        print(f"{path.name}: {candidate.stat().st_size / 1e6:.1f} MB")
        print(f"heading errors, degrees: {np.round(before, 2).tolist()} trained, {np.round(after, 2).tolist()} shipped")
        if not (after < before + _WORSE).all():
            raise ValueError(f"in half precision {name} obeys its keys worse than before: not shipped")
        candidate.replace(path)
    finally:
        candidate.unlink(missing_ok=True)
    return path


if __name__ == "__main__":
    try:
        tyro.cli(ship, description=__doc__)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None
