"""What a comparison of `experiments.smad_dynamics` found, as SMAD's tables and figures have it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from avatarjax.metrics import published
from avatarjax.metrics.statistics import Estimate, bootstrap, paired_t_test
from experiments import pictures
from experiments import smad_dynamics_measures as measures
from experiments.smad_dynamics_measures import Found
from experiments.smad_motions import Motions
from experiments.tables.table import Table

PARTS = ("train", "test", "unseen")
TWINS, SKINNING, MEAN, RIDGE, SPACE, KERNEL, DRAPE, EQUILIBRIUM, OURS = (
    "twins",
    "skinning",
    "mean drape",
    "ridge regression",
    "linear state space",
    "kernel ridge regression",
    "our drape alone",
    "equilibrium alone",
    "ours",
)
YARDSTICKS = (SKINNING, MEAN, RIDGE, SPACE, KERNEL, DRAPE, EQUILIBRIUM)
# What a method of another loss weight, or of another length of training, is called; they are numbers of the preset's.
ISOMETRY, DAMPING, LENGTH = "isometry ", "damping ", " times the steps"
TOLD = 0.05  # p below which two methods are told apart
Results = dict[str, list[Found]]  # by method, of every seed


def tables(about: str, results: dict[int, Results], motions: Motions) -> list[Table]:
    """All tables of the results that there are, by number of motions that were learned from, the comparison first."""
    first = next(iter(results.values()))
    made = [main_table(about, first), swing_table(first)]
    if any(name not in (TWINS, *YARDSTICKS, OURS) for name in first):
        made.append(paper_table(first))
    made += [weights_table(first, kind) for kind in (ISOMETRY, DAMPING) if any(n.startswith(kind) for n in first)]
    if any(name.endswith(LENGTH) for name in first):
        made.append(length_table(first))
    if len(results) > 1:
        made.append(data_table(results))
    return [*made, similarity_table(first), long_table(first, motions)]


def plots(folder: Path, results: Results, motions: Motions) -> None:
    """Errors over long sequences, and against how far a motion is from those that were learned from."""
    shown = [name for name in (SKINNING, RIDGE, OURS, "B0 no velocities") if name in results]
    for kind in motions.long:
        label = measures.label(kind)
        lines = {n: np.array(results[n][0]["long"][label]["curve"]) for n in shown if label in results[n][0]["long"]}
        x = {n: np.stack([np.arange(len(y)) * measures.BLOCK / 30, y], axis=1) for n, y in lines.items()}
        pictures.plot_lines(folder / f"long-{label}.png", x, "seconds", "error of loose nodes, mm")
    near, errors, _ = windows(results, (SKINNING, RIDGE, OURS))
    bins = quarters(near)
    curves = {n: np.array([[near[b].mean(), values[b].mean()] for b in bins]) for n, values in errors.items()}
    xlabel = "likeness of half a second of poses to the nearest that was learned from"
    pictures.plot_lines(folder / "similarity.png", curves, xlabel, "error of loose nodes, mm")


def data_table(results: dict[int, Results]) -> Table:
    """What more motions to learn from are worth."""
    rows = []
    for count in sorted(results):
        found = results[count]
        cells = [across(found[name], "test", "loose") for name in (*YARDSTICKS[1:], OURS)]
        unseen = [across(found[name], "unseen", "loose") for name in (RIDGE, OURS)]
        rows.append([count, *cells, compared(found[OURS], found[RIDGE], "test"), *unseen])
    return Table(
        "How much motion it is learned from",
        "Loose nodes, mm; the same motions of the test throughout, the learned methods trained for the same steps. p: "
        "ours against ridge regression.",
        ["motions", *YARDSTICKS[1:], OURS, "p", f"unseen, {RIDGE}", f"unseen, {OURS}"],
        rows,
    )


def main_table(about: str, results: Results) -> Table:
    """Errors on all parts, and whether a method differs from ours."""
    rows = []
    for name in ordered(results):
        cells = [across(results[name], part, "loose") for part in PARTS]
        p = None if name in (OURS, TWINS) else compared(results[OURS], results[name], "test")
        rows.append([name, across(results[name], "test", "all"), *cells, p])
    return Table(
        "Where the cloth is (SMAD Tables 2, 3, J and K, in millimetres)",
        about + "Mean distance of nodes to their true places; loose are the "
        f"{measures.LOOSE:.0%} of the nodes that are furthest from their mean offset in training. Rollouts from rest; "
        "intervals are a bootstrap over motions; p: two-sided paired t-test against ours over the motions of the test. "
        f"Nodes that are lost count as {measures.LOST:g} m away.",
        ["method", "test, all nodes", *(f"{part}, loose" for part in PARTS), "p"],
        rows,
    )


def swing_table(results: Results) -> Table:
    """Does it swing as much as it should, and in time?"""
    rows = [
        [n, *(across(results[n], "test", what) for what in ("swing", "lag", "acceleration", "spikes"))]
        for n in ordered(results)
    ]
    return Table(
        "How it swings (SMAD Fig. 6 left)",
        "Loose nodes on the motions of the test. Swing: speed in the body frame, root mean square, as a share of the "
        "true one. Lag: milliseconds by which the true motion comes after the method's (skinning's: how late cloth "
        "follows the body). Acceleration error, mm a frame squared; spikes: share of frames with more of it than three "
        "deviations above the median of skinning's.",
        ["method", "swing", "lag, ms", "acceleration error", "spikes"],
        rows,
    )


def paper_table(results: Results) -> Table:
    """SMAD Tables 2 and 4: order of the paper's PSNR, and ours of errors."""
    letters = ("A0", "A1", "A2", "A3", "B0", "B1", "B2", "B3")
    printed = {f"{key} ": published.SMAD_2.at(key, "PSNR").value for key in letters}
    rows, known = [], []
    for name in ordered(results):
        paper = next((value for key, value in printed.items() if name.startswith(key)), None)
        if name in ("MLP", "vanilla GNN", OURS):
            row = published.SMAD if name == OURS else name
            paper = published.SMAD_4.at((row, "test"), "PSNR").value
        if paper is None:
            continue
        known.append((name, paper))
        rows.append([name, paper, mean(results[name], "test", "loose")])
    told, same = 0, 0
    pairs = [pair for pair in itertools.combinations(known, 2) if pair[0][1] != pair[1][1]]
    for (first, better), (second, other) in pairs:
        here = [mean(results[name], "test", "loose") for name in (first, second)]
        if compared(results[first], results[second], "test") < TOLD:
            told, same = told + 1, same + ((better > other) == (here[0] < here[1]))
    return Table(
        "The paper's order",
        "The paper's PSNR (higher is better) beside our error of loose nodes on the test, mm (lower is better). A4's "
        "latent codes change the look alone and are not in this comparison.",
        ["method", "paper, dB", "here, mm"],
        rows,
        [f"Of {len(pairs)} pairs, {told} are told apart here (p < {TOLD}), {same} of these in the paper's order."],
    )


