"""The slow, obvious renderer that the fast one is compared with: every Gaussian against every pixel, in any dtype."""

from __future__ import annotations

import typing

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from avatarjax import rotations
from avatarjax.cameras import Camera
from avatarjax.gaussians import Gaussians
from avatarjax.splat.config import ALPHA_MAX, ALPHA_MIN, SplatConfig
from avatarjax.splat.sh import view_colors


class ReferenceOutput(typing.NamedTuple):
    """image (h, w, c), alpha (h, w), depth (h, w) metres, as in `RenderOutput`."""

    image: Float[Array, "h w c"]
    alpha: Float[Array, "h w"]
    depth: Float[Array, "h w"]


def render_reference(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: ArrayLike = 0.0,
    features: Float[Array, "n d"] | None = None,
    config: SplatConfig = SplatConfig(),
) -> ReferenceOutput:
    """What `render` computes, in the dtype of its input and with memory for n times h times w numbers.

    Give it float64 inside `jax.enable_x64` for an oracle. It never stops early and knows no capacity; all Gaussians
    must be finite.
    """
    if features is None:
        features = view_colors(gaussians, camera)
    centers, inverse_covariances, depths, opacities = _project(gaussians, camera, config)
    in_front = depths > config.near
    order = jnp.argsort(jnp.where(in_front, depths, jnp.inf))
    x, y = jnp.meshgrid(jnp.arange(camera.width) + 0.5, jnp.arange(camera.height) + 0.5)
    pixels = jnp.stack([x, y], axis=-1).astype(centers.dtype)
    offsets = pixels[None] - centers[:, None, None]
    exponents = -0.5 * jnp.einsum("nhwi,nij,nhwj->nhw", offsets, inverse_covariances, offsets)
    alphas = jnp.minimum(opacities[:, None, None] * jnp.exp(exponents), ALPHA_MAX)
    alphas = jnp.where((alphas >= ALPHA_MIN) & in_front[:, None, None], alphas, 0)[order]
    behind = jnp.cumprod(1 - alphas, axis=0)
    before = jnp.concatenate([jnp.ones_like(behind[:1]), behind[:-1]])
    weights = alphas * before
    alpha = 1 - behind[-1]
    background = jnp.broadcast_to(jnp.asarray(background, centers.dtype), features.shape[1:])
    image = jnp.einsum("nhw,nc->hwc", weights, features[order])
    image = image + behind[-1][..., None] * background[None, None]
    depth = jnp.einsum("nhw,n->hw", weights, depths[order])
    return ReferenceOutput(image, alpha, jnp.where(alpha > 0, depth / jnp.where(alpha > 0, alpha, 1), 0))


def _project(
    gaussians: Gaussians, camera: Camera, config: SplatConfig
) -> tuple[Float[Array, "n 2"], Float[Array, "n 2 2"], Float[Array, " n"], Float[Array, " n"]]:
    """Centres in pixels, inverse 2D covariances, depths and opacities; those behind the camera are without meaning."""
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    focal = jnp.diagonal(camera.intrinsics)[:2]
    principal = camera.intrinsics[:2, 2]
    points = gaussians.means @ rotation.T + translation[None]
    depths = points[:, 2]
    z = jnp.where(depths > config.near, depths, 1)[:, None]
    slopes = points[:, :2] / z
    # The linearisation point stays within 1.3 times the field of view.
    size = jnp.asarray([camera.width, camera.height], points.dtype)
    margin = 0.15 * size / focal
    bounded = jnp.clip(slopes, (-principal / focal - margin)[None], ((size - principal) / focal + margin)[None])
    jacobian = jnp.concatenate([jax.vmap(jnp.diag)(focal[None] / z), (-focal[None] * bounded / z)[..., None]], axis=-1)
    axes = rotations.to_matrix(gaussians.quats) * gaussians.scales[:, None, :]
    on_image = jnp.einsum("nij,jk,nkl->nil", jacobian, rotation, axes)
    sharp = on_image @ on_image.mT
    blurred = sharp + config.eps2d * jnp.eye(2, dtype=points.dtype)[None]
    opacities = gaussians.opacities
    if config.antialiased:
        opacities = opacities * jnp.sqrt(jnp.maximum(jnp.linalg.det(sharp) / jnp.linalg.det(blurred), 1e-12))
    return focal[None] * slopes + principal[None], jnp.linalg.inv(blurred), depths, opacities
