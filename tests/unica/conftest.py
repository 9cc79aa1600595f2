"""The smallest networks, and avatars of both models that are put together without training."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import posmap
from avatarjax.nets.point_transformer import PointTransformerConfig
from avatarjax.posmap import pca as pcs
from avatarjax.train import StageConfig
from avatarjax.unica import Avatar, appearance, batches, fit, texel_head, train, train_appearance
from avatarjax.unica.appearance import AppearanceConfig, AppearanceNetwork
from avatarjax.unica.coefficients import CoefficientConfig, CoefficientDenoiser, CoefficientDynamics
from avatarjax.unica.config import DataConfig, UnicaConfig
from avatarjax.unica.denoiser import Denoiser, DenoiserConfig
from avatarjax.unica.latent import LatentConfig, LatentDynamics
from avatarjax.unica.texel_head import TexelHead, TexelHeadConfig
from avatarjax.unica.vae import VAE, VAEConfig
from tests.parameters import random_params

# The same steps everywhere: what one test has compiled serves others.
FEW = StageConfig(3, 2, 1e-3)
TINY = UnicaConfig(
    size=32,
    upscaled=64,
    pca_components=16,
    dynamics="coefficients",
    appearance_model="texels",
    texel_head=TexelHeadConfig(code=4, width=8),
    data=DataConfig(60, 60, 2, 2, 2, 32),
    latent=LatentConfig(
        vae=VAEConfig(channels=(8, 16), residual_blocks=1),
        denoiser=DenoiserConfig(channels=(16, 16), residual_blocks=1, head_width=8, action_features=8),
        sample_steps=2,
    ),
    coefficients=CoefficientConfig(components=12, width=24, depth=1, condition=16, sample_steps=2, rollout_frames=2),
    appearance=AppearanceConfig(
        transformer=PointTransformerConfig(
            encoder_channels=(8, 16),
            encoder_depths=(1, 1),
            encoder_heads=(2, 2),
            strides=(2,),
            decoder_channels=(8,),
            decoder_depths=(1,),
            decoder_heads=(2,),
            patch=64,
            grid=32,
            expansion=2,
        ),
        head_width=8,
        head_layers=2,
        offset_bound=0.05,
    ),
    views_per_step=2,
    vae_stage=FEW,
    unet_stage=FEW,
    coefficients_stage=dataclasses.replace(FEW, ema=0.9, batch=8),
    base_stage=FEW,
    appearance_stage=FEW,
    texels_stage=FEW,
)


fit_basis = jax.jit(pcs.fit, static_argnums=1)


@pytest.fixture(scope="session")
def config():
    return TINY


@pytest.fixture(scope="session")
def upscaler(tiny_data):
    return posmap.build_upscaler(tiny_data.atlas, TINY.upscaled)


@pytest.fixture(scope="session")
def base(tiny_data, upscaler):
    """Base attributes of many colours and turns, as if trained."""
    points, side = jax.jit(train_appearance.boxed_points)(upscaler, jnp.asarray(tiny_data.standing_images.texels[0]))
    rng = np.random.default_rng(0)
    n = len(points)
    return appearance.initial_base(points, side).replace(
        quats=jnp.asarray(rng.normal(size=(n, 4)), jnp.float32), colors=jnp.asarray(rng.random((n, 3)), jnp.float32)
    )


@pytest.fixture(scope="session")
def coefficient_frames(tiny_data):
    """Canonical vectors (f, 3t) and roots (f, 3) of the training recording."""
    return train.coefficient_frames(tiny_data, tiny_data.train)


@pytest.fixture(scope="session")
def coefficient_dynamics(tiny_data, coefficient_frames):
    """Basis and scaling from the data, network parameters at random."""
    flat, roots = coefficient_frames
    basis = fit_basis(jnp.asarray(flat), TINY.coefficients.components, jax.random.key(1))
    poses = np.asarray(pcs.project(basis, jnp.asarray(flat)))
    return CoefficientDynamics(
        params=random_params(CoefficientDenoiser, TINY.coefficients, scale=0.1),
        basis=basis,
        scaling=fit.coefficient_scaling(poses, roots, tiny_data.train.sequence),
        action_yaw=jnp.asarray([0.0, 0.0, np.pi, np.pi / 2, -np.pi / 2], jnp.float32),
        action_moves=jnp.asarray([0.0, 1, 1, 1, 1]),
    )


@pytest.fixture(scope="session")
def latent_dynamics(tiny_data):
    """Statistics like the data's, network parameters at random, outputs small enough to stay near the body."""
    standing = posmap.normalize(tiny_data.atlas, tiny_data.standing, posmap.root(tiny_data.atlas, tiny_data.standing))
    return LatentDynamics(
        vae=random_params(VAE, TINY.latent.vae, scale=0.2),
        denoiser=random_params(Denoiser, TINY.latent.denoiser, seed=1, scale=0.3),
        map_mean=standing,
        map_scale=jnp.asarray(0.03),
        latent_mean=jnp.asarray([0.1, -0.2, 0.0, 0.3]),
        latent_scale=jnp.asarray([1.0, 2.0, 0.5, 1.5]),
    )


@pytest.fixture(scope="session")
def head(tiny_data):
    """Parameters of the texel head at random."""
    params = texel_head.init(TINY.texel_head, len(tiny_data.atlas.rows), jax.random.key(5))
    return params | {"network": random_params(TexelHead, TINY.texel_head, scale=0.3)}


@pytest.fixture(scope="session")
def avatars(tiny_data, upscaler, base, head, coefficient_dynamics, latent_dynamics):
    """An avatar of each model by the model's name; untrained, so what they do is wild but well defined.

    The coefficient model goes with the texel head, the UNet with alignment and point transformer.
    """
    windows = batches.windows(tiny_data.train, 4, TINY.turn_window)
    groups, _ = windows.groups(np.arange(0, len(windows.first), 4), float(tiny_data.atlas.scale))
    fourth = jnp.asarray(groups[:, 3])
    parts = {
        "atlas": tiny_data.atlas,
        "upscaler": upscaler,
        "tangents": posmap.tangents(tiny_data.atlas),
        "base": base,
        "standing": tiny_data.standing,
    }
    paper = {
        "pca": fit_basis(fourth.reshape(len(fourth), -1), TINY.pca_components, jax.random.key(2)),
        "appearance": random_params(AppearanceNetwork, TINY.appearance, scale=0.1),
        "config": dataclasses.replace(TINY, dynamics="unet", appearance_model="point_transformer"),
    }
    return {
        "coefficients": Avatar(dynamics=coefficient_dynamics, appearance=head, pca=None, config=TINY, **parts),
        "unet": Avatar(dynamics=latent_dynamics, **parts, **paper),
    }


@pytest.fixture(params=["coefficients", "unet"])
def avatar(request, avatars):
    return avatars[request.param]
