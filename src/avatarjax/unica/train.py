"""The trained stages of UNICA's dynamics (3.6, C.2), each one jitted step inside the common loop.

Every function takes the config, the dataset and a `Run` (where checkpoints go, and the seed), resumes what it finds
there, and returns plain arrays. Weights that a stage does not train travel with the batch: closed over, they
would be compiled in as constants.
"""

from __future__ import annotations

import functools
import typing
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from avatarjax.data import sequences
from avatarjax.data.dataset import Dataset
from avatarjax.nets import functional
from avatarjax.posmap import pca as pcs
from avatarjax.train import Run, train_stage
from avatarjax.unica import batches, coefficients, latent, quarters
from avatarjax.unica import fit as closed_form
from avatarjax.unica.batches import Windows
from avatarjax.unica.coefficients import CoefficientDenoiser, CoefficientDynamics, Context
from avatarjax.unica.config import UnicaConfig
from avatarjax.unica.denoiser import Denoiser
from avatarjax.unica.latent import LatentDynamics
from avatarjax.unica.vae import VAE


def new_latent_dynamics(config: UnicaConfig, data: Dataset, run: Run) -> LatentDynamics:
    """Untrained autoencoder and UNet, with the statistics of the maps."""
    mean, scale = map_statistics(config, data)
    width = config.latent.vae.latent_channels
    return LatentDynamics(
        vae=functional.init(VAE, config.latent.vae, run.key("vae")),
        denoiser=functional.init(Denoiser, config.latent.denoiser, run.key("unet")),
        map_mean=mean,
        map_scale=scale,
        latent_mean=jnp.zeros(width),
        latent_scale=jnp.ones(width),
    )


MakeGroups = Callable[[np.ndarray, np.random.Generator], tuple[np.ndarray, np.ndarray]]


def _training_groups(config: UnicaConfig, data: Dataset) -> tuple[Windows, MakeGroups]:
    """The windows that autoencoder and UNet learn from, and the function that makes normalised groups (b, 4, t, 3) and
    their actions (b,) of chosen ones: as recorded or, where `rotate` is set, each turned by quarters at random."""
    windows = batches.windows(data.train, 4, config.turn_window)
    scale = float(data.atlas.scale)
    if not config.rotate:
        return windows, lambda chosen, rng: windows.groups(chosen, scale)
    ground = data.train.roots[:, [0, 2, 1]]
    asked = closed_form.action_directions(ground, data.train.actions, data.train.sequence, config.actions)
    table = quarters.permutations(*asked)

    def turned(chosen, rng):
        groups, actions = windows.groups(chosen, scale)
        turns = rng.integers(0, 4, len(chosen))
        return quarters.turn(groups, turns), table[turns, actions]

    return windows, turned


def sample_groups(config: UnicaConfig, data: Dataset, count: int) -> np.ndarray:
    """Evenly spaced training groups (count, 4, t, 3) in normalised space."""
    windows, make = _training_groups(config, data)
    chosen = np.linspace(0, len(windows.first) - 1, min(count, len(windows.first))).astype(int)
    return make(chosen, np.random.default_rng(0))[0]


def map_statistics(config: UnicaConfig, data: Dataset) -> tuple[jax.Array, jax.Array]:
    """Mean (t, 3) and size () of the deviation from it, of normalised training maps."""
    groups = sample_groups(config, data, 256)
    mean = groups.mean((0, 1))
    return jnp.asarray(mean), jnp.asarray((groups - mean).std())


def frame_batches(config: UnicaConfig, data: Dataset, seed: int) -> Callable[[int], np.ndarray]:
    """What an autoencoder sees at each step: normalised texels (b, t, 3) of frames of random groups, each frame at the
    four places it takes in them."""
    windows, make = _training_groups(config, data)
    count = config.vae_stage.batch

    def batch_at(step):
        rng = batches.generator(seed, step)
        groups, _ = make(rng.integers(0, len(windows.first), count), rng)
        return groups[np.arange(count), rng.integers(0, 4, count)]

    return batch_at


