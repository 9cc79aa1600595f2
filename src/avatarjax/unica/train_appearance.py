"""The trained stages of UNICA's appearance: base attributes, point transformer (B.1, C.2), and our texel head."""

from __future__ import annotations

import typing
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from avatarjax import posmap
from avatarjax.data.dataset import Dataset, cylinder_cameras
from avatarjax.gaussians import Gaussians
from avatarjax.metrics import lpips
from avatarjax.nets import functional
from avatarjax.nets.functional import Params
from avatarjax.train import Run, train_stage
from avatarjax.unica import appearance, batches, photometric, texel_head
from avatarjax.unica.avatar import in_box
from avatarjax.unica.config import StageConfig, UnicaConfig

# The base attributes that training changes.
_LEARNED = ("log_scales", "quats", "logit_opacities", "colors")


def boxed_points(upscaler: posmap.Upscaler, texels: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Upscaled points (n, 3) of a pose in its box, and the box' side in the texels' unit (UNICA B.1)."""
    points = posmap.upscale(upscaler, texels)
    box = posmap.bounding_box(points)
    return posmap.into_box(box, points), box.side


def train_base(
    config: UnicaConfig,
    data: Dataset,
    run: Run,
    upscaler: posmap.Upscaler,
    perceptual: lpips.Network | None = None,
) -> appearance.BaseAttributes:
    """The base attribute map on the standing pose's 50 views, with frozen means (UNICA B.1).

    Without a `perceptual` network the loss has no LPIPS term.
    """
    stage, images = config.base_stage, data.standing_images
    cameras = cylinder_cameras(images.rgba.shape[-2])
    points, side = boxed_points(upscaler, jnp.asarray(images.texels[0]))
    start = appearance.initial_base(points, side)
    splat = photometric.splat_config(appearance.coarse_gaussians(start, points, side), cameras)

    def batch_at(step):
        rng = batches.generator(run.seed, step)
        slots = rng.choice(images.view.shape[1], min(stage.batch, images.view.shape[1]), replace=False)
        return {
            "points": points,
            "height": side,
            "perceptual": perceptual,
            "views": photometric.pick_views(cameras, images.view[0, slots]),
            "rgba": images.rgba[0, slots],
            "white": np.float32(rng.integers(2)),
        }

    def loss(params, key, batch):
        base = appearance.BaseAttributes(**params, height=batch["height"])
        cloud = appearance.coarse_gaussians(base, batch["points"], batch["height"])
        return photometric.loss(
            config, cloud, batch["views"], batch["rgba"], batch["white"], splat, batch["perceptual"]
        )

    initial = {name: getattr(start, name) for name in _LEARNED}
    settings = photometric.settings(config, perceptual)
    trained = train_stage(run, "base", stage, settings, loss, initial, batch_at)
    return start.replace(**trained)


def train_appearance(
    config: UnicaConfig,
    data: Dataset,
    run: Run,
    upscaler: posmap.Upscaler,
    base: appearance.BaseAttributes,
    perceptual: lpips.Network | None = None,
) -> Params:
    """The point transformer on training poses and random views of each (UNICA B.1, C.2).

    Without a `perceptual` network the loss has no LPIPS term.
    """
    network = config.appearance

    def dressed(params, fixed, texels, key):
        points, side = boxed_points(fixed["upscaler"], texels)
        worn = fixed["base"]
        if network.turn:
            worn = appearance.turned_base(worn, fixed["tangents"], fixed["standing"], texels)
        coarse = appearance.coarse_gaussians(worn, points, side)
        refined = appearance.refine(network, params, coarse, key if network.transformer.shuffle else None)
        return refined, {"overflow": appearance.overflow(network, points).astype(jnp.float32)}

    initial = functional.init(appearance.AppearanceNetwork, network, run.key("appearance"))
    fixed = {"upscaler": upscaler, "base": base, "tangents": posmap.tangents(data.atlas), "standing": data.standing}
    stage, settings = config.appearance_stage, (network, config.base_stage)
    poses = data.train_images.texels
    return _train_on_poses(config, data, run, "appearance", stage, settings, initial, fixed, poses, dressed, perceptual)


def train_texels(
    config: UnicaConfig,
    data: Dataset,
    run: Run,
    upscaler: posmap.Upscaler,
    base: appearance.BaseAttributes,
    perceptual: lpips.Network | None = None,
    *,
    surfaces: Float[np.ndarray, "p t 3"] | None = None,
) -> tuple[Params, appearance.BaseAttributes]:
    """The texel head, in the same way and with the same loss as the point transformer, and base attributes with it.

    The base attributes have seen only the standing pose until then; what it hides, other poses show. The head sees
    the pictured surfaces or, for a baseline that does not know them, the given ones, metres relative to the same roots.
    """
    seen = data.train_images.texels if surfaces is None else surfaces

    def dressed(params, fixed, pose, key):
        pictured, texels = pose
        box = posmap.bounding_box(posmap.upscale(fixed["upscaler"], pictured))
        worn = fixed["base"].replace(**params["base"])
        surface = fixed["upscaler"], fixed["tangents"], fixed["standing"]
        cloud = texel_head.wear(config.texel_head, params["head"], worn, *surface, texels, jnp.zeros(3))
        return in_box(cloud, box), {}

    initial = {
        "head": texel_head.init(config.texel_head, len(data.atlas.rows), run.key("texels")),
        "base": {name: getattr(base, name) for name in _LEARNED},
    }
    fixed = {"upscaler": upscaler, "base": base, "tangents": posmap.tangents(data.atlas), "standing": data.standing}
    stage, settings = config.texels_stage, (config.texel_head, config.base_stage)
    poses = data.train_images.texels, seen
    trained = _train_on_poses(config, data, run, "texels", stage, settings, initial, fixed, poses, dressed, perceptual)
    return trained["head"], base.replace(**trained["base"])


def _train_on_poses(
    config: UnicaConfig,
    data: Dataset,
    run: Run,
    name: str,
    stage: StageConfig,
    settings: tuple[typing.Any, ...],
    initial: Params,
    fixed: dict[str, typing.Any],
    inputs: typing.Any,
    dressed: Callable[[Params, dict[str, typing.Any], typing.Any, jax.Array], tuple[Gaussians, dict[str, jax.Array]]],
    perceptual: lpips.Network | None,
) -> Params:
    """Train what makes Gaussians in the box of a pose, and metrics, from parameters, `fixed`, a pose and a key.

    `inputs` are the pictured poses, a pytree of arrays (p, ...).
    """
    images = data.train_images
    cameras = cylinder_cameras(images.rgba.shape[-2])
    cloud, _ = jax.jit(dressed)(initial, fixed, jax.tree.map(lambda x: jnp.asarray(x[0]), inputs), run.key(name))
    splat = photometric.splat_config(cloud, cameras)
    k = min(config.views_per_step, images.view.shape[1])

    def batch_at(step):
        rng = batches.generator(run.seed, step)
        poses = rng.choice(len(images.texels), stage.batch, replace=len(images.texels) < stage.batch)
        slots = np.stack([rng.permutation(images.view.shape[1])[:k] for _ in poses])
        return {
            "fixed": fixed,
            "perceptual": perceptual,
            "poses": jax.tree.map(lambda x: x[poses], inputs),
            "views": photometric.pick_views(cameras, images.view[poses[:, None], slots]),
            "rgba": images.rgba[poses[:, None], slots],
            "white": rng.integers(0, 2, stage.batch).astype(np.float32),
        }

    def loss(params, key, batch):
        # The network runs outside the loop over poses: inside one, XLA's CPU backend uses a single core.
        clouds, watched = jax.vmap(lambda pose: dressed(params, batch["fixed"], pose, key))(batch["poses"])
        value, metrics = jax.lax.map(
            lambda pose: photometric.loss(config, *pose, splat, batch["perceptual"]),
            (clouds, batch["views"], batch["rgba"], batch["white"]),
        )
        return jnp.mean(value), jax.tree.map(jnp.mean, metrics | watched)

    settings = (*settings, config.views_per_step, *photometric.settings(config, perceptual))
    return train_stage(run, name, stage, settings, loss, initial, batch_at)
