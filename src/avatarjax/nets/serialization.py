"""Space-filling curves over voxels: the orders in which a point transformer reads a point cloud (PTv3, UNICA C.1)."""

from __future__ import annotations

import typing

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

Curve = typing.Literal["z", "z-trans", "hilbert", "hilbert-trans"]
CURVES: tuple[Curve, ...] = typing.get_args(Curve)


def voxels(points: Float[Array, "n 3"], grid: int) -> Int[Array, "n 3"]:
    """Voxel indices in a grid^3 grid over [0, 1]^3; points outside count to the border voxels."""
    return jnp.clip(jnp.floor(points * grid), 0, grid - 1).astype(jnp.int32)


def codes(voxel: Int[Array, "n 3"], bits: int, curve: Curve) -> Int[Array, "n"]:
    """Position of each voxel along a curve through the (2^bits)^3 grid, bits <= 10; "-trans" swaps x and y first."""
    if curve.endswith("-trans"):
        voxel = voxel[:, jnp.array([1, 0, 2])]
    return _interleave(voxel if curve.startswith("z") else _hilbert_transpose(voxel, bits), bits)


def _interleave(voxel: Int[Array, "n 3"], bits: int) -> Int[Array, "n"]:
    """Morton code: the bits of x, y, z in turn, x the most significant."""
    code = jnp.zeros(voxel.shape[0], jnp.int32)
    for bit in reversed(range(bits)):
        for axis in range(3):
            code = (code << 1) | ((voxel[:, axis] >> bit) & 1)
    return code


def _hilbert_transpose(voxel: Int[Array, "n 3"], bits: int) -> Int[Array, "n 3"]:
    """The transposed Hilbert index, whose interleaved bits are the position (Skilling 2004, AxestoTranspose)."""
    x = [voxel[:, axis] for axis in range(3)]
    for bit in reversed(range(1, bits)):
        q = 1 << bit
        low = q - 1
        for axis in range(3):
            set_ = (x[axis] & q) != 0
            swap = (x[0] ^ x[axis]) & low
            # A set bit inverts the low bits of x; a clear one exchanges them with those of this axis.
            x0 = jnp.where(set_, x[0] ^ low, x[0] ^ swap)
            x[axis] = x0 if axis == 0 else jnp.where(set_, x[axis], x[axis] ^ swap)
            x[0] = x0
    x[1] = x[1] ^ x[0]
    x[2] = x[2] ^ x[1]
    gray = jnp.zeros_like(x[0])
    for bit in reversed(range(1, bits)):
        q = 1 << bit
        gray = jnp.where((x[2] & q) != 0, gray ^ (q - 1), gray)
    return jnp.stack([value ^ gray for value in x], axis=-1)
