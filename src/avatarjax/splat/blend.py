"""Front-to-back alpha blending of per-tile lists, forward and backward, in plain lax operations.

Each lane (see lanes.py) blends a few list entries of its tile per iteration. The backward pass keeps no lists of
weights: it blends front to back again and gets the colour behind an entry as the final colour less the colour in front
of it, with no division by the transmittance.
"""

from __future__ import annotations

import functools
import math
import typing

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from avatarjax.splat import columns, lanes
from avatarjax.splat.config import ALPHA_MAX, ALPHA_MIN, SplatConfig
from avatarjax.splat.project import CHANNELS, DEPTH, EXTENT_X, LOG2_OPACITY, XX, XY, YY, X, Y
from avatarjax.splat.tiles import TileLists


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def blend(
    table: Float[Array, "n k"], lists: TileLists, corners: Float[Array, "t 2"], config: SplatConfig
) -> Float[Array, "t c p"]:
    """Blend the features and the depth of projected Gaussians over every tile; the last result is the transmittance.

    `table` as `project` makes it; `corners` are the upper left corners of the tiles, pixels. Differentiable with
    respect to the table. An entry counts from ALPHA_MIN and is clamped at ALPHA_MAX; a tile is finished once no pixel
    of it lets more than TRANSMITTANCE_MIN through. Under `jax.vmap` the scenes are blended one after another: on two
    CPU cores that is as fast as letting the tiles of all scenes share the lanes.
    """
    return _blend_fwd(table, lists, corners, config)[0]


def _blend_fwd(table, lists, corners, config):
    forward = lanes.by_platform(functools.partial(_forward, config=config), config.forward_lanes, corners.shape[0])
    blended = jax.custom_batching.sequential_vmap(forward)(_first_order(table), lists, corners)
    return blended, (table, lists, corners, blended)


def _blend_bwd(config, residuals, cotangent):
    table, lists, corners, blended = residuals
    backward = lanes.by_platform(functools.partial(_backward, config=config), config.backward_lanes, corners.shape[0])
    backward = jax.custom_batching.sequential_vmap(backward)
    return backward(table, lists, corners, blended, _first_order(cotangent)), None, None


blend.defvjp(_blend_fwd, _blend_bwd)


