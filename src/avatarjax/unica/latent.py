"""The faithful dynamics: latent diffusion of the next position map by the action-conditioned UNet (UNICA 3.4, 3.6)."""

from __future__ import annotations

import dataclasses
import typing

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from avatarjax import posmap
from avatarjax.diffusion import samplers, schedules
from avatarjax.nets.functional import Params, bind
from avatarjax.posmap import Atlas
from avatarjax.unica.denoiser import Denoiser, DenoiserConfig
from avatarjax.unica.vae import VAE, VAEConfig, kl_divergence, sample_latent

CONTEXT = 3  # frames of a state; a network may look at fewer of them


@dataclasses.dataclass(frozen=True)
class LatentConfig:
    """Autoencoder, UNet and diffusion. Where the paper is silent, the comment says whose choice a value is."""

    vae: VAEConfig = VAEConfig()
    denoiser: DenoiserConfig = DenoiserConfig()
    kl_weight: float = 1e-6  # ours; Stable Diffusion's
    schedule: schedules.ScheduleName = "scaled_linear"  # code
    train_timesteps: int = 1000  # code
    sample_steps: int = 10  # paper
    guidance: float = 1.0  # code
    action_dropout: float = 0.1  # ours; usual for guidance
    context_noise: float = 0.1  # ours; the largest standard deviation, in units of the latents'
    clean_contexts: float = 0.3  # code; share of the samples whose context has no noise
    noise_offset: float = 0.0  # ours; noise of this size that all places of a channel share, in training
    from_last: bool = False  # ours; the network's output is the change from frame t, from which the noise follows
    min_snr: float = (
        0.0  # ours; weight the loss by min(SNR, this) / SNR (Hang et al. 2023); 0 is the paper's plain loss
    )


@typing.no_type_check
@flax.struct.dataclass
class LatentDynamics:
    """Trained weights of autoencoder and UNet, and the statistics that bring maps and latents to unit size.

    map_mean (t, 3) and map_scale () of normalised texels; latent_mean, latent_scale (l,).
    """

    vae: Params
    denoiser: Params
    map_mean: Float[Array, "t 3"]
    map_scale: Float[Array, ""]
    latent_mean: Float[Array, "l"]
    latent_scale: Float[Array, "l"]


@typing.runtime_checkable
class MapStatistics(typing.Protocol):
    """Whatever knows the mean (t, 3) and the size () of the deviation from it of normalised texels."""

    @property
    def map_mean(self) -> Float[Array, "t 3"]: ...

    @property
    def map_scale(self) -> Float[Array, ""]: ...


def to_images(atlas: Atlas, dynamics: MapStatistics, texels: Float[Array, "b t 3"]) -> Float[Array, "b h w 3"]:
    """Normalised texels as the autoencoder's input: their deviation from the mean map, of unit size, background 0.

    The deviation is ours: the mean map is the same in every frame, and a network that must also paint it, with its
    silhouette against the background, spends most of its training on that.
    """
    deviation = (texels - dynamics.map_mean[None]) / dynamics.map_scale
    return jax.vmap(lambda x: posmap.to_map(atlas, x))(deviation)


def from_images(atlas: Atlas, dynamics: MapStatistics, images: Float[Array, "b h w 3"]) -> Float[Array, "b t 3"]:
    """The inverse of `to_images` on the foreground."""
    deviation = jax.vmap(lambda x: posmap.from_map(atlas, x))(images)
    return deviation * dynamics.map_scale + dynamics.map_mean[None]


