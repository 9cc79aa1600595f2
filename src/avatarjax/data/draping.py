"""Posing a whole avatar: linear blend skinning with lagged bones, and a skirt that stays outside both legs."""

from __future__ import annotations

import functools
import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from avatarjax.data import skinning
from avatarjax.data.garments import Drape

# Metres: how far past the middle the leading leg takes the cloth, the width of the change from one leg to the other and
# what is added to it where no leg leads, and the lead at which it takes over.
_SHARE_SHIFT, _SHARE_WIDTH, _SHARE_SPREAD, _SHARE_REACH = 0.07, 0.03, 0.06, 0.08


@typing.no_type_check
@flax.struct.dataclass
class PosingBasis:
    """Constants of posing one avatar: whole (8 j, v), left and right (8 j, s) skinning bases over bones and lagged
    bones; outward (s, 3) and side (s,) of the skirt, whose vertices are the last s; s may be 0."""

    whole: Float[Array, "k v"]
    left: Float[Array, "k s"]
    right: Float[Array, "k s"]
    outward: Float[Array, "s 3"]
    side: Float[Array, " s"]


def lagging_basis(
    vertices: Float[np.ndarray, "v 3"], weights: Float[np.ndarray, "v j"], lag: Float[np.ndarray, " v"]
) -> Float[Array, "k v"]:
    """A skinning basis (8 j, v) over the bones followed by the lagged bones."""
    share = lag[:, None]
    both = np.concatenate([weights * (1 - share), weights * share], axis=1)
    return skinning.skinning_basis(jnp.asarray(vertices), jnp.asarray(both))


def drape(
    left: Float[Array, "s 3"], right: Float[Array, "s 3"], outward: Float[Array, "s 3"], side: Float[Array, " s"]
) -> Float[Array, "s 3"]:
    """Blend the two copies (s, 3) of a skirt, each of which follows one leg, so that cloth lies outside both legs.

    In front of (behind, beside) a leg the cloth follows that leg; between the legs it follows the one that is further
    out along `outward`.
    """
    ahead = jnp.sum(outward * (left - right), axis=-1)
    lead = jnp.tanh(ahead / _SHARE_REACH)
    # Side by side the legs share the cloth between them; the further one leads, the sharper it takes over.
    width = _SHARE_WIDTH + _SHARE_SPREAD * (1 - lead * lead)
    share = jax.nn.sigmoid((side + _SHARE_SHIFT * lead) / width)[:, None]
    return left * share + right * (1 - share)


def pose(basis: PosingBasis, transforms: Float[Array, "j 3 4"], lagged: Float[Array, "j 3 4"]) -> Float[Array, "v 3"]:
    """Posed vertices (v, 3) of one frame from its bone transforms and their lagged copies. The hips are bone 0."""
    both = jnp.concatenate([transforms, lagged])
    vertices = skinning.skin(basis.whole, both)
    count = basis.side.shape[0]
    if count == 0:
        return vertices
    outward = basis.outward @ transforms[0, :, :3].T
    cloth = drape(skinning.skin(basis.left, both), skinning.skin(basis.right, both), outward, basis.side)
    return jnp.concatenate([vertices[:-count], cloth])


@functools.partial(jax.jit)
def pose_frames(
    basis: PosingBasis, transforms: Float[Array, "f j 3 4"], lagged: Float[Array, "f j 3 4"]
) -> Float[Array, "f v 3"]:
    """`pose` of f frames at once."""
    return jax.vmap(pose, in_axes=(None, 0, 0))(basis, transforms, lagged)


def posing_basis(
    vertices: Float[np.ndarray, "v 3"],
    weights: Float[np.ndarray, "v j"],
    lag: Float[np.ndarray, " v"],
    skirt: Drape | None,
) -> PosingBasis:
    """The constants of `pose`; a skirt's vertices must be the last of the mesh."""
    whole = lagging_basis(vertices, weights, lag)
    if skirt is None:
        none = jnp.zeros((whole.shape[0], 0))
        return PosingBasis(whole, none, none, jnp.zeros((0, 3)), jnp.zeros(0))
    own = slice(len(vertices) - len(skirt.side), None)
    left, right = (lagging_basis(vertices[own], side, lag[own]) for side in (skirt.left, skirt.right))
    return PosingBasis(whole, left, right, jnp.asarray(skirt.outward), jnp.asarray(skirt.side))
