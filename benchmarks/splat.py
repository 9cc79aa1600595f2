"""Speed of the splatting kernel on a CPU, beside the old prototype, the naive renderer, and two peers, in one run.

    python -m benchmarks.splat              # bodies of four sizes and needles, all contenders that are installed
    python -m benchmarks.splat --size 2 3   # those with goals: 65k Gaussians at 256x256, 200k at 512x512
    python -m benchmarks.splat --quick      # the two small scenes, few runs: does it work?

The peers are optional: `pip install torch mitsuba`, and LLVM for the latter (see splat_mitsuba.py).

Columns: medians and, in brackets, minima in milliseconds of the image, and of the image with the gradient of
sum(image * fixed random weights) + sum(alpha) by all arrays of the cloud; `ratio` to the prototype of the same run (of
the needles, to the first row), and `floor`, how many times the least time that the arithmetic of the blending would
take on all cores; seconds to compile and peak megabytes, both for the two passes; the largest difference of the picture
from the first row's, in the smallest scene.

The floor counts every entry of the tiles' lists, intersections of a Gaussian's bounding box with 8x4 tiles, at all 32
pixels, with the operations listed in floor.py. Opaque tiles end early: up to a quarter of the entries is never read.

The contenders do not compute quite the same. Ours also returns a depth map, unless it says otherwise. The prototype
is given scales and opacities, not their logarithms, and five entries a Gaussian as capacity. Mitsuba's model is another
(see splat_mitsuba.py), its loss has no alpha, and its search structure is built beforehand, while all others sort in
every pass.
"""

from __future__ import annotations

import contextlib
import os
import platform
import statistics
import typing
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import tyro

from avatarjax.splat import SplatConfig
from benchmarks import splat_contenders as contenders
from benchmarks.floor import BACKWARD_FLOPS, FORWARD_FLOPS, Throughput
from benchmarks.scenes import SIZES
from benchmarks.splat_contenders import Scene
from benchmarks.timing import BACKWARD, FORWARD, Prepared, Process, Unavailable

OURS, TWO_DEVICES, NO_DEPTH, PROTOTYPE = "ours", "ours, two devices", "ours, two, no depth", "prototype"
# The largest ratio of ours to the prototype that is wanted, in the scenes of SIZES[2] and SIZES[3].
GOALS = {FORWARD: 0.5, BACKWARD: 0.6}
GOAL_SCENES = SIZES[2:]

_NEEDLE_SCENE = Scene("needle", *SIZES[2])
_TILE_PIXELS = 32
_ROUNDS = 5
# Seconds after which a contender's turn ends early. Those that take up to a second a pass still come to 15 runs.
_TURN = 3.0


class Entry(typing.NamedTuple):
    """A contender: its name in the table, and what makes it of a scene and `arguments`."""

    name: str
    make: Callable
    arguments: tuple = ()


class Result(typing.NamedTuple):
    """Of one contender and scene: times in seconds and preparation by pass, and what it counted."""

    times: dict[str, list[float]]
    prepared: dict[str, Prepared]
    counts: dict[str, int]


BODY_ENTRIES = (
    Entry(OURS, contenders.ours),
    Entry(TWO_DEVICES, contenders.ours, (SplatConfig(shards=2),)),
    Entry(NO_DEPTH, contenders.ours, (SplatConfig(shards=2, depth=False),)),
    Entry(PROTOTYPE, contenders.prototype),
    Entry("naive, all pairs", contenders.naive),
)
PEERS = (Entry("Mitsuba volprim_rf_basic", contenders.mitsuba), Entry("plain PyTorch", contenders.torch))
NEEDLE_ENTRIES = (
    Entry(OURS, contenders.ours, (SplatConfig(cull_ellipses=False),)),
    Entry("ours, cull_ellipses", contenders.ours, (SplatConfig(cull_ellipses=True),)),
)


def main(size: tuple[int, ...] = (), runs: int = 25, peers: bool = True, quick: bool = False) -> None:
    """Print the tables.

    Args:
        size: which scenes: 0 to 3 are bodies by size, 4 are the needles; by default all.
        runs: of each pass of each contender, in five turns; fewer of those that take longer than half a second.
        peers: measure Mitsuba and PyTorch too, if they are installed.
        quick: only the two small scenes, five runs.
    """
    runs = 5 if quick else runs
    tables = [(Scene("body", *size), BODY_ENTRIES + (PEERS if peers else ())) for size in SIZES]
    tables.append((_NEEDLE_SCENE, NEEDLE_ENTRIES))
    if not set(size) <= set(range(len(tables))):
        raise SystemExit(f"--size takes numbers from 0 to {len(tables) - 1}, got {size}")
    chosen = size or (range(2) if quick else range(len(tables)))
    differences: dict[tuple, dict[str, float]] = {}
    for scene, entries in (tables[k] for k in chosen):
        smallest = Scene(scene.cloud, *SIZES[0])
        if entries not in differences:
            differences[entries] = picture_differences(smallest, entries)
        results, flops = measure(scene, entries, runs)
        print("\n".join(table(scene, results, differences[entries], flops)), end="\n\n", flush=True)
    print(f"jax {jax.__version__}, {os.cpu_count()} cores, {_processor()}")


