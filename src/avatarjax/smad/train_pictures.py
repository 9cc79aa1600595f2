"""Learning how clothes hang and swing from the pictures themselves (SMAD 3.2, Eqs. 9 to 11).

First `train_drape`: the equilibrium, which is what a window of poses alone says, and the Gaussians, from single
frames. All frames share it, so that a side that one frame hides is learned from others in which the person stood
otherwise; tracks (`refine`), which belong to one frame each, are only where it starts from. Then `train_swing`:
everything, through rollouts (Eq. 10), which begin in frames as if the clothes had always been at their equilibrium.
`train_fusion` is an option beside them: colours that depend on where a camera stands.
"""

from __future__ import annotations

import typing
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import cKDTree

from avatarjax.gaussians import Gaussians
from avatarjax.nets.functional import Params
from avatarjax.smad import avatar as smad
from avatarjax.smad import dynamics, embedded, footage, fusion, refine, train_dynamics
from avatarjax.smad.avatar import Avatar
from avatarjax.smad.driving import Pose
from avatarjax.smad.footage import Footage
from avatarjax.smad.fusion import FusionConfig, Views
from avatarjax.smad.train_dynamics import Recorded, Take
from avatarjax.smad.views import spread
from avatarjax.splat import SplatConfig, l1, render
from avatarjax.train import Run, train_stage
from avatarjax.train.state import Metrics

# Metres in which the Gaussians' canonical means are learned: a stage has one rate, for numbers of unit size.
_UNIT = 0.125


def train_drape(avatar: Avatar, takes: Footage, run: Run) -> Avatar:
    """The avatar with an equilibrium and Gaussians that look like the pictures: Gaussians that were fitted to motion of
    each frame's own (`refine`) are learned on, places and all, for what the equilibrium says.

    Frames that are held out are not drawn. Raises ValueError where the avatar has no equilibrium to learn.
    """
    config, settings = avatar.config, avatar.config.pictures
    if not config.equilibrium:
        raise ValueError("equilibrium is False: there is nothing that poses alone say")
    recorded, splat = _recorded(avatar, takes), _room(avatar, takes)
    frames = np.flatnonzero(~takes.held_out)

    def batch_at(step):
        chosen = np.random.default_rng([run.seed, step]).choice(frames, settings.drape_stage.batch)
        return _fixed(avatar, recorded) | _views(takes, chosen) | {"frames": chosen.astype(np.int32)}

    def loss(params, key, batch):
        fixed, recorded = batch["avatar"], batch["recorded"]
        gaussians = _with_look(fixed.gaussians, params["look"])

        def shown(frame):
            nodes, offset = _at(fixed.replace(params=params["dynamics"]), recorded, frame)
            return embedded.carry(fixed.binding, gaussians, fixed.system.graph, nodes), nodes, offset

        return _total(avatar, key, batch, splat, shown, batch["frames"])

    start = {"dynamics": avatar.params, "look": _look(avatar.gaussians)}
    trained = train_stage(run, "drape", settings.drape_stage, config, loss, start, batch_at)
    params = trained["dynamics"]
    system = train_dynamics.knowing(config, params, avatar.system, recorded)
    return avatar.replace(system=system, params=params, gaussians=_with_look(avatar.gaussians, trained["look"]))


def train_swing(avatar: Avatar, takes: Footage, run: Run) -> Avatar:
    """The avatar with dynamics that were trained on through rollouts of `config.pictures.frames` frames.

    Of each rollout `config.pictures.drawn` frames are drawn, the last and others evenly before it.
    """
    config, settings = avatar.config, avatar.config.pictures
    recorded, splat = _recorded(avatar, takes), _room(avatar, takes)
    starts, frames = train_dynamics.rollouts(recorded, settings.frames)
    drawn = np.unique(np.linspace(frames, 0, settings.drawn, endpoint=False).round().astype(int)) - 1

    def batch_at(step):
        start = np.random.default_rng([run.seed, step]).choice(starts, settings.swing_stage.batch)
        shown = start[:, None] + 1 + drawn[None]
        counts = {"counts": ~takes.held_out[shown.reshape(-1)]}
        return _fixed(avatar, recorded) | _views(takes, shown.reshape(-1)) | counts | {"start": start}

    def loss(params, key, batch):
        fixed = batch["avatar"]

        def one(start):
            state = train_dynamics.calm_at(config, params, fixed.system, batch["recorded"], start)
            states, looks = train_dynamics.roll(config, params, fixed.system, batch["recorded"], state, start, frames)
            return jax.tree.map(lambda x: x[drawn], (states, looks))

        def shown(found):
            state, look = found
            nodes = dynamics.positions(fixed.system, state)
            return smad.dressed(fixed, nodes, look), nodes, state.offset

        found = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), jax.vmap(one)(batch["start"]))
        return _total(avatar, key, batch, splat, shown, found)

    hold = train_dynamics.hold_equilibrium(config)
    params = train_stage(run, "swing", settings.swing_stage, config, loss, avatar.params, batch_at, hold)
    return avatar.replace(params=params)


