"""Contenders that are timed in turns, each in a process of its own.

A process of its own gives each its own devices, threads, peak memory and compile time. Taking turns spreads a
disturbance of the machine over all of them.
"""

from __future__ import annotations

import ctypes
import dataclasses
import multiprocessing
import re
import time
import traceback
import typing
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

FORWARD, BACKWARD = "forward", "backward"

# A pass this slow, in seconds, needs no run to warm the caches before it is timed.
_SLOW = 1.0


class Unavailable(Exception):
    """A contender cannot run here, and why."""


class Prepared(typing.NamedTuple):
    """Seconds to compile; bytes that the first call after that added to the memory of the process at its peak, None
    where the system does not tell."""

    compile: float
    memory: int | None


@dataclasses.dataclass(frozen=True)
class Contender:
    """Two passes that return when all is computed, and what they compute.

    forward: the image; backward: the image and the gradient of a loss. image: (h, w, 3). counts: numbers that the
    contender alone knows. compile: compile a pass.
    """

    forward: Callable[[], object]
    backward: Callable[[], object]
    image: Callable[[], np.ndarray]
    counts: Callable[[], dict[str, int]] = dict
    compile: Callable[[str], object] = lambda which: None

    def prepare(self, which: str) -> Prepared:
        """Compile a pass, FORWARD or BACKWARD, and run it for the first time."""
        return Prepared(seconds(lambda: self.compile(which)), _peak_memory(getattr(self, which)))

    def burst(self, which: str, runs: int, limit: float) -> list[float]:
        """Seconds of `runs` runs of a pass, one after another; of fewer, but one, where all take more than `limit`."""
        run = getattr(self, which)
        times = [seconds(run)]
        if times[0] < _SLOW:
            times = []
        while not times or (len(times) < runs and sum(times) < limit):
            times.append(seconds(run))
        return times


class Process:
    """What `make(*arguments)` returns, in a process of its own, which ends with the `with` block."""

    def __init__(self, make: Callable, *arguments: typing.Any) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, make, arguments), daemon=True)
        self._process.start()
        theirs.close()
        self._started = False

    def ask(self, method: str, *arguments: typing.Any) -> typing.Any:
        """The result of a method. Raises Unavailable where there is none to ask, and RuntimeError where it failed."""
        if not self._started:
            self._answer()
            self._started = True
        self._pipe.send((method, arguments))
        return self._answer()

    def end(self) -> None:
        self._pipe.close()
        self._process.join(timeout=10)
        if self._process.is_alive():
            self._process.kill()

    def __enter__(self) -> typing.Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def _answer(self) -> typing.Any:
        try:
            error, result = self._pipe.recv()
        except EOFError:
            self._process.join()
            raise Unavailable(f"died with exit code {self._process.exitcode}") from None
        if error is not None:
            raise error
        return result


def _serve(pipe: typing.Any, make: Callable, arguments: tuple) -> None:
    jax.config.update("jax_platforms", "cpu")
    # Compile times are those of an empty cache.
    jax.config.update("jax_enable_compilation_cache", False)
    made = None
    while True:
        try:
            if made is None:
                made, result = make(*arguments), None
            else:
                method, parameters = pipe.recv()
                result = getattr(made, method)(*parameters)
            pipe.send((None, result))
        except (EOFError, BrokenPipeError):
            return
        except Unavailable as reason:
            pipe.send((reason, None))
            return
        except Exception:
            pipe.send((RuntimeError(traceback.format_exc()), None))
            return


def seconds(run: Callable[[], object]) -> float:
    """Wall time of a call."""
    began = time.perf_counter()
    run()
    return time.perf_counter() - began


def _peak_memory(run: Callable[[], object]) -> int | None:
    """Bytes that `run` adds to the memory of the process at its peak; only Linux tells."""
    status, reset = Path("/proc/self/status"), Path("/proc/self/clear_refs")
    if not reset.exists():
        return None
    # Or else the call would reuse, unseen, what was freed before.
    ctypes.CDLL(None).malloc_trim(0)
    reset.write_text("5")
    before = _kibibytes(status.read_text(), "VmRSS")
    run()
    return 1024 * (_kibibytes(status.read_text(), "VmHWM") - before)


def _kibibytes(status: str, field: str) -> int:
    found = re.search(rf"^{field}:\s+(\d+) kB", status, re.MULTILINE)
    assert found is not None
    return int(found[1])
