"""The `Gaussians` pytree: what both systems produce and the kernel draws."""

from __future__ import annotations

import typing

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from avatarjax import rotations


@typing.no_type_check
@flax.struct.dataclass
class Gaussians:
    """n anisotropic 3D Gaussians as a struct of arrays, leading batch axes allowed (Kerbl et al. 2023, 3DGS).

    means (n, 3) metres; log_scales (n, 3) natural logarithm of the standard deviations in metres; quats (n, 4) as
    (w, x, y, z), normalised on use; logit_opacities (n,); colors (n, 3) display sRGB in [0, 1]; sh (n, k, 3) optional
    spherical harmonics coefficients of degree 1 and higher, added to `colors` by view direction.
    """

    means: Float[Array, "*b n 3"]
    log_scales: Float[Array, "*b n 3"]
    quats: Float[Array, "*b n 4"]
    logit_opacities: Float[Array, "*b n"]
    colors: Float[Array, "*b n 3"]
    sh: Float[Array, "*b n k 3"] | None = None

    @property
    def scales(self) -> Float[Array, "*b n 3"]:
        """Standard deviations along the principal axes, metres."""
        return jnp.exp(self.log_scales)

    @property
    def opacities(self) -> Float[Array, "*b n"]:
        """Opacities in (0, 1)."""
        return jax.nn.sigmoid(self.logit_opacities)

    def __len__(self) -> int:
        return self.means.shape[-2]


def transform(
    gaussians: Gaussians,
    scale: Float[Array, ""] | float,
    rotation: Float[Array, "3 3"],
    translation: Float[Array, " 3"],
) -> Gaussians:
    """The cloud under x -> scale * rotation @ x + translation: means, orientations and sizes move together.

    View-dependent `sh` coefficients stay in the old frame: rotate them, or use a cloud without them.
    """
    quats = rotations.multiply(
        jnp.broadcast_to(rotations.from_matrix(rotation), gaussians.quats.shape), gaussians.quats
    )
    return gaussians.replace(
        means=scale * gaussians.means @ rotation.T + translation[None],
        quats=quats,
        log_scales=gaussians.log_scales + jnp.log(scale),
    )
