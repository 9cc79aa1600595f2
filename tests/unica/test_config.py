import dataclasses
import json

import pytest

from avatarjax.io import weights
from avatarjax.nets import functional
from avatarjax.unica import PRESETS, UnicaConfig, preset
from avatarjax.unica.appearance import AppearanceNetwork
from avatarjax.unica.denoiser import Denoiser
from avatarjax.unica.vae import VAE


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_can_be_made_and_is_hashable(name):
    assert hash(preset(name)) == hash(preset(name))


@pytest.mark.parametrize("name", PRESETS)
def test_a_config_survives_json(name):
    config = preset(name)
    assert weights.from_dict(UnicaConfig, json.loads(json.dumps(dataclasses.asdict(config)))) == config


def test_fields_of_a_preset_can_be_replaced():
    assert preset("ci", turn_fraction=0.5) == dataclasses.replace(preset("ci"), turn_fraction=0.5)


def test_an_unknown_preset_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"'huge'.*ci, small, base, paper"):
        preset("huge")


@pytest.mark.parametrize("sizes", [{"size": 48}, {"size": 30}])
def test_maps_that_cannot_be_halved_are_refused(sizes):
    with pytest.raises(ValueError, match=f"side {sizes['size']} cannot be halved"):
        UnicaConfig(**sizes)


def test_upscaled_maps_must_be_multiples():
    with pytest.raises(ValueError, match="upscaled side 200 must be a multiple of the map's side 128"):
        UnicaConfig(upscaled=200)


@pytest.mark.parametrize("name", PRESETS)
def test_the_latent_of_vae_and_unet_is_the_same(name):
    latent = preset(name).latent
    assert latent.vae.latent_channels == latent.denoiser.latent_channels == 4


@pytest.mark.parametrize(
    "name, vae, unet, appearance",
    [("base", (1e7, 4e7), (5e7, 3e8), (4e7, 5e7)), ("paper", (6e7, 1e8), (7e8, 1.6e9), (4e7, 5e7))],
)
def test_large_networks_have_the_parameters_of_their_kind(name, vae, unet, appearance):
    """Stable Diffusion 1.5's autoencoder has 84 million; its UNet 860 million, without temporal attention."""
    config = preset(name)
    counts = {
        "VAE": (functional.count(functional.shapes(VAE, config.latent.vae)), vae),
        "UNet": (functional.count(functional.shapes(Denoiser, config.latent.denoiser)), unet),
        "appearance": (functional.count(functional.shapes(AppearanceNetwork, config.appearance)), appearance),
    }
    for network, (count, (low, high)) in counts.items():
        print(f"{name} {network}: {count / 1e6:.1f} million parameters")
        assert low < count < high, network
