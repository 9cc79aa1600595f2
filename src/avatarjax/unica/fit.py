"""What is computed from the data in closed form before and between the trained stages.

Statistics of the latents, the alignment basis, and for the coefficient model: the pose basis, the scaling, what each
action asks for, the ridge solution at which its linear path starts, and what holds its feet where they stand.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from avatarjax.data.sequences import Recording
from avatarjax.nets.functional import Params
from avatarjax.posmap import pca as pcs
from avatarjax.unica import coefficients, stance
from avatarjax.unica.coefficients import CoefficientConfig, CoefficientDynamics, Context, Scaling
from avatarjax.unica.stance import Stance


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


def fit_stance(
    config: CoefficientConfig,
    dynamics: CoefficientDynamics,
    recording: Recording,
    standing: Float[Array | np.ndarray, "t 3"],
    context: Context,
    target_pose: Float[Array, "b k"],
    target_root: Float[Array, "b 3"],
    action: Int[Array | np.ndarray, "b"],
    key: Key[Array, ""],
) -> Stance | None:
    """What a trained model needs for `stance.hold`: soles, and the covariance of its one-step errors.

    Errors are those of rough samples on the given contexts, of training data. None where no soles are found.
    """
    found = stance.find_soles(
        *(np.asarray(x) for x in (recording.texels, recording.roots, recording.sequence, standing))
    )
    if found is None:
        return None
    sample = jax.jit(coefficients.sample, static_argnums=0)
    pose, root = sample(config.rough, dynamics, key, context, jnp.asarray(action))
    newest = context.root[:, 2]
    missed = coefficients.relative(root, newest) - coefficients.relative(target_root, newest)
    errors = np.asarray(jnp.concatenate([pose - target_pose, missed], axis=-1), np.float64)
    spread = stance.square_root(errors.T @ errors / len(errors))
    soles, slack = found
    return Stance(jnp.asarray(soles), jnp.asarray(spread, jnp.float32), jnp.asarray(slack, jnp.float32))


def latent_statistics(latents: Float[Array, "n u v l"]) -> tuple[Float[Array, "l"], Float[Array, "l"]]:
    """Mean and standard deviation of each latent channel."""
    return jnp.mean(latents, axis=(0, 1, 2)), jnp.maximum(jnp.std(latents, axis=(0, 1, 2)), 1e-3)


def alignment_basis(fourth: Float[Array, "f t 3"], components: int, key: Key[Array, ""]) -> pcs.PCA:
    """The basis of normalised fourth maps that makes six views agree (UNICA B.2)."""
    return pcs.fit(fourth.reshape(fourth.shape[0], -1), components, key)
