"""The constants of the splatting kernel that a caller may choose."""

from __future__ import annotations

import dataclasses

# Alphas are counted from ALPHA_MIN and clamped at ALPHA_MAX, and a tile is finished when no pixel lets more light
# through than TRANSMITTANCE_MIN: the values of 3D Gaussian Splatting (Kerbl et al. 2023) and of gsplat.
ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4

# Positions in the lists are computed with float32 sums, which are exact for integers below this.
CAPACITY_MAX = 2**24


@dataclasses.dataclass(frozen=True)
class SplatConfig:
    """Static settings of `render`; hashable, so that it can be a static argument of `jax.jit`.

    capacity: room for the tiles in the bounding boxes of all Gaussians; None takes `default_capacity`. What does not
    fit is dropped, farthest first, and counted in `RenderInfo.dropped`; `required_capacity` gives a value that fits a
    scene.
    near: Gaussians whose centre is nearer to the image plane than this many metres are not drawn.
    eps2d: variance in square pixels added to each axis of a projected Gaussian (0.3 as in gsplat).
    antialiased: take from the opacity of small Gaussians what `eps2d` adds to their area (Mip-Splatting, Yu et al.
    2024), so that they do not grow brighter as they move away.
    depth: draw the mean depth too; without it `RenderOutput.depth` is None, and all is a few percent faster.
    cull_ellipses: leave out tiles in the corners of bounding boxes that the ellipses do not reach. Changes no picture
    by more than the early stop does; saves a fifth of the blending of long, thin Gaussians, and a sixteenth of round
    ones, about what it costs.
    shards: devices that share an image, row of tiles by row of tiles; on CPU, start with `jax_num_cpu_devices` set.
    tile_width, tile_height: pixels. forward_lanes, backward_lanes: tiles in flight at once; None takes up to 128 on CPU
    and up to 4096 elsewhere. forward_steps, backward_steps: list entries that a lane blends per iteration. The defaults
    are the fastest that were measured on two CPU cores.
    """

    capacity: int | None = None
    near: float = 0.01
    eps2d: float = 0.3
    antialiased: bool = False
    depth: bool = True
    cull_ellipses: bool = False
    shards: int = 1
    tile_width: int = 8
    tile_height: int = 4
    forward_lanes: int | None = None
    forward_steps: int = 16
    backward_lanes: int | None = None
    backward_steps: int = 8

    def __post_init__(self) -> None:
        if self.capacity is not None and not 0 < self.capacity <= CAPACITY_MAX:
            raise ValueError(f"capacity must be in 1..{CAPACITY_MAX} or None, got {self.capacity}")
        counts = ["shards", "tile_width", "tile_height", "forward_steps", "backward_steps"]
        counts += [name for name in ("forward_lanes", "backward_lanes") if getattr(self, name) is not None]
        for name in counts:
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.near <= 0 or self.eps2d <= 0:
            raise ValueError(f"near and eps2d must be positive, got {self.near} and {self.eps2d}")


def default_capacity(n_gaussians: int, n_tiles: int) -> int:
    """Intersections that `capacity=None` makes room for: five tiles a Gaussian or 64 Gaussians a tile.

    The larger of the two, but no more than could ever be needed. A body of small Gaussians that fills the image takes
    about four tiles a Gaussian, whatever the resolution; clouds of few or large Gaussians take more.
    """
    return max(1, min(n_gaussians * n_tiles, max(5 * n_gaussians, 64 * n_tiles), CAPACITY_MAX))
