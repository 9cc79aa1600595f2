"""The SMAD avatar and its verbs: `reset`, `step` and `rollout`, pure functions that other JAX code may jit and batch.

    state = smad.reset(avatar, poses_at(0))
    state, frames = smad.rollout(avatar, state, poses)      # one lax.scan
    picture = aj.render(jax.tree.map(lambda x: x[-1], frames.gaussians), camera)

An action is a body pose (`driving.Pose`). Everything is simulated in the body frame; frames are in the world.
"""

from __future__ import annotations

import typing

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from avatarjax import gaussians as clouds
from avatarjax import rotations
from avatarjax.gaussians import Gaussians
from avatarjax.nets.functional import Params
from avatarjax.smad import driving, dynamics, embedded
from avatarjax.smad.config import SmadConfig
from avatarjax.smad.deformer import Deltas
from avatarjax.smad.driving import Pose
from avatarjax.smad.dynamics import State, System
from avatarjax.smad.embedded import Binding


@typing.no_type_check
@flax.struct.dataclass
class Avatar:
    """Canonical Gaussians in the body frame, how they are bound to nodes, the system of nodes and its parameters."""

    gaussians: Gaussians
    binding: Binding
    system: System
    params: Params
    config: SmadConfig = flax.struct.field(pytree_node=False)


@typing.no_type_check
@flax.struct.dataclass
class Frame:
    """Gaussians in the world, nodes (n, 3) in the body frame of the pose, metres; gaussians is None where not asked
    for."""

    gaussians: Gaussians | None
    nodes: Float[Array, "n 3"]


def reset(avatar: Avatar, pose: Pose) -> State:
    """Standing still in a pose. Raises ValueError for a pose of another number of joints than the avatar's."""
    joints = (avatar.config.deformer.pose - driving.MOTION) // 6
    if pose.rotations.shape != (joints, 3, 3):
        raise ValueError(f"rotations {pose.rotations.shape} of a pose must be ({joints}, 3, 3) for this avatar")
    return dynamics.reset(avatar.config, avatar.params, avatar.system, pose)


def step(avatar: Avatar, state: State, pose: Pose) -> tuple[State, Frame]:
    """The next frame, `config.dt` seconds later, in the next pose."""
    return _step(avatar, state, pose, True)


def rollout(avatar: Avatar, state: State, poses: Pose, *, gaussians: bool = True) -> tuple[State, Frame]:
    """`step` over t poses as one `lax.scan`: the last state, and frames with a leading time axis.

    `gaussians=False` leaves `frames.gaussians` None, and takes less time and memory.
    """
    return jax.lax.scan(lambda state, pose: _step(avatar, state, pose, gaussians), state, poses)


def wear(avatar: Avatar, nodes: Float[Array, "n 3"], pose: Pose) -> Gaussians:
    """World Gaussians on nodes that lie anywhere in the body frame of a pose, as canonical ones look: for baselines."""
    return _in_world(embedded.carry(avatar.binding, avatar.gaussians, avatar.system.graph, nodes), pose)


def dressed(avatar: Avatar, nodes: Float[Array, "n 3"], look: Deltas) -> Gaussians:
    """Gaussians in the body frame, on nodes there, each as the network says that its nearest node looks."""
    cloud = embedded.carry(avatar.binding, avatar.gaussians, avatar.system.graph, nodes)
    nearest = avatar.binding.nodes[:, 0]
    return cloud.replace(
        log_scales=cloud.log_scales + look.log_scales[nearest],
        logit_opacities=cloud.logit_opacities + look.logit_opacities[nearest],
        colors=jnp.clip(cloud.colors + look.colors[nearest], 0.0, 1.0),
    )


def _step(avatar: Avatar, state: State, pose: Pose, gaussians: bool) -> tuple[State, Frame]:
    state, look = dynamics.step(avatar.config, avatar.params, avatar.system, state, pose)
    nodes = dynamics.positions(avatar.system, state)
    if not gaussians:
        return state, Frame(None, nodes)
    return state, Frame(_in_world(dressed(avatar, nodes, look), pose), nodes)


def _in_world(cloud: Gaussians, pose: Pose) -> Gaussians:
    turn = rotations.yaw_matrix(driving.yaw(pose.root_rotation))
    return clouds.transform(cloud, jnp.ones(()), turn, pose.root_translation)
