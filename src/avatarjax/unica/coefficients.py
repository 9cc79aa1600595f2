"""The fast dynamics: diffusion in heading-relative principal components of position maps (ours).

A frame is a pose, the coefficients (k,) of its texels turned to face +z with the root's ground position removed and the
height kept, and a root (3,) of ground position x, z in metres and heading yaw in radians. The network denoises the
increment to the next frame, in units of its standard deviation and in the frame of the current heading; the key enters
as the angle between the direction it asks for and the heading. So the model is equivariant to turning the world, and
copying the last frame costs it nothing.
"""

from __future__ import annotations

import dataclasses
import typing

import flax.struct
import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Int, Key

from avatarjax import posmap, rotations
from avatarjax.diffusion import edm
from avatarjax.nets.blocks import sinusoidal_embedding
from avatarjax.nets.functional import Params, bind
from avatarjax.posmap import Atlas
from avatarjax.posmap import pca as pcs
from avatarjax.unica import stance
from avatarjax.unica.stance import Stance

CONTEXT = 3
ROOT = 3
ACTION_FEATURES = 6


@dataclasses.dataclass(frozen=True)
class CoefficientConfig:
    """Sizes and noise levels; every field is ours (the paper has no such model)."""

    components: int = 96
    width: int = 384
    depth: int = 3
    condition: int = 128
    sigma_min: float = 0.03
    sigma_max: float = 5.0
    at_sigma_max: float = 0.4
    sample_steps: int = 2
    temperature: float = 0.5  # size of the noise that sampling starts from; 0: no chance at all
    context_noise: float = 1.0
    clean_contexts: float = 0.2
    rollout_frames: int = 8
    single_share: float = 0.3  # of the steps, before rollout training joins
    context: int = CONTEXT  # frames that the network looks at, the newest of the three

    def __post_init__(self):
        if not 1 <= self.context <= CONTEXT:
            raise ValueError(f"the model looks at 1, 2 or 3 context frames, not {self.context}")
        if not 0 <= self.temperature <= 1:
            raise ValueError(f"the temperature is {self.temperature}: it must lie in 0..1")

    @property
    def rough(self) -> CoefficientConfig:
        """With the sampler of training: one step from full noise.

        It is the cheapest, and what a model has learned to undo of it covers what better samplers leave behind.
        """
        return dataclasses.replace(self, sample_steps=1, temperature=1.0)

    @property
    def features(self) -> int:
        """Length of the increment that is denoised."""
        return self.components + ROOT


@typing.no_type_check
@flax.struct.dataclass
class Scaling:
    """Statistics that bring poses and increments to unit size, and the loss weight of each entry.

    pose_mean, pose_scale, step_scale (k,), root_scale (3,), weight (k + 3,).
    """

    pose_mean: Float[Array, "k"]
    pose_scale: Float[Array, "k"]
    step_scale: Float[Array, "k"]
    root_scale: Float[Array, "3"]
    weight: Float[Array, "d"]


@typing.no_type_check
@flax.struct.dataclass
class CoefficientDynamics:
    """A trained model: network parameters, the basis of canonical poses, scaling, and what each action asks for.

    action_yaw (a,) is the world heading in radians that an action drives towards, action_moves (a,) 1 for an action
    that moves and 0 for one that stands. `stance` holds feet where they stand; None while training and without feet.
    """

    params: Params
    basis: pcs.PCA
    scaling: Scaling
    action_yaw: Float[Array, "a"]
    action_moves: Float[Array, "a"]
    stance: Stance | None = None


@typing.no_type_check
@flax.struct.dataclass
class Context:
    """The last three frames: poses (3, k) and roots (3, 3) in the world, oldest first."""

    pose: Float[Array, "3 k"]
    root: Float[Array, "3 3"]


def canonical(atlas: Atlas, texels: Float[Array, "t 3"]) -> tuple[Float[Array, "d"], Float[Array, "3"]]:
    """World texels in metres as a flat heading-relative vector (3t,) and a root (x, z, yaw)."""
    centre = posmap.root(atlas, texels).at[1].set(0.0)
    yaw = posmap.heading(atlas, texels)
    return ((texels - centre[None]) @ rotations.yaw_matrix(yaw)).reshape(-1), jnp.stack([centre[0], centre[2], yaw])