def train_fusion(
    avatar: Avatar, takes: Footage, config: FusionConfig, run: Run
) -> tuple[Avatar, tuple[Params, Views] | None]:
    """The avatar with colours that were learned on at its equilibrium, all else held, and beside them parameters and
    views of the fusion (`fusion.fuse`) that were learned with them; None where `config` wants no views."""
    stage = config.stage
    recorded, splat = _recorded(avatar, takes), _room(avatar, takes)
    frames = np.flatnonzero(~takes.held_out)
    start = {"colors": refine.encode(avatar.gaussians)["colors"]}
    views = None
    if config.views:
        views = views_of(avatar, takes, config.views)
        start["fusion"] = fusion.init(config, run.key("fusion"))

    def batch_at(step):
        chosen = np.random.default_rng([run.seed, step]).choice(frames, stage.batch)
        fixed = {"avatar": avatar, "recorded": recorded, "seen": views}
        return fixed | _views(takes, chosen) | {"frames": chosen.astype(np.int32)}

    def loss(params, key, batch):
        dressed = batch["avatar"].replace(gaussians=_with_look(batch["avatar"].gaussians, {"colors": params["colors"]}))
        background = jax.random.uniform(key, (3,))

        def missed(shot):
            frame, camera, rgba = shot
            cloud = _carried(dressed, batch["recorded"], frame)
            if config.views:
                cloud = fusion.fuse(config, params["fusion"], batch["seen"], cloud, fusion.direction(camera))
            return l1(render(cloud, camera, background=background, config=splat).image, footage.over(rgba, background))

        return jnp.mean(jax.lax.map(missed, (batch["frames"], batch["cameras"], batch["rgba"]))), {}

    trained = train_stage(run, "fusion", stage, (avatar.config, config), loss, start, batch_at)
    avatar = avatar.replace(gaussians=_with_look(avatar.gaussians, {"colors": trained["colors"]}))
    return avatar, None if views is None else (trained["fusion"], views)


def views_of(avatar: Avatar, takes: Footage, count: int) -> Views:
    """What so many frames of the first take, spread evenly over those that are trained on, show of the Gaussians."""
    first = np.flatnonzero(~takes.held_out[: takes.takes[0]])
    frames = first[spread(len(first), count)]
    recorded = _recorded(avatar, takes)
    means = jax.lax.map(lambda frame: _carried(avatar, recorded, frame).means, jnp.asarray(frames))
    nearest = cKDTree(np.asarray(avatar.gaussians.means)).query(np.asarray(avatar.gaussians.means), 2)[0][:, 1]
    shown = {name: jax.tree.map(jnp.asarray, x) for name, x in _views(takes, frames).items()}
    return fusion.gather(means, jnp.asarray(np.median(nearest), jnp.float32), shown["rgba"], shown["cameras"])


def _at(avatar: Avatar, recorded: Recorded, frame: Int[Array, ""]) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """The nodes at their equilibrium in a frame, and its offset."""
    now = train_dynamics.window_at(avatar.config, recorded, frame), train_dynamics.draped_at(recorded, frame)
    offset = dynamics.settled(avatar.config, avatar.params, avatar.system, *now)
    pose = jax.tree.map(lambda x: x[frame], recorded.poses)
    return dynamics.driven(avatar.system, pose) + offset, offset


def _carried(avatar: Avatar, recorded: Recorded, frame: Int[Array, ""]) -> Gaussians:
    """The Gaussians at the equilibrium in a frame, in its body frame."""
    return embedded.carry(avatar.binding, avatar.gaussians, avatar.system.graph, _at(avatar, recorded, frame)[0])


