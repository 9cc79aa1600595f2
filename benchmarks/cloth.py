"""Milliseconds a frame of the avatars' cloth on a CPU, and of its parts beside NumPy's and SciPy's, in one run.

    python -m benchmarks.cloth                              # UNICA's five
    python -m benchmarks.cloth --avatars monk --repeats 3   # does it work?

First table: whole frames of running as the datasets are made: skinning, contacts and 32 steps of the cloth; medians
and, in brackets, minima of the runs; compile time apart, without a cache on disk.

Second table: a frame's 32 passes over all distance constraints, which is the part of the steps that another array
library does as well. Peers do the same arithmetic, in float32, on arrays prepared beforehand. `colours`: NumPy with
fancy indexing, colour after colour as ours, which gives the same positions; `difference` is the largest between the
two after the 32 passes, in metres. `Jacobi`: NumPy with all pairs at once, each vertex moved by the mean of its
corrections with np.bincount; needs no colours, but a pass brings less: `strain` is the mean relative change of length
of the pairs after the passes of ours and of Jacobi's, from the same strained start. Ratios are times of ours. XLA may
use all cores, NumPy's indexing uses one.

Third table: one search for what the cloth may touch, as `find_planes` does twice a frame: the nearest of 512 points on
each of four groups of limbs, for every vertex, in the first pose of the run. `k-d tree` is SciPy's, built and asked by
all cores. `further` is by how much our points are further away than its, at most, in per cent.
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
import scipy
import tyro
from scipy.spatial import cKDTree

from avatarjax.data import avatars, dressing, skinning
from avatarjax.data.body import Rig
from avatarjax.data.motion import clips
from avatarjax.physics import contacts, xpbd
from avatarjax.physics.cloth import Cloth
from avatarjax.physics.contacts import columns
from benchmarks.timing import seconds

CONFIG = xpbd.XPBDConfig()
_DT = 1 / (CONFIG.fps * CONFIG.substeps)
_SPEED = 3.0  # metres a second


@dataclasses.dataclass(frozen=True)
class Options:
    """avatars: whose cloth; frames: simulated in one call; repeats: runs after the first of each."""

    avatars: tuple[str, ...] = avatars.NAMES
    frames: int = 32
    repeats: int = 7


class Passes(typing.NamedTuple):
    """Functions of positions (n, 3) that make all passes of a frame over the constraints."""

    ours: Callable[[np.ndarray], np.ndarray]
    colours: Callable[[np.ndarray], np.ndarray]
    jacobi: Callable[[np.ndarray], np.ndarray]


def running(rig: Rig, frames: int) -> jax.Array:
    """Bone transforms (f, j, 3, 4) of a run straight ahead."""
    clip = clips.ground_clip(rig, clips.load_clip("run", rig))
    time = np.arange(frames)
    ahead = jnp.asarray(time[:, None] * np.array([0, 0, _SPEED / CONFIG.fps]), jnp.float32)
    frame = time % len(clip.quats)
    kinematics = jax.jit(jax.vmap(skinning.forward_kinematics, in_axes=(None, 0, 0)))
    return kinematics(rig, clip.quats[frame], clip.hips[frame] + ahead)


def passes(cloth: Cloth) -> Passes:
    """Ours and the peers'."""

    @jax.jit
    def solve(x: jax.Array) -> jax.Array:
        once = xpbd._pair_solver(cloth, _DT)
        passed, _ = jax.lax.scan(lambda x, _: (once(x), None), columns(x), length=CONFIG.substeps)
        return jnp.stack(passed, axis=1)

    masses = np.append(np.asarray(cloth.inverse_masses), np.float32(0))
    ends, weights, lengths = [], [], []
    for pairs, length, compliance in zip(
        *map(np.asarray, (cloth.pairs, cloth.lengths, cloth.compliances)), strict=True
    ):
        real = pairs[:, 0] < cloth.count
        ends.append(pairs[real])
        own = masses[pairs[real]]
        weights.append(own / (own.sum(1) + compliance[real] / np.float32(_DT**2))[:, None])
        lengths.append(length[real])

    def corrections(x: np.ndarray, pair: np.ndarray, weight: np.ndarray, length: np.ndarray) -> list[np.ndarray]:
        """How far the two ends of each pair move."""
        offset = x[pair[:, 0]] - x[pair[:, 1]]
        lacking = length / np.sqrt((offset * offset).sum(1)) - 1
        return [(weight[:, 0] * lacking)[:, None] * offset, -(weight[:, 1] * lacking)[:, None] * offset]

    def coloured(x: np.ndarray) -> np.ndarray:
        x = x.copy()
        for _ in range(CONFIG.substeps):
            for pair, weight, length in zip(ends, weights, lengths, strict=True):
                up, down = corrections(x, pair, weight, length)
                x[pair[:, 0]] += up
                x[pair[:, 1]] += down
        return x

    every = np.concatenate(ends), np.concatenate(weights), np.concatenate(lengths)
    ordered = every[0].T.ravel()
    share = (1 / np.maximum(np.bincount(ordered, minlength=cloth.count), 1)).astype(np.float32)

    def jacobi(x: np.ndarray) -> np.ndarray:
        for _ in range(CONFIG.substeps):
            both = np.concatenate(corrections(x, *every))
            total = np.stack([np.bincount(ordered, both[:, k], cloth.count) for k in range(3)], axis=1)
            x = x + share[:, None] * total.astype(np.float32)
        return x

    return Passes(lambda x: np.asarray(solve(x)), coloured, jacobi)


