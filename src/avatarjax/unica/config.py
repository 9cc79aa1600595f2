"""Every size and number of a UNICA run, as one frozen dataclass with presets by name.

Presets run the same code with different numbers: `ci` in minutes on two CPU cores, `small` is the default on a CPU,
`base` is for one GPU, `paper` is UNICA C.1 and C.2 in full. A comment says whose a value is where it is not the
paper's.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Callable

from avatarjax.nets.point_transformer import PointTransformerConfig
from avatarjax.train import StageConfig
from avatarjax.unica.appearance import AppearanceConfig
from avatarjax.unica.coefficients import CoefficientConfig
from avatarjax.unica.denoiser import DenoiserConfig
from avatarjax.unica.latent import LatentConfig
from avatarjax.unica.texel_head import TexelHeadConfig
from avatarjax.unica.vae import VAEConfig

AppearanceName = typing.Literal["texels", "point_transformer"]
DynamicsName = typing.Literal["coefficients", "unet"]
PresetName = typing.Literal["ci", "small", "base", "paper"]


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """What is simulated and rendered. The paper has 6,253 frames an avatar and renders every one in 50 views."""

    transition_frames: int | None = None  # of each of the 20 transitions; None: those of UNICA Table A
    held_out_frames: int | None = 150
    image_poses: int = 6253
    image_views: int = 50
    standing_views: int = 50
    image_size: int = 1024
    cloth_steps: int = 32  # ours
    scripts: typing.Literal["transitions", "chains"] = "transitions"  # ours: chains turn several times as often
    vertices: typing.Literal["none", "float16", "float32"] = "none"  # ours


@dataclasses.dataclass(frozen=True)
class UnicaConfig:
    """A whole run. `dynamics` and `appearance_model` name the models behind `step`; the other two are trained as well
    where `train_both` is set."""

    size: int = 128
    upscaled: int = 1024
    pca_components: int = 200
    actions: int = 5
    dynamics: DynamicsName = "unet"
    train_both: bool = False
    data: DataConfig = DataConfig()
    latent: LatentConfig = LatentConfig()
    coefficients: CoefficientConfig = CoefficientConfig()
    appearance_model: AppearanceName = "point_transformer"
    appearance: AppearanceConfig = AppearanceConfig()
    texel_head: TexelHeadConfig = TexelHeadConfig()  # ours
    turn_window: tuple[int, int] = (0, 25)  # frames after a key change that count as turning; code: (-5, 40)
    turn_fraction: float = 0.7  # of the second stage's samples
    rotate: bool = False  # ours; autoencoder and UNet learn from groups turned by quarters, their keys turned too
    views_per_step: int = 8
    loss_l1: float = 0.8  # ours; 3DGS' weights, the paper gives none
    loss_ssim: float = 0.2
    loss_lpips: float = 0.1  # ours; 0 or weights that were not fetched: no such term
    lpips_views: int = 8  # of a step's views, those that LPIPS looks at; ours: the others spare its cost
    lpips_network: typing.Literal["alex", "vgg"] = "vgg"  # ours; the paper names none
    vae_stage: StageConfig = StageConfig(300_000, 32, 1.5e-5)
    unet_stage: StageConfig = StageConfig(300_000, 32, 5e-5)
    unet_steady: float = 1 / 3  # of the UNet's steps are its first stage, on steady movement only
    coefficients_stage: StageConfig = StageConfig(30_000, 128, 1e-3, ema=0.998)  # ours
    base_stage: StageConfig = StageConfig(3_000, 8, 1e-2)  # ours
    appearance_stage: StageConfig = StageConfig(15_600, 8, 1e-4)
    texels_stage: StageConfig = StageConfig(10_000, 8, 5e-3)  # ours

    def __post_init__(self):
        side = self.size // self.latent.vae.downsampling
        if self.size % 32 or side % 2 ** (len(self.latent.denoiser.channels) - 1):
            raise ValueError(f"a map of side {self.size} cannot be halved as often as the networks do")
        if self.upscaled % self.size:
            raise ValueError(f"upscaled side {self.upscaled} must be a multiple of the map's side {self.size}")


def _base() -> UnicaConfig:
    return UnicaConfig(
        upscaled=512,
        data=DataConfig(image_poses=1500, image_views=12, image_size=512),
        latent=LatentConfig(
            vae=VAEConfig(channels=(64, 128, 256, 256)),
            denoiser=DenoiserConfig(channels=(128, 256, 512, 512), head_width=64, action_features=256),
        ),
        vae_stage=StageConfig(30_000, 32, 1e-4),
        unet_stage=StageConfig(90_000, 32, 1e-4),
        base_stage=StageConfig(2_000, 8, 1e-2),
        appearance_stage=StageConfig(8_000, 4, 2e-4),
        texels_stage=StageConfig(6_000, 4, 5e-3),
    )


def _small() -> UnicaConfig:
    return UnicaConfig(
        size=64,
        upscaled=256,
        pca_components=120,
        dynamics="coefficients",
        appearance_model="texels",
        data=DataConfig(
            transition_frames=300,
            image_poses=160,
            image_views=8,
            standing_views=50,
            image_size=256,
            scripts="chains",
        ),
        latent=LatentConfig(
            vae=VAEConfig(channels=(32, 64, 128), residual_blocks=1, positions=64),
            denoiser=DenoiserConfig(channels=(64, 128, 256), residual_blocks=1, head_width=32, action_features=128),
            from_last=True,
            min_snr=5.0,
        ),
        coefficients=CoefficientConfig(components=96),
        appearance=AppearanceConfig(
            transformer=PointTransformerConfig(
                encoder_channels=(32, 64, 96),
                encoder_depths=(1, 1, 2),
                encoder_heads=(2, 4, 6),
                strides=(2, 2),
                decoder_channels=(32, 64),
                decoder_depths=(1, 1),
                decoder_heads=(2, 4),
                patch=128,
                grid=96,
                recompute=False,
                fill=2.0,
                expansion=2,
            ),
            head_width=64,
            head_layers=3,
            offset_bound=0.05,
        ),
        views_per_step=4,
        lpips_views=1,
        lpips_network="alex",
        vae_stage=StageConfig(3_000, 16, 3e-3),
        unet_stage=StageConfig(4_500, 8, 3e-4),
        coefficients_stage=StageConfig(6_000, 128, 1e-3, ema=0.998),
        base_stage=StageConfig(200, 4, 2e-2),
        appearance_stage=StageConfig(400, 1, 1e-3),
        texels_stage=StageConfig(800, 1, 5e-3),
    )


def _ci() -> UnicaConfig:
    return UnicaConfig(
        size=32,
        upscaled=128,
        pca_components=64,
        dynamics="coefficients",
        appearance_model="texels",
        train_both=True,
        data=DataConfig(
            transition_frames=120,
            held_out_frames=80,
            image_poses=48,
            image_views=6,
            standing_views=50,
            image_size=64,
            cloth_steps=12,
            scripts="chains",
        ),
        latent=LatentConfig(
            vae=VAEConfig(channels=(16, 32, 32), residual_blocks=1, positions=32),
            denoiser=DenoiserConfig(channels=(32, 64), residual_blocks=1, head_width=16, action_features=64),
            sample_steps=4,
            from_last=True,
            min_snr=5.0,
        ),
        coefficients=CoefficientConfig(components=32, width=192, depth=2, condition=64),
        appearance=AppearanceConfig(
            transformer=PointTransformerConfig(
                encoder_channels=(16, 32),
                encoder_depths=(1, 1),
                encoder_heads=(2, 4),
                strides=(2,),
                decoder_channels=(16,),
                decoder_depths=(1,),
                decoder_heads=(2,),
                patch=64,
                grid=48,
                recompute=False,
                fill=2.0,
                expansion=2,
            ),
            head_width=32,
            head_layers=2,
            offset_bound=0.05,
        ),
        views_per_step=4,
        lpips_views=1,
        lpips_network="alex",
        vae_stage=StageConfig(1_000, 8, 5e-3),
        unet_stage=StageConfig(700, 8, 1e-3),
        coefficients_stage=StageConfig(3_000, 128, 2e-3, ema=0.998),
        base_stage=StageConfig(150, 4, 3e-2),
        appearance_stage=StageConfig(300, 1, 2e-3),
        texels_stage=StageConfig(800, 1, 5e-3),
    )


PRESETS: dict[str, Callable[[], UnicaConfig]] = {
    "ci": _ci,
    "small": _small,
    "base": _base,
    "paper": UnicaConfig,
}


def preset(name: str, **changes: typing.Any) -> UnicaConfig:
    """The preset of this name with fields replaced; ValueError that lists the names for an unknown one."""
    if name not in PRESETS:
        raise ValueError(f"unknown preset {name!r}: choose one of {', '.join(PRESETS)}")
    return dataclasses.replace(PRESETS[name](), **changes)