def _total(
    avatar: Avatar,
    key: Array,
    batch: dict[str, typing.Any],
    splat: SplatConfig,
    shown: Callable[[typing.Any], tuple[Gaussians, Float[Array, "n 3"], Float[Array, "n 3"]]],
    found: typing.Any,
) -> tuple[Float[Array, ""], Metrics]:
    """Mean absolute errors of colours and alphas over a background that is drawn anew, mean squared stretch of edges in
    units of their mean length (Eq. 11), and the mean square of offsets in metres; those two choose among all motions
    that look alike to one camera. `shown` says of each of what was `found` the cloud, the nodes and their offsets."""
    settings, graph = avatar.config.pictures, batch["avatar"].system.graph
    background = jax.random.uniform(key, (3,))
    rest = refine.lengths(graph.positions, graph.edges)

    def terms(view):
        (cloud, nodes, offsets), camera, rgba = shown(view[0]), *view[1:]
        out = render(cloud, camera, background=background, config=splat)
        stretch = (refine.lengths(nodes, graph.edges) - rest) / jnp.mean(rest)
        regular = {"isometry": jnp.mean(stretch**2), "offset": jnp.mean(offsets**2)}
        return footage.missed(out, rgba, background) | regular

    # One frame after the other, with all that is its own: a batch of scatters is slow on a CPU.
    each = jax.lax.map(terms, (found, batch["cameras"], batch["rgba"]))
    counts = batch.get("counts", jnp.ones(len(each["photometric"]))).astype(jnp.float32)
    share = {name: counts / jnp.maximum(jnp.sum(counts), 1.0) for name in ("photometric", "silhouette")}
    alike = jnp.full(len(counts), 1 / len(counts))
    dropped = jnp.sum(each.pop("dropped"))
    means = {name: jnp.sum(share.get(name, alike) * values) for name, values in each.items()}
    weights = {"photometric": 1.0} | {k: getattr(settings, k) for k in ("silhouette", "isometry", "offset")}
    value = jnp.sum(jnp.stack([weights[name] * term for name, term in means.items()]))
    return value, means | {"dropped": dropped}


def _recorded(avatar: Avatar, takes: Footage) -> Recorded:
    """The takes' poses, with nodes that are nowhere but on the driven surface."""
    parts, first = [], 0
    for count in takes.takes:
        poses = jax.tree.map(lambda x, k=slice(first, first + count): x[k], takes.poses)
        parts.append(Take(poses, dynamics.surfaces(avatar.system, poses)))
        first += count
    return train_dynamics.record(avatar.config, avatar.system, parts)


def _fixed(avatar: Avatar, recorded: Recorded) -> dict[str, typing.Any]:
    """What every batch brings along, so that it is no constant of the compiled step."""
    return {"avatar": avatar.replace(params=None), "recorded": recorded}


def _views(takes: Footage, frames: Int[np.ndarray, " k"]) -> dict[str, typing.Any]:
    cameras = jax.tree.map(lambda x: np.asarray(x)[frames], takes.cameras)
    return {"cameras": cameras, "rgba": takes.rgba[frames]}


def _look(gaussians: Gaussians) -> Params:
    """What is learned of the Gaussians."""
    encoded = refine.encode(gaussians)
    return encoded | {"means": encoded["means"] / _UNIT}


def _with_look(gaussians: Gaussians, look: Params) -> Gaussians:
    """The Gaussians with what was learned of them, or with a part of it."""
    learned = _look(gaussians) | look
    return refine.decode(learned | {"means": _UNIT * learned["means"]})


def _room(avatar: Avatar, takes: Footage) -> SplatConfig:
    """Room for what skinning needs, and more."""
    return footage.room(takes, lambda frame: _skinned(avatar, takes.poses, jnp.asarray(frame)))


@jax.jit
def _skinned(avatar: Avatar, poses: Pose, frame: Int[Array, ""]) -> Gaussians:
    """The Gaussians where skinning alone has them, in the body frame of a frame."""
    nodes = dynamics.driven(avatar.system, jax.tree.map(lambda x: x[frame], poses))
    return embedded.carry(avatar.binding, avatar.gaussians, avatar.system.graph, nodes)
