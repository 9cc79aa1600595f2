"""Learning the dynamics from tracks: where nodes were in every frame of some takes (SMAD 3.2, Eqs. 9 and 11, B.3).

The equilibrium is learned from single frames. Rollouts then start at it in any frame and are trained through for some
frames: from where the recording was, the system would learn to carry on what it cannot know in a rollout from rest.
Without an equilibrium they start where the recording was, a little wrong, so that the model learns to live with its own
errors. Tracks come from the refined initialisation (`refine`), or from a mesh sequence.
"""

from __future__ import annotations

import typing
from collections.abc import Callable, Sequence

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from avatarjax.nets.functional import Params
from avatarjax.smad import deformer, drape, driving, dynamics, kernel
from avatarjax.smad.config import SmadConfig
from avatarjax.smad.deformer import Deltas
from avatarjax.smad.drape import Drape
from avatarjax.smad.driving import Pose
from avatarjax.smad.dynamics import Known, Scaling, State, System
from avatarjax.smad.graph import Graph
from avatarjax.smad.skeletal import Skin
from avatarjax.train import Run, train_stage
from avatarjax.train.state import Metrics


@typing.no_type_check
@flax.struct.dataclass
class Take:
    """t frames: poses, and the nodes' positions (t, n, 3) in the body frame of each, metres."""

    poses: Pose
    positions: Float[Array, "t n 3"]


@typing.no_type_check
@flax.struct.dataclass
class Recorded:
    """All frames of some takes, one after the other, as training needs them: poses (f, ...), offsets (f, n, 3) from the
    driven surface, that surface in the world (f, n, 3), normalised pose features (f, p), the first frame (f,) of the
    take that a frame belongs to, and the drape's components (f, c) where there is one, begun at rest in each take."""

    poses: Pose
    offsets: Float[Array, "f n 3"]
    driven: Float[Array, "f n 3"]
    features: Float[Array, "f p"]
    first: Int[Array, "f"]
    draped: Float[Array, "f c"] | None = None


def fit_system(config: SmadConfig, graph: Graph, skin: Skin | None, takes: Sequence[Take]) -> System:
    """The system to be learned for, with the statistics and the drape of these takes, in closed form. Raises ValueError
    without takes, for one of less than three frames, and where positions are not one for each node."""
    if not takes:
        raise ValueError("no takes to learn dynamics from: give at least one")
    for take in takes:
        if len(take.positions) < 3 or take.positions.shape[1:] != graph.positions.shape:
            raise ValueError(
                f"positions {take.positions.shape} of a take must be of 3 frames or more and of "
                f"{len(graph.positions)} nodes"
            )
    features = np.concatenate([np.asarray(driving.track(take.poses, config.dt)) for take in takes])
    one = jnp.ones(())
    deviation = features.std(axis=0)
    # A joint that hardly moves in training must not shout where it moves more.
    scaling = Scaling(jnp.asarray(features.mean(axis=0)), jnp.asarray(np.maximum(deviation, 0.05)), one, one, one, one)
    recorded = [record(config, System(graph, skin, scaling), [take]) for take in takes]

    def spread(values, order):
        changes = [np.diff(np.asarray(x), n=order, axis=0) / config.dt**order for x in values]
        return jnp.asarray(max(1e-4, float(np.sqrt(np.mean(np.concatenate(changes) ** 2)))), jnp.float32)

    offsets = [part.offsets for part in recorded]
    scaling = scaling.replace(
        offset=spread(offsets, 0),
        velocity=spread(offsets, 1),
        acceleration=spread(offsets, 2),
        drive=spread([part.driven for part in recorded], 2),
    )
    system = System(graph, skin, scaling)
    if not (config.equilibrium and config.dynamics.components):
        return system
    return system.replace(drape=fit_drape(config, record(config, system, takes)))


def fit_drape(config: SmadConfig, recorded: Recorded) -> Drape:
    """The drape of recorded takes, in closed form."""
    settings = config.dynamics
    return drape.fit(
        *(recorded.offsets, recorded.features, recorded.first),
        components=min(settings.components, len(recorded.first)),
        window=config.deformer.pose_window,
        stride=config.deformer.pose_stride,
        memory=settings.memory,
        ridge=settings.ridge,
        centres=settings.centres,
    )


def knowing(config: SmadConfig, params: Params, system: System, recorded: Recorded) -> System:
    """The system that knows which windows its equilibrium was learned from: those of the recording. Without an
    equilibrium it is returned as it is."""
    if not config.equilibrium:
        return system
    net = config.deformer
    options = {"window": net.pose_window, "stride": net.pose_stride, "centres": config.dynamics.centres}
    fitted = kernel.fit(recorded.features, recorded.first, **options)
    frames = jnp.arange(len(recorded.first))

    def embedding(frame):
        window = window_at(config, recorded, frame)[:: net.pose_stride]
        return deformer.embed(net, params["deformer"], window)

    return system.replace(known=Known(fitted, jnp.mean(jax.lax.map(embedding, frames, batch_size=256), axis=0)))


