"""The training loop: deterministic batches by step number, checkpoints, metrics.jsonl, a progress bar."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

from avatarjax.io import weights
from avatarjax.train.state import Batch, Metrics, TrainState

CHECKPOINT_SECONDS = 30.0


def fit(
    step: Callable[[TrainState, Batch], tuple[TrainState, Metrics]],
    state: TrainState,
    batch_at: Callable[[int], Batch],
    steps: int,
    folder: str | os.PathLike,
    name: str,
    *,
    fingerprint: str = "",
    log_points: int = 100,
) -> TrainState:
    """Run `step` until the state has seen `steps` batches, and return it.

    `batch_at(k)` gives the batch of step k from k alone, so that a run which was interrupted goes on as if it had not
    been. State is saved to `folder/name.safetensors` twice a minute and at the end; a file that is there is resumed if
    its `fingerprint` (of configuration and data) and the arrays of its state are these, and ignored otherwise. Means
    over about `log_points` intervals go to `folder/name.jsonl`, with the seconds since the run began and the processor
    time, of all cores together, since this process took it up. Raises FloatingPointError when every step of an interval
    was skipped because its gradient was not finite.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint, log = folder / f"{name}.safetensors", folder / f"{name}.jsonl"
    arrays = [(x.shape, str(x.dtype)) for x in jax.tree.leaves(state)]
    fingerprint = hashlib.sha256(f"{fingerprint} {arrays}".encode()).hexdigest()[:12]
    state, seconds = _resume(checkpoint, state, fingerprint)
    start = int(state.step)
    if start >= steps:
        tqdm.write(f"{name}: its {steps} steps were done before, reused")
        return state
    records = [r for r in read_metrics(log) if r["step"] <= start] if start else []
    log.write_text("".join(json.dumps(r) + "\n" for r in records), encoding="utf-8")

    every = max(1, steps // log_points)
    began = saved = time.monotonic()
    busy = time.process_time()
    pending: list[Metrics] = []
    with tqdm(total=steps, initial=start, desc=name, unit="step", dynamic_ncols=True) as bar, log.open("a") as out:
        for k in range(start, steps):
            state, metrics = step(state, batch_at(k))
            pending.append(metrics)
            bar.update()
            if (k + 1) % every == 0 or k + 1 == steps:
                record = {m: float(np.mean([p[m] for p in jax.device_get(pending)])) for m in pending[0]}
                pending = []
                if record["skipped"] == 1.0:
                    raise FloatingPointError(f"{name}: no step up to {k + 1} had a finite gradient; lower its rate")
                record |= {"step": k + 1, "seconds": round(seconds + time.monotonic() - began, 3)}
                record["processor_seconds"] = round(time.process_time() - busy, 3)
                out.write(json.dumps(record) + "\n")
                out.flush()
                bar.set_postfix(loss=f"{record['loss']:.4g}", refresh=False)
                if time.monotonic() - saved > CHECKPOINT_SECONDS:
                    _save(checkpoint, state, fingerprint, record["seconds"])
                    saved = time.monotonic()
    _save(checkpoint, state, fingerprint, seconds + time.monotonic() - began)
    return state


def read_metrics(path: str | os.PathLike) -> list[dict[str, int | float]]:
    """The records of a metrics file, without a last line that was cut off; empty where there is no file."""
    if not Path(path).is_file():
        return []
    records = []
    for line in Path(path).read_text(encoding="utf-8").splitlines():
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return records


def _save(path: Path, state: TrainState, fingerprint: str, seconds: float) -> None:
    weights.save_tree(path, state, fingerprint=fingerprint, seconds=seconds)


def _resume(path: Path, state: TrainState, fingerprint: str) -> tuple[TrainState, float]:
    if not path.exists():
        return state, 0.0
    _, metadata = weights.load_arrays(path)
    if metadata.get("fingerprint") != fingerprint:
        return state, 0.0
    state, metadata = weights.load_tree(path, state)
    return state, float(metadata["seconds"])
