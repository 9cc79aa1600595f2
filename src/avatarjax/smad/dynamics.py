"""How the nodes move: masses on springs and dampers, driven by poses, with a learned acceleration (SMAD 3.2).

A node's place is that of the driven surface plus an offset o = t + r, both in the body frame: t is the equilibrium
under a window of poses, and the swing r about it is that of masses on springs:

    r'' = - k_i r_i - g_i r'_i - sum_j k_ij (r_i - r_j) - m_i s''_i + f_i

The spring k_i holds a node to its equilibrium, k_ij to its neighbours, g_i damps, and m_i s'' is the inertia by
which cloth lags behind a surface that accelerates in the world: all learned, so that what is rigid becomes stiff and
what is loose soft (Eqs. 2 and 3, with the external force split into what drives). f is what the deformation network
adds. One explicit Euler step (Eq. 4) a frame; the constants are bounded so that the system without f is stable at any
weights. Without inertia and f nothing swings, and o is t: dynamics can only add to what poses explain. The paper's
springs are between nodes alone, and its network predicts all of the motion: such rollouts drifted or diverged in our
prototype. `motion="deltas"` is B.2 instead, where the network's changes are no forces but places.
"""

from __future__ import annotations

import dataclasses
import functools
import typing

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from avatarjax.nets.functional import Params
from avatarjax.physics import mass_spring_damper as msd
from avatarjax.physics.mass_spring_damper import Springs
from avatarjax.smad import deformer, drape, driving, kernel, skeletal
from avatarjax.smad.config import SmadConfig
from avatarjax.smad.drape import Drape
from avatarjax.smad.driving import Pose
from avatarjax.smad.graph import Graph
from avatarjax.smad.kernel import Kernel
from avatarjax.smad.skeletal import Skin

# Numbers of a node beside its place and velocities: at rest, offset, swing, the surface's motion.
NODE_FEATURES = 15

# Bounds of k_i, of the sum of a node's k_ij, and of g_i, each per unit of mass, in SI units. At 30 frames a second
# w^2 dt^2 + 2 g dt then stays below (1200 + 2 * 600) / 900 + 1 = 3.7, and Eq. 4 is stable below 4.
ANCHOR, NEIGHBOUR, DAMPING = 1200.0, 600.0, 15.0


@typing.no_type_check
@flax.struct.dataclass
class Scaling:
    """What brings the network's inputs and outputs to unit size: mean and deviation (p,) of pose features, and typical
    offsets, their velocities and accelerations, and accelerations of the driven surface, in SI units."""

    pose_mean: Float[Array, "p"]
    pose_scale: Float[Array, "p"]
    offset: Float[Array, ""]
    velocity: Float[Array, ""]
    acceleration: Float[Array, ""]
    drive: Float[Array, ""]


@typing.no_type_check
@flax.struct.dataclass
class Known:
    """The windows of poses that were learned from, and the mean (e,) of the network's embeddings of them."""

    kernel: Kernel
    embedding: Float[Array, "e"]


@typing.no_type_check
@flax.struct.dataclass
class System:
    """What dynamics are learned for: the graph, what drives its nodes, scaling, the drape under a window of poses in
    closed form, from which the learned equilibrium departs (none: from no offset), and what that is known of (none:
    it is trusted everywhere).

    Without a skin (its joints are not known) the nodes' places at rest are the driven surface.
    """

    graph: Graph
    skin: Skin | None
    scaling: Scaling
    drape: Drape | None = None
    known: Known | None = None


@typing.no_type_check
@flax.struct.dataclass
class State:
    """offset (n, 3) of each node from the driven surface in the body frame, metres; velocities (n, v, 3) of it, newest
    first, metres a second, v at least 1; equilibrium (2, n, 3) of the offset and driven (2, n, 3) the driven surface in
    the world, newest first; window (w, p) normalised pose features, newest first; the last pose; draped (l, c)
    components of the drape in as many frames as it remembers, at least one, newest first; None without a drape."""

    offset: Float[Array, "n 3"]
    velocities: Float[Array, "n v 3"]
    equilibrium: Float[Array, "2 n 3"]
    driven: Float[Array, "2 n 3"]
    window: Float[Array, "w p"]
    pose: Pose
    draped: Float[Array, "l c"] | None = None


def sized(config: SmadConfig, joints: int) -> SmadConfig:
    """The configuration with a network of the right number of inputs for bodies of so many joints."""
    network = dataclasses.replace(config.deformer, pose=driving.count(joints), node_features=NODE_FEATURES)
    return dataclasses.replace(config, deformer=network)