def long_table(results: Results, motions: Motions) -> Table:
    """SMAD Table 5: errors on long sequences, and whether they grow."""
    rows = []
    for name in ordered(results):
        found = results[name][0]["long"]
        if found:
            cells = [x for label in found for x in (found[label]["loose"], estimate(found[label]["growth"]))]
            rows.append([name, *cells])
    columns = [x for kind in motions.long for x in (measures.label(kind), "growth, mm in 1,000 frames")]
    return Table(
        "Long sequences (SMAD Table 5)",
        "960 frames under the keyboard: keys that change (dynamic), one key held (repetitive). Loose nodes, mm; growth "
        "with its interval over blocks of frames. First seed.",
        ["method", *columns],
        rows,
    )


def weights_table(results: Results, kind: str) -> Table:
    """SMAD Fig. I: what a term of Eq. 11 does."""
    found = sorted((float(name[len(kind) :]), name) for name in results if name.startswith(kind))
    rows = [[weight, *(across(results[name], part, "loose") for part in PARTS)] for weight, name in found]
    rows.append(["the preset's", *(across(results[OURS], part, "loose") for part in PARTS)])
    term, best = kind.strip(), "0.1" if kind == ISOMETRY else "0.01"
    return Table(
        f"Weight of the {term} term (SMAD Fig. I)",
        f"Loose nodes, mm. The paper prints a plot alone and finds {best} best, in units of its own.",
        ["weight", *PARTS],
        rows,
    )


