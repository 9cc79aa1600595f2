"""Appearance: a base attribute map and a point transformer turn points into 3D Gaussians (UNICA 3.5, B.1).

Everything here happens in the box [-0.5, 0.5]^3 of one frame; `align` brings it into the world.
"""

from __future__ import annotations

import dataclasses
import typing

import flax.struct
import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Int, Key

from avatarjax import posmap, rotations
from avatarjax.gaussians import Gaussians
from avatarjax.nets import point_transformer
from avatarjax.nets.functional import Params, bind
from avatarjax.nets.point_transformer import PointTransformer, PointTransformerConfig

ATTRIBUTES = {"means": 3, "colors": 3, "log_scales": 3, "quats": 4, "logit_opacities": 1}


@typing.no_type_check
@flax.struct.dataclass
class BaseAttributes:
    """What one Gaussian a fine texel looks like in the standing pose: the base attribute map A_base.

    log_scales (n, 3) in box units, quats (n, 4), logit_opacities (n,), colors (n, 3), and the side () of the standing
    pose's box in metres, H_s.
    """

    log_scales: Float[Array, "n 3"]
    quats: Float[Array, "n 4"]
    logit_opacities: Float[Array, "n"]
    colors: Float[Array, "n 3"]
    height: Float[Array, ""]


@dataclasses.dataclass(frozen=True)
class AppearanceConfig:
    """The point transformer's sizes and its heads'; defaults are the paper's.

    `offset_bound` bounds the correction of the means, in box units (the paper's tanh: 1). `turn` turns the coarse
    Gaussians with the surface, as UNICA E proposes for its failures in turns.
    """

    transformer: PointTransformerConfig = PointTransformerConfig()
    head_width: int = 128
    head_layers: int = 4
    offset_bound: float = 1.0
    turn: bool = False  # ours: on


class AppearanceNetwork(nnx.Module):
    """Per-attribute offsets from coarse Gaussians: a point transformer and one MLP head an attribute.

    The last layer of each head starts at zero, so an untrained network changes nothing.
    """

    def __init__(self, config: AppearanceConfig, *, rngs: nnx.Rngs):
        self.transformer = PointTransformer(config.transformer, rngs=rngs)
        width = config.transformer.decoder_channels[0] + sum(ATTRIBUTES.values())
        self.heads = nnx.Dict({name: self._head(width, size, config, rngs) for name, size in ATTRIBUTES.items()})

    @staticmethod
    def _head(width: int, outputs: int, config: AppearanceConfig, rngs: nnx.Rngs) -> nnx.Module:
        layers = []
        for _ in range(config.head_layers - 1):
            layers += [nnx.Linear(width, config.head_width, rngs=rngs), jax.nn.gelu]
            width = config.head_width
        layers.append(nnx.Linear(width, outputs, kernel_init=nnx.initializers.zeros, rngs=rngs))
        return nnx.Sequential(*layers)

    def __call__(
        self, points: Float[Array, "n 3"], attributes: Float[Array, "n 14"], key: Key[Array, ""] | None = None
    ) -> dict[str, Float[Array, "n _"]]:
        features = jnp.concatenate([self.transformer(points, attributes, key), attributes], axis=-1)
        return {name: head(features) for name, head in self.heads.items()}


def initial_base(points: Float[Array, "n 3"], height: Float[Array, ""]) -> BaseAttributes:
    """Base attributes before training: grey, round, half opaque, as large as the distance to near neighbours.

    `points` (n, 3) are the standing pose in box units. The 3DGS rule (mean distance to the three nearest) is taken over
    the 16 nearest points along the map's rows, which needs no search structure.
    """
    n = points.shape[0]
    near = jnp.stack([jnp.sum((points - jnp.roll(points, shift, axis=0)) ** 2, -1) for shift in (-2, -1, 1, 2)], -1)
    spacing = jnp.sqrt(jnp.sort(near, axis=-1)[:, 1])
    spacing = jnp.clip(spacing, 0.5 * jnp.median(spacing), 2.0 * jnp.median(spacing))
    return BaseAttributes(
        log_scales=jnp.repeat(jnp.log(spacing)[:, None], 3, axis=1),
        quats=jnp.zeros((n, 4)).at[:, 0].set(1.0),
        logit_opacities=jnp.full((n,), 1.0),
        colors=jnp.full((n, 3), 0.5),
        height=height,
    )


def coarse_gaussians(base: BaseAttributes, points: Float[Array, "n 3"], height: Float[Array, ""]) -> Gaussians:
    """Base attributes on the points of a posed frame in box units; sizes grow by H_s / H_p (UNICA B.1).

    `height` is the side of this frame's box in metres, H_p.
    """
    return Gaussians(
        means=points,
        log_scales=base.log_scales + jnp.log(base.height / height),
        quats=base.quats,
        logit_opacities=base.logit_opacities,
        colors=base.colors,
    )


def turned(quats: Float[Array, "n 4"], before: posmap.Frames, after: posmap.Frames) -> Float[Array, "n 4"]:
    """Orientations of the upscaled points, turned as the surface at their texel has from one pose to another."""
    turns = posmap.turns(before, after, jnp.asarray([1.0, 0.0, 0.0, 0.0]))
    return rotations.multiply(jnp.repeat(turns, len(quats) // len(turns), axis=0), quats)


def turned_base(
    base: BaseAttributes, tangents: posmap.Tangents, standing: Float[Array, "t 3"], texels: Float[Array, "t 3"]
) -> BaseAttributes:
    """Base attributes turned as the surface has from the standing pose's texels to these, both in one unit."""
    before, after = (posmap.frames(tangents, t) for t in (standing, texels))
    return base.replace(quats=turned(base.quats, before, after))


def refine(config: AppearanceConfig, params: Params, coarse: Gaussians, key: Key[Array, ""] | None = None) -> Gaussians:
    """G_refined = G_coarse + delta G (UNICA Eq. 6), in box units; a key shuffles the curves, for training."""
    stacked = jnp.concatenate(
        [
            coarse.means,
            coarse.colors,
            # Brings the logarithms of texel-sized scales near zero, where the other attributes are.
            coarse.log_scales + 4.0,
            coarse.quats,
            coarse.logit_opacities[:, None],
        ],
        axis=-1,
    )
    delta = bind(AppearanceNetwork, config, params)(coarse.means + 0.5, stacked, key)
    return coarse.replace(
        means=coarse.means + config.offset_bound * jnp.tanh(delta["means"]),
        colors=coarse.colors + delta["colors"],
        log_scales=coarse.log_scales + delta["log_scales"],
        quats=coarse.quats + delta["quats"],
        logit_opacities=coarse.logit_opacities + delta["logit_opacities"][:, 0],
    )


def overflow(config: AppearanceConfig, points: Float[Array, "n 3"]) -> Int[Array, ""]:
    """How many voxels of points in box units find no room in the point transformer: 0, or its `fill` is too small."""
    return point_transformer.overflow(config.transformer, points + 0.5)