def world_texels(
    dynamics: CoefficientDynamics, pose: Float[Array, "k"], root: Float[Array, "3"]
) -> Float[Array, "t 3"]:
    """The inverse of `canonical`, from coefficients: world texels in metres."""
    texels = pcs.reconstruct(dynamics.basis, pose).reshape(-1, 3) @ rotations.yaw_matrix(root[2]).T
    return texels + jnp.stack([root[0], jnp.zeros_like(root[0]), root[1]])[None]


def relative(root: Float[Array, "*b 3"], origin: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """A root in the ground frame of another: displacement turned by its heading, and the difference of headings."""
    dx, dz = root[..., 0] - origin[..., 0], root[..., 1] - origin[..., 1]
    c, s = jnp.cos(origin[..., 2]), jnp.sin(origin[..., 2])
    return jnp.stack([c * dx - s * dz, s * dx + c * dz, root[..., 2] - origin[..., 2]], -1)


def compose(origin: Float[Array, "*b 3"], step: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """The inverse of `relative`: the root reached from `origin` by `step`."""
    c, s = jnp.cos(origin[..., 2]), jnp.sin(origin[..., 2])
    x = origin[..., 0] + c * step[..., 0] + s * step[..., 1]
    z = origin[..., 1] - s * step[..., 0] + c * step[..., 1]
    return jnp.stack([x, z, origin[..., 2] + step[..., 2]], -1)


def action_features(
    dynamics: CoefficientDynamics, action: Int[Array, "*b"], yaw: Float[Array, "*b"]
) -> Float[Array, "*b 6"]:
    """What the key asks for, seen from the heading: moving or not, and sines and cosines of the angle to turn."""
    moves = dynamics.action_moves[action]
    angle = dynamics.action_yaw[action] - yaw
    waves = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.cos(2 * angle), jnp.sin(2 * angle)], -1)
    return jnp.concatenate([moves[..., None], 1 - moves[..., None], moves[..., None] * waves], -1)


class CoefficientDenoiser(nnx.Module):
    """Residual MLP with adaptive layer norms, plus a linear path that starts at the ridge solution."""

    def __init__(self, config: CoefficientConfig, *, rngs: nnx.Rngs):
        inputs = config.context * config.features - ROOT + config.features
        self.action = nnx.Linear(ACTION_FEATURES, 64, rngs=rngs)
        self.condition1 = nnx.Linear(64 + 32 + 32 * config.context, config.condition, rngs=rngs)
        self.condition2 = nnx.Linear(config.condition, config.condition, rngs=rngs)
        self.enter = nnx.Linear(inputs, config.width, rngs=rngs)
        self.norms = nnx.List(
            [nnx.LayerNorm(config.width, use_bias=False, use_scale=False, rngs=rngs) for _ in range(config.depth + 1)]
        )
        small = nnx.initializers.variance_scaling(0.01, "fan_in", "normal")
        self.modulate = nnx.List(
            [nnx.Linear(config.condition, 3 * config.width, kernel_init=small, rngs=rngs) for _ in range(config.depth)]
        )
        self.up = nnx.List([nnx.Linear(config.width, 2 * config.width, rngs=rngs) for _ in range(config.depth)])
        self.down = nnx.List([nnx.Linear(2 * config.width, config.width, rngs=rngs) for _ in range(config.depth)])
        self.modulate_last = nnx.Linear(config.condition, 2 * config.width, kernel_init=small, rngs=rngs)
        self.leave = nnx.Linear(config.width, config.features, kernel_init=small, rngs=rngs)
        self.linear = nnx.Linear(inputs, config.features, kernel_init=nnx.initializers.zeros, rngs=rngs)

    def __call__(
        self,
        context: Float[Array, "b f"],
        noise_level: Float[Array, "b c"],
        action: Float[Array, "b 6"],
        x: Float[Array, "b d"],
        log_sigma: Float[Array, "b"],
    ) -> Float[Array, "b d"]:
        levels = sinusoidal_embedding(20.0 * jnp.log(noise_level.reshape(-1) + 0.01), 32, 300.0)
        condition = jnp.concatenate(
            [
                self.action(action),
                sinusoidal_embedding(20.0 * log_sigma, 32, 300.0),
                levels.reshape(x.shape[0], -1),
            ],
            axis=-1,
        )
        condition = jax.nn.silu(self.condition2(jax.nn.silu(self.condition1(condition))))
        inputs = jnp.concatenate([context, x], axis=-1)
        h = self.enter(inputs)
        for norm, modulate, up, down in zip(self.norms, self.modulate, self.up, self.down, strict=False):
            scale, shift, gate = jnp.split(modulate(condition), 3, axis=-1)
            h = h + (1 + gate) * down(jax.nn.silu(up(norm(h) * (1 + scale) + shift)))
        scale, shift = jnp.split(self.modulate_last(condition), 2, axis=-1)
        return self.leave(self.norms[-1](h) * (1 + scale) + shift) + self.linear(inputs)