def vae_loss(
    config: LatentConfig, atlas: Atlas, dynamics: LatentDynamics, key: Key[Array, ""], texels: Float[Array, "b t 3"]
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Reconstruction on the foreground plus weighted KL divergence (UNICA 3.6), and the error in normalised units."""
    vae = bind(VAE, config.vae, dynamics.vae)
    mean, log_variance = vae.encode(to_images(atlas, dynamics, texels))
    decoded = from_images(atlas, dynamics, vae.decode(sample_latent(mean, log_variance, key)))
    squared = jnp.mean((decoded - texels) ** 2)
    kl = kl_divergence(mean, log_variance)
    return squared / dynamics.map_scale**2 + config.kl_weight * kl, {"rmse": jnp.sqrt(squared), "kl": kl}


def encode(
    config: LatentConfig, atlas: Atlas, dynamics: LatentDynamics, texels: Float[Array, "b t 3"]
) -> Float[Array, "b u v l"]:
    """Latent means of unit size."""
    mean, _ = bind(VAE, config.vae, dynamics.vae).encode(to_images(atlas, dynamics, texels))
    shape = (1, 1, 1, -1)
    return (mean - dynamics.latent_mean.reshape(shape)) / dynamics.latent_scale.reshape(shape)


def decode(
    config: LatentConfig, atlas: Atlas, dynamics: LatentDynamics, latents: Float[Array, "b u v l"]
) -> Float[Array, "b t 3"]:
    """Normalised texels of unit-size latents."""
    shape = (1, 1, 1, -1)
    latents = latents * dynamics.latent_scale.reshape(shape) + dynamics.latent_mean.reshape(shape)
    return from_images(atlas, dynamics, bind(VAE, config.vae, dynamics.vae).decode(latents))


def diffusion_loss(
    config: LatentConfig,
    atlas: Atlas,
    dynamics: LatentDynamics,
    key: Key[Array, ""],
    groups: Float[Array, "b 4 t 3"],
    action: Int[Array, "b"],
) -> Float[Array, ""]:
    """Epsilon loss on the fourth frame, with context noise and action dropout (UNICA Eq. 5 and 3.6)."""
    time_key, noise_key, drop_key, context_key = jax.random.split(key, 4)
    groups = groups[:, -config.denoiser.frames :]
    b, frames, t, _ = groups.shape
    latents = encode(config, atlas, dynamics, groups.reshape(b * frames, t, 3))
    latents = jax.lax.stop_gradient(latents).reshape(b, frames, *latents.shape[1:])
    context, target = latents[:, :-1], latents[:, -1]

    context = context + _context_noise(config, context_key, context.shape)
    timestep = jax.random.randint(time_key, (b,), 0, config.train_timesteps)
    noise = _noise(config, noise_key, target.shape)
    signal = schedules.alphas_cumprod(config.schedule, config.train_timesteps)
    noisy = schedules.add_noise(signal, target, noise, timestep)
    dropped = jax.random.uniform(drop_key, (b,)) < config.action_dropout
    action = jnp.where(dropped, config.denoiser.null_action, action)
    predicted = _predict_noise(config, dynamics, context, noisy, timestep, action)
    weight = jnp.ones(b)
    if config.min_snr > 0:
        snr = signal[timestep] / (1 - signal[timestep])
        weight = jnp.minimum(snr, config.min_snr) / snr
    return jnp.mean(weight * jnp.mean((predicted - noise) ** 2, axis=(1, 2, 3)))


def _context_noise(config: LatentConfig, key: Key[Array, ""], shape: tuple[int, ...]) -> Float[Array, "b c u v l"]:
    """Noise of an own level for each frame of each context, and none for a share of the contexts (UNICA 3.6)."""
    level_key, clean_key, noise_key = jax.random.split(key, 3)
    level = config.context_noise * jax.random.uniform(level_key, (*shape[:2], 1, 1, 1))
    clean = jax.random.uniform(clean_key, (shape[0], 1, 1, 1, 1)) < config.clean_contexts
    return jnp.where(clean, 0.0, level) * jax.random.normal(noise_key, shape)


def _noise(config: LatentConfig, key: Key[Array, ""], shape: tuple[int, ...]) -> Float[Array, "b u v l"]:
    """Unit noise, with the offset of each channel where the configuration asks for one."""
    noise = jax.random.normal(key, shape)
    if config.noise_offset == 0:
        return noise
    offset = jax.random.normal(jax.random.fold_in(key, 1), (shape[0], 1, 1, shape[-1]))
    return noise + config.noise_offset * offset


def _predict_noise(
    config: LatentConfig,
    dynamics: LatentDynamics,
    context: Float[Array, "b c u v l"],
    noisy: Float[Array, "b u v l"],
    timestep: Int[Array, "b"],
    action: Int[Array, "b"],
) -> Float[Array, "b u v l"]:
    """The network's epsilon for a noisy fourth frame beside its context (UNICA Eq. 4)."""
    network = bind(Denoiser, config.denoiser, dynamics.denoiser)
    output = network(jnp.concatenate([context, noisy[:, None]], axis=1), timestep, action)
    if not config.from_last:
        return output
    signal = schedules.alphas_cumprod(config.schedule, config.train_timesteps)[timestep].reshape(-1, 1, 1, 1)
    clean = context[:, -1] + output
    return (noisy - jnp.sqrt(signal) * clean) / jnp.sqrt(1 - signal)


def sample(
    config: LatentConfig,
    atlas: Atlas,
    dynamics: LatentDynamics,
    key: Key[Array, ""],
    context: Float[Array, "b 3 t 3"],
    action: Int[Array, "b"],
) -> Float[Array, "b t 3"]:
    """The next frame's normalised texels from three normalised frames, by DDIM (UNICA 3.7)."""
    context = context[:, -config.denoiser.context :]
    b, frames, t, _ = context.shape
    latents = encode(config, atlas, dynamics, context.reshape(b * frames, t, 3))
    latents = latents.reshape(b, frames, *latents.shape[1:])

    def predictor(action):
        return lambda x, tau: _predict_noise(config, dynamics, latents, x, jnp.full(b, tau), action)

    start = jax.random.normal(key, (b, *latents.shape[2:]))
    nobody = jnp.full_like(action, config.denoiser.null_action)
    clean = samplers.ddim(
        samplers.guided(predictor(action), predictor(nobody), config.guidance),
        start,
        schedules.alphas_cumprod(config.schedule, config.train_timesteps),
        schedules.ddim_timesteps(config.train_timesteps, config.sample_steps),
    )
    return decode(config, atlas, dynamics, clean)
