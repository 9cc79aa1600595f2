"""Milliseconds and memory of one SMAD step on the Gaussian graph, factored edges against plain ones, in one run.

    python -m benchmarks.smad                          # the paper's network at 1,000 and 4,000 nodes
    python -m benchmarks.smad --nodes 40000            # at the paper's 40,000
    python -m benchmarks.smad --nodes 300 --preset ci --repeats 2   # does it work?

`forward` is the deformation network from poses and recent motion to changes of every Gaussian (not the splatting);
`backward` also the gradient of a loss by parameters, positions and velocities. `plain` computes messages as SMAD B.2
prints them, from an array of all edges' features; `factored` is what the library uses. The two take turns; times are
medians, ratios plain's by factored's. `MB` is what XLA sets aside for intermediate results. `difference` is the largest
between their outputs relative to the largest output. Plain is left out beyond `--plain-limit` nodes: at 40,000 its
backward pass wants several gigabytes. Nodes are spread over an ellipsoid of a person's size.
"""

from __future__ import annotations

import dataclasses
import os
import platform
import statistics
import typing
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from avatarjax.smad import deformer, preset
from avatarjax.smad import graph as graphs
from avatarjax.smad.config import DeformerConfig, PresetName
from avatarjax.smad.deformer import Deformer, PlainDeformer
from avatarjax.smad.graph import Graph
from benchmarks.timing import seconds

HALF_AXES = 0.3, 0.9, 0.2  # metres


@dataclasses.dataclass(frozen=True)
class Options:
    """nodes: sizes of graphs; preset: whose network and neighbours; repeats: timed runs after the first of each."""

    nodes: tuple[int, ...] = (1_000, 4_000)
    preset: PresetName = "paper"
    repeats: int = 7
    plain_limit: int = 16_000


class Passes(typing.NamedTuple):
    """Compiled passes over the same inputs, and megabytes of intermediate results of each."""

    forward: Callable[[], typing.Any]
    backward: Callable[[], typing.Any]
    memory: tuple[float, float]


def body(count: int, neighbours: int) -> Graph:
    """The graph of so many random points on an ellipsoid."""
    points = np.random.default_rng(0).normal(size=(count, 3))
    points *= np.asarray(HALF_AXES) / np.linalg.norm(points, axis=1, keepdims=True)
    return graphs.build(points.astype(np.float32), neighbours)


def passes(config: DeformerConfig, graph: Graph, network: type[Deformer]) -> Passes:
    """Both passes of a network from the same fresh parameters."""
    rng = np.random.default_rng(1)
    shapes = (config.pose_window, config.pose), (len(graph.positions), config.velocities, 3)
    pose, velocities = (jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in shapes)
    inputs = deformer.init(config, graph, jax.random.key(0)), graph.positions, velocities

    def forward(params, positions, velocities, graph, pose):
        return deformer.deform(config, params, graph, pose, positions, velocities, network=network)

    def loss(*arguments):
        return sum(jnp.sum(x**2) for x in jax.tree.leaves(forward(*arguments)))

    made = [
        jax.jit(work).lower(*inputs, graph, pose).compile()
        for work in (forward, jax.value_and_grad(loss, argnums=(0, 1, 2)))
    ]
    run = [lambda work=work: jax.block_until_ready(work(*inputs, graph, pose)) for work in made]
    memory = tuple(work.memory_analysis().temp_size_in_bytes / 2**20 for work in made)
    return Passes(run[0], run[1], memory)


def in_turns(works: list[Callable[[], typing.Any]], repeats: int) -> list[float]:
    """Median milliseconds of each after a first call."""
    for work in works:
        work()
    times = [[1000 * seconds(work) for work in works] for _ in range(repeats)]
    return [statistics.median(column) for column in zip(*times, strict=True)]


def rows(config: DeformerConfig, graph: Graph, options: Options) -> list[str]:
    """A graph's rows of the table, one for each pass."""
    networks = [Deformer] + [PlainDeformer] * (len(graph.positions) <= options.plain_limit)
    made = [passes(config, graph, network) for network in networks]
    outs = [jnp.concatenate([x.reshape(-1) for x in jax.tree.leaves(p.forward())]) for p in made]
    difference = f"{float(jnp.abs(outs[0] - outs[-1]).max() / jnp.abs(outs[0]).max()):.1e}" if len(made) > 1 else "-"
    found = []
    for k, name in enumerate(("forward", "backward")):
        times = in_turns([p[k] for p in made], options.repeats)
        own, other = made[0].memory[k], made[-1].memory[k]
        plain = f"{times[1]:9.1f} {times[1] / times[0]:6.1f}" if len(made) > 1 else f"{'-':>9s} {'-':>6s}"
        more = f"{other:8.0f} {other / own:6.1f}" if len(made) > 1 else f"{'-':>8s} {'-':>6s}"
        found.append(
            f"{len(graph.positions):7d} {name:9s} {times[0]:11.1f} {1000 / times[0]:9.1f} {plain} "
            f"{own:11.0f} {more} {difference:>10s}"
        )
    return found


def main(options: Options) -> None:
    """Print the table."""
    chosen = preset(options.preset)
    sizes = chosen.deformer
    print(f"jax {jax.__version__} on {jax.default_backend()}, {os.cpu_count()} cores ({platform.machine()})")
    print(
        f"preset {options.preset}: {sizes.hidden} hidden, {sizes.message} in a message, {sizes.iterations} iterations, "
        f"{chosen.graph.neighbours} neighbours"
    )
    print(
        f"{'nodes':>7s} {'pass':9s} {'factored ms':>11s} {'frames/s':>9s} {'plain ms':>9s} {'ratio':>6s} "
        f"{'factored MB':>11s} {'plain MB':>8s} {'ratio':>6s} {'difference':>10s}"
    )
    for count in options.nodes:
        graph = body(count, chosen.graph.neighbours)
        for row in rows(sizes, graph, options):
            print(row, flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
