"""Vector quantisation: a codebook, its nearest entries, the loss that teaches both sides (van den Oord et al. 2017).

Nothing is kept beside the codebook: it learns by a loss, not by running averages.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def nearest(codebook: Float[Array, "k l"], vectors: Float[Array, "*b l"]) -> Int[Array, "*b"]:
    """Numbers of the entries that are nearest to vectors; of equally near ones the first."""
    flat = vectors.reshape(-1, vectors.shape[-1])
    # The square of a vector is the same for every entry.
    distance = jnp.sum(codebook**2, axis=-1)[None] - 2 * flat @ codebook.T
    return jnp.argmin(distance, axis=-1).reshape(vectors.shape[:-1])


def straight_through(vectors: Float[Array, "*b l"], entries: Float[Array, "*b l"]) -> Float[Array, "*b l"]:
    """The entries, whose gradient goes to the vectors as if they had not been replaced."""
    return vectors + jax.lax.stop_gradient(entries - vectors)


def codebook_loss(vectors: Float[Array, "*b l"], entries: Float[Array, "*b l"], commitment: float) -> Float[Array, ""]:
    """Mean square distance: it draws entries to their vectors and, `commitment` times as much, vectors to entries."""
    drawn = jnp.mean((jax.lax.stop_gradient(vectors) - entries) ** 2)
    return drawn + commitment * jnp.mean((vectors - jax.lax.stop_gradient(entries)) ** 2)


def perplexity(codes: Int[Array, "*b"], count: int) -> Float[Array, ""]:
    """How many of `count` entries are in use: the exponential of the entropy, from 1 to `count`."""
    share = jnp.bincount(codes.ravel(), length=count) / codes.size
    return jnp.exp(-jnp.sum(jax.scipy.special.xlogy(share, share)))