def strain(cloth: Cloth, x: np.ndarray) -> float:
    """Mean relative change of length of the pairs."""
    pairs = np.asarray(cloth.pairs)
    real = pairs[..., 0] < cloth.count
    apart = x[pairs[real][:, 0]] - x[pairs[real][:, 1]]
    return float(np.abs(np.linalg.norm(apart, axis=1) / np.asarray(cloth.lengths)[real] - 1).mean())


def strained(cloth: Cloth) -> np.ndarray:
    """The pattern (n, 3), stretched by a tenth, sewn vertices too, and noise of a millimetre."""
    noise = np.random.default_rng(0).normal(scale=1e-3, size=cloth.rest.shape)
    return (np.asarray(cloth.rest) * 1.1 + noise).astype(np.float32)


def timed(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Median and minimum of the milliseconds of so many calls after a first one."""
    work()
    times = [1000 * seconds(work) for _ in range(repeats)]
    return statistics.median(times), min(times)


def whole_frames(name: str, options: Options) -> str:
    """An avatar's row of the first table."""
    avatar = avatars.build(name)
    outfit, transforms = dressing.outfit(avatar), running(avatar.rig, options.frames + 1)
    state = dressing.dress(outfit, transforms[0], jnp.array([0.0, 0.0, _SPEED]), CONFIG)

    def simulate(outfit: dressing.Outfit, state: xpbd.ClothState, transforms: jax.Array) -> jax.Array:
        drives = jax.vmap(dressing.drive, in_axes=(None, 0))(outfit, transforms)
        return xpbd.simulate(outfit.cloth, state, drives, CONFIG)[1]

    made: list[typing.Any] = []
    inputs = outfit, state, transforms
    compiling = seconds(lambda: made.append(jax.jit(simulate).lower(*inputs).compile()))
    middle, least = (t / options.frames for t in timed(lambda: made[0](*inputs).block_until_ready(), options.repeats))
    count = int((outfit.cloth.pairs[..., 0] < outfit.cloth.count).sum())
    return (
        f"{name:10s} {outfit.cloth.count:8d} {count:11d} {len(outfit.cloth.pairs):7d} "
        f"{f'{middle:.1f} ({least:.1f})':>15s} {1000 / middle:8.0f} {compiling:9.1f}"
    )


def constraint_passes(name: str, options: Options) -> str:
    """An avatar's row of the second table."""
    cloth = dressing.outfit(avatars.build(name)).cloth
    start, made = strained(cloth), passes(cloth)
    ours, colours, jacobi = (timed(lambda work=work: work(start), options.repeats)[0] for work in made)
    ends = [work(start) for work in made]
    difference = np.abs(ends[0] - ends[1]).max()
    strains = f"{strain(cloth, start):.3f} {strain(cloth, ends[0]):.3f} {strain(cloth, ends[2]):.3f}"
    return (
        f"{name:10s} {ours:8.2f} {colours:9.2f} {colours / ours:6.1f} {jacobi:9.2f} {jacobi / ours:6.1f} "
        f"{difference:11.1e} {strains:>25s}"
    )


def contact_search(name: str, options: Options) -> str:
    """An avatar's row of the third table."""
    avatar = avatars.build(name)
    outfit, transforms = dressing.outfit(avatar), running(avatar.rig, 1)[0]
    cloth = dressing.dress(outfit, transforms, jnp.array([0.0, 0.0, _SPEED]), CONFIG).positions
    surface = dressing.drive(outfit, transforms).surface
    queries, groups, ask = np.asarray(cloth), np.asarray(surface.points), jax.jit(contacts.find_planes)

    def tree() -> np.ndarray:
        return np.stack([cKDTree(points).query(queries, workers=-1)[1] for points in groups])

    ours, peer = (timed(work, options.repeats)[0] for work in (lambda: np.asarray(ask(cloth, surface)), tree))
    found, best = (
        np.stack([np.linalg.norm(queries - points[k], axis=1) for points, k in zip(groups, chosen, strict=True)])
        for chosen in (np.asarray(ask(cloth, surface)), tree())
    )
    return f"{name:10s} {ours:8.2f} {peer:9.2f} {peer / ours:6.1f} {100 * (found / best - 1).max():8.3f}"


def main(options: Options) -> None:
    """Print the tables."""
    jax.config.update("jax_enable_compilation_cache", False)
    print(f"jax {jax.__version__} on {jax.default_backend()}, {os.cpu_count()} cores ({platform.machine()})")
    print("\nwhole frames\navatar     vertices constraints colours        ms a frame frames/s compile s")
    for name in options.avatars:
        print(whole_frames(name, options), flush=True)
    print("\n32 passes over the constraints, ms (numpy", np.__version__ + ")")
    print("avatar         ours   colours  ratio    Jacobi  ratio  difference strain: start ours Jacobi")
    for name in options.avatars:
        print(constraint_passes(name, options), flush=True)
    print("\nthe nearest points of the body, ms (scipy", scipy.__version__ + ")")
    print("avatar         ours  k-d tree  ratio  further")
    for name in options.avatars:
        print(contact_search(name, options), flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
