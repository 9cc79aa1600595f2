"""Frames a second of a trained avatar: part by part as UNICA Table D, and whole, from a key to Gaussians and a picture.

    python -m benchmarks.rollout cowgirl
    python -m benchmarks.rollout runs/unica/cowgirl/small --devices 1

Takes a name or run folder as `avatarjax.load` does. Medians of five runs after one that compiles. "Key to picture" is
what somebody at a keyboard waits for, the picture fetched before the next key. Pictures are drawn on two host devices
where `--devices` says so (the default), everything else on one: so a frame is two jitted calls, as in a single one both
devices would compute the same Gaussians.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

FRAMES = 100
BATCH = 64
RUNS = 5
# Seconds a frame on one NVIDIA 3090, by the paper.
PAPER = {"geometry": 0.414, "appearance": 0.250, "whole frame without rendering": 0.683}


def seconds(work: Callable[[], object]) -> float:
    """Median wall time of `work` after a first call that compiles."""
    jax.block_until_ready(work())
    times = []
    for _ in range(RUNS):
        began = time.perf_counter()
        jax.block_until_ready(work())
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def main(source: str, size: int, devices: int) -> None:
    """Print the table."""
    jax.config.update("jax_num_cpu_devices", devices)
    import avatarjax as aj
    from avatarjax.data.dataset import cardinal_cameras
    from avatarjax.splat import SplatConfig, required_capacity

    avatar = aj.load(source)
    state = aj.unica.reset(avatar, jax.random.key(0))
    actions = jnp.asarray([1] * (FRAMES // 2) + [2] * (FRAMES - FRAMES // 2))
    roll = jax.jit(aj.unica.rollout, static_argnames="gaussians")
    step, dress = jax.jit(aj.unica.step), jax.jit(aj.unica.dress)
    batched = jax.jit(jax.vmap(lambda s: aj.unica.rollout(avatar, s, actions, gaussians=False)[1].root))
    states = jax.vmap(lambda k: aj.unica.reset(avatar, k))(jax.random.split(jax.random.key(1), BATCH))
    frames = roll(avatar, state, actions)[1]
    last = jax.tree.map(lambda x: x[-1], frames)
    camera = jax.tree.map(lambda x: x[0], cardinal_cameras(size))
    centred = last.gaussians.replace(means=last.gaussians.means - last.root[None] * jnp.asarray([[1.0, 0.0, 1.0]]))
    splat = SplatConfig(capacity=2 * required_capacity(centred, camera), depth=False, shards=devices)

    def picture(gaussians, root):
        seen = gaussians.replace(means=gaussians.means - root[None] * jnp.asarray([[1.0, 0.0, 1.0]]))
        return aj.render(seen, camera, config=splat).image

    draw = jax.jit(picture)

    def gaussians_loop():
        current = state
        for action in actions:
            current, frame = step(avatar, current, action)
            jax.block_until_ready(frame.gaussians)

    def picture_loop():
        current = state
        for action in actions:
            current, frame = step(avatar, current, action)
            np.asarray(draw(frame.gaussians, frame.root))

    geometry = FRAMES / seconds(lambda: roll(avatar, state, actions, gaussians=False))
    rows = {
        "geometry (rollout)": geometry,
        f"geometry, {BATCH} avatars under vmap": BATCH * FRAMES / seconds(lambda: batched(states)),
        "appearance (one frame's Gaussians)": 1 / seconds(lambda: dress(avatar, last)),
        f"rendering {size}x{size}": 1 / seconds(lambda: draw(last.gaussians, last.root)),
        "rollout with world-space Gaussians": FRAMES / seconds(lambda: roll(avatar, state, actions)),
        "key to Gaussians, one call a frame": FRAMES / seconds(gaussians_loop),
        f"key to picture {size}x{size}": FRAMES / seconds(picture_loop),
    }
    config, count = avatar.config, len(last.gaussians.means)
    print(f"{source}: {config.dynamics}, {config.appearance_model}, map {config.size}, {count} Gaussians")
    print(
        f"jax {jax.__version__} on {jax.default_backend()}, {os.cpu_count()} cores ({platform.machine()}), "
        f"{devices} device(s) for pictures"
    )
    print(f"{'what':50s} {'frames/s':>10s} {'ms':>8s}")
    for name, rate in rows.items():
        print(f"{name:50s} {rate:10.1f} {1000 / rate:8.2f}")
    print("UNICA Table D, NVIDIA 3090, ms: " + ", ".join(f"{k} {1000 * v:.0f}" for k, v in PAPER.items()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="an avatar's name, file or run folder")
    parser.add_argument("--size", type=int, default=256, help="pixels a side")
    parser.add_argument("--devices", type=int, default=2, help="host devices that share a picture")
    args = parser.parse_args()
    main(args.source, args.size, args.devices)