def group_batches(config: UnicaConfig, data: Dataset, seed: int) -> Callable[[int], dict[str, typing.Any]]:
    """What a model of the fourth frame sees at each step: "groups" (b, 4, t, 3), their "actions" (b,), and whether the
    step is "steady", of the first stage (UNICA 3.6).

    The first stage sees steady movement only; the second draws 70 % of its groups from the frames after a turn.
    """
    windows, make = _training_groups(config, data)
    stage = config.unet_stage
    everything = np.ones_like(windows.turning)

    def batch_at(step):
        rng = batches.generator(seed, step)
        steady = step < config.unet_steady * stage.steps
        allowed, fraction = (~windows.turning, 0.0) if steady else (everything, config.turn_fraction)
        groups, actions = make(batches.draw(allowed, windows.turning, fraction, stage.batch, rng), rng)
        return {"groups": groups, "actions": actions, "steady": np.bool_(steady)}

    return batch_at


def train_vae(config: UnicaConfig, data: Dataset, run: Run, start: LatentDynamics) -> LatentDynamics:
    """The autoencoder, with the statistics of its latents."""
    stage, settings = config.vae_stage, (config.latent, config.rotate)
    frames_at = frame_batches(config, data, run.seed)

    def batch_at(step):
        return {"atlas": data.atlas, "frozen": start.replace(vae={}, denoiser={}), "texels": frames_at(step)}

    def loss(params, key, batch):
        dynamics = batch["frozen"].replace(vae=params)
        return latent.vae_loss(config.latent, batch["atlas"], dynamics, key, batch["texels"])

    trained = start.replace(vae=train_stage(run, "vae", stage, settings, loss, start.vae, batch_at))
    groups = sample_groups(config, data, 64)
    encode = jax.jit(functools.partial(latent.encode, config.latent))
    mean, spread = closed_form.latent_statistics(encode(data.atlas, trained, groups.reshape(-1, *groups.shape[2:])))
    return trained.replace(latent_mean=mean, latent_scale=spread)


def train_unet(config: UnicaConfig, data: Dataset, run: Run, start: LatentDynamics) -> LatentDynamics:
    """Diffusion training in the two stages of UNICA 3.6, as one run of steps.

    The first stage learns action embeddings and UNet; the second, on other groups (`group_batches`), freezes the
    embeddings.
    """
    stage = config.unet_stage
    groups_at = group_batches(config, data, run.seed)
    turns = (config.turn_window, config.turn_fraction, config.rotate)
    settings = (config.latent, config.vae_stage, config.unet_steady, *turns)

    def batch_at(step):
        return {"atlas": data.atlas, "frozen": start.replace(denoiser={}), **groups_at(step)}

    def loss(params, key, batch):
        table = params["action_table"]["embedding"]
        table = jnp.where(batch["steady"], table, jax.lax.stop_gradient(table))
        dynamics = batch["frozen"].replace(denoiser={**params, "action_table": {"embedding": table}})
        groups, actions = batch["groups"], batch["actions"]
        return latent.diffusion_loss(config.latent, batch["atlas"], dynamics, key, groups, actions), {}

    def hold(new, old, batch):
        table = jnp.where(batch["steady"], new["action_table"]["embedding"], old["action_table"]["embedding"])
        return {**new, "action_table": {"embedding": table}}

    return start.replace(denoiser=train_stage(run, "unet", stage, settings, loss, start.denoiser, batch_at, hold))


def coefficient_frames(data: Dataset, recording: typing.Any) -> tuple[np.ndarray, np.ndarray]:
    """Canonical vectors (f, 3t) and roots (f, 3) of a recording, headings unwrapped along each sequence."""
    world = jnp.asarray(recording.texels + recording.roots[:, None])
    flat, roots = jax.jit(jax.vmap(lambda x: coefficients.canonical(data.atlas, x)))(world)
    roots = np.array(roots)
    for sequence in np.unique(recording.sequence):
        rows = recording.sequence == sequence
        roots[rows, 2] = np.unwrap(roots[rows, 2])
    return np.asarray(flat), roots


