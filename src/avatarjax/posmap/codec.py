"""Position maps as gathers: posed vertices to texels to maps and back, and the group normalisation of UNICA Eq. 3.

Computations run on the t foreground texels (t, 3); a map (h, w, 3) is their picture. Every function works under vmap.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from avatarjax.posmap.atlas import Atlas


def encode(atlas: Atlas, vertices: Float[Array, "v 3"]) -> Float[Array, "t 3"]:
    """Positions of the texels' surface points on a posed mesh, in the unit of `vertices` (UNICA Eq. 2)."""
    return jnp.einsum("tk,tkc->tc", atlas.barycentric, vertices[atlas.corners])


def to_map(atlas: Atlas, texels: Float[Array, "t d"], background: float = 0.0) -> Float[Array, "h w d"]:
    """The picture of per-texel values: a map with `background` wherever no texel is."""
    empty = jnp.full((atlas.size, atlas.size, texels.shape[-1]), background, texels.dtype)
    return empty.at[atlas.rows, atlas.cols].set(texels, unique_indices=True)


def from_map(atlas: Atlas, posmap: Float[Array, "h w d"]) -> Float[Array, "t d"]:
    """The foreground values of a map; whatever stands in its background is ignored."""
    return posmap[atlas.rows, atlas.cols]


def root(atlas: Atlas, texels: Float[Array, "t 3"]) -> Float[Array, "3"]:
    """Centre of the waist, in the unit and frame of `texels` (UNICA 3.3)."""
    return atlas.waist @ texels


def heading(atlas: Atlas, texels: Float[Array, "t 3"]) -> Float[Array, ""]:
    """Yaw (radians, 0 faces +z, pi/2 faces +x) that best turns the A-pose waist onto the posed one.

    The closed-form two-dimensional Procrustes angle of the waist texels about the vertical axis: no skeleton is needed.
    """
    reference = atlas.reference - root(atlas, atlas.reference)[None]
    posed = texels - root(atlas, texels)[None]
    cross = reference[:, 2] * posed[:, 0] - reference[:, 0] * posed[:, 2]
    dot = reference[:, 2] * posed[:, 2] + reference[:, 0] * posed[:, 0]
    return jnp.arctan2(atlas.waist @ cross, atlas.waist @ dot)


def normalize(
    atlas: Atlas, texels: Float[Array, "*frames t 3"], origin: Float[Array, "3"]
) -> Float[Array, "*frames t 3"]:
    """World texels in metres to normalised space: s (v - origin) + 0.5 (UNICA Eq. 3 with T = s origin).

    `origin` is the root of frame t, the same for all frames of a group.
    """
    return atlas.scale * (texels - _per_texel(origin, texels)) + 0.5


def denormalize(
    atlas: Atlas, texels: Float[Array, "*frames t 3"], origin: Float[Array, "3"]
) -> Float[Array, "*frames t 3"]:
    """The inverse of `normalize`: normalised texels to world metres."""
    return (texels - 0.5) / atlas.scale + _per_texel(origin, texels)


def _per_texel(origin: Float[Array, "3"], texels: Float[Array, "*frames t 3"]) -> Float[Array, "*ones 3"]:
    return origin.reshape((1,) * (texels.ndim - 1) + (3,))


def normalize_group(
    atlas: Atlas, group: Float[Array, "frames t 3"], centre: int = 2
) -> tuple[Float[Array, "frames t 3"], Float[Array, "3"]]:
    """A group of consecutive world frames in the space of its frame `centre`, and that frame's root in metres."""
    origin = root(atlas, group[centre])
    return normalize(atlas, group, origin), origin