def picture_differences(scene: Scene, entries: tuple[Entry, ...]) -> dict[str, float]:
    """The largest difference of each contender's picture from the first one's."""
    pictures: dict[str, np.ndarray] = {}
    with _processes(scene, entries) as processes:
        for name, process in processes.items():
            with contextlib.suppress(Unavailable):
                pictures[name] = process.ask("image")
    first = pictures[entries[0].name]
    return {name: float(np.abs(picture - first).max()) for name, picture in pictures.items()}


def measure(scene: Scene, entries: tuple[Entry, ...], runs: int) -> tuple[dict[str, Result | str], dict[int, float]]:
    """By name: a result, or why there is none; and the machine's float32 operations a second by number of threads.

    All take turns; the operations a second are those of the best turn.
    """
    results: dict[str, Result | str] = {}
    flops: dict[int, float] = {}
    with _processes(scene, entries) as processes, Process(Throughput) as throughput:
        for name, process in processes.items():
            try:
                prepared = {which: process.ask("prepare", which) for which in (FORWARD, BACKWARD)}
                results[name] = Result({FORWARD: [], BACKWARD: []}, prepared, process.ask("counts"))
            except Unavailable as reason:
                results[name] = str(reason)
        for which in (FORWARD, BACKWARD):
            for _ in range(_ROUNDS):
                flops = {k: max(rate, flops.get(k, 0.0)) for k, rate in throughput.ask("flops").items()}
                for name, result in results.items():
                    if isinstance(result, Result):
                        try:
                            result.times[which] += processes[name].ask("burst", which, -(-runs // _ROUNDS), _TURN)
                        except Unavailable as reason:
                            results[name] = str(reason)
    return results, flops


@contextlib.contextmanager
def _processes(scene: Scene, entries: tuple[Entry, ...]) -> typing.Iterator[dict[str, Process]]:
    with contextlib.ExitStack() as stack:
        yield {entry.name: stack.enter_context(Process(entry.make, scene, *entry.arguments)) for entry in entries}


def table(
    scene: Scene, results: dict[str, Result | str], differences: dict[str, float], flops: dict[int, float]
) -> typing.Iterator[str]:
    """Lines of text; `flops` are operations a second by number of threads."""
    counts = results[OURS].counts
    base = PROTOTYPE if PROTOTYPE in results else OURS
    floors = floor_seconds(counts["intersections"], max(flops.values()))
    yield f"{scene}: {counts['intersections']:,} intersections, {counts['dropped']:,} dropped"
    passes = f"{'forward ms':>17s} {'ratio':>6s} {'floor':>6s} {'forward+backward':>18s} {'ratio':>6s} {'floor':>6s}"
    yield f"  {'':24s} {passes} {'compile s':>11s} {'peak MB':>11s} {'picture':>8s}"
    for name, result in results.items():
        if isinstance(result, str):
            yield f"  {name:24s} {result}"
            continue
        cells = []
        for which, width in ((FORWARD, 17), (BACKWARD, 18)):
            times, ratio = result.times[which], _median(result, which) / _median(results[base], which)
            milliseconds = f"{1e3 * statistics.median(times):.1f} ({1e3 * min(times):.1f})"
            cells.append(f"{milliseconds:>{width}s} {ratio:6.2f} {_median(result, which) / floors[which]:6.1f}")
        compiled = " + ".join(f"{prepared.compile:.1f}" for prepared in result.prepared.values())
        memory = " / ".join(_megabytes(prepared.memory) for prepared in result.prepared.values())
        yield f"  {name:24s} {' '.join(cells)} {compiled:>11s} {memory:>11s} {differences.get(name, np.nan):8.0e}"
    rates = ", ".join(f"{rate / 1e9:.0f} GFLOP/s on {threads}" for threads, rate in flops.items())
    yield f"  {'floor':24s} {1e3 * floors[FORWARD]:8.1f} {1e3 * floors[BACKWARD]:32.1f}        ({rates} threads)"
    if (scene.n, scene.size) in GOAL_SCENES and scene.cloud == "body":
        yield from goals(results)


def floor_seconds(intersections: int, flops: float) -> dict[str, float]:
    """Seconds that the operations of the blending take, by pass; `flops` are operations a second."""
    forward = sum(FORWARD_FLOPS.values())
    pairs = intersections * _TILE_PIXELS
    return {FORWARD: pairs * forward / flops, BACKWARD: pairs * (forward + sum(BACKWARD_FLOPS.values())) / flops}


def goals(results: dict[str, Result | str]) -> typing.Iterator[str]:
    """A line for each goal: ratio to the prototype, which draws no depth, of the fastest of ours."""
    for which, goal in GOALS.items():
        base = _median(results[PROTOTYPE], which)
        ratios = {
            name: _median(results[name], which) / base for name in (OURS, TWO_DEVICES, NO_DEPTH) if name in results
        }
        name, ratio = min(ratios.items(), key=lambda item: item[1])
        verdict = "reached" if ratio <= goal else "not reached"
        title = {FORWARD: "forward", BACKWARD: "forward+backward"}[which]
        yield f"  goal, {title}: at most {goal:.2f} of the prototype; {name}: {ratio:.2f}, {verdict}"


def _median(result: typing.Any, which: str) -> float:
    return statistics.median(result.times[which])


def _megabytes(memory: int | None) -> str:
    return "-" if memory is None else f"{memory / 1e6:.0f}"


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
