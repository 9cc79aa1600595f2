"""Feed-forward or diffusion (UNICA D.1, Fig. D): a VQ-VAE and a transformer beside the run's autoencoder and UNet."""

from __future__ import annotations

import typing
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from avatarjax import unica
from avatarjax.data import dataset
from avatarjax.data.dataset import Dataset
from avatarjax.metrics.statistics import Estimate, bootstrap
from avatarjax.train import Run
from avatarjax.unica import evaluate, forecast
from avatarjax.unica.baselines import train_feed_forward
from experiments import pictures, unica_motion
from experiments.tables.finished import Finished
from experiments.tables.table import Notebook, Table, cell
from experiments.unica_rollout import before_each_action

OURS, UNET = "feed-forward", "diffusion"
LITTLE = 0.25  # of the controller's progress: an avatar that makes less is not driven
SHOWN = 6  # frames of the picture


def feed_forward(runs: list[Finished], notebook: Notebook, folder: Path) -> Table:
    """UNICA Fig. D in numbers and point clouds; what is trained goes below `folder`."""
    run = runs[0]
    unet = run.avatar("unet").replace(pca=None)
    built = {OURS: unet.replace(dynamics=_trained(run, unet, folder / "feed_forward" / run.name)), UNET: unet}
    found = {
        name: notebook.measured(f"{run.mark('unet')}, without PCA, {name}", lambda a=avatar: _measured(run, a))
        for name, avatar in built.items()
    }
    truth, beside = run.data.truth, found[UNET]
    way = travelled(truth.roots, truth.actions, *unica_motion.asked(run.data, unet.config.actions))
    share = {name: each["progress"] / way["progress"] for name, each in found.items()}
    path = folder / f"feed_forward-{run.name}.png"
    clouds = {name: np.asarray(forecast.surfaces(a.atlas, _scripted(a, truth.actions))) for name, a in built.items()}
    draw_clouds(path, clouds | {"controller": np.asarray(truth.texels)})
    sizes = {name: sum(x.size for x in jax.tree.leaves(avatar.dynamics)) for name, avatar in built.items()}
    millions = {name: f"{size / 1e6:.2g} million" for name, size in sizes.items()}
    return Table(
        f"Feed-forward or diffusion, {run.name}, {run.folder.name} (UNICA D.1, Fig. D)",
        f"A VQ-VAE and a spatial-temporal transformer ({millions[OURS]} parameters) beside the run's autoencoder and "
        f"UNet ({millions[UNET]}), trained on the same batches for the same {unet.config.vae_stage.steps} and "
        f"{unet.config.unet_stage.steps} steps; neither is aligned, as in the paper's figure. Autoencoder and next "
        "frame: errors on held-out groups, mm. Heading error in degrees and distance to the nearest training frame in "
        f"mm: in a rollout of {unica_motion.LONG} frames. Progress: metres in the directions that the keys of the "
        f"report's script ask for, {len(truth.actions)} frames from standing, with its share of the controller's, and "
        "the length of the path.",
        ["", *_COLUMNS, "share"],
        [
            *([name, *(each[key] for key in _COLUMNS.values()), share[name]] for name, each in found.items()),
            ["copying the last frame", None, beside["copy"], beside["copy turning"], *[None] * 5],
            ["controller", *[None] * 3, beside["controller"], None, way["path"], way["progress"], 1.0],
        ],
        [
            geometry_finding(found[OURS]["all"], beside["all"]),
            driving_finding(share[OURS], found[OURS]["path"] / way["path"], share[UNET]),
        ],
        [(path.name, "Raw position maps as points, under the same keys, from the front and left; frame numbers above")],
    )


_COLUMNS = {
    "autoencoder": "autoencoder",
    "next frame": "all",
    "in turns": "turning",
    "heading error": "heading",
    "distance": "distance",
    "path": "path",
    "progress": "progress",
}


def _trained(run: Finished, avatar: unica.Avatar, folder: Path) -> train_feed_forward.FeedForwardDynamics:
    """The pipeline at the sizes and steps of the run's UNet."""
    place = Run(folder, 0, dataset.fingerprint(run.folder / "data"))
    return train_feed_forward.train(avatar.config, run.data, place)


