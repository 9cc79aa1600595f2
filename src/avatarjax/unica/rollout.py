"""An avatar that answers keys: `reset`, `step` and `rollout` as pure functions (UNICA 3.7).

Each round predicts the next frame in the space where the root of frame t is at the origin, adds the movement to a world
offset, and renormalises before the next round, so an avatar can walk any distance. PCA, the appearance network and the
Procrustes fit act only on what is shown, never on what is fed back.
"""

from __future__ import annotations

import typing

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from avatarjax import posmap
from avatarjax.gaussians import Gaussians
from avatarjax.posmap import pca as pcs
from avatarjax.unica import coefficients, latent
from avatarjax.unica.avatar import Avatar, overflow, wear
from avatarjax.unica.baselines import feed_forward
from avatarjax.unica.baselines.feed_forward import FeedForwardDynamics
from avatarjax.unica.coefficients import CoefficientDynamics


@typing.no_type_check
@flax.struct.dataclass
class State:
    """Where a rollout is: the context of the dynamics model, the world position (3,) of the root in metres, a PRNG key.

    The context holds the last three frames with the root of the newest at the origin: normalised texels (3, t, 3) for
    the UNet and its baseline, `coefficients.Context` for the coefficient model.
    """

    context: typing.Any
    offset: Float[Array, "3"]
    key: Key[Array, ""]


@typing.no_type_check
@flax.struct.dataclass
class Info:
    """What a user may want to watch: how far alignment moved the generated texels, the lowest texel's height, and for
    how many voxels the point transformer had no room.

    pca_residual () root mean square in metres; ground () metres, 0 for a foot on the floor: a trend is vertical drift;
    overflow () 0 if all is well, or if no Gaussians were asked for.
    """

    pca_residual: Float[Array, ""]
    ground: Float[Array, ""]
    overflow: Int[Array, ""]


@typing.no_type_check
@flax.struct.dataclass
class Frame:
    """One generated frame: normalised position map (h, w, 3), world Gaussians (None if not asked for), root (3,)."""

    posmap: Float[Array, "h w 3"]
    gaussians: Gaussians | None
    root: Float[Array, "3"]
    info: Info


def reset(avatar: Avatar, key: Key[Array, ""]) -> State:
    """The state before the first key: standing at the world's origin, the standing map three times (UNICA C.4)."""
    if isinstance(avatar.dynamics, CoefficientDynamics):
        flat, root = coefficients.canonical(avatar.atlas, avatar.standing)
        pose = pcs.project(avatar.dynamics.basis, flat)
        root = root.at[:2].set(0.0)
        context = coefficients.Context(
            pose=jnp.repeat(pose[None], coefficients.CONTEXT, axis=0),
            root=jnp.repeat(root[None], coefficients.CONTEXT, axis=0),
        )
    else:
        texels = posmap.normalize(avatar.atlas, avatar.standing, posmap.root(avatar.atlas, avatar.standing))
        context = jnp.repeat(texels[None], latent.CONTEXT, axis=0)
    return State(context, posmap.root(avatar.atlas, avatar.standing), key)


def step(avatar: Avatar, state: State, action: Int[Array, ""] | int) -> tuple[State, Frame]:
    """The next frame under an action id (0 idle, 1 W, 2 S, 3 A, 4 D in the shipped vocabulary).

    An id outside the vocabulary is clamped to it, as JAX indexes; check ids before a jitted call.
    """
    return _step(avatar, state, jnp.asarray(action, jnp.int32), True)


def rollout(
    avatar: Avatar, state: State, actions: Int[Array, "frames"], *, gaussians: bool = True
) -> tuple[State, Frame]:
    """`step` over a sequence of actions as one `lax.scan`: the last state, and frames with a leading time axis.

    `gaussians=False` skips appearance and leaves `frames.gaussians` None; `dress` can make them later, frame by frame.
    """
    return jax.lax.scan(lambda s, a: _step(avatar, s, a, gaussians), state, jnp.asarray(actions, jnp.int32))


