"""A finished run of `experiments.unica` and what tables measure on it: rollouts, their videos, their images."""

from __future__ import annotations

import dataclasses
import functools
import typing
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from avatarjax import unica
from avatarjax.data import dataset
from avatarjax.metrics import fvd, i3d, lpips
from avatarjax.metrics.statistics import Estimate, bootstrap
from avatarjax.unica import batches, evaluate, files, image_quality
from avatarjax.unica.avatar import wear as wear_surface
from avatarjax.unica.config import DynamicsName
from experiments.tables.table import mark
from experiments.unica_rollout import SCRIPT

NEXT_FRAMES = 50  # of the script, in four views
GROUPS = 400  # held-out, on which geometry is measured


@dataclasses.dataclass(frozen=True)
class Finished:
    """One avatar's finished run. Its data and networks are read when they are first asked for."""

    folder: Path

    @property
    def name(self) -> str:
        """The avatar's."""
        return self.folder.parent.name

    @functools.cached_property
    def data(self) -> dataset.Dataset:
        """What it was trained on."""
        return dataset.load(self.folder / "data")

    @functools.cached_property
    def pictures(self) -> np.ndarray:
        """The meshes under the report's script (f, 4, h, w, 4)."""
        return dataset.truth_pictures(self.folder / "data")

    @functools.cached_property
    def truth_features(self) -> np.ndarray:
        """I3D features (4, clips, d) of those."""
        return fvd.features(video_network(), image_quality.truth_video(self.pictures))

    def avatar(self, dynamics: DynamicsName | None = None) -> unica.Avatar:
        """The trained avatar."""
        return unica.load(self.folder, dynamics=dynamics)

    def dynamics(self) -> list[DynamicsName]:
        """The dynamics models that the run has trained."""
        return [d for d in typing.get_args(DynamicsName) if (self.folder / files.file_name(d)).is_file()]

    def mark(self, dynamics: DynamicsName) -> str:
        """A short name of the trained weights, which tells measured cells of one training from those of another."""
        return f"{self.name}-{self.folder.name}-{dynamics}-{mark(self.folder / files.file_name(dynamics))}"

    def video(self, avatar: unica.Avatar, seed: int, script: tuple[int, ...] = SCRIPT) -> np.ndarray:
        """A rollout of a script of keys from standing, as `image_quality.video` sees it: (4, f, h, w, 3) uint8.

        Rolled out in pieces, because Gaussians of thousands of frames fit in no memory.
        """
        roll = jax.jit(unica.rollout)
        state, parts = unica.reset(avatar, jax.random.key(seed)), []
        for start in range(0, len(script), 50):
            state, frames = roll(avatar, state, jnp.asarray(script[start : start + 50]))
            clouds, roots = jax.device_get((frames.gaussians, frames.root))
            parts.append(image_quality.video(avatar, clouds, roots, self.pictures.shape[2]))
        return np.concatenate(parts, axis=1)

    def fvd(self, video: np.ndarray) -> float:
        """Against the meshes under the same keys, the mean of the four views (UNICA 4.2)."""
        return fvd.distance(fvd.features(video_network(), video), self.truth_features).per_view_mean

    def dressed_video(self, avatar: unica.Avatar, texels: np.ndarray, roots: np.ndarray) -> np.ndarray:
        """Given world surfaces (f, t, 3) and roots (f, 3) in the avatar's Gaussians, as `video` shows a rollout."""
        wear = jax.jit(lambda avatar, surfaces: jax.lax.map(lambda x: wear_surface(avatar, x), surfaces))
        parts = []
        for start in range(0, len(texels), 50):
            some = slice(start, start + 50)
            clouds = jax.device_get(wear(avatar, jnp.asarray(texels[some])))
            parts.append(image_quality.video(avatar, clouds, roots[some], self.pictures.shape[2]))
        return np.concatenate(parts, axis=1)

    def judge_video(self, video: np.ndarray) -> dict[str, Estimate]:
        """FVD, PSNR and LPIPS of a video (4, f, h, w, 3) of the very frames that the meshes are pictured in."""
        found = image_quality.video_quality(video, self.pictures, self._judged_frames(), _lpips())
        return {"FVD": bootstrap([self.fvd(video)]), **_images(found)}

    def held_out_groups(self, avatar: unica.Avatar) -> tuple[np.ndarray, np.ndarray]:
        """Numbers (g,) of the held-out groups that errors are measured on, and the sequence (g,) of each."""
        windows = batches.windows(self.data.held_out, 4, avatar.config.turn_window)
        chosen = np.unique(np.linspace(0, len(windows.first) - 1, GROUPS).astype(int))
        return chosen, np.asarray(self.data.held_out.sequence)[windows.first[chosen]]

    def next_frames(self, avatar: unica.Avatar) -> dict[str, Estimate]:
        """Errors in mm of the next frame on those, "all" and "turning", and of copying the last frame, "copy" and "copy
        turning"."""
        chosen, sequence = self.held_out_groups(avatar)
        error = evaluate.one_step(avatar, self.data, chosen, jax.random.key(11))
        turns, model, copied = error["turning"], error["model"], error["copy last"]
        return {
            "all": bootstrap(model, sequence),
            "turning": bootstrap(model[turns], sequence[turns]),
            "copy": bootstrap(copied, sequence),
            "copy turning": bootstrap(copied[turns], sequence[turns]),
        }

    def judge(self, avatar: unica.Avatar, rollouts: int) -> dict[str, Estimate]:
        """FVD of rollouts with other noise, PSNR and LPIPS of next frames (UNICA 4.2), each with its interval."""
        chosen, key = self._judged_frames(), jax.random.key(13)
        found = image_quality.next_frame_quality(avatar, self.data.truth, self.pictures, chosen, key, _lpips())
        return {"FVD": bootstrap([self.fvd(self.video(avatar, seed)) for seed in range(rollouts)]), **_images(found)}

    def _judged_frames(self) -> np.ndarray:
        return np.unique(np.linspace(image_quality.CONTEXT, len(self.pictures) - 1, NEXT_FRAMES).astype(int))


def _images(found: image_quality.Quality) -> dict[str, Estimate]:
    """Means over pictures; those of one pose are a group."""
    assert found.lpips is not None
    poses = np.repeat(np.arange(len(found.psnr)), found.psnr.shape[1])
    return {"PSNR": bootstrap(found.psnr, poses), "LPIPS": bootstrap(found.lpips, poses)}


@functools.cache
def video_network() -> dict[str, typing.Any]:
    """I3D, read once."""
    return i3d.load()


@functools.cache
def _lpips() -> lpips.Network:
    return lpips.load("alex")
