"""Confidence-aware feature fusion: colours by what some frames show of the side that a camera looks at. An option.

SMAD's introduction names it and Table F has its symbols (rows 27 to 32), but no section says how they go together: this
is a reading of them. The features f_k of a Gaussian are the colours of the pixels that show it in K frames, the views.
A view counts by its confidence, which falls with the angle between the direction d_0 of the camera that looks now and
its own d_k, both from the body and in its frame, and by attention:

    omega_k = exp(-(1 - d_0 . d_k) / (2 rho))
    alpha_k = softmax_k(q . k_k / sqrt(d) + log omega_k)         over the views that see the Gaussian
    colour  = sum_k alpha_k v_k

with a query q of the Gaussian's colour and d_0, keys k_k of f_k and d_k, and values v_k of f_k, all linear. The colour
that the Gaussian has without stands beside the views with a learned logit, so that what none shows keeps it.
"""

from __future__ import annotations

import dataclasses
import typing

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key, UInt8

from avatarjax.cameras import Camera
from avatarjax.gaussians import Gaussians
from avatarjax.nets.functional import Params
from avatarjax.smad import hull
from avatarjax.train import StageConfig


@dataclasses.dataclass(frozen=True)
class FusionConfig:
    """So many `views` are kept (0: colours are learned without), the confidence falls off with rho, queries and keys
    have `width` numbers. `confidence` and `attention` may be left out. All numbers are ours."""

    views: int = 24
    rho: float = 0.05
    width: int = 8
    confidence: bool = True
    attention: bool = True
    stage: StageConfig = StageConfig(1_500, 2, 5e-3)

    def __post_init__(self):
        if self.rho <= 0 or self.views < 0 or self.width < 1:
            raise ValueError(f"rho {self.rho} and width {self.width} must be positive, views {self.views} not negative")


@typing.no_type_check
@flax.struct.dataclass
class Views:
    """What k frames show of n Gaussians: colours (k, n, 3) in [0, 1], whether they are seen (k, n), and unit vectors
    (k, 3) from the body to the cameras, in the body frame."""

    features: Float[Array, "k n 3"]
    seen: Bool[Array, "k n"]
    directions: Float[Array, "k 3"]


def gather(
    means: Float[Array, "k n 3"], edge: Float[Array, ""], rgba: UInt8[Array, "k h w 4"], cameras: Camera
) -> Views:
    """The views of frames: where Gaussians are in the body frame of each, their typical distance to their neighbours,
    pictures over black with alpha, and cameras (k,) of the body frame."""

    def one(frame):
        points, picture, camera = frame
        row, column, visible = hull.visible_at(points, edge, picture[..., 3] > 127, camera)
        rgba = picture[row, column].astype(jnp.float32) / 255
        return rgba[:, :3] / jnp.maximum(rgba[:, 3:], 0.5), visible, direction(camera)

    return Views(*jax.lax.map(one, (means, rgba, cameras)))


def direction(camera: Camera) -> Float[Array, "3"]:
    """The unit vector from the body to a camera of the body frame."""
    return camera.position / jnp.linalg.norm(camera.position)


def init(config: FusionConfig, key: Key[Array, ""]) -> Params:
    """Fresh parameters: views are taken as they are, with hardly any attention."""
    query, keys = (0.1 * jax.random.normal(k, (6, config.width)) for k in jax.random.split(key))
    return {"query": query, "key": keys, "value": jnp.eye(3), "own": jnp.zeros(())}


def fuse(
    config: FusionConfig, params: Params, views: Views, gaussians: Gaussians, towards: Float[Array, "3"]
) -> Gaussians:
    """The Gaussians as they look from a camera in the direction `towards`, a unit vector in the body frame."""
    own = gaussians.colors
    logits = jnp.zeros(views.seen.shape)
    if config.attention:
        query = _beside(own, towards) @ params["query"]
        keys = jax.vmap(_beside)(views.features, views.directions) @ params["key"]
        logits = logits + jnp.sum(query[None] * keys, axis=-1) / jnp.sqrt(1.0 * config.width)
    if config.confidence:
        logits = logits - (1 - views.directions @ towards)[:, None] / (2 * config.rho)
    logits = jnp.where(views.seen, logits, -1e9)
    alpha = jax.nn.softmax(jnp.concatenate([jnp.broadcast_to(params["own"], (1, len(own))), logits]), axis=0)
    values = jnp.concatenate([own[None], views.features @ params["value"]])
    return gaussians.replace(colors=jnp.clip(jnp.sum(alpha[..., None] * values, axis=0), 0.0, 1.0))


def _beside(colors: Float[Array, "n 3"], towards: Float[Array, "3"]) -> Float[Array, "n 6"]:
    return jnp.concatenate([colors, jnp.broadcast_to(towards, colors.shape)], axis=1)
