"""Scenes that the benchmarks draw: clouds on the surface of a figure of capsules, about what an avatar looks like."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np

from avatarjax import Camera, Gaussians, look_at

# Gaussians and pixels a side of the four standard scenes: about as many Gaussians a pixel in each.
SIZES = ((4_000, 64), (16_000, 128), (65_000, 256), (200_000, 512))

# Start, end and radius, metres: trunk, head, two arms, two legs of a figure of 1.8 m that stands on y = 0.
_CAPSULES = (
    ((0.0, 0.95, 0.0), (0.0, 1.40, 0.0), 0.15),
    ((0.0, 1.66, 0.0), (0.0, 1.70, 0.0), 0.10),
    ((0.17, 1.42, 0.0), (0.62, 1.05, 0.05), 0.05),
    ((-0.17, 1.42, 0.0), (-0.62, 1.05, 0.05), 0.05),
    ((0.10, 0.88, 0.0), (0.16, 0.08, 0.0), 0.08),
    ((-0.10, 0.88, 0.0), (-0.16, 0.08, 0.0), 0.08),
)
_OPACITY = 0.9
_FLATNESS = 0.3
_NEEDLE_ASPECT = 12.0


def body_cloud(n: int, seed: int = 0) -> Gaussians:
    """n flat Gaussians spread evenly over the surface of a figure of six capsules, in random order.

    Standard deviations are sqrt(area / n) metres in the tangent plane and 0.3 times that along the normal, each times
    exp(0.2 g) with g standard normal; opacity is 0.9. So every pixel of the figure sees several layers.
    """
    return _cloud(*_parameters(n, np.random.default_rng(seed)))


def needle_cloud(n: int, seed: int = 0) -> Gaussians:
    """`body_cloud(n, seed)` with Gaussians 12 times as long as wide, of the same area, in random tangent directions.

    Most of a needle's bounding box is empty where it lies across the axes of the image.
    """
    rng = np.random.default_rng(seed)
    means, scales, quats, colors = _parameters(n, rng)
    scales = scales * np.array([math.sqrt(_NEEDLE_ASPECT), 1 / math.sqrt(_NEEDLE_ASPECT), 1.0])
    half = rng.uniform(0, math.pi / 2, size=n)
    return _cloud(means, scales, _turn_about_z(quats, half), colors)


def body_camera(size: int) -> Camera:
    """A square camera of `size` pixels a side, 3 m from the figure, which fills nine tenths of its height."""
    return look_at((0.0, 0.9, -3.0), (0.0, 0.9, 0.0), width=size, height=size, fov_y=2 * math.atan(1 / 3))


def _parameters(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Means (n, 3), scales (n, 3), quats (n, 4) and colours (n, 3), float64."""
    areas = np.array([_area(*capsule) for capsule in _CAPSULES])
    counts = np.floor(areas / areas.sum() * n).astype(int)
    counts[0] += n - counts.sum()
    parts = [_surface(rng, count, *capsule) for count, capsule in zip(counts, _CAPSULES, strict=True)]
    order = rng.permutation(n)
    means, normals = (np.concatenate(part)[order] for part in zip(*parts, strict=True))
    spacing = math.sqrt(areas.sum() / n)
    scales = spacing * np.array([1.0, 1.0, _FLATNESS]) * np.exp(0.2 * rng.normal(size=(n, 3)))
    colors = 0.5 + 0.5 * np.sin(means * [7, 9, 11] + [0, 1, 2]) + 0.05 * rng.normal(size=(n, 3))
    return means, scales, _quats_from_z(normals), np.clip(colors, 0, 1)


def _cloud(means: np.ndarray, scales: np.ndarray, quats: np.ndarray, colors: np.ndarray) -> Gaussians:
    logits = np.full(len(means), math.log(_OPACITY / (1 - _OPACITY)))
    fields = (means, np.log(scales), quats, logits, colors)
    return Gaussians(*(jnp.asarray(field, jnp.float32) for field in fields))


def _area(start: tuple, end: tuple, radius: float) -> float:
    return 2 * math.pi * radius * math.dist(start, end) + 4 * math.pi * radius**2


def _surface(
    rng: np.random.Generator, n: int, start: tuple, end: tuple, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) spread evenly over a capsule, metres, and unit normals (n, 3)."""
    length = math.dist(start, end)
    axis = np.subtract(end, start) / length
    on_side = rng.random(n) < length / (length + 2 * radius)
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    along = rng.random((n, 1)) * length
    upward = (directions @ axis)[:, None]
    across = directions - upward * axis
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    sides = start + along * axis + radius * across
    caps = np.where(upward > 0, end, start) + radius * directions
    on_side = on_side[:, None]
    return np.where(on_side, sides, caps), np.where(on_side, across, directions)


def _quats_from_z(normals: np.ndarray) -> np.ndarray:
    """Rotations (n, 4) as (w, x, y, z) that take +z to `normals` (n, 3) on the shortest way."""
    z = np.array([0.0, 0.0, 1.0])
    quats = np.concatenate([1 + normals @ z[:, None], np.cross(z, normals)], axis=1)
    # -z has no shortest way: half a turn about x.
    quats[quats[:, 0] < 1e-6] = [0, 1, 0, 0]
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def _turn_about_z(quats: np.ndarray, half_angles: np.ndarray) -> np.ndarray:
    """`quats` after a turn about their own z axis by twice `half_angles` (n,), radians."""
    w, x, y, z = quats.T
    c, s = np.cos(half_angles), np.sin(half_angles)
    return np.stack([w * c - z * s, x * c + y * s, y * c - x * s, w * s + z * c], axis=1)