@jax.custom_jvp
def _first_order(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """x, with a clear error where somebody differentiates what is made of it."""
    return x


@_first_order.defjvp
def _refuse(primals, tangents):
    raise TypeError("render has first derivatives only: for second ones use avatarjax.splat.reference.render_reference")


class _Forward(typing.NamedTuple):
    work: lanes.Work
    transmittance: Float[Array, "l p"]
    channels: Float[Array, "l c p"]
    out: Float[Array, "t+l c p"]
    out_transmittance: Float[Array, "t+l p"]
    rows: Float[Array, "l+1 s k"]
    alphas: Float[Array, "l+1 s p"]
    mixed: Float[Array, "l+1 c p"]


def _forward(
    table: Float[Array, "n k"],
    lists: TileLists,
    corners: Float[Array, "t 2"],
    *,
    config: SplatConfig,
    n_lanes: int,
) -> Float[Array, "t c p"]:
    n_tiles, drawn = corners.shape[0], _channels(table, config)
    n_channels, steps = drawn.stop - drawn.start, config.forward_steps
    pixels = jnp.asarray(_pixels(config), jnp.float32)
    queue, work = lanes.start(lists, n_lanes)
    corners = jnp.pad(corners, ((0, 1), (0, 0)))
    # Lanes that are not done write behind the image: a scatter to distinct places is cheaper than a select.
    spare = n_tiles + jnp.arange(n_lanes, dtype=jnp.int32)

    def iterate(s: _Forward) -> _Forward:
        chosen, listed = lanes.entries(s.work, queue, lists, steps)
        rows = lanes.in_place(s.rows, columns.take(table, chosen), s.work)
        alphas = lanes.in_place(s.alphas, _alphas(rows[:-1], listed, pixels, corners[s.work.tile]), s.work)
        # Horner's scheme over the entries, back to front: one product less per entry than summing up weights.
        mixed = jnp.zeros_like(s.channels)
        for k in reversed(range(steps)):
            mixed = mixed + alphas[:-1, k, None] * (rows[:-1, k, drawn, None] - mixed)
        mixed = lanes.in_place(s.mixed, mixed, s.work)
        channels = s.channels + s.transmittance[:, None] * mixed[:-1]
        transmittance = s.transmittance
        for k in range(steps):
            transmittance = transmittance * (1 - alphas[:-1, k])
        done, work = lanes.advance(s.work, queue, steps, transmittance)
        place = jnp.where(done, s.work.tile, spare)
        write = {"unique_indices": True, "mode": "promise_in_bounds"}
        return _Forward(
            work=work,
            transmittance=jnp.where(done[:, None], 1.0, transmittance),
            channels=jnp.where(done[:, None, None], 0.0, channels),
            out=s.out.at[place].set(channels, **write),
            out_transmittance=s.out_transmittance.at[place].set(transmittance, **write),
            rows=rows,
            alphas=alphas,
            mixed=mixed,
        )

    n_pixels = pixels.shape[0]
    first = _Forward(
        work=work,
        transmittance=jnp.ones((n_lanes, n_pixels), jnp.float32),
        channels=jnp.zeros((n_lanes, n_channels, n_pixels), jnp.float32),
        out=jnp.zeros((n_tiles + n_lanes, n_channels, n_pixels), jnp.float32),
        out_transmittance=jnp.ones((n_tiles + n_lanes, n_pixels), jnp.float32),
        rows=jnp.zeros((n_lanes + 1, steps, table.shape[1]), jnp.float32),
        alphas=jnp.zeros((n_lanes + 1, steps, n_pixels), jnp.float32),
        mixed=jnp.zeros((n_lanes + 1, n_channels, n_pixels), jnp.float32),
    )
    last = lax.while_loop(lambda s: lanes.busy(s.work, queue), iterate, first)
    return jnp.concatenate([last.out[:n_tiles], last.out_transmittance[:n_tiles, None]], axis=1)


class _Backward(typing.NamedTuple):
    work: lanes.Work
    transmittance: Float[Array, "l p"]
    behind: Float[Array, "l p"]
    gradient: Float[Array, "n k"]
    rows: Float[Array, "l+1 s k"]
    weights: Float[Array, "l+1 c p"]
    alphas: Float[Array, "l+1 s p"]
    visibility: Float[Array, "l+1 s p"]
    contributions: Float[Array, "l+1 s p"]
    d_exponents: Float[Array, "l+1 s p"]


def _backward(
    table: Float[Array, "n k"],
    lists: TileLists,
    corners: Float[Array, "t 2"],
    blended: Float[Array, "t c p"],
    cotangent: Float[Array, "t c p"],
    *,
    config: SplatConfig,
    n_lanes: int,
) -> Float[Array, "n k"]:
    """Gradient of the table. What matters of the channels is their product with the cotangent, one number a pixel."""
    drawn, steps = _channels(table, config), config.backward_steps
    n_channels = drawn.stop - drawn.start
    pixels, monomials = jnp.asarray(_pixels(config), jnp.float32), _monomials(config)
    center = jnp.asarray([config.tile_width / 2, config.tile_height / 2], jnp.float32)
    queue, work = lanes.start(lists, n_lanes)
    # One more tile, for lanes without work.
    corners = jnp.pad(corners, ((0, 1), (0, 0)))
    behind = jnp.pad(jnp.sum(blended * cotangent, axis=1), ((0, 1), (0, 0)))
    weights = jnp.pad(cotangent[:, :n_channels], ((0, 1), (0, 0), (0, 0)))

    def iterate(s: _Backward) -> _Backward:
        chosen, listed = lanes.entries(s.work, queue, lists, steps)
        corner = corners[s.work.tile]
        rows = lanes.in_place(s.rows, columns.take(table, chosen), s.work)
        entry = rows[:-1]
        v = lanes.in_place(s.weights, weights[s.work.tile], s.work)
        alphas = lanes.in_place(s.alphas, _alphas(entry, listed, pixels, corner), s.work)
        alpha = alphas[:-1]
        before, through = _exclusive(jnp.multiply, 1 - alpha, 1.0)
        visibility = lanes.in_place(s.visibility, s.transmittance[:, None] * before * alpha, s.work)
        value = sum(entry[..., CHANNELS + c, None] * v[:-1, None, c] for c in range(n_channels))
        contributions = lanes.in_place(s.contributions, visibility[:-1] * value, s.work)
        contribution = contributions[:-1]
        in_front, total = _exclusive(jnp.add, contribution, 0.0)
        # d alpha / d log2(alpha) is alpha ln 2 (the logarithm is in the monomials), and 0 where alpha is clamped.
        behind_entry = s.behind[:, None] - in_front - contribution
        slope = contribution - behind_entry * (alpha / (1 - alpha))
        d_exponents = lanes.in_place(s.d_exponents, jnp.where(alpha < ALPHA_MAX, slope, 0.0), s.work)
        # Sums over the pixels of a tile are matrix products.
        moments = jnp.dot(d_exponents.reshape((n_lanes + 1) * steps, -1), monomials)
        moments = moments.reshape(n_lanes + 1, steps, 6)[:-1]
        d_channels = jnp.matmul(visibility, v.mT)[:-1]
        d_rows = [*_exponent_gradients(entry, corner + center[None], moments), d_channels]
        d_rows = jnp.concatenate(d_rows, axis=-1).reshape(n_lanes * steps, -1)
        transmittance = s.transmittance * through
        done, work = lanes.advance(s.work, queue, steps, transmittance)
        return _Backward(
            work=work,
            transmittance=jnp.where(done[:, None], 1.0, transmittance),
            behind=jnp.where(done[:, None], behind[work.tile], s.behind - total),
            gradient=s.gradient.at[chosen.reshape(-1), : drawn.stop].add(d_rows, mode="promise_in_bounds"),
            rows=rows,
            weights=v,
            alphas=alphas,
            visibility=visibility,
            contributions=contributions,
            d_exponents=d_exponents,
        )

    n_pixels = pixels.shape[0]
    block = jnp.zeros((n_lanes + 1, steps, n_pixels), jnp.float32)
    first = _Backward(
        work=work,
        transmittance=jnp.ones((n_lanes, n_pixels), jnp.float32),
        behind=behind[work.tile],
        gradient=jnp.zeros_like(table),
        rows=jnp.zeros((n_lanes + 1, steps, table.shape[1]), jnp.float32),
        weights=jnp.zeros((n_lanes + 1, n_channels, n_pixels), jnp.float32),
        alphas=block,
        visibility=block,
        contributions=block,
        d_exponents=block,
    )
    return lax.while_loop(lambda s: lanes.busy(s.work, queue), iterate, first).gradient


def _exclusive(
    combine: typing.Any, x: Float[Array, "l s p"], neutral: float
) -> tuple[Float[Array, "l s p"], Float[Array, "l p"]]:
    """Sum or product along s of all before each element, and of all.

    Each element is combined from the others, masked, in groups of four: more arithmetic than a running sum, but it
    is one vectorised loop, where XLA on CPU stacks running sums element by element.
    """
    n_lanes, steps, n_pixels = x.shape
    group = 4 if steps % 4 == 0 else steps
    x = x.reshape(n_lanes, steps // group, group, n_pixels)
    within, totals = _exclusive_masked(combine, x, neutral)
    if steps == group:
        return within[:, 0], totals[:, 0]
    before, total = _exclusive_masked(combine, totals[:, None], neutral)
    return combine(within, before[:, 0, :, None]).reshape(n_lanes, steps, n_pixels), total[:, 0]


def _exclusive_masked(
    combine: typing.Any, x: Float[Array, "l g s p"], neutral: float
) -> tuple[Float[Array, "l g s p"], Float[Array, "l g p"]]:
    steps = x.shape[2]
    index = np.arange(steps)[None, None, :, None]
    before, total = jnp.full_like(x, neutral), x[:, :, 0]
    for k in range(steps - 1):
        before = combine(before, jnp.where(k < index, x[:, :, k : k + 1], neutral))
        total = combine(total, x[:, :, k + 1])
    return before, total


def _pixels(config: SplatConfig) -> np.ndarray:
    """Pixel centres (p, 2) of a tile, relative to its corner."""
    index = np.arange(config.tile_width * config.tile_height)
    return np.stack([index % config.tile_width, index // config.tile_width], axis=1) + np.float32(0.5)


def _channels(table: Float[Array, "n k"], config: SplatConfig) -> slice:
    """Which columns are drawn."""
    return slice(CHANNELS, table.shape[1] + (EXTENT_X if config.depth else DEPTH))


def _alphas(
    entry: Float[Array, "l s k"], listed: Bool[Array, "l s"], pixels: Float[Array, "p 2"], corner: Float[Array, "l 2"]
) -> Float[Array, "l s p"]:
    column = [entry[..., k, None] for k in range(CHANNELS)]
    dx = pixels[None, None, :, 0] - (column[X] - corner[:, :1, None])
    dy = pixels[None, None, :, 1] - (column[Y] - corner[:, 1:, None])
    # What is not in the list is transparent.
    log2_opacity = jnp.where(listed[..., None], column[LOG2_OPACITY], -1e9)
    alpha = _exp2(log2_opacity + (column[XX] * dx + column[XY] * dy) * dx + column[YY] * dy * dy)
    return jnp.where(alpha >= ALPHA_MIN, jnp.minimum(alpha, ALPHA_MAX), 0.0)


# Minimax polynomial of 2^x on [-1/2, 1/2], relative error 7.5e-8.
_EXP2 = (1.0000000717, 0.6931469670, 0.2402211973, 0.0555071331, 0.0096755412, 0.0013276460)
# Adding 1.5 * 2^23 leaves the nearest integer in the low bits of a float.
_ROUND = np.float32(1.5 * 2**23)


def _exp2(x: Float[Array, "l s p"]) -> Float[Array, "l s p"]:
    """2^x for x up to 1; below -9, where 2^x is less than ALPHA_MIN, 2^-9. Twice as fast as XLA's own on CPU."""
    x = jnp.maximum(x, -9.0)
    bits = lax.bitcast_convert_type(x + _ROUND, jnp.int32)
    fraction = x - (bits - _ROUND.view(np.int32)).astype(jnp.float32)
    power = jnp.full_like(x, _EXP2[-1])
    for c in _EXP2[-2::-1]:
        power = power * fraction + c
    # The integer goes into the exponent of the float.
    exponent = lax.shift_left(bits, jnp.int32(23))
    return lax.bitcast_convert_type(lax.bitcast_convert_type(power, jnp.int32) + exponent, jnp.float32)


def _monomials(config: SplatConfig) -> Float[Array, "p 6"]:
    """1, x, y, x^2, x y, y^2 of the pixel centres relative to the centre of the tile, where they are smallest; times
    ln 2, the slope of 2^x."""
    x, y = _pixels(config).T
    x, y = x - config.tile_width / 2, y - config.tile_height / 2
    return jnp.asarray(math.log(2) * np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1), jnp.float32)


def _exponent_gradients(
    entry: Float[Array, "l s k"], center: Float[Array, "l 2"], moments: Float[Array, "l s 6"]
) -> list[Float[Array, "l s 1"]]:
    """Gradients of centre, conic and log opacity from the moments, about `center`, of the gradient of the exponent."""
    m, mx, my, mxx, mxy, myy = (moments[..., k : k + 1] for k in range(6))
    x, y = (entry[..., k : k + 1] - center[:, k, None, None] for k in (X, Y))
    # Moments about the centre of the Gaussian.
    dx, dy = mx - x * m, my - y * m
    dxx = mxx - 2 * x * mx + x * x * m
    dxy = mxy - x * my - y * mx + x * y * m
    dyy = myy - 2 * y * my + y * y * m
    xx, xy, yy = (entry[..., k : k + 1] for k in (XX, XY, YY))
    return [-2 * xx * dx - xy * dy, -xy * dx - 2 * yy * dy, dxx, dxy, dyy, m]