def context_features(scaling: Scaling, pose: Float[Array, "b c k"], root: Float[Array, "b c 3"]) -> Float[Array, "b f"]:
    """Newest pose, and the differences of successive poses and roots of contexts, all near unit size.

    `root` is relative to the newest frame, whose own entry is therefore zero and left out.
    """
    differences = 0.7 * jnp.diff(pose, axis=1) / scaling.step_scale[None, None]
    steps = jnp.diff(root, axis=1) / scaling.root_scale[None, None]
    newest = (pose[:, -1] - scaling.pose_mean[None]) / scaling.pose_scale[None]
    b = pose.shape[0]
    return jnp.concatenate([newest, differences.reshape(b, -1), steps.reshape(b, -1)], axis=-1)


def seen(config: CoefficientConfig, scaling: Scaling, context: Context) -> Float[Array, "b f"]:
    """The features of contexts (b, 3, ...) that the network looks at, as many frames as it is configured for."""
    newest = jnp.broadcast_to(context.root[:, 2:], context.root.shape)
    roots = relative(context.root, newest)
    return context_features(scaling, context.pose[:, -config.context :], roots[:, -config.context :])


def sample(
    config: CoefficientConfig,
    dynamics: CoefficientDynamics,
    key: Key[Array, ""],
    context: Context,
    action: Int[Array, "b"],
) -> tuple[Float[Array, "b k"], Float[Array, "b 3"]]:
    """The next pose and the next root in the world, for a batch of contexts (b, 3, ...).

    A colder start keeps draws near the middle of the distribution: what is left of the first noise after few steps is
    a tremble, not diversity.
    """
    network = _network(config, dynamics, context, jnp.zeros((action.shape[0], CONTEXT)), action)
    noise = config.temperature * jax.random.normal(key, (action.shape[0], config.features))
    increment = edm.euler(network, noise, edm.sigma_steps(config.sample_steps, config.sigma_min, config.sigma_max))
    pose_step = increment[:, : config.components] * dynamics.scaling.step_scale[None]
    root_step = increment[:, config.components :] * dynamics.scaling.root_scale[None]
    pose = context.pose[:, -1] + pose_step
    if dynamics.stance is not None:
        pose, root_step = stance.hold(dynamics.stance, dynamics.basis, context.pose[:, -1], pose, root_step)
    return pose, compose(context.root[:, -1], root_step)


def _network(config, dynamics, context: Context, noise_level, action) -> edm.Network:
    """The denoiser with everything but the noisy increment filled in."""
    module = bind(CoefficientDenoiser, config, dynamics.params)
    features = seen(config, dynamics.scaling, context)
    wish = action_features(dynamics, action, context.root[:, 2, 2])
    return lambda x, log_sigma: module(features, noise_level[:, -config.context :], wish, x, log_sigma)


def push(context: Context, pose: Float[Array, "b k"], root: Float[Array, "b 3"]) -> Context:
    """The context after a new frame: the oldest one goes."""
    return Context(
        pose=jnp.concatenate([context.pose[:, 1:], pose[:, None]], axis=1),
        root=jnp.concatenate([context.root[:, 1:], root[:, None]], axis=1),
    )


