"""What the sides of the position map and of the upscaled map are worth (UNICA Fig. E): appearance alone."""

from __future__ import annotations

import dataclasses
import typing
from pathlib import Path

import numpy as np

from avatarjax import posmap, unica
from avatarjax.data import building, dataset
from avatarjax.data.dataset import Dataset
from avatarjax.io import exr
from avatarjax.metrics import lpips
from avatarjax.metrics.statistics import bootstrap
from avatarjax.unica import image_quality, train, train_appearance
from avatarjax.unica.config import UnicaConfig
from experiments import unica as main_run
from experiments.tables.finished import Finished
from experiments.tables.table import Notebook, Table

DOUBLED = (1, 2)  # of the preset's map
UPSCALED = (4, 8)  # times the preset's map; the paper's are 4 and 8 times its 128


def resolution(runs: list[Finished], notebook: Notebook, folder: Path) -> Table:
    """UNICA Fig. E: base attributes and appearance model trained anew for each pair of sides, below `folder`."""
    run = runs[0]
    config = run.avatar().config
    rows, strips = [], []
    for times in DOUBLED:
        for factor in UPSCALED:
            changed = dataclasses.replace(config, size=times * config.size, upscaled=factor * config.size)
            name = f"{changed.size} to {changed.upscaled}"
            place = folder / "resolution" / run.name / name.replace(" ", "-")
            picture = place / "pose.png"
            found = notebook.measured(
                f"{run.name}-{run.folder.name}, resolution {name}",
                lambda c=changed, p=place, q=picture: _measured(run.name, c, p, q),
            )
            rows.append([name, found["points"], found["psnr"], found["lpips"]])
            strips.append(exr.read_png(picture)[..., :3])
    path = folder / f"resolution-{run.name}.png"
    exr.write_png(path, np.concatenate(strips, axis=0))
    return Table(
        f"Sides of the map and of the upscaled map, {run.name}, {run.folder.name} (UNICA Fig. E)",
        f"Appearance ({config.appearance_model}) trained with each, the same steps: PSNR and LPIPS of held-out poses. "
        "The paper shows pictures and finds that only the upscaled side counts.",
        ["map, upscaled", "Gaussians", "PSNR", "LPIPS"],
        rows,
        pictures=[(path.name, "One held-out pose: each row a pair of sides, the picture of the mesh on the right")],
    )


def _measured(name: str, config: UnicaConfig, place: Path, picture: Path) -> dict[str, typing.Any]:
    data = _data(name, config, place)
    avatar = _dressed(config, data, train.Run(place, 0, dataset.fingerprint(place / "data")))
    found = image_quality.appearance_quality(avatar, data.held_out_images, lpips.load("alex"))
    assert found.lpips is not None
    poses = np.repeat(np.arange(len(found.psnr)), found.psnr.shape[1])
    exr.write_png(picture, image_quality.beside_truth(avatar, data.held_out_images, 0))
    return {
        "points": len(avatar.base.logit_opacities),
        "psnr": bootstrap(found.psnr, poses),
        "lpips": bootstrap(found.lpips, poses),
    }


def _data(name: str, config: UnicaConfig, place: Path) -> Dataset:
    spec = main_run.Experiment(main_run.Args(avatar=name), config, place).spec()
    if not dataset.matches(place / "data", spec):
        building.build(place / "data", spec)
    return dataset.load(place / "data")


def _dressed(config: UnicaConfig, data: Dataset, run: train.Run) -> unica.Avatar:
    """An avatar that has something to wear and does not move."""
    upscaler, seen = posmap.build_upscaler(data.atlas, config.upscaled), lpips.load(config.lpips_network)
    base = train_appearance.train_base(config, data, run, upscaler, seen)
    if config.appearance_model == "texels":
        params, base = train_appearance.train_texels(config, data, run, upscaler, base, seen)
    else:
        params = train_appearance.train_appearance(config, data, run, upscaler, base, seen)
    still: dict[str, typing.Any] = {"pca": None, "dynamics": None}
    return unica.Avatar(
        atlas=data.atlas,
        upscaler=upscaler,
        tangents=posmap.tangents(data.atlas),
        base=base,
        appearance=params,
        standing=data.standing,
        config=config,
        **still,
    )
