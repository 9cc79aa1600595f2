"""Principal components of flattened position maps by randomised SVD (UNICA B.2)."""

from __future__ import annotations

import typing

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key


@typing.no_type_check
@flax.struct.dataclass
class PCA:
    """An orthonormal basis (m, d) in rows, the sample mean (d,), and the standard deviation (m,) along each row."""

    mean: Float[Array, "d"]
    basis: Float[Array, "m d"]
    stddev: Float[Array, "m"]


def fit(samples: Float[Array, "f d"], components: int, key: Key[Array, ""], *, oversampling: int = 16) -> PCA:
    """The leading `components` of f samples (Halko, Martinsson, Tropp 2011, with two power iterations).

    Raises ValueError where fewer samples or dimensions than components are given.
    """
    f, d = samples.shape
    if components > min(f - 1, d):
        raise ValueError(f"{components} components need more than {components} samples and dimensions, got {(f, d)}")
    mean = jnp.mean(samples, axis=0)
    centred = samples - mean[None]
    rank = min(components + oversampling, f, d)
    probe = centred @ jax.random.normal(key, (d, rank), samples.dtype)
    for _ in range(2):
        q, _ = jnp.linalg.qr(probe)
        q, _ = jnp.linalg.qr(centred.T @ q)
        probe = centred @ q
    q, _ = jnp.linalg.qr(probe)
    _, singular, vt = jnp.linalg.svd(q.T @ centred, full_matrices=False)
    return PCA(mean, vt[:components], singular[:components] / jnp.sqrt(f - 1.0))


def project(pca: PCA, sample: Float[Array, "*b d"]) -> Float[Array, "*b m"]:
    """Coefficients of samples (UNICA B.2, Eq. 4)."""
    return (sample - pca.mean.reshape((1,) * (sample.ndim - 1) + (-1,))) @ pca.basis.T


def reconstruct(pca: PCA, coefficients: Float[Array, "*b m"]) -> Float[Array, "*b d"]:
    """Samples from coefficients (UNICA B.2, Eq. 5)."""
    return coefficients @ pca.basis + pca.mean.reshape((1,) * (coefficients.ndim - 1) + (-1,))


def align(pca: PCA, texels: Float[Array, "t 3"]) -> Float[Array, "t 3"]:
    """The nearest texels in the span of the basis: the projection that makes the six views agree again."""
    return reconstruct(pca, project(pca, texels.reshape(-1))).reshape(texels.shape)
