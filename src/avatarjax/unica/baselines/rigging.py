"""Automatic rigging: linear blend skinning with weights solved from example poses (the Mixamo row of UNICA Table 2).

Every surface point is a mixture of where the bones would carry it; the mixture that fits the examples best, weights
non-negative with sum 1, is a small quadratic problem on the simplex (Le and Deng 2012 alternate it with fitting the
bones; ours are known). Mixamo itself sees one pose and no examples: this is the best that rigging can do, so whatever
it misses is what bones cannot say.
"""

from __future__ import annotations

import typing
import warnings

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from avatarjax.data import skinning


@typing.no_type_check
@flax.struct.dataclass
class Rigged:
    """A skinned surface: weights (t, j), each row on the simplex, and points (t, 3) in the reference pose, metres."""

    weights: Float[Array, "t j"]
    reference: Float[Array, "t 3"]


def fit(
    reference: Float[Array, "t 3"],
    transforms: Float[Array | np.ndarray, "f j 3 4"],
    points: Float[Array | np.ndarray, "f t 3"],
    *,
    steps: int = 2000,
) -> Rigged:
    """Solve for the weights with which `pose` comes nearest to the example points in the least-squares sense.

    `transforms` carry points from the reference pose to each of f example poses, one a bone (`from_reference`), and
    `points` are where the surface is in them, metres. Projected gradient descent (jaxopt), at most `steps` steps a
    point, all points at once.
    """
    count = transforms.shape[1]

    def gram(rest, moved):
        carried = jnp.einsum("fjab,b->fja", transforms, jnp.append(rest, 1.0))
        apart = (carried - moved[:, None]).swapaxes(0, 1).reshape(count, -1)
        product = apart @ apart.T
        # A point whose bones all fit perfectly has no scale of its own.
        return product / jnp.maximum(jnp.trace(product), 1e-12)

    moved = jnp.swapaxes(jnp.asarray(points), 0, 1)
    grams = jax.lax.map(lambda pair: gram(*pair), (jnp.asarray(reference), moved))
    return Rigged(_on_simplex(grams, steps), jnp.asarray(reference))


def _on_simplex(grams: Float[Array, "t j j"], steps: int) -> Float[Array, "t j"]:
    """The w on the simplex that minimise w^T G w, for Gram matrices of trace 1."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="JAXopt is no longer maintained", category=DeprecationWarning)
        import jaxopt

    # The largest eigenvalue of 2 G is at most twice its trace. No acceleration: two equal steps in a corner of the
    # simplex, where momentum drives it, would end the search there.
    solver = jaxopt.ProjectedGradient(
        lambda w, g: w @ g @ w,
        jaxopt.projection.projection_simplex,
        stepsize=0.5,
        maxiter=steps,
        tol=1e-8,
        acceleration=False,
    )
    start = jnp.full(grams.shape[1], 1 / grams.shape[1])
    return jax.jit(jax.vmap(lambda g: solver.run(start, g=g).params))(grams)


def from_reference(
    reference: Float[Array, "j 3 4"], transforms: Float[Array | np.ndarray, "f j 3 4"]
) -> Float[Array, "f j 3 4"]:
    """Bone transforms from a rest pose as those from the pose `reference`: rotations and translations undone first."""
    turn, shift = reference[..., :3], reference[..., 3]
    back = jnp.swapaxes(turn, -1, -2)
    moved = jnp.asarray(transforms)
    turned = jnp.einsum("fjab,jbc->fjac", moved[..., :3], back)
    return jnp.concatenate([turned, (moved[..., 3] - jnp.einsum("fjab,jb->fja", turned, shift))[..., None]], axis=-1)


@jax.jit
def pose(rigged: Rigged, transforms: Float[Array | np.ndarray, "f j 3 4"]) -> Float[Array, "f t 3"]:
    """Surface points (f, t, 3) in poses given as `fit` takes them, metres."""
    basis = skinning.skinning_basis(rigged.reference, rigged.weights)
    return jax.vmap(skinning.skin, in_axes=(None, 0))(basis, jnp.asarray(transforms))