def record(config: SmadConfig, system: System, takes: Sequence[Take]) -> Recorded:
    """The takes, ready to start rollouts from."""
    parts, start = [], 0
    for take in takes:
        surface = dynamics.surfaces(system, take.poses)
        features = dynamics.pose_features(config, system, take.poses)
        parts.append(
            Recorded(
                poses=take.poses,
                offsets=take.positions - surface,
                driven=driving.to_world(take.poses, surface),
                features=features,
                first=jnp.full(len(take.positions), start, jnp.int32),
                draped=dynamics.draped_under(config, system, features),
            )
        )
        start += len(take.positions)
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


def state_at(config: SmadConfig, params: Params, system: System, recorded: Recorded, frame: Int[Array, ""]) -> State:
    """The state that the recording was in; before a take began, it is taken to have stood still."""
    back = _back(config, recorded, frame)
    equilibrium = _settled(config, params, system, recorded, back[:2])
    return _state(config, recorded, back, recorded.offsets[back], equilibrium)


def calm_at(config: SmadConfig, params: Params, system: System, recorded: Recorded, frame: Int[Array, ""]) -> State:
    """The state of a frame as if the offsets had always been at their equilibrium, whatever was recorded."""
    back = _back(config, recorded, frame)
    offsets = _settled(config, params, system, recorded, back)
    return _state(config, recorded, back, offsets, offsets[:2])


def window_at(config: SmadConfig, recorded: Recorded, frame: Int[Array, ""]) -> Float[Array, "w p"]:
    """The window of pose features that ends in a frame; before a take began, it is taken to have stood still."""
    return _windows(config, recorded, frame[None])[0]


def draped_at(recorded: Recorded, frames: Int[Array, "..."]) -> Float[Array, "... c"] | None:
    """The drape's components in some frames; None without a drape."""
    return jax.tree.map(lambda x: x[frames], recorded.draped)


def _back(config: SmadConfig, recorded: Recorded, frame: Int[Array, ""]) -> Int[Array, "k"]:
    """A frame and those before it that a state remembers."""
    return jnp.maximum(frame - jnp.arange(max(config.deformer.velocities, 1) + 1), recorded.first[frame])


def _windows(config: SmadConfig, recorded: Recorded, frames: Int[Array, "k"]) -> Float[Array, "k w p"]:
    """The windows of pose features that end in each frame."""
    back = frames[:, None] - jnp.arange(config.deformer.pose_span)[None]
    return recorded.features[jnp.maximum(back, jnp.asarray(recorded.first)[frames][:, None])]


def _settled(
    config: SmadConfig, params: Params, system: System, recorded: Recorded, frames: Int[Array, "k"]
) -> Float[Array, "k n 3"]:
    """The equilibrium in each frame."""
    windows, draped = _windows(config, recorded, frames), draped_at(recorded, frames)
    return jax.vmap(lambda *now: dynamics.settled(config, params, system, *now))(windows, draped)


def _state(config: SmadConfig, recorded: Recorded, back: Int[Array, "k"], offsets, equilibrium) -> State:
    start = jnp.asarray(recorded.first)[back[0]]
    return State(
        offset=offsets[0],
        velocities=jnp.swapaxes((offsets[:-1] - offsets[1:]) / config.dt, 0, 1),
        equilibrium=equilibrium,
        driven=jnp.asarray(recorded.driven)[back[:2]],
        window=window_at(config, recorded, back[0]),
        pose=jax.tree.map(lambda x: x[back[0]], recorded.poses),
        draped=draped_at(recorded, jnp.maximum(back[0] - jnp.arange(max(config.dynamics.memory, 1)), start)),
    )


def losses(system: System, offsets: Float[Array, "t n 3"], states: State) -> dict[str, Float[Array, ""]]:
    """Terms of the loss of a rollout of t frames against recorded offsets: `data`, mean squared errors in units of the
    offsets' spread; `isometry`, mean squared stretch of edges, and `damping`, mean squared velocity of offsets (Eq. 11
    as means), both in the same unit."""
    unit = system.scaling.offset
    i, j = system.graph.edges.T
    rest = jnp.linalg.norm(system.graph.positions[i] - system.graph.positions[j], axis=-1)

    def stretch(state):
        edge = jnp.take(dynamics.positions(system, state), i, axis=0) - dynamics.positions(system, state)[j]
        return jnp.mean((jnp.linalg.norm(edge, axis=-1) - rest) ** 2)

    return {
        "data": jnp.mean((states.offset - offsets) ** 2) / unit**2,
        "isometry": jnp.mean(jax.vmap(stretch)(states)) / unit**2,
        "damping": jnp.mean(states.velocities[:, :, 0] ** 2) / system.scaling.velocity**2,
    }