def _measured(run: Finished, avatar: unica.Avatar) -> dict[str, typing.Any]:
    data, (chosen, sequence) = run.data, run.held_out_groups(avatar)
    rolled = unica_motion.roll_long(avatar, data, 0)
    answers = unica_motion.answers(data, avatar, rolled)
    return {
        "autoencoder": bootstrap(evaluate.reconstruction(avatar, data, chosen)["autoencoder"], sequence),
        **run.next_frames(avatar),
        "heading": answers["rollout"]["heading_error"],
        "controller": answers["controller"]["heading_error"],
        "distance": float(1000 * rolled.distance.mean()) if len(rolled.distance) else None,
        **_way(avatar, data),
    }


def _way(avatar: unica.Avatar, data: Dataset) -> dict[str, float]:
    """What `travelled` says of a rollout of the report's script."""
    roots = before_each_action(avatar, np.asarray(_scripted(avatar, data.truth.actions).root))
    return travelled(roots, data.truth.actions, *unica_motion.asked(data, avatar.config.actions))


def travelled(roots: np.ndarray, actions: np.ndarray, yaw: np.ndarray, moves: np.ndarray) -> dict[str, float]:
    """Metres along the ground of roots (f, 3), given where each action sets in: "progress" in the directions that the
    actions ask for (world yaw; idle, which does not move, counts nothing), and "path", all of it."""
    steps = np.diff(np.asarray(roots)[:, [0, 2]], axis=0)
    asked = np.stack([np.sin(yaw), np.cos(yaw)], axis=-1) * moves[:, None]
    return {
        "progress": float((steps * asked[np.asarray(actions)[:-1]]).sum()),
        "path": float(np.linalg.norm(steps, axis=1).sum()),
    }


def geometry_finding(ours: Estimate, unet: Estimate) -> str:
    """Whether the feed-forward geometry is worse than that of diffusion, as the paper finds."""
    if ours.low > unet.high:
        verdict = "reproduced"
    else:
        verdict = "not reproduced" if ours.mean <= unet.mean else "not told apart here"
    return (
        f"The paper: geometry severely degraded. Here the next frame is {cell(ours)} mm off, by diffusion "
        f"{cell(unet)}: {verdict}."
    )


def driving_finding(ours: float, path: float, unet: float) -> str:
    """Whether feed-forward leaves the avatar standing where diffusion drives it, as the paper finds: from the progress
    and the path that feed-forward makes and the progress of diffusion, as shares of the controller's."""
    if not ours < LITTLE:
        verdict = "not reproduced"
    elif unet < LITTLE:
        verdict = "true of both here, so nothing is told apart"
    else:
        verdict = "reproduced" if path < LITTLE else "it is not driven, as in the paper, but it wanders"
    return (
        "The paper: fails to drive the avatar, which mostly remains stationary. Here it makes "
        f"{100 * ours:.0f} % of the controller's progress on {100 * path:.0f} % of its path, diffusion "
        f"{100 * unet:.0f} % (little: under {100 * LITTLE:.0f} %): {verdict}."
    )


def draw_clouds(path: Path, clouds: dict[str, np.ndarray]) -> None:
    """Root-relative surfaces (f, t, 3) as points: a row for each name, evenly spaced frames across."""

    def draw(axes):
        for row, surfaces in enumerate(clouds.values()):
            for column, k in enumerate(np.linspace(0, len(surfaces) - 1, SHOWN + 1).astype(int)[1:]):
                x, y, z = surfaces[k].T
                across, depth = (x - z) * np.sqrt(0.5), (x + z) * np.sqrt(0.5)
                axes.scatter(across + 2 * column, y - 2.2 * row, s=0.6, c=depth, cmap="viridis", vmin=-0.6, vmax=0.6)
                axes.text(2 * column, 1.0 - 2.2 * row, str(k), ha="center", fontsize=8)
        axes.set_yticks([-2.2 * row for row in range(len(clouds))], list(clouds))
        axes.set(xlim=(-1, 2 * SHOWN - 1), ylim=(1.2 - 2.2 * len(clouds), 1.3), xticks=[], aspect="equal")

    pictures.save_plot(path, draw, size=(2 * SHOWN, 2.3 * len(clouds)))


def _scripted(avatar: unica.Avatar, actions: np.ndarray) -> unica.Frame:
    """A script of keys from standing, without appearance."""
    roll = jax.jit(unica.rollout, static_argnames="gaussians")
    return roll(avatar, unica.reset(avatar, jax.random.key(0)), jnp.asarray(actions), gaussians=False)[1]
