"""Several devices at one image: each projects a part of the Gaussians and draws a part of the tile rows.

On CPU the devices are threads of one process (set JAX_NUM_CPU_DEVICES=2, or `jax_num_cpu_devices`, before JAX starts):
XLA runs the many small operations of the sorts and of the blending on one thread, so one device leaves cores idle.
"""

from __future__ import annotations

import typing
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jax.sharding import AxisType, PartitionSpec
from jaxtyping import Array, Float, Int

from avatarjax.cameras import Camera
from avatarjax.gaussians import Gaussians

_AXIS = "shards"


def over_rows(draw: Callable, shards: int) -> Callable:
    """`draw(gaussians, features, camera) -> (tiles, counts)` on `shards` devices, tiles one shard after another.

    Raises ValueError where there are fewer devices.
    """
    if shards == 1:
        return draw
    if len(jax.devices()) < shards:
        raise ValueError(
            f"SplatConfig(shards={shards}) needs {shards} devices, found {len(jax.devices())}: set the environment "
            f"variable JAX_NUM_CPU_DEVICES={shards}, or jax_num_cpu_devices, before JAX starts"
        )
    mesh = jax.make_mesh((shards,), (_AXIS,), axis_types=(AxisType.Auto,), devices=jax.devices()[:shards])
    part, whole = PartitionSpec(_AXIS), PartitionSpec()
    sharded = jax.shard_map(draw, mesh=mesh, in_specs=(part, part, whole), out_specs=(part, whole), check_vma=False)

    def padded(gaussians: Gaussians, features: Float[Array, "n d"], camera: Camera) -> typing.Any:
        gaussians, features = jax.tree.map(lambda x: _pad(x, shards), (gaussians, features))
        return sharded(gaussians, features, camera)

    return padded


def _pad(x: Float[Array, "n ..."], shards: int) -> Float[Array, "n2 ..."]:
    """Rows for all shards alike: transparent Gaussians at the origin of the world."""
    rows = -x.shape[0] % shards
    fill = -jnp.inf if x.ndim == 1 else 0.0
    return jnp.pad(x, ((0, rows),) + ((0, 0),) * (x.ndim - 1), constant_values=fill)


def gather(rows: Float[Array, "n k"], shards: int) -> Float[Array, "m k"]:
    """The rows of all shards."""
    return rows if shards == 1 else lax.all_gather(rows, _AXIS, tiled=True)


def index(shards: int) -> Int[Array, ""] | int:
    """Which shard this is."""
    return 0 if shards == 1 else lax.axis_index(_AXIS)


def total(counts: Int[Array, " k"], shards: int) -> Int[Array, " k"]:
    """The sums over all shards, of counts up to 2^30, at most 2^30."""
    return counts if shards == 1 else lax.psum(jnp.minimum(counts, 2**30 // shards), _AXIS)