def init(config: SmadConfig, system: System, key: Key[Array, ""]) -> Params:
    """Fresh parameters: a stiff, well damped system without inertia, the drape as equilibrium, a network that adds
    nothing."""
    nodes, embedding = len(system.graph.positions), config.deformer.pose_embedding
    return {
        "deformer": deformer.init(config.deformer, system.graph, key),
        "target": jnp.zeros((embedding, nodes, 3)),
        "anchor": jnp.full((nodes,), -2.0, jnp.float32),
        "neighbour": jnp.full((len(system.graph.edges),), -2.0, jnp.float32),
        "damping": jnp.zeros(nodes),
        "inertia": jnp.zeros(nodes),
    }


def springs(params: Params, graph: Graph) -> tuple[Springs, Float[Array, "n"]]:
    """The system's springs between nodes, of unit masses and without offsets at rest, and k_i (n,) to the surface."""
    i, j = graph.edges.T
    # Shared out so that no node's springs sum to more than the bound.
    share = NEIGHBOUR / jnp.maximum(graph.degree[i], graph.degree[j])
    unit = jnp.ones(len(graph.positions))
    between = Springs(
        edges=graph.edges,
        mask=jnp.ones(len(graph.edges), bool),
        rest=jnp.zeros((len(graph.edges), 3)),
        stiffness=share * jax.nn.sigmoid(params["neighbour"]),
        mass=unit,
        damping=DAMPING * jax.nn.sigmoid(params["damping"]),
    )
    return between, ANCHOR * jax.nn.sigmoid(params["anchor"])


def driven(system: System, pose: Pose) -> Float[Array, "n 3"]:
    """The surface that drives the nodes, in the body frame."""
    return system.graph.positions if system.skin is None else skeletal.pose_points(system.skin, pose)


@jax.jit
def surfaces(system: System, poses: Pose) -> Float[Array, "t n 3"]:
    """The driven surface under every one of t poses, in the body frame of each."""
    return jax.lax.map(lambda pose: driven(system, pose), poses)


@functools.partial(jax.jit, static_argnames="config")
def pose_features(config: SmadConfig, system: System, poses: Pose) -> Float[Array, "t p"]:
    """Normalised features of every one of t poses; before the first the body is taken to have stood still."""
    return (driving.track(poses, config.dt) - system.scaling.pose_mean[None]) / system.scaling.pose_scale[None]


def settled(
    config: SmadConfig,
    params: Params,
    system: System,
    window: Float[Array, "w p"],
    draped: Float[Array, "c"] | None = None,
) -> Float[Array, "n 3"]:
    """The equilibrium of the offset under a window of poses: the drape, whose components are `draped`, and a linear
    reading of the network's own embedding of the window. The less the window is like any that were learned from, the
    nearer that is drawn to the mean embedding, as a network goes on where nothing tells it to."""
    if not config.equilibrium:
        return jnp.zeros(params["target"].shape[1:])
    window = window[:: config.deformer.pose_stride]
    embedding = deformer.embed(config.deformer, params["deformer"], window)
    if system.known is not None:
        usual, trust = system.known.embedding, jnp.max(kernel.near(system.known.kernel, window))
        embedding = usual + trust * (embedding - usual)
    learned = jnp.tensordot(embedding, params["target"], 1)
    return learned if draped is None else learned + drape.offsets(system.drape, draped)


def draped_at_rest(config: SmadConfig, system: System, window: Float[Array, "w p"]) -> Float[Array, "l c"] | None:
    """What a state knows of the drape where the window has been the same for long; None without a drape."""
    if system.drape is None:
        return None
    found = drape.at_rest(system.drape, window[:: config.deformer.pose_stride])
    return jnp.repeat(found[None], max(config.dynamics.memory, 1), axis=0)


def draped_after(
    config: SmadConfig, system: System, draped: Float[Array, "l c"], window: Float[Array, "w p"]
) -> Float[Array, "l c"]:
    """What a state knows of the drape a frame later, under the next window."""
    found = drape.components(system.drape, window[:: config.deformer.pose_stride], draped[-1])
    return jnp.concatenate([found[None], draped[:-1]])


@functools.partial(jax.jit, static_argnames="config")
def draped_under(config: SmadConfig, system: System, features: Float[Array, "t p"]) -> Float[Array, "t c"] | None:
    """The drape's components under every one of t poses; before the first the body is taken to have stood still."""
    begin = draped_at_rest(config, system, _window(config, features, jnp.int32(0)))
    if begin is None:
        return None

    def at(draped, frame):
        draped = draped_after(config, system, draped, _window(config, features, frame))
        return draped, draped[0]

    return jnp.concatenate([begin[:1], jax.lax.scan(at, begin, jnp.arange(1, len(features)))[1]])


@functools.partial(jax.jit, static_argnames="config")
def without_swing(
    config: SmadConfig, params: Params, system: System, poses: Pose
) -> tuple[Float[Array, "t n 3"], Float[Array, "t n 3"]]:
    """The driven surface under every one of t poses, and the nodes at their equilibrium, both in the body frames;
    before the first pose the body is taken to have stood still."""
    surface = surfaces(system, poses)
    features = pose_features(config, system, poses)

    def at(now):
        frame, draped = now
        return settled(config, params, system, _window(config, features, frame), draped)

    return surface, surface + jax.lax.map(at, (jnp.arange(len(surface)), draped_under(config, system, features)))


