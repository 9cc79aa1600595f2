"""The renderer: a cloud of Gaussians and a camera in, an image out; pure, differentiable, jitted inside."""

from __future__ import annotations

import functools
import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import checkify
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from avatarjax.cameras import Camera
from avatarjax.gaussians import Gaussians
from avatarjax.splat import sharding, tiles
from avatarjax.splat.blend import blend
from avatarjax.splat.config import CAPACITY_MAX, SplatConfig, default_capacity
from avatarjax.splat.project import project
from avatarjax.splat.sh import view_colors


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
    """image (h, w, d) over the background, in the space of the colours or features; alpha (h, w) in [0, 1]; depth
    (h, w) metres, the mean depth of what a pixel shows, 0 where it shows nothing, None with `SplatConfig(depth=False)`;
    info."""

    image: Float[Array, "h w d"]
    alpha: Float[Array, "h w"]
    depth: Float[Array, "h w"] | None
    info: RenderInfo


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: ArrayLike = 0.0,
    features: Float[Array, "n d"] | None = None,
    config: SplatConfig = SplatConfig(),
) -> RenderOutput:
    """Draw a cloud by 3D Gaussian splatting (Kerbl et al. 2023), differentiable in the cloud, camera and background.

    gaussians: one cloud of n >= 0; camera: one camera; `jax.vmap` over either renders batches. features: (n, d) of any
    d >= 1 to draw in place of the colours; None draws what the camera sees of `colors` and `sh` (`view_colors`).
    background: a scalar or (d,). Gaussians behind the near plane are not drawn; what did not fit or was not finite is
    counted in `info`. Opaque tiles are finished early, which leaves out at most 1e-4 of the light.

    Reverse-mode derivatives are those of the picture with its early stop; `jax.jvp` and second ones raise TypeError:
    use `splat.reference.render_reference` for those. Raises ValueError for batched, wrongly shaped or non-float32
    input, and where `config.shards` is more than the devices there are.
    """
    _check(gaussians, camera)
    if features is None:
        features = view_colors(gaussians, camera)
    channels = features.shape[-1] if features.ndim == 2 else 1
    _check_array("features", features, (len(gaussians), channels))
    background = jnp.asarray(background, jnp.float32)
    if background.shape not in ((), (channels,)):
        raise ValueError(f"background must be a scalar or have shape ({channels},), got {background.shape}")
    return _render(gaussians, features, camera, jnp.broadcast_to(background, (channels,)), config)


def check(info: RenderInfo) -> None:
    """Raise, under `jax.experimental.checkify`, where Gaussians were dropped or were not finite.

    Call it on `RenderOutput.info` in a function that `checkify.checkify` wraps, jitted or not; elsewhere it raises
    at once, or, inside `jax.jit`, that the check was not wrapped.
    """
    checkify.check(
        jnp.all(info.dropped == 0),
        "{dropped} of {total} intersections of Gaussians and tiles did not fit: see avatarjax.splat.required_capacity",
        dropped=jnp.sum(info.dropped),
        total=jnp.sum(info.total),
    )
    checkify.check(jnp.all(info.non_finite == 0), "{count} Gaussians are not finite", count=jnp.sum(info.non_finite))