def denoising_loss(
    config: CoefficientConfig,
    dynamics: CoefficientDynamics,
    key: Key[Array, ""],
    context: Context,
    noise_level: Float[Array, "b 3"],
    target_pose: Float[Array, "b k"],
    target_root: Float[Array, "b 3"],
    action: Int[Array, "b"],
) -> Float[Array, ""]:
    """EDM loss of the increment that leads from a possibly wrong context to the true next frame."""
    sigma_key, noise_key = jax.random.split(key)
    root_step = relative(target_root, context.root[:, 2]) / dynamics.scaling.root_scale[None]
    pose_step = (target_pose - context.pose[:, 2]) / dynamics.scaling.step_scale[None]
    clean = jnp.concatenate([pose_step, root_step], axis=-1)
    sigma = edm.sample_sigma(sigma_key, action.shape[0], config.sigma_min, config.sigma_max, config.at_sigma_max)
    noisy = clean + sigma[:, None] * jax.random.normal(noise_key, clean.shape)
    denoised = edm.denoise(_network(config, dynamics, context, noise_level, action), noisy, sigma)
    per_sample = jnp.mean((denoised - clean) ** 2 * dynamics.scaling.weight[None], axis=-1)
    return jnp.mean(per_sample * edm.loss_weight(sigma))


def noised_context(
    config: CoefficientConfig, scaling: Scaling, key: Key[Array, ""], context: Context
) -> tuple[Context, Float[Array, "b 3"]]:
    """Contexts disturbed by up to about one frame's motion, and the noise level of each frame.

    Part of the noise is shared by the three frames, as drift is. The newest root stays: it is the origin.
    """
    level_key, clean_key, own_key, shared_key, mix_key, root_key = jax.random.split(key, 6)
    b, _, k = context.pose.shape
    level = config.context_noise * jax.random.uniform(level_key, (b, CONTEXT)) ** 2
    level = jnp.where(jax.random.uniform(clean_key, (b, 1)) < config.clean_contexts, 0.0, level)
    mix = 0.5 * jax.random.uniform(mix_key, (b, 1, 1))
    own, shared = jax.random.normal(own_key, (b, CONTEXT, k)), jax.random.normal(shared_key, (b, 1, k))
    noise = jnp.sqrt(1 - mix) * own + jnp.sqrt(mix) * shared
    root_noise = 0.3 * jax.random.normal(root_key, (b, CONTEXT, ROOT)).at[:, -1].set(0.0)
    return (
        Context(
            pose=context.pose + level[..., None] * scaling.step_scale[None, None] * noise,
            root=context.root + level[..., None] * scaling.root_scale[None, None] * root_noise,
        ),
        level,
    )


def rollout_loss(
    config: CoefficientConfig,
    dynamics: CoefficientDynamics,
    key: Key[Array, ""],
    context: Context,
    target_pose: Float[Array, "b u k"],
    target_root: Float[Array, "b u 3"],
    actions: Int[Array, "b u"],
) -> Float[Array, ""]:
    """Rollout training: contexts are what the model itself produced over up to u frames, targets the recorded frames.

    The produced contexts, roughly sampled, carry no gradient; the loss teaches the model to undo its own drift (self
    forcing).
    """
    noise_key, roll_key, loss_key = jax.random.split(key, 3)
    b, u = actions.shape
    frozen = jax.lax.stop_gradient(dynamics)
    start, _ = noised_context(config, dynamics.scaling, noise_key, context)

    def step(context, inputs):
        key, action = inputs
        pose, root = sample(config.rough, frozen, key, context, action)
        return push(context, pose, root), context

    _, contexts = jax.lax.scan(step, start, (jax.random.split(roll_key, u), actions.T))
    flat = jax.tree.map(lambda x: jax.lax.stop_gradient(x).reshape(u * b, *x.shape[2:]), contexts)
    return denoising_loss(
        config,
        dynamics,
        loss_key,
        flat,
        jnp.zeros((u * b, CONTEXT)),
        target_pose.swapaxes(0, 1).reshape(u * b, -1),
        _recorded_target(flat.root[:, 2], target_root, context.root),
        actions.T.reshape(-1),
    )


def _recorded_target(reached, target_root, context_root):
    """Roots to aim for from roots that have left the recorded path: recorded steps, but the recorded heading.

    A wrong position is nobody's fault once it is reached: the step on the ground is the recorded one. A wrong heading
    must be undone.
    """
    b, u, _ = target_root.shape
    before = jnp.concatenate([context_root[:, -1:], target_root[:, :-1]], axis=1)
    step = (target_root - before).swapaxes(0, 1).reshape(u * b, ROOT)
    yaw = target_root.swapaxes(0, 1).reshape(u * b, ROOT)[:, 2]
    return jnp.concatenate([reached[:, :2] + step[:, :2], yaw[:, None]], axis=-1)
