"""How an avatar looks beside pictures of the meshes: image quality, and the FVD of its rollout (UNICA 4.2, Table 2)."""

from __future__ import annotations

import typing

import jax
import numpy as np

from avatarjax import unica
from avatarjax.data import dataset
from avatarjax.data.dataset import Dataset
from avatarjax.metrics import fvd, i3d, lpips, pretrained, published
from avatarjax.metrics.report import Report
from avatarjax.metrics.statistics import Estimate, bootstrap
from avatarjax.unica import image_quality
from avatarjax.unica.config import AppearanceName

if typing.TYPE_CHECKING:
    from experiments.unica import Experiment

NEXT_FRAMES = 50  # of the script, in four views


def measure(
    experiment: Experiment,
    data: Dataset,
    dressed: dict[AppearanceName, unica.Avatar],
    plain: unica.Avatar,
    frames: unica.Frame,
) -> dict[str, typing.Any]:
    """PSNR, SSIM and LPIPS of pictured held-out poses and of next frames, and FVD of the rollout of the script.

    `dressed` are the avatars of the run by their appearance model, the one whose rollout this is first, and
    `plain` has the attributes of the base stage. What needs weights that were not fetched is None.
    """
    avatar = next(iter(dressed.values()))
    perceptual = lpips.load("alex") if pretrained.available("alex") else None
    pictures = dataset.truth_pictures(experiment.folder / "data")
    chosen = np.unique(np.linspace(image_quality.CONTEXT, len(pictures) - 1, NEXT_FRAMES).astype(int))
    key = jax.random.key(experiment.args.seed + 13)
    held = data.held_out_images
    generated = image_quality.video(avatar, frames.gaussians, frames.root, pictures.shape[2])
    return {
        "poses": {
            "base attributes": _summary(image_quality.appearance_quality(plain, held, perceptual, refined=False)),
            **{n: _summary(image_quality.appearance_quality(a, held, perceptual)) for n, a in dressed.items()},
        },
        "next frame": _summary(image_quality.next_frame_quality(avatar, data.truth, pictures, chosen, key, perceptual)),
        "fvd": _fvd(generated, image_quality.truth_video(pictures)),
        "pixels": pictures.shape[2],
    }


def _summary(quality: image_quality.Quality) -> dict[str, Estimate | None]:
    """Means over pictures; those of one pose are a group."""
    poses = np.repeat(np.arange(len(quality.psnr)), quality.psnr.shape[1])
    return {k: None if x is None else bootstrap(x, poses) for k, x in quality._asdict().items()}


def _fvd(generated: np.ndarray, truth: np.ndarray) -> dict[str, typing.Any] | None:
    if not pretrained.available("i3d") or min(generated.shape[1], truth.shape[1]) < 2 * fvd.CLIP:
        return None
    network = i3d.load()
    found = fvd.distance(fvd.features(network, generated), fvd.features(network, truth))
    clips = len(found.per_view) * found.generated_clips
    return {
        "pooled": Estimate(found.pooled, found.low, found.high, clips, found.generated_clips),
        "mean of views": found.per_view_mean,
        "clips a view": found.generated_clips,
    }


def section(page: Report, experiment: Experiment, found: dict[str, typing.Any]) -> None:
    """What was measured, beside the paper's numbers for this avatar where it has them."""
    page.heading("How does it look?")
    rows = [(name.replace("_", " "), *values.values()) for name, values in found["poses"].items()]
    page.table(
        f"Held-out poses in random views against pictures of the mesh, {found['pixels']} pixels, over black: means "
        "with 95 % intervals from a bootstrap over poses. LPIPS is that of AlexNet, smaller is better.",
        ["", "PSNR, dB", "SSIM", "LPIPS"],
        rows,
    )
    name = experiment.args.avatar
    known = experiment.meshes is None
    table = published.UNICA_C

    def paper(column: str) -> published.Published:
        return table.at((name, published.UNICA), column) if known else published.UNICA_2.at(published.UNICA, column)

    rows = [
        ("PSNR of the next frame, dB", found["next frame"]["psnr"], paper("PSNR")),
        ("LPIPS of the next frame", found["next frame"]["lpips"], paper("LPIPS")),
    ]
    if found["fvd"] is not None:
        rows.append(("FVD of the rollout, mean of four views", found["fvd"]["mean of views"], paper("FVD")))
        rows.append(("FVD of the rollout, clips of all views pooled", found["fvd"]["pooled"], paper("FVD")))
    page.comparison(
        "The next frame from three true ones and the key, and the rollout of the script, both against pictures of the "
        "meshes under the same keys from four cardinal views (UNICA 4.2, C.4), the cameras following the root. The "
        "paper's characters, pictures and truth are others: its numbers are a landmark, not a competitor.",
        rows,
    )
    if found["fvd"] is None:
        page.text(f"FVD was not measured: the weights are not fetched ({pretrained.COMMAND}), or the script is short.")
    if found["next frame"]["lpips"] is None:
        page.text(f"LPIPS was not measured: the weights are not fetched ({pretrained.COMMAND}).")
