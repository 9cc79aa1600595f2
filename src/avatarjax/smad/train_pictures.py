"""Learning the dynamics from pictures themselves: rollouts are drawn and compared with takes (SMAD 3.2, Eqs. 9 to 11).

Tracks come first (`train_dynamics`), as a rollout that is far from its picture gets no gradient from it that leads
there. Then this: one camera's tracks are right only across the view, and this loss asks for no more than that.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from avatarjax.smad import avatar as smad
from avatarjax.smad import dynamics, embedded, train_dynamics
from avatarjax.smad.avatar import Avatar
from avatarjax.smad.footage import Footage
from avatarjax.smad.train_dynamics import Take
from avatarjax.splat import SplatConfig, l1, render, required_capacity
from avatarjax.train import Run, train_stage

# Room for Gaussians that grow or gather: so many times what those of the tracks need, in so many frames.
_GROWTH, _LOOKS = 3, 16


def train(avatar: Avatar, takes: Footage, tracks: Sequence[Take], run: Run) -> Avatar:
    """The avatar with parameters that were trained on from the pictures, the first frames of rollouts being tracks'.

    Of the frames of each rollout `config.dynamics.pictures` are drawn, the last and others evenly before it, over a
    background that is drawn anew for each step; those that are held out count for nothing. Raises ValueError where
    tracks and takes have different frames.
    """
    if [len(track.positions) for track in tracks] != list(takes.takes):
        raise ValueError(f"tracks of {[len(x.positions) for x in tracks]} frames for takes of {takes.takes}")
    config, settings = avatar.config, avatar.config.dynamics
    recorded = train_dynamics.record(config, avatar.system, tracks)
    starts, frames = train_dynamics.rollouts(recorded, settings.frames)
    drawn = np.unique(np.linspace(frames, 0, settings.pictures, endpoint=False).round().astype(int)) - 1
    splat = _room(avatar, takes, tracks)

    def batch_at(step):
        start = np.random.default_rng([run.seed, step]).choice(starts, settings.picture_stage.batch)
        shown = start[:, None] + 1 + drawn[None]
        cameras = jax.tree.map(lambda x: np.asarray(x)[shown], takes.cameras)
        parts = {"avatar": avatar.replace(params=None), "recorded": recorded}
        return parts | {"start": start, "cameras": cameras, "rgba": takes.rgba[shown], "counts": ~takes.held_out[shown]}

    def loss(params, key, batch):
        fixed, recorded = batch["avatar"], batch["recorded"]
        roll_key, background_key = jax.random.split(key)
        background = jax.random.uniform(background_key, (3,))

        def one(start, key):
            states, looks = train_dynamics.roll(config, params, fixed.system, recorded, start, frames, key)
            truth = recorded.offsets[start + 1 + jnp.arange(frames)]
            chosen = jax.tree.map(lambda x: x[drawn], (states, looks))
            nodes = jax.vmap(lambda state: dynamics.positions(fixed.system, state))(chosen[0])
            clouds = jax.vmap(smad.dressed, in_axes=(None, 0, 0))(fixed, nodes, chosen[1])
            return train_dynamics.losses(config, params, fixed.system, truth, states), clouds

        found, clouds = jax.vmap(one)(batch["start"], jax.random.split(roll_key, len(batch["start"])))

        def seen(view):
            cloud, camera, rgba = view
            out = render(cloud, camera, background=background, config=splat)
            rgba = rgba.astype(jnp.float32) / 255
            wanted = rgba[..., :3] + (1 - rgba[..., 3:]) * background[None, None]
            return l1(out.image, wanted), jnp.mean(rgba[..., 3]), out.info.dropped

        views = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (clouds, batch["cameras"], batch["rgba"]))
        errors, shares, dropped = jax.lax.map(seen, views)
        counts = batch["counts"].reshape(-1).astype(jnp.float32)
        # The mean over the person, not the picture: a wide margin should not change what the tracks count beside it.
        photometric = jnp.sum(counts * errors) / jnp.maximum(jnp.sum(counts * shares), 1e-3)
        value, means = train_dynamics.total(config, found, settings.tracks)
        means |= {"photometric": photometric, "dropped": jnp.sum(dropped).astype(jnp.float32)}
        return value + settings.photometric * photometric, means

    params = train_stage(run, "dynamics_pictures", settings.picture_stage, config, loss, avatar.params, batch_at)
    return avatar.replace(params=params)


def _room(avatar: Avatar, takes: Footage, tracks: Sequence[Take]) -> SplatConfig:
    """Room for what the tracks need, and more."""
    positions: Float[Array, "f n 3"] = jnp.concatenate([track.positions for track in tracks])
    needed = 0
    for frame in np.linspace(0, len(positions) - 1, _LOOKS).astype(int):
        cloud = embedded.carry(avatar.binding, avatar.gaussians, avatar.system.graph, positions[frame])
        needed = max(
            needed, required_capacity(cloud, jax.tree.map(lambda x, k=frame: jnp.asarray(x[k]), takes.cameras))
        )
    return SplatConfig(capacity=min(2**24, _GROWTH * needed), depth=False)
