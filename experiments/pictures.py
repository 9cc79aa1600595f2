"""Pictures of rollouts: four cardinal views over a ground grid, contact sheets, plots."""

from __future__ import annotations

import functools
import typing
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from avatarjax import Camera, Gaussians
from avatarjax.data.dataset import cardinal_cameras
from avatarjax.io import atomic
from avatarjax.splat import SplatConfig, render, required_capacity

VIEW_NAMES = ("front", "left side", "back", "right side")
CHUNK = 10
SKY, TILE_LIGHT, TILE_DARK = 0.93, 0.86, 0.80


def follow(cameras: Camera, position: jax.Array) -> Camera:
    """Cameras moved along the ground to a position (3,)."""
    shift = jnp.eye(4).at[0, 3].set(-position[0]).at[2, 3].set(-position[2])
    return cameras.replace(world_to_camera=cameras.world_to_camera @ shift)


def ground(camera: Camera) -> jax.Array:
    """The chequered ground y = 0, squares of half a metre, under a pale sky (h, w, 3): it makes movement visible."""
    rows, columns = jnp.mgrid[: camera.height, : camera.width]
    pixels = jnp.stack([columns + 0.5, rows + 0.5, jnp.ones_like(rows)], -1)
    rays = pixels @ jnp.linalg.inv(camera.intrinsics).T @ camera.world_to_camera[:3, :3]
    eye = camera.position
    distance = -eye[1] / jnp.where(rays[..., 1] < -1e-4, rays[..., 1], -1e-4)
    hit = eye[None, None] + rays * distance[..., None]
    odd = (jnp.floor(hit[..., 0] * 2) + jnp.floor(hit[..., 2] * 2)) % 2
    shade = jnp.where(odd == 1, TILE_DARK, TILE_LIGHT)
    # Squares smaller than a pixel would flicker: fade them out with distance.
    shade = SKY + (shade - SKY) * jnp.exp(-((distance / 12) ** 2))
    return jnp.repeat(jnp.where(rays[..., 1] < -1e-4, shade, SKY)[..., None], 3, axis=-1)


@functools.partial(jax.jit, static_argnames="config")
def _draw(gaussians: Gaussians, positions: jax.Array, cameras: Camera, config: SplatConfig):
    """Views (f, v, h, w, 3) uint8 and dropped intersections (f, v) of frames (f) from cameras (v) that follow."""

    def frame(inputs):
        cloud, position = inputs

        def view(camera):
            out = render(cloud, camera, config=config)
            picture = out.image + (1 - out.alpha)[..., None] * ground(camera)
            return (jnp.clip(picture, 0, 1) * 255 + 0.5).astype(jnp.uint8), out.info.dropped

        return jax.lax.map(view, follow(cameras, position))

    return jax.lax.map(frame, (gaussians, positions))