def train(config: SmadConfig, system: System, takes: Sequence[Take], run: Run) -> Params:
    """Parameters of the dynamics, learned from takes (SMAD Eq. 9 with the tracks' error for the picture's): first the
    equilibrium, from single frames, then all else, through rollouts."""
    recorded = record(config, system, takes)
    initial = train_target(config, system, recorded, run)
    settings = config.dynamics
    starts, frames = rollouts(recorded, settings.frames)

    def batch_at(step):
        rng = np.random.default_rng([run.seed, step])
        return {"recorded": recorded, "system": system, "start": rng.choice(starts, settings.stage.batch)}

    def loss(params, key, batch):
        system, recorded = batch["system"], batch["recorded"]

        def one(start, key):
            if config.equilibrium:
                state = calm_at(config, params, system, recorded, start)
            else:
                state = shaken(config, system, state_at(config, params, system, recorded, start), key)
            states, _ = roll(config, params, system, recorded, state, start, frames)
            return losses(system, recorded.offsets[start + 1 + jnp.arange(frames)], states)

        return total(config, jax.vmap(one)(batch["start"], jax.random.split(key, len(batch["start"]))))

    return train_stage(run, "dynamics", settings.stage, config, loss, initial, batch_at, hold_equilibrium(config))


def hold_equilibrium(config: SmadConfig) -> Callable[[Params, Params, typing.Any], Params] | None:
    """What keeps the equilibrium as it was learned from single frames, of which there are more than of rollouts: for
    `train_stage`. None without an equilibrium."""

    def hold(new, old, batch):
        network = new["deformer"]["network"] | {"pose": old["deformer"]["network"]["pose"]}
        return new | {"target": old["target"], "deformer": new["deformer"] | {"network": network}}

    return hold if config.equilibrium else None


def rollouts(recorded: Recorded, frames: int) -> tuple[Int[np.ndarray, " s"], int]:
    """The frames from which a rollout of so many frames stays in its take, and how many those are: `frames`, or as many
    as the shortest take has."""
    first = np.asarray(recorded.first)
    ends = np.append(np.flatnonzero(np.diff(first)) + 1, len(first))
    last = ends[np.searchsorted(ends, np.arange(len(first)), side="right")]
    frames = min(frames, int(min(np.diff(np.append(0, ends)))) - 1)
    return np.flatnonzero(np.arange(len(first)) + frames < last), frames


def roll(
    config: SmadConfig,
    params: Params,
    system: System,
    recorded: Recorded,
    state: State,
    start: Int[Array, ""],
    frames: int,
) -> tuple[State, Deltas]:
    """The states of a rollout under the poses after a recorded frame, from the state there, and what the network says
    of the look, both with a leading axis of `frames`."""
    poses = jax.tree.map(lambda x: x[start + 1 + jnp.arange(frames)], recorded.poses)

    def advance(state, pose):
        state, look = dynamics.step(config, params, system, state, pose)
        return state, (state, look)

    return jax.lax.scan(advance, state, poses)[1]


def shaken(config: SmadConfig, system: System, state: State, key: Key[Array, ""]) -> State:
    """The state made a little wrong."""
    wrong = jax.random.normal(key, state.offset.shape)
    return state.replace(offset=state.offset + config.dynamics.noise * system.scaling.offset * wrong)


def total(config: SmadConfig, found: dict[str, Float[Array, "..."]]) -> tuple[Array, Metrics]:
    """The sum of the means of `losses`, each with its weight, and the means."""
    settings, means = config.dynamics, {name: jnp.mean(values) for name, values in found.items()}
    weights = {"data": 1.0, "isometry": settings.isometry, "damping": settings.damping}
    return jnp.sum(jnp.stack([weights[name] * value for name, value in means.items()])), means


def train_target(config: SmadConfig, system: System, recorded: Recorded, run: Run) -> Params:
    """Fresh parameters with an equilibrium that is learned: a hundred of these steps take the time of a rollout's."""
    stage, initial = config.dynamics.target_stage, dynamics.init(config, system, run.key("dynamics"))
    if not config.equilibrium:
        return initial

    def batch_at(step):
        frames = np.random.default_rng([run.seed, step]).integers(len(recorded.first), size=stage.batch)
        return {"recorded": recorded, "system": system, "frames": frames.astype(np.int32)}

    def loss(params, key, batch):
        def missed(frame):
            recorded = batch["recorded"]
            now = window_at(config, recorded, frame), draped_at(recorded, frame)
            return jnp.mean((dynamics.settled(config, params, system, *now) - recorded.offsets[frame]) ** 2)

        return jnp.mean(jax.vmap(missed)(batch["frames"])) / batch["system"].scaling.offset ** 2, {}

    return train_stage(run, "dynamics_target", stage, config, loss, initial, batch_at)


def replay(config: SmadConfig, params: Params, system: System, take: Take, start: int) -> Float[Array, "t n 3"]:
    """A rollout over the rest of a take from the state that it was in at a frame: positions (t, n, 3) in the body
    frames of the frames after it."""
    state = state_at(config, params, system, record(config, system, [take]), jnp.asarray(start))
    poses = jax.tree.map(lambda x: x[start + 1 :], take.poses)
    return dynamics.rollout(config, params, system, state, poses)[1]