def length_table(results: Results) -> Table:
    """SMAD Fig. 7: what more training is worth."""
    names = [*(name for name in results if name.endswith(LENGTH)), OURS]
    found = sorted((float(np.mean([seed["seconds"] for seed in results[name]])), name) for name in names)
    rows = [[name, seconds, *(across(results[name], part, "loose") for part in PARTS)] for seconds, name in found]
    rows.insert(0, [RIDGE, 0.0, *(across(results[RIDGE], part, "loose") for part in PARTS)])
    return Table(
        "Length of training (SMAD Fig. 7)",
        "Loose nodes, mm. The paper's curve, of PSNR against hours, still rises at its end.",
        ["method", "seconds of training", *PARTS],
        rows,
    )


def windows(results: Results, methods: Sequence[str]) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """Of each half second of motions that were not learned from: likeness (w,) of its poses to what was, errors (w,) of
    each method in mm, and which motion (w,) it belongs to; first seed."""
    near = [row for part in ("test", "unseen") for row in results[OURS][0]["similarity"][part]]
    errors = {
        name: np.concatenate([row for part in ("test", "unseen") for row in results[name][0][part]["windows"]])
        for name in methods
    }
    return np.concatenate(near), errors, np.repeat(np.arange(len(near)), [len(row) for row in near])


def quarters(values: np.ndarray) -> list[np.ndarray]:
    """The places of the lowest quarter of the values, of the next one, and so on."""
    return np.array_split(np.argsort(values, kind="stable"), 4)


def similarity_table(results: Results) -> Table:
    """SMAD Fig. J: errors against how much a motion is like what was learned from."""
    methods = (SKINNING, RIDGE, OURS)
    near, errors, motion = windows(results, methods)
    bins = quarters(near)
    rows = [
        [f"{near[b].min():.3f} to {near[b].max():.3f}", *(bootstrap(errors[name][b], motion[b]) for name in methods)]
        for b in bins
    ]
    growth = {name: errors[name][bins[0]].mean() / errors[name][bins[-1]].mean() - 1 for name in methods}
    verdict = "reproduced" if growth[OURS] <= growth[SKINNING] else "not reproduced"
    remark = (
        f"From the most to the least similar quarter errors change by {growth[OURS]:+.0%} with ours, by "
        f"{growth[SKINNING]:+.0%} with skinning. The paper's stay as they are, and a skinned avatar's rise: {verdict}."
    )
    return Table(
        "Motions that are further from what was learned (SMAD Fig. J)",
        "Loose nodes, mm, in quarters of the half seconds of all motions that were not learned from, the most unlike "
        "first. Likeness is the highest normalised cross-correlation of its poses with those of any half second that "
        "was learned from; intervals are a bootstrap over motions, first seed.",
        ["likeness", *methods],
        rows,
        [remark],
        [("similarity.png", "Error against likeness")],
    )


def ordered(results: Results) -> list[str]:
    """Twins, yardsticks, then what is learned."""
    first = [name for name in (TWINS, *YARDSTICKS) if name in results]
    return first + [name for name in results if name not in first]


def mean(seeds: list[Found], part: str, what: str) -> float:
    """The mean over motions and seeds."""
    return float(np.mean([value for found in seeds for value in found[part][what]]))


def across(seeds: list[Found], part: str, what: str) -> Estimate | None:
    """The mean over seeds of each motion, and its interval over motions."""
    if not seeds[0].get(part):
        return None
    return bootstrap(np.mean([found[part][what] for found in seeds], axis=0))


def compared(ours: list[Found], other: list[Found], part: str) -> float:
    """The p-value of the difference in the errors of loose nodes, motion by motion."""
    a, b = (np.mean([found[part]["loose"] for found in seeds], axis=0) for seeds in (ours, other))
    return paired_t_test(a, b).p


def estimate(cells: list[float]) -> Estimate:
    """A mean with its bounds as JSON had it."""
    value, low, high = cells
    return Estimate(value, low, high, 1) if math.isfinite(low) else Estimate(value, math.nan, math.nan, 1)
