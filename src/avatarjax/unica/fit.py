"""What is computed from the data in closed form before and between the trained stages.

Statistics of the latents, the alignment basis, and for the coefficient model: the pose basis, the scaling, what each
action asks for, and the ridge solution at which its linear path starts.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from avatarjax.nets.functional import Params
from avatarjax.posmap import pca as pcs
from avatarjax.unica import coefficients
from avatarjax.unica.coefficients import CoefficientConfig, CoefficientDynamics, Context, Scaling


def action_directions(
    roots: Float[np.ndarray, "f 3"],
    actions: Int[np.ndarray, "f"],
    sequence: Int[np.ndarray, "f"],
    count: int,
    settle: int = 30,
) -> tuple[Float[np.ndarray, "a"], Float[np.ndarray, "a"]]:
    """World yaw (radians) that each action drives towards, and 1 for those that move: measured, so actions are data.

    `roots` (f, 3) are x, z, yaw. Only frames count that have held their action for `settle` frames. An action moves if
    its mean speed is over a quarter of the fastest one's. Raises ValueError for an action without such frames.
    """
    steady = np.zeros(len(actions), bool)
    steady[settle:-1] = True
    for lag in range(1, settle + 1):
        steady[lag:] &= (actions[lag:] == actions[:-lag]) & (sequence[lag:] == sequence[:-lag])
    steady[:-1] &= sequence[1:] == sequence[:-1]
    velocity = np.diff(roots[:, :2], axis=0, append=roots[-1:, :2])
    mean = np.zeros((count, 2))
    for action in range(count):
        chosen = steady & (actions == action)
        if not chosen.any():
            raise ValueError(f"no sequence holds action {action} for more than {settle} frames: record longer ones")
        mean[action] = velocity[chosen].mean(0)
    speed = np.linalg.norm(mean, axis=1)
    return np.arctan2(mean[:, 0], mean[:, 1]), (speed > 0.25 * speed.max()).astype(np.float64)


def coefficient_scaling(
    poses: Float[np.ndarray, "f k"], roots: Float[np.ndarray, "f 3"], sequence: Int[np.ndarray, "f"]
) -> Scaling:
    """Scales of poses and increments. Loss weights lie between relative error and error in metres."""
    same = sequence[1:] == sequence[:-1]
    steps = np.diff(poses, axis=0)[same]
    root_steps = np.asarray(coefficients.relative(jnp.asarray(roots[1:]), jnp.asarray(roots[:-1])))[same]
    step_scale = np.maximum(steps.std(0), 0.003)
    weight = np.append(step_scale / step_scale.max(), [0.5] * coefficients.ROOT) + 0.02
    as_float = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    return Scaling(
        pose_mean=as_float(poses.mean(0)),
        pose_scale=as_float(np.maximum(poses.std(0), 0.01)),
        step_scale=as_float(step_scale),
        root_scale=as_float(np.maximum(np.sqrt((root_steps**2).mean(0)), 1e-4)),
        weight=as_float(weight / weight.mean()),
    )


def ridge_start(
    config: CoefficientConfig,
    dynamics: CoefficientDynamics,
    context: Context,
    target_pose: Float[Array, "b k"],
    target_root: Float[Array, "b 3"],
    key: Key[Array, ""],
    *,
    noise: float = 0.05,
    penalty: float = 1e-3,
) -> Params:
    """The network's parameters with its linear path set to the ridge regression of the increment on the context."""
    scaling = dynamics.scaling
    disturbance = noise * scaling.step_scale[None, None] * jax.random.normal(key, context.pose.shape)
    features = coefficients.seen(config, scaling, context.replace(pose=context.pose + disturbance))
    increment = jnp.concatenate(
        [
            (target_pose - (context.pose + disturbance)[:, 2]) / scaling.step_scale[None],
            coefficients.relative(target_root, context.root[:, 2]) / scaling.root_scale[None],
        ],
        axis=-1,
    )
    design = np.concatenate([np.asarray(features, np.float64), np.ones((len(features), 1))], axis=1)
    gram = design.T @ design / len(design) + penalty * np.eye(design.shape[1])
    solution = np.linalg.solve(gram, design.T @ np.asarray(increment, np.float64) / len(design))
    kernel = np.zeros(dynamics.params["linear"]["kernel"].shape, np.float32)
    kernel[: features.shape[1]] = solution[:-1]
    linear = {"kernel": jnp.asarray(kernel), "bias": jnp.asarray(solution[-1], jnp.float32)}
    return {**dynamics.params, "linear": linear}


def latent_statistics(latents: Float[Array, "n u v l"]) -> tuple[Float[Array, "l"], Float[Array, "l"]]:
    """Mean and standard deviation of each latent channel."""
    return jnp.mean(latents, axis=(0, 1, 2)), jnp.maximum(jnp.std(latents, axis=(0, 1, 2)), 1e-3)


def alignment_basis(fourth: Float[Array, "f t 3"], components: int, key: Key[Array, ""]) -> pcs.PCA:
    """The basis of normalised fourth maps that makes six views agree (UNICA B.2)."""
    return pcs.fit(fourth.reshape(fourth.shape[0], -1), components, key)
