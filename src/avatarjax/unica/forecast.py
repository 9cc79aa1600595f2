"""Rollouts from the middle of a recording: three true frames, then the recording's keys and nothing else of it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from avatarjax import posmap
from avatarjax.data.sequences import Recording
from avatarjax.posmap import Atlas
from avatarjax.posmap import pca as pcs
from avatarjax.unica import coefficients
from avatarjax.unica.avatar import Avatar
from avatarjax.unica.coefficients import CoefficientDynamics
from avatarjax.unica.rollout import Frame, State, rollout


def state_at(
    avatar: Avatar,
    texels: Float[Array | np.ndarray, "3 t 3"],
    roots: Float[Array | np.ndarray, "3 3"],
    key: Key[Array, ""],
) -> State:
    """The state after three known frames, oldest first: root-relative texels and roots in the world, metres."""
    texels, roots = jnp.asarray(texels), jnp.asarray(roots)
    if isinstance(avatar.dynamics, CoefficientDynamics):
        flat, ground = jax.vmap(lambda x: coefficients.canonical(avatar.atlas, x))(texels + roots[:, None])
        # Headings are compared across the three frames: no jump by a full turn between them.
        ground = ground.at[:, 2].set(jnp.unwrap(ground[:, 2]))
        ground = ground.at[:, :2].add(-ground[2:, :2])
        context = coefficients.Context(pose=pcs.project(avatar.dynamics.basis, flat), root=ground)
    else:
        context = posmap.normalize(avatar.atlas, texels + roots[:, None], roots[2])
    return State(context, roots[2], key)


def forecast(
    avatar: Avatar, recording: Recording, first: Int[np.ndarray, " s"], frames: int, key: Key[Array, ""]
) -> tuple[Float[np.ndarray, "s f t 3"], Float[np.ndarray, "s f 3"]]:
    """For each of s places in a recording, the next `frames` frames as the avatar makes them under the recorded keys.

    The three frames from `first` on are given; the result are root-relative texels (s, f, t, 3) and roots (s, f, 3) of
    those that follow, metres. Raises ValueError where a sequence ends earlier.
    """
    last = first + 2 + frames
    if last.max() >= len(recording.actions) or (recording.sequence[first] != recording.sequence[last]).any():
        raise ValueError(f"from frame {first.max()} there are no {frames + 3} frames of one sequence: ask for fewer")
    context = first[:, None] + np.arange(3)
    keys = jax.random.split(key, len(first))
    inputs = recording.texels[context], recording.roots[context], recording.actions[context[:, 2:] + np.arange(frames)]
    surfaces, roots = _forecast(avatar, *map(jnp.asarray, inputs), keys)
    return np.asarray(surfaces), np.asarray(roots)


@jax.jit
def _forecast(avatar: Avatar, texels: Array, roots: Array, actions: Array, keys: Array) -> tuple[Array, Array]:
    def one(texels, roots, actions, key):
        frames = rollout(avatar, state_at(avatar, texels, roots, key), actions, gaussians=False)[1]
        return surfaces(avatar.atlas, frames), frames.root

    return jax.vmap(one)(texels, roots, actions, keys)


@jax.jit
def surfaces(atlas: Atlas, frames: Frame) -> Float[Array, "f t 3"]:
    """Texels (f, t, 3) of generated frames relative to their own roots, metres, as recordings have them."""
    texels = jax.vmap(lambda x: posmap.from_map(atlas, x))(frames.posmap)
    return (texels - jax.vmap(lambda x: posmap.root(atlas, x))(texels)[:, None]) / atlas.scale
