"""A fixed number of lanes works through a queue of tiles, each lane through the depth-sorted list of its tile.

A lane reads a few entries of its tile's list per iteration; when the list is exhausted or the tile opaque, it takes the
next tile of the queue, longest list first. So all lanes have work until the queue is empty, though lists differ in
length by a factor of a hundred.
"""

from __future__ import annotations

import functools
import typing
from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from avatarjax.splat import columns
from avatarjax.splat.config import TRANSMITTANCE_MIN
from avatarjax.splat.tiles import TileLists

_CPU_LANES, _MIN_LANES, _WIDE_LANES = 128, 16, 4096


class Queue(typing.NamedTuple):
    """Tiles by falling list length, then the number of tiles, which stands for "none", for two rounds of lanes; and
    where the lists start and end, with an empty one for "none"."""

    order: Int[Array, " q"]
    starts: Int[Array, " t+1"]
    ends: Int[Array, " t+1"]

    @property
    def none(self) -> int:
        return self.starts.shape[0] - 1


class Work(typing.NamedTuple):
    """What the lanes are at: their tile, the position in its list, and how many places of the queue are taken."""

    tile: Int[Array, " l"]
    position: Int[Array, " l"]
    taken: Int[Array, ""]


def by_platform(kernel: Callable, chosen: int | None, tiles: int) -> Callable:
    """`kernel(..., n_lanes=...)` with the chosen number of lanes, or with that which suits the platform.

    On CPU the lanes fit the cache, and small images take fewer, or the last ones idle while the longest lists end;
    elsewhere all tiles are worked on at once, for the sake of few, wide operations.
    """
    if chosen is not None:
        return functools.partial(kernel, n_lanes=chosen)
    few = functools.partial(kernel, n_lanes=min(_CPU_LANES, max(_MIN_LANES, tiles // 16)))
    many = functools.partial(kernel, n_lanes=min(_WIDE_LANES, tiles))
    return lambda *arrays: lax.platform_dependent(*arrays, cpu=few, default=many)


def start(lists: TileLists, lanes: int) -> tuple[Queue, Work]:
    """The queue of all tiles with a list, and the lanes at the first of them."""
    lengths = lists.ends - lists.starts
    none = lengths.shape[0]
    order = jnp.argsort(-lengths).astype(jnp.int32)
    order = jnp.where(lengths[order] > 0, order, none)
    order = jnp.pad(order, (0, 2 * lanes), constant_values=none)
    queue = Queue(order, jnp.pad(lists.starts, (0, 1)), jnp.pad(lists.ends, (0, 1)))
    tile = order[:lanes]
    return queue, Work(tile, queue.starts[tile], jnp.int32(lanes))


def busy(work: Work, queue: Queue) -> Bool[Array, ""]:
    """Whether any lane has a tile."""
    return jnp.any(work.tile < queue.none)


def entries(work: Work, queue: Queue, lists: TileLists, steps: int) -> tuple[Int[Array, "l s"], Bool[Array, "l s"]]:
    """The next `steps` Gaussians of each lane, and which of them are in its list; behind its end come others that are
    visible."""
    places = work.position[:, None] + jnp.arange(steps, dtype=jnp.int32)[None]
    ids = columns.take(lists.ids, jnp.minimum(places, lists.ids.shape[0] - 1))
    return ids, places < queue.ends[work.tile][:, None]


def advance(work: Work, queue: Queue, steps: int, transmittance: Float[Array, "l p"]) -> tuple[Bool[Array, " l"], Work]:
    """Which lanes are done with their tile, and all lanes `steps` entries on or at the next tile of the queue."""
    position = work.position + steps
    opaque = jnp.max(transmittance, axis=-1) <= TRANSMITTANCE_MIN
    done = ((position >= queue.ends[work.tile]) | opaque) & (work.tile < queue.none)
    place = work.taken + jnp.cumsum(done, dtype=jnp.int32) - 1
    following = queue.order[jnp.minimum(place, queue.order.shape[0] - 1)]
    tile = jnp.where(done, following, work.tile)
    position = jnp.where(done, queue.starts[tile], position)
    return done, Work(tile, position, work.taken + jnp.sum(done, dtype=jnp.int32))


def in_place(buffer: Float[Array, "k ..."], x: Float[Array, "l ..."], work: Work) -> Float[Array, "k ..."]:
    """The buffer, one lane larger than x, with x in it.

    Does nothing but keep XLA on CPU from computing x on several threads, which it does for every operation but updates
    in place: waking a thread takes longer than half of such an operation, and the other threads have their own tiles
    under `SplatConfig.shards`. It also makes x the result of one loop, not repeated in each use.
    """
    zero = jnp.minimum(work.taken, 0)
    return lax.dynamic_update_slice(buffer, x, (zero,) * x.ndim)
