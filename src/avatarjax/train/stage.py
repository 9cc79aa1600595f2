"""One stage of a training: its numbers, and how it is run, kept and gone on with."""

from __future__ import annotations

import dataclasses
import hashlib
import typing
from collections.abc import Callable
from pathlib import Path

import jax

from avatarjax.train.loop import fit
from avatarjax.train.state import Loss, Params, make_step, new_state, optimiser, weights


@dataclasses.dataclass(frozen=True)
class StageConfig:
    """One training stage: number of steps, batch size, peak learning rate (linear warm-up, cosine decay to a tenth)."""

    steps: int
    batch: int
    learning_rate: float
    ema: float = 0.0  # ours; 0 keeps no average of the weights


@dataclasses.dataclass(frozen=True)
class Run:
    """Where a run keeps its checkpoints, its seed, and the fingerprint of its data."""

    folder: Path
    seed: int
    data: str

    def key(self, stage: str) -> jax.Array:
        """The PRNG key of a stage: every stage has its own, whatever ran before it."""
        return jax.random.fold_in(jax.random.key(self.seed), int(hashlib.sha256(stage.encode()).hexdigest()[:7], 16))


def train_stage(
    run: Run,
    name: str,
    stage: StageConfig,
    settings: typing.Any,
    loss: Loss,
    initial: Params,
    batch_at: Callable[[int], typing.Any],
    hold: Callable[[Params, Params, typing.Any], Params] | None = None,
) -> Params:
    """Train one stage; `settings` is all of the configuration that its result depends on, beside the stage's own."""
    transform = optimiser(stage.learning_rate, stage.steps)
    state = new_state(initial, transform, run.key(name), averaged=stage.ema > 0)
    step = make_step(loss, transform, decay=stage.ema, hold=hold)
    mark = hashlib.sha256(f"{run.data} {run.seed} {stage} {settings}".encode()).hexdigest()[:12]
    return weights(fit(step, state, batch_at, stage.steps, run.folder, name, fingerprint=mark))
