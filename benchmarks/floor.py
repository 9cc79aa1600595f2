"""The least time that the arithmetic of blending takes: its operations, and how many a second this machine sustains."""

from __future__ import annotations

import os
from collections.abc import Callable

import jax
import jax.numpy as jnp

from benchmarks.timing import seconds

# Float32 operations for a list entry at a pixel, with colour and depth as channels; a comparison or a conversion counts
# as one, a multiply-add as two.
FORWARD_FLOPS = {
    "offset of the pixel": 2,
    "exponent": 8,
    "power of two: range reduction, polynomial of degree 5, scaling": 16,
    "limits of alpha": 3,
    "four channels": 12,
    "transmittance": 2,
}
BACKWARD_FLOPS = {
    "alpha again": 29,
    "transmittance and weight": 3,
    "four channels times their cotangents": 7,
    "what is behind": 2,
    "slope of the exponent": 4,
    "six moments over the pixels": 11,
    "cotangents of four channels": 8,
}

# 256 KiB: in the second-level cache of a core, beyond its first.
_ELEMENTS = 2**16
_MULTIPLY_ADDS = 40
_REPEATS = 200
_RUNS = 15


class Throughput:
    """Sustained float32 operations a second of a fused elementwise kernel: a polynomial of 40 multiply-adds.

    It is compiled by XLA like the blending, so it reaches what XLA's vector code can, not the processor's peak. To be
    made in a process of its own, since it takes a device for each thread.
    """

    def __init__(self) -> None:
        most = os.cpu_count() or 1
        jax.config.update("jax_num_cpu_devices", most)
        self._runs = {threads: _kernel(threads) for threads in sorted({1, most})}

    def flops(self) -> dict[int, float]:
        """Operations a second by number of threads, one and all: the best of a few runs."""
        best = {threads: min(seconds(run) for _ in range(_RUNS)) for threads, run in self._runs.items()}
        per_thread = 2 * _MULTIPLY_ADDS * _REPEATS * _ELEMENTS
        return {threads: threads * per_thread / best[threads] for threads in best}


def _kernel(threads: int) -> Callable[[], object]:
    mesh = jax.make_mesh((threads,), ("x",), axis_types=(jax.sharding.AxisType.Auto,), devices=jax.devices()[:threads])

    def polynomial(_, x):
        y = jnp.full_like(x, 0.01)
        for k in range(_MULTIPLY_ADDS):
            y = y * x + 0.3 / (k + 1)
        return y

    def repeat(x):
        return jax.lax.fori_loop(0, _REPEATS, polynomial, x)

    run = jax.jit(jax.shard_map(repeat, mesh=mesh, in_specs=jax.P("x"), out_specs=jax.P("x")))
    x = jax.device_put(jnp.linspace(0, 0.5, threads * _ELEMENTS), jax.NamedSharding(mesh, jax.P("x")))
    return lambda: jax.block_until_ready(run(x))
