"""What a trained avatar is, and how it wears its Gaussians: from a posed surface to a cloud in the world."""

from __future__ import annotations

import typing

import flax.struct
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from avatarjax import posmap
from avatarjax.gaussians import Gaussians
from avatarjax.nets.functional import Params
from avatarjax.posmap import Atlas, Box, Tangents, Upscaler
from avatarjax.posmap import pca as pcs
from avatarjax.unica import align, appearance, texel_head
from avatarjax.unica.baselines.feed_forward import FeedForwardDynamics
from avatarjax.unica.coefficients import CoefficientDynamics
from avatarjax.unica.config import UnicaConfig
from avatarjax.unica.latent import LatentDynamics


@typing.no_type_check
@flax.struct.dataclass
class Avatar:
    """Everything that a trained avatar is.

    `standing` (t, 3) are the texels of the standing pose in metres with the root above the world's origin. `dynamics`
    is either of the two models and `appearance` the parameters of either of the two networks; `config`, static, says
    which; `dynamics` may also be the baseline that takes the UNet's place. `pca` is the basis of normalised fourth maps
    that aligns the six views of the UNet's maps; maps of the coefficient model are aligned as they come, and it is
    None.
    """

    atlas: Atlas
    upscaler: Upscaler
    tangents: Tangents
    pca: pcs.PCA | None
    base: appearance.BaseAttributes
    appearance: Params
    dynamics: CoefficientDynamics | LatentDynamics | FeedForwardDynamics
    standing: Float[Array, "t 3"]
    config: UnicaConfig = flax.struct.field(pytree_node=False)


def wear(avatar: Avatar, texels: Float[Array, "t 3"]) -> Gaussians:
    """World Gaussians of a posed surface from its texels (t, 3) in the world, metres."""
    if avatar.config.appearance_model == "texels":
        return texel_head.wear(
            avatar.config.texel_head,
            avatar.appearance,
            avatar.base,
            avatar.upscaler,
            avatar.tangents,
            avatar.standing,
            texels,
            posmap.root(avatar.atlas, texels),
        )
    return wear_base(avatar, texels, refined=True)


def wear_base(avatar: Avatar, texels: Float[Array, "t 3"], *, refined: bool = False) -> Gaussians:
    """The same from base attributes alone or, `refined`, with the point transformer: in the box of the pose, and from
    there into the world (UNICA 3.5, 3.7)."""
    points = posmap.upscale(avatar.upscaler, texels)
    box = posmap.bounding_box(points)
    base = avatar.base
    if refined and avatar.config.appearance.turn:
        base = appearance.turned_base(base, avatar.tangents, avatar.standing, texels)
    cloud = appearance.coarse_gaussians(base, posmap.into_box(box, points), box.side)
    if refined:
        cloud = appearance.refine(avatar.config.appearance, avatar.appearance, cloud)
    return align.place(cloud, points)


def overflow(avatar: Avatar, texels: Float[Array, "t 3"]) -> Int[Array, ""]:
    """How many voxels of a posed surface the point transformer has no room for; 0 with the texel head."""
    if avatar.config.appearance_model == "texels":
        return jnp.asarray(0)
    points = posmap.upscale(avatar.upscaler, texels)
    return appearance.overflow(avatar.config.appearance, posmap.into_box(posmap.bounding_box(points), points))


def in_box(gaussians: Gaussians, box: Box) -> Gaussians:
    """World Gaussians in the units of a box, in which poses are pictured."""
    return gaussians.replace(
        means=posmap.into_box(box, gaussians.means), log_scales=gaussians.log_scales - jnp.log(box.side)
    )