def required_capacity(
    gaussians: Gaussians,
    camera: Camera,
    config: SplatConfig = SplatConfig(),
) -> int:
    """A capacity with room for this cloud in this camera, or in all of a batch of cameras, and an eighth to spare.

    Rounded up to one of eight steps per octave, so that similar scenes share a compiled program. Not for use under jit.
    Raises ValueError where no capacity is enough.
    """
    views = jax.tree.map(lambda x: x.reshape(-1, *x.shape[-2:]), camera)
    _check(gaussians, jax.tree.map(lambda x: x[0], views))
    total = int(jnp.max(_count(gaussians, views, config))) * config.shards if len(gaussians) else 0
    if total > CAPACITY_MAX:
        raise ValueError(
            f"{total} intersections are more than {CAPACITY_MAX}: use fewer or smaller Gaussians, or tiles"
        )
    step = 2 ** max(0, int(np.floor(np.log2(max(total, 1)))) - 3)
    return min(CAPACITY_MAX, max(64, -(-(total + total // 8) // step) * step))


@functools.partial(jax.jit, static_argnames="config")
def _render(
    gaussians: Gaussians,
    features: Float[Array, "n d"],
    camera: Camera,
    background: Float[Array, " d"],
    config: SplatConfig,
) -> RenderOutput:
    if len(gaussians) == 0:
        return _nothing(camera, background, config)
    grid = _grid(camera, config)
    capacity = config.capacity or default_capacity(len(gaussians), grid.tiles * grid.shards)
    draw = functools.partial(_draw, grid=grid, capacity=capacity, config=config)
    blended, counts = sharding.over_rows(draw, config.shards)(gaussians, features, camera)
    blended = grid.assemble(blended)
    channels = background.shape[0]
    transmittance = blended[..., -1]
    alpha = 1 - transmittance
    seen = alpha > 0
    return RenderOutput(
        image=blended[..., :channels] + transmittance[..., None] * background[None, None],
        alpha=alpha,
        depth=jnp.where(seen, blended[..., channels] / jnp.where(seen, alpha, 1.0), 0.0) if config.depth else None,
        info=RenderInfo(*counts, capacity),
    )


def _draw(
    gaussians: Gaussians,
    features: Float[Array, "n d"],
    camera: Camera,
    *,
    grid: tiles.TileGrid,
    capacity: int,
    config: SplatConfig,
) -> tuple[Float[Array, "t c p"], Int[Array, " 3"]]:
    """The blended tiles of a shard, which projects its part of the Gaussians; and intersections, those dropped, and the
    Gaussians that are not finite, of all shards."""
    table, finite = project(gaussians, features, camera, config)
    table = sharding.gather(table, config.shards)
    shard = sharding.index(config.shards)
    lists = tiles.bin_splats(table, grid, -(-capacity // config.shards), shard, config.cull_ellipses)
    blended: Float[Array, "t c p"] = blend(table, lists, grid.corners(shard), config)
    counts = jnp.stack([lists.total, lists.dropped, jnp.sum(~finite, dtype=jnp.int32)])
    return blended, sharding.total(counts, config.shards)


@functools.partial(jax.jit, static_argnames="config")
def _count(gaussians: Gaussians, cameras: Camera, config: SplatConfig) -> Int[Array, "v s"]:
    """Intersections in each view and shard."""

    def count(camera):
        table, _ = project(gaussians, gaussians.colors, camera, config)
        grid = _grid(camera, config)
        return jnp.stack([tiles.count_intersections(table, grid, k) for k in range(config.shards)])

    return jax.lax.map(count, cameras)


def _grid(camera: Camera, config: SplatConfig) -> tiles.TileGrid:
    return tiles.TileGrid(camera.width, camera.height, config.tile_width, config.tile_height, config.shards)


def _nothing(camera: Camera, background: Float[Array, " d"], config: SplatConfig) -> RenderOutput:
    size = (camera.height, camera.width)
    none = jnp.int32(0)
    return RenderOutput(
        image=jnp.broadcast_to(background, (*size, background.shape[0])),
        alpha=jnp.zeros(size),
        depth=jnp.zeros(size) if config.depth else None,
        info=RenderInfo(none, none, none, capacity=0),
    )


def _check(gaussians: Gaussians, camera: Camera) -> None:
    n = gaussians.means.shape[0] if gaussians.means.ndim == 2 else None
    fields = {
        "means": (n, 3),
        "log_scales": (n, 3),
        "quats": (n, 4),
        "logit_opacities": (n,),
        "colors": (n, 3),
    }
    if gaussians.sh is not None:
        fields["sh"] = (n, gaussians.sh.shape[1] if gaussians.sh.ndim == 3 else None, 3)
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