def reset(config: SmadConfig, params: Params, system: System, pose: Pose) -> State:
    """Standing still in a pose, the cloth where that pose alone would have it."""
    surface = driving.to_world(pose, driven(system, pose))
    features = _normalised(system, driving.features(pose, pose, config.dt))
    window = jnp.repeat(features[None], config.deformer.pose_span, axis=0)
    still = jnp.zeros((len(surface), max(config.deformer.velocities, 1), 3))
    draped = draped_at_rest(config, system, window)
    offset = settled(config, params, system, window, jax.tree.map(lambda x: x[0], draped))
    return State(offset, still, jnp.stack([offset, offset]), jnp.stack([surface, surface]), window, pose, draped)


def step(config: SmadConfig, params: Params, system: System, state: State, pose: Pose) -> tuple[State, deformer.Deltas]:
    """One frame: the state under the next pose, and what the network says of the Gaussians' look.

    positions(...) of the new state are the nodes in the body frame of `pose`.
    """
    scaling, net = system.scaling, config.deformer
    features = _normalised(system, driving.features(state.pose, pose, config.dt))
    window = jnp.concatenate([features[None], state.window[:-1]])
    surface = driven(system, pose)
    world = driving.to_world(pose, surface)
    # How the surface accelerates in the world, seen in the body frame: a second difference, which is late by a frame.
    lurch = _turned(pose, world - 2 * state.driven[0] + state.driven[1]) / config.dt**2
    sweep = _turned(pose, world - state.driven[0]) / config.dt
    draped = None if state.draped is None else draped_after(config, system, state.draped, window)
    now = settled(config, params, system, window, jax.tree.map(lambda x: x[0], draped))
    equilibrium = jnp.concatenate([now[None], state.equilibrium])
    swing = state.offset - equilibrium[1]
    inputs = [system.graph.positions, state.offset / scaling.offset, swing / scaling.offset]
    inputs += [sweep, lurch / scaling.drive]
    deltas = deformer.deform(
        net,
        params["deformer"],
        system.graph,
        window[:: net.pose_stride],
        surface + state.offset,
        state.velocities[:, : net.velocities] / scaling.velocity,
        jnp.concatenate(inputs, axis=1),
    )
    if config.motion == "deltas":
        offset = equilibrium[0] + scaling.offset * deltas.position
        velocity = (offset - state.offset) / config.dt + scaling.velocity * deltas.velocity
    else:
        between, anchor = springs(params, system.graph)
        # The swing is about an equilibrium that itself moves and accelerates.
        swinging = state.velocities[:, 0] - (equilibrium[1] - equilibrium[2]) / config.dt
        carried = (equilibrium[0] - 2 * equilibrium[1] + equilibrium[2]) / config.dt**2
        force = -anchor[:, None] * swing - params["inertia"][:, None] * lurch
        force = force + scaling.acceleration * deltas.position
        acceleration = msd.acceleration(between, swing, swinging, force) + carried
        offset, velocity = msd.euler_step(state.offset, state.velocities[:, 0], acceleration, config.dt)
    velocities = jnp.concatenate([velocity[:, None], state.velocities[:, :-1]], axis=1)
    driven_now = jnp.stack([world, state.driven[0]])
    return State(offset, velocities, equilibrium[:2], driven_now, window, pose, draped), deltas


def positions(system: System, state: State) -> Float[Array, "n 3"]:
    """The nodes in the body frame of the state's pose, metres."""
    return driving.to_body(state.pose, state.driven[0]) + state.offset


def rollout(
    config: SmadConfig, params: Params, system: System, state: State, poses: Pose
) -> tuple[State, Float[Array, "t n 3"]]:
    """`step` over t poses as one `lax.scan`: the last state, and the nodes in each pose's body frame."""

    def advance(state, pose):
        state, _ = step(config, params, system, state, pose)
        return state, positions(system, state)

    return jax.lax.scan(advance, state, poses)


def _window(config: SmadConfig, features: Float[Array, "t p"], frame: Int[Array, ""]) -> Float[Array, "w p"]:
    """The window of pose features that ends in a frame of a take."""
    return features[jnp.maximum(frame - jnp.arange(config.deformer.pose_span), 0)]


def _turned(pose: Pose, vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """World vectors in the body frame."""
    return driving.to_body(pose.replace(root_translation=jnp.zeros(3)), vectors)


def _normalised(system: System, features: Float[Array, "p"]) -> Float[Array, "p"]:
    return (features - system.scaling.pose_mean) / system.scaling.pose_scale