def train_coefficients(config: UnicaConfig, data: Dataset, run: Run) -> CoefficientDynamics:
    """The coefficient model: closed-form fits, denoising steps, and after 30 % of them also rollout training."""
    settings, stage = config.coefficients, config.coefficients_stage
    flat, roots = coefficient_frames(data, data.train)
    basis = pcs.fit(jnp.asarray(flat), settings.components, run.key("coefficient basis"))
    poses = np.asarray(pcs.project(basis, jnp.asarray(flat)))
    yaw, moves = closed_form.action_directions(roots, data.train.actions, data.train.sequence, config.actions)
    start = CoefficientDynamics(
        params=functional.init(CoefficientDenoiser, settings, run.key("coefficients")),
        basis=basis,
        scaling=closed_form.coefficient_scaling(poses, roots, data.train.sequence),
        action_yaw=jnp.asarray(yaw, jnp.float32),
        action_moves=jnp.asarray(moves, jnp.float32),
    )
    single = batches.windows(data.train, 4, config.turn_window)
    long = batches.windows(data.train, 3 + settings.rollout_frames, config.turn_window)
    # A long window is worth oversampling when the turn is in its middle.
    near_turn = sequences.turning(data.train.actions, data.train.sequence, config.turn_window)
    long_turning = near_turn[long.first + 3 + settings.rollout_frames // 2]

    everything = single.frames(np.arange(len(single.first)))
    known = Context(jnp.asarray(poses[everything[:, :3]]), jnp.asarray(roots[everything[:, :3]]))
    wanted = jnp.asarray(poses[everything[:, 3]]), jnp.asarray(roots[everything[:, 3]])
    linear = closed_form.ridge_start(settings, start, known, *wanted, run.key("ridge"))

    def windows_at(windows, turning, count, rng):
        chosen = batches.draw(np.ones_like(turning), turning, config.turn_fraction, count, rng)
        frames = windows.frames(chosen)
        # Positions start at the origin: far from it, float32 would round a step away.
        ground = np.append(roots[frames[:, 2], :2], np.zeros((count, 1), np.float32), axis=1)
        actions = data.train.actions[frames[:, 2:-1]]
        return {"poses": poses[frames], "roots": roots[frames] - ground[:, None], "actions": actions}

    def batch_at(step):
        rng = batches.generator(run.seed, step)
        return {
            "frozen": start.replace(params={}),
            "single": windows_at(single, single.turning, stage.batch, rng),
            "long": windows_at(long, long_turning, max(1, stage.batch // 8), rng),
            "rolling": np.bool_(step >= settings.single_share * stage.steps),
        }

    def loss(params, key, batch):
        dynamics = batch["frozen"].replace(params=params)
        noise_key, one_key, roll_key = jax.random.split(key, 3)
        one, many = batch["single"], batch["long"]
        context, level = coefficients.noised_context(
            settings, dynamics.scaling, noise_key, Context(one["poses"][:, :3], one["roots"][:, :3])
        )
        single_loss = coefficients.denoising_loss(
            settings,
            dynamics,
            one_key,
            context,
            level,
            one["poses"][:, 3],
            one["roots"][:, 3],
            one["actions"][:, 0],
        )

        def rolled(_):
            return coefficients.rollout_loss(
                settings,
                dynamics,
                roll_key,
                Context(many["poses"][:, :3], many["roots"][:, :3]),
                many["poses"][:, 3:],
                many["roots"][:, 3:],
                many["actions"],
            )

        roll_loss = jax.lax.cond(batch["rolling"], rolled, lambda _: single_loss, None)
        return 0.5 * (single_loss + roll_loss), {"single": single_loss, "rollout": roll_loss}

    trained = start.replace(params=train_stage(run, "coefficients", stage, settings.rough, loss, linear, batch_at))
    actions = data.train.actions[everything[:, 2]]
    held = closed_form.fit_stance(
        settings, trained, data.train, data.standing, known, *wanted, actions, run.key("stance")
    )
    return trained.replace(stance=held)


def fit_alignment(config: UnicaConfig, data: Dataset, run: Run) -> pcs.PCA:
    """The PCA of normalised fourth maps (UNICA B.2)."""
    windows = batches.windows(data.train, 4, config.turn_window)
    frames = windows.frames(np.arange(len(windows.first)))
    shift = data.train.roots[frames[:, 3]] - data.train.roots[frames[:, 2]]
    fourth = batches.frame_images(data.train.texels[frames[:, 3]], shift, float(data.atlas.scale))
    return closed_form.alignment_basis(jnp.asarray(fourth), config.pca_components, run.key("pca"))
