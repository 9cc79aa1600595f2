"""The fast appearance (ours): base attributes that turn with the surface, corrected by a small network on the map.

A texel of the position map and its eight neighbours know how the surface stands there: its local frame turns the base
Gaussians (UNICA's limitation 2 names fragments in turns as what comes of not doing so), and a network of two 3x3
convolutions over the foreground texels, with a learned code for each texel, says how shade, size and place differ from
the standing pose. Corrections are bilinearly upscaled with the points. No sorting, no attention, static shapes: a
thousandth of the point transformer's arithmetic. Everything is in metres, so no box and no Procrustes fit are needed.
"""

from __future__ import annotations

import dataclasses
import itertools

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Int, Key

from avatarjax import posmap
from avatarjax.gaussians import Gaussians
from avatarjax.nets import functional
from avatarjax.nets.functional import Params
from avatarjax.posmap import Tangents, Upscaler
from avatarjax.unica import appearance
from avatarjax.unica.appearance import BaseAttributes

# What the network corrects: places along the texel's own axes, colours, log-scales and opacities.
OUTPUTS = {"offset": 3, "colors": 3, "log_scales": 3, "logit_opacities": 1}
_GEOMETRY = 8  # the normal, the place relative to the root, and how far the surface is stretched in two directions


@dataclasses.dataclass(frozen=True)
class TexelHeadConfig:
    """Sizes. `turn` switches the turning with the surface; `offset_bound` is in metres."""

    code: int = 12
    width: int = 32
    layers: int = 2
    offset_bound: float = 0.03
    turn: bool = True


class TexelHead(nnx.Module):
    """Layers over 3x3 neighbourhoods of texels; the last one starts at zero: an untrained head changes nothing."""

    def __init__(self, config: TexelHeadConfig, *, rngs: nnx.Rngs):
        widths = [_GEOMETRY + config.code] + [config.width] * config.layers
        self.layers = nnx.List(
            [nnx.Linear(9 * inputs, width, rngs=rngs) for inputs, width in itertools.pairwise(widths)]
        )
        self.leave = nnx.Linear(widths[-1], sum(OUTPUTS.values()), kernel_init=nnx.initializers.zeros, rngs=rngs)

    def __call__(self, features: Float[Array, "t f"], neighbours: Int[Array, "t 9"]) -> Float[Array, "t 10"]:
        x = features
        for layer in self.layers:
            kernel = layer.kernel[...].reshape(9, x.shape[1], -1)
            x = jax.nn.silu(posmap.convolve(neighbours, x, kernel) + jnp.asarray(layer.bias)[None])
        return self.leave(x)


def init(config: TexelHeadConfig, texels: int, key: Key[Array, ""]) -> Params:
    """Fresh parameters: the network's, and a code for each of so many texels."""
    network_key, code_key = jax.random.split(key)
    code = 0.1 * jax.random.normal(code_key, (texels, config.code))
    return {"network": functional.init(TexelHead, config, network_key), "code": code}


def wear(
    config: TexelHeadConfig,
    params: Params,
    base: BaseAttributes,
    upscaler: Upscaler,
    tangents: Tangents,
    standing: Float[Array, "t 3"],
    texels: Float[Array, "t 3"],
    root: Float[Array, "3"],
) -> Gaussians:
    """World Gaussians of a posed surface, from its texels, its root and the texels of the standing pose, all in metres.

    `base` are the attributes that were fitted to the standing pose, in the units of its box.
    """
    before, after = posmap.frames(tangents, standing), posmap.frames(tangents, texels)
    stretch = jnp.log(after.lengths / before.lengths) * (before.known * after.known)[:, None]
    place = texels - root[None]
    features = jnp.concatenate([after.axes[:, :, 2], place, jnp.clip(stretch, -2, 2), params["code"]], axis=-1)
    delta = functional.bind(TexelHead, config, params["network"])(features, upscaler.neighbours)
    offset = config.offset_bound * jnp.tanh(delta[:, :3])
    moved = place + jnp.einsum("tij,tj->ti", after.axes, offset)
    fine = posmap.upscale(upscaler, jnp.concatenate([moved, delta[:, 3:]], axis=-1))
    quats = base.quats
    if config.turn:
        quats = appearance.turned(quats, before, after)
    return Gaussians(
        means=fine[:, :3] + root[None],
        colors=base.colors + fine[:, 3:6],
        log_scales=base.log_scales + jnp.log(base.height) + fine[:, 6:9],
        logit_opacities=base.logit_opacities + fine[:, 9],
        quats=quats,
    )