def dress(avatar: Avatar, frame: Frame) -> Gaussians:
    """World Gaussians of a frame's geometry."""
    return wear(avatar, _surface(avatar, frame))


def _surface(avatar: Avatar, frame: Frame) -> Float[Array, "t 3"]:
    """World texels of a frame's geometry, aligned."""
    texels = posmap.from_map(avatar.atlas, frame.posmap)
    # The map is normalised about the root of the frame before; its own root tells where that is in the world.
    origin = frame.root - (posmap.root(avatar.atlas, texels) - 0.5) / avatar.atlas.scale
    return posmap.denormalize(avatar.atlas, _aligned(avatar, texels), origin)


def _aligned(avatar: Avatar, texels: Float[Array, "t 3"]) -> Float[Array, "t 3"]:
    """Normalised texels whose six views agree."""
    return texels if avatar.pca is None else pcs.align(avatar.pca, texels)


def _step(avatar: Avatar, state: State, action: Int[Array, ""], gaussians: bool) -> tuple[State, Frame]:
    key, sample_key = jax.random.split(state.key)
    advance = _advance_coefficients if isinstance(avatar.dynamics, CoefficientDynamics) else _advance_maps
    context, texels = advance(avatar, state, sample_key, action)

    # Movement accumulation (Eq. 7): in the shared space of the group, the root has moved from 0.5 to here.
    root = state.offset + (posmap.root(avatar.atlas, texels) - 0.5) / avatar.atlas.scale
    residual = (texels - _aligned(avatar, texels)) / avatar.atlas.scale
    info = Info(
        pca_residual=jnp.sqrt(jnp.mean(jnp.sum(residual**2, axis=-1))),
        ground=jnp.min(texels[:, 1] - 0.5) / avatar.atlas.scale + state.offset[1],
        overflow=jnp.asarray(0),
    )
    frame = Frame(posmap.to_map(avatar.atlas, texels), None, root, info)
    if gaussians:
        surface = _surface(avatar, frame)
        frame = frame.replace(gaussians=wear(avatar, surface), info=info.replace(overflow=overflow(avatar, surface)))
    return State(context, root, key), frame


def next_maps(
    avatar: Avatar, key: Key[Array, ""], context: Float[Array, "b 3 t 3"], action: Int[Array, "b"]
) -> Float[Array, "b t 3"]:
    """The next normalised texels from three normalised frames, by the UNet or by the baseline in its place."""
    if isinstance(avatar.dynamics, FeedForwardDynamics):
        return feed_forward.predict(avatar.atlas, avatar.dynamics, context, action)
    return latent.sample(avatar.config.latent, avatar.atlas, avatar.dynamics, key, context, action)


def _advance_maps(avatar: Avatar, state: State, key, action):
    """The next normalised texels, and the context renormalised about them (Eq. 8)."""
    texels = next_maps(avatar, key, state.context[None], action[None])[0]
    context = jnp.concatenate([state.context[1:], texels[None]])
    return context - (posmap.root(avatar.atlas, texels) - 0.5)[None, None], texels


def _advance_coefficients(avatar: Avatar, state: State, key, action):
    """The same from coefficients: heights are absolute there, ground positions relative to the offset."""
    batched = jax.tree.map(lambda x: x[None], state.context)
    pose, root = coefficients.sample(avatar.config.coefficients, avatar.dynamics, key, batched, action[None])
    context = coefficients.push(batched, pose, root)
    ground = jnp.concatenate([root[:, None, :2], jnp.zeros((1, 1, 1))], axis=-1)
    context = context.replace(root=context.root - ground)
    height = jnp.zeros(3).at[1].set(state.offset[1])
    texels = coefficients.world_texels(avatar.dynamics, pose[0], root[0])
    return jax.tree.map(lambda x: x[0], context), posmap.normalize(avatar.atlas, texels, height)
