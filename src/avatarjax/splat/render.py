"""The renderer: a cloud of Gaussians and a camera in, an image out; pure, differentiable, jitted inside."""

from __future__ import annotations

import functools
import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from avatarjax.cameras import Camera
from avatarjax.gaussians import Gaussians
from avatarjax.splat import columns, tiles
from avatarjax.splat.blend import blend, fields_of
from avatarjax.splat.config import CAPACITY_MAX, SplatConfig, default_capacity
from avatarjax.splat.project import project


@typing.no_type_check
@flax.struct.dataclass
class RenderInfo:
    """What the image does not say: total intersections of Gaussians and tiles, how many were dropped because they
    exceed `capacity`, and how many Gaussians were left out because they are not finite; int32 scalars.

    `dropped` > 0 means that the image lacks Gaussians, the farthest: render with
    `SplatConfig(capacity=required_capacity(...))`.
    """

    total: Int[Array, ""]
    dropped: Int[Array, ""]
    non_finite: Int[Array, ""]
    capacity: int = flax.struct.field(pytree_node=False)


@typing.no_type_check
@flax.struct.dataclass
class RenderOutput:
    """image (h, w, 3) over the background, in the space of the Gaussians' colours; alpha (h, w) in [0, 1]; depth (h, w)
    metres, the mean depth of what a pixel shows, 0 where it shows nothing; info."""

    image: Float[Array, "h w 3"]
    alpha: Float[Array, "h w"]
    depth: Float[Array, "h w"]
    info: RenderInfo


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: ArrayLike = 0.0,
    config: SplatConfig = SplatConfig(),
) -> RenderOutput:
    """Draw a cloud by 3D Gaussian splatting (Kerbl et al. 2023), differentiable in the cloud, camera and background.

    gaussians: one cloud of n >= 0; camera: one camera; `jax.vmap` over either renders batches. background: a scalar or
    (3,). Gaussians behind the near plane are not drawn; what did not fit or was not finite is counted in `info`.
    Opaque tiles are finished early, which leaves out at most 1e-4 of the light.

    Raises ValueError for batched, wrongly shaped or non-float32 input, and for clouds with spherical harmonics.
    """
    _check(gaussians, camera)
    background = jnp.asarray(background, jnp.float32)
    if background.shape not in ((), (3,)):
        raise ValueError(f"background must be a scalar or have shape (3,), got {background.shape}")
    return _render(gaussians, camera, jnp.broadcast_to(background, (3,)), config)


def required_capacity(
    gaussians: Gaussians,
    camera: Camera,
    config: SplatConfig = SplatConfig(),
) -> int:
    """A capacity with room for this cloud in this camera, or in all of a batch of cameras, and a quarter to spare.

    Rounded up to one of four steps per octave, so that similar scenes share a compiled program. Not for use under jit.
    Raises ValueError where no capacity is enough.
    """
    views = jax.tree.map(lambda x: x.reshape(-1, *x.shape[-2:]), camera)
    _check(gaussians, jax.tree.map(lambda x: x[0], views))
    total = int(jnp.max(_count(gaussians, views, config))) if len(gaussians) else 0
    if total > CAPACITY_MAX:
        raise ValueError(
            f"{total} intersections are more than {CAPACITY_MAX}: use fewer or smaller Gaussians, or tiles"
        )
    step = 2 ** max(0, int(np.floor(np.log2(max(total, 1)))) - 2)
    return min(CAPACITY_MAX, max(64, -(-(total + total // 4) // step) * step))


@functools.partial(jax.jit, static_argnames="config")
def _render(gaussians: Gaussians, camera: Camera, background: Float[Array, " 3"], config: SplatConfig) -> RenderOutput:
    if len(gaussians) == 0:
        return _nothing(camera, background)
    grid = _grid(camera, config)
    capacity = config.capacity or default_capacity(len(gaussians), grid.tiles)
    splats = project(gaussians, camera, config)
    lists = tiles.bin_splats(splats, grid, capacity)
    channels = [*columns.split(gaussians.colors), splats.depth]
    blended = grid.assemble(blend(fields_of(splats, channels), lists, grid, config))
    colors, depth, transmittance = blended[..., :3], blended[..., 3], blended[..., 4]
    alpha = 1 - transmittance
    seen = alpha > 0
    return RenderOutput(
        image=colors + transmittance[..., None] * background[None, None],
        alpha=alpha,
        depth=jnp.where(seen, depth / jnp.where(seen, alpha, 1.0), 0.0),
        info=RenderInfo(lists.total, lists.dropped, jnp.sum(~splats.finite, dtype=jnp.int32), capacity),
    )


@functools.partial(jax.jit, static_argnames="config")
def _count(gaussians: Gaussians, cameras: Camera, config: SplatConfig) -> Int[Array, " v"]:
    def count(camera):
        splats = project(gaussians, camera, config)
        return tiles.count_intersections(splats, _grid(camera, config))

    return jax.lax.map(count, cameras)


def _grid(camera: Camera, config: SplatConfig) -> tiles.TileGrid:
    return tiles.TileGrid(camera.width, camera.height, config.tile_width, config.tile_height)


def _nothing(camera: Camera, background: Float[Array, " 3"]) -> RenderOutput:
    size = (camera.height, camera.width)
    none = jnp.int32(0)
    info = RenderInfo(none, none, none, capacity=0)
    return RenderOutput(jnp.broadcast_to(background, (*size, 3)), jnp.zeros(size), jnp.zeros(size), info)


def _check(gaussians: Gaussians, camera: Camera) -> None:
    if gaussians.sh is not None:
        raise ValueError("render draws plain colours: evaluate sh into colors first, and pass sh=None")
    n = gaussians.means.shape[0] if gaussians.means.ndim == 2 else None
    fields = {
        "means": (n, 3),
        "log_scales": (n, 3),
        "quats": (n, 4),
        "logit_opacities": (n,),
        "colors": (n, 3),
    }
    for name, shape in fields.items():
        _check_array(f"gaussians.{name}", getattr(gaussians, name), shape)
    _check_array("camera.world_to_camera", camera.world_to_camera, (4, 4))
    _check_array("camera.intrinsics", camera.intrinsics, (3, 3))
    if camera.width < 1 or camera.height < 1:
        raise ValueError(f"image size must be positive, got {camera.width}x{camera.height}")


def _check_array(name: str, value: ArrayLike, shape: tuple) -> None:
    if value.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {value.shape}; use jax.vmap for batches")
    if value.dtype != jnp.float32:
        raise ValueError(f"{name} must be float32, got {value.dtype}")