def draw_frames(gaussians: Gaussians, roots: jax.Array, size: int, *, label: str = "pictures") -> Iterator[np.ndarray]:
    """Pictures (4, h, w, 3) of frame after frame; Gaussians and roots (f, 3) have a leading time axis.

    The cameras follow the smoothed root. Warns where the kernel had to drop intersections.
    """
    cameras = cardinal_cameras(size)
    frames = roots.shape[0]
    kernel = np.hanning(17)
    smooth = [
        np.convolve(np.pad(np.asarray(roots)[:, k], 8, mode="edge"), kernel / kernel.sum(), "valid") for k in range(3)
    ]
    positions = jnp.asarray(np.stack(smooth, -1), jnp.float32)
    probe = [frames // 4, frames // 2, frames - 1]
    capacity = max(
        required_capacity(jax.tree.map(lambda x, k=k: x[k], gaussians), follow(cameras, positions[k])) for k in probe
    )
    config = SplatConfig(capacity=2 * capacity, depth=False)
    dropped = 0
    for start in tqdm(range(0, frames, CHUNK), desc=label, unit=f"{CHUNK} frames"):
        chosen = np.minimum(np.arange(start, start + CHUNK), frames - 1)
        views, lost = _draw(jax.tree.map(lambda x, c=chosen: x[c], gaussians), positions[chosen], cameras, config)
        dropped += int(lost.sum())
        yield from np.asarray(views)[: min(CHUNK, frames - start)]
    if dropped:
        print(f"warning: {dropped} splat intersections did not fit and were dropped from the pictures")


def key_frames(script: Sequence[int]) -> list[int]:
    """Frames worth seeing: shortly after each key change, well after it, and just before the next."""
    starts = [0] + [k for k in range(1, len(script)) if script[k] != script[k - 1]]
    ends = [*starts[1:], len(script)]
    return sorted({k for s, e in zip(starts, ends, strict=True) for k in (s + 4, s + 10, s + 30, e - 2) if s <= k < e})


def contact_sheet(views: Sequence[np.ndarray], columns: Sequence[int]) -> np.ndarray:
    """Chosen frames across, the four views down."""
    return np.concatenate([np.concatenate([views[k][v] for k in columns], axis=1) for v in range(4)], axis=0)


def save_plot(path: Path, draw: Callable[[typing.Any], None], *, size: tuple[float, float] = (7, 4)) -> None:
    """Save a matplotlib figure that `draw(axes)` fills in, atomically and without a display."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    draw(figure.subplots())
    with atomic.replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format=path.suffix[1:])


def save_grid(path: Path, images: Sequence[np.ndarray], titles: Sequence[str], *, columns: int) -> None:
    """Pictures (h, w, 3) uint8 of one size in rows of `columns`, each under its title, bold where it is a new one."""
    from matplotlib.figure import Figure

    rows = -(-len(images) // columns)
    height, width = images[0].shape[:2]
    figure = Figure(figsize=(1.4 * columns, (1.4 * height / width + 0.25) * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for k, axes in enumerate(grid):
        axes.set_axis_off()
        if k < len(images):
            changed = k > 0 and titles[k] != titles[k - 1]
            axes.imshow(images[k])
            axes.set_title(titles[k], fontsize=10, fontweight="bold" if changed else "normal", pad=2)
    with atomic.replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format=path.suffix[1:])


def plot_losses(path: Path, records: Sequence[dict[str, float]], name: str) -> None:
    """Loss against step, both on the scale that shows it best."""

    def draw(axes):
        axes.plot([r["step"] for r in records], [r["loss"] for r in records])
        axes.set(xlabel="step", ylabel="loss", title=name, yscale="log")
        axes.grid(alpha=0.3)

    save_plot(path, draw, size=(5, 3))


def plot_paths(path: Path, paths: dict[str, np.ndarray]) -> None:
    """Root paths (f, 3) seen from above, z up and x to the left as the figure's own left and right are."""

    def draw(axes):
        for label, roots in paths.items():
            axes.plot(roots[:, 0], roots[:, 2], label=label, lw=1.6)
        axes.plot(0, 0, "ko", ms=5)
        axes.invert_xaxis()
        axes.set(xlabel="x in metres (A, left, is +x)", ylabel="z in metres (W, forward, is +z)", aspect="equal")
        axes.grid(alpha=0.3)
        axes.legend()

    save_plot(path, draw, size=(6, 6))


def draw_lines(axes: typing.Any, lines: dict[str, np.ndarray], xlabel: str, ylabel: str, *, logy: bool = False) -> None:
    """Several curves over their index or, for (n, 2) arrays, over their first column."""
    for label, line in lines.items():
        x, y = (line[:, 0], line[:, 1]) if line.ndim == 2 else (np.arange(len(line)), line)
        axes.plot(x, y, label=label, lw=1.4, marker="o" if line.ndim == 2 else None, ms=3)
    axes.set(xlabel=xlabel, ylabel=ylabel, yscale="log" if logy else "linear")
    axes.grid(alpha=0.3)
    axes.legend()


def plot_lines(path: Path, lines: dict[str, np.ndarray], xlabel: str, ylabel: str) -> None:
    """A picture of `draw_lines`."""
    save_plot(path, lambda axes: draw_lines(axes, lines, xlabel, ylabel))
