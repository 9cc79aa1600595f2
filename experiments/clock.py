"""How long the stages of a run took, over several runs of the program."""

from __future__ import annotations

import json
import time
import typing
from collections.abc import Callable
from pathlib import Path

import jax

from avatarjax.io import atomic


class Clock:
    """Runs work and keeps how long it took, by stage, in a JSON file."""

    def __init__(self, path: Path):
        self.path = path
        self.seconds: dict[str, float] = json.loads(path.read_text()) if path.is_file() else {}

    def run(self, stage: str, work: Callable[[], typing.Any], *, resumed: bool = False) -> typing.Any:
        """The result of the work. Work that goes on where it was interrupted, `resumed`, adds to the time before; else
        the longer counts: a stage that was only read back took its time in an earlier run."""
        before, began = self.seconds.get(stage, 0.0), time.monotonic()
        try:
            return jax.block_until_ready(work())
        finally:
            taken = round(time.monotonic() - began, 1)
            self.seconds[stage] = before + taken if resumed else max(before, taken)
            atomic.write_text(self.path, json.dumps(self.seconds, indent=1))
