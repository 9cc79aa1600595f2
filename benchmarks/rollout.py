"""Frames a second of a trained avatar's rollout, part by part, beside a Python loop over the jitted step.

    python -m benchmarks.rollout cowgirl

Takes a name or run folder as `avatarjax.load` does. Medians of five runs after one that compiles.
"""

from __future__ import annotations

import os
import platform
import statistics
import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp

import avatarjax as aj

FRAMES = 100
RUNS = 5


def seconds(work: Callable[[], object]) -> float:
    """Median wall time of `work` after a first call that compiles."""
    jax.block_until_ready(work())
    times = []
    for _ in range(RUNS):
        began = time.perf_counter()
        jax.block_until_ready(work())
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def main(source: str) -> None:
    """Print the table."""
    avatar = aj.load(source)
    state = aj.unica.reset(avatar, jax.random.key(0))
    actions = jnp.asarray([1] * (FRAMES // 2) + [2] * (FRAMES - FRAMES // 2))
    roll = jax.jit(aj.unica.rollout, static_argnames="gaussians")
    step = jax.jit(aj.unica.step)
    batched = jax.jit(jax.vmap(lambda s: aj.unica.rollout(avatar, s, actions, gaussians=False)[1].root))
    states = jax.vmap(lambda k: aj.unica.reset(avatar, k))(jax.random.split(jax.random.key(1), 64))
    _, frames = roll(avatar, state, actions)
    cloud = jax.tree.map(lambda x: x[-1], frames.gaussians)
    size = avatar.config.data.image_size
    camera = aj.look_at(frames.root[-1] + jnp.array([0.0, 0.5, 4.2]), frames.root[-1], width=size, height=size)

    def loop():
        current = state
        for action in actions:
            current, frame = step(avatar, current, action)
        return frame

    rows = {
        "Python loop over the jitted step, with Gaussians": FRAMES / seconds(loop),
        "rollout, geometry only": FRAMES / seconds(lambda: roll(avatar, state, actions, gaussians=False)),
        "rollout, geometry only, 64 avatars under vmap": 64 * FRAMES / seconds(lambda: batched(states)),
        "rollout, with world-space Gaussians": FRAMES / seconds(lambda: roll(avatar, state, actions)),
        f"render alone, {len(cloud)} Gaussians at {size}x{size}": 1 / seconds(lambda: aj.render(cloud, camera).image),
    }
    base = next(iter(rows.values()))
    print(f"{source}: dynamics {avatar.config.dynamics}, {avatar.config.size} texels a side, {len(cloud)} Gaussians")
    print(f"jax {jax.__version__} on {jax.default_backend()}, {os.cpu_count()} cores ({platform.machine()})")
    print(f"{'what':58s} {'frames/s':>10s} {'ratio':>8s}")
    for name, rate in rows.items():
        print(f"{name:58s} {rate:10.1f} {rate / base:8.2f}")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    main(sys.argv[1])
