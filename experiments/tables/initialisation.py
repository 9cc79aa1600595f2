"""What canonical Gaussians begin with (SMAD Fig. 6, right): a visual hull, a radiance field or a body template."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import typing
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from avatarjax import smad
from avatarjax.data import MonocularVideo, capture, load_monocular
from avatarjax.gaussians import Gaussians
from avatarjax.io import exr
from avatarjax.metrics import lpips, pretrained
from avatarjax.metrics.statistics import Estimate, bootstrap
from avatarjax.smad import footage, graph, hull, radiance_field, refine, template, train_radiance_field
from avatarjax.smad.footage import Footage
from avatarjax.smad.radiance_field import FieldConfig
from avatarjax.smad.refine import Refined
from avatarjax.smad.template import TemplateConfig
from avatarjax.splat import render
from experiments import smad as experiment
from experiments.clock import Clock
from experiments.tables.table import BETTER, Notebook, Table

HULL, FIELD, TEMPLATE = "visual hull", "radiance field", "body template"
METHODS = (HULL, FIELD, TEMPLATE)
STATES = ("as they begin", "refined")
PARTS = ("slow turn", "moving takes")
METRICS = ("PSNR", "PSNR in the mask", "PSNR beyond the body", "SSIM", "LPIPS")
# The presets of a run have no field: what the hull takes seconds for takes it minutes.
FIELDS = {
    "ci": FieldConfig(cells=64, steps=600),
    "small": FieldConfig(steps=2000),
    "base": FieldConfig(cells=160, steps=20_000),
    "paper": FieldConfig(cells=160, steps=20_000),
}
SEEDS = (0, 1)
# Frames of one second are alike: intervals are over pieces of a take of so many frames.
PIECE = 30
# Pixels about the figure in the picture, and how large one of them is there.
ROOM, ENLARGED = 3, 4

# One repeat: its number of Gaussians, seconds, frames of the turn, and by state and metric pairs of frame and value.
Measured = dict[str, typing.Any]


@dataclasses.dataclass
class Video:
    """What a run of experiments.smad has filmed, and where results on it go."""

    folder: Path
    place: Path

    @property
    def name(self) -> str:
        """Of the avatar."""
        return self.folder.parent.name

    @property
    def preset(self) -> str:
        """Of the run."""
        return self.folder.name

    @functools.cached_property
    def config(self) -> smad.SmadConfig:
        """The sizes of the run."""
        return smad.preset(self.preset)

    @functools.cached_property
    def videos(self) -> list[MonocularVideo]:
        """What it was filmed in, the slow turn first."""
        return [load_monocular(folder) for folder in films(self.folder, self.config)]

    @functools.cached_property
    def takes(self) -> Footage:
        """All that Gaussians are refined on and measured on."""
        return footage.gather(self.videos)

    @functools.cached_property
    def turn(self) -> MonocularVideo:
        """The slow turn, which Gaussians begin with, without the frames that they are measured on."""
        whole = self.videos[0]
        return whole.only(np.flatnonzero(~self.takes.held_out[: len(whole)]))

    @functools.cached_property
    def beyond(self) -> Footage:
        """The takes with masks that end where the body begins: hat, hair and skirt remain."""
        naked = self.start(self.cloud(TEMPLATE, 0))
        held_out = np.flatnonzero(self.takes.held_out)
        rgba = self.takes.rgba.copy()
        for frame, drawn in zip(held_out, self.draw(naked, held_out.tolist()), strict=True):
            rgba[frame, ..., 3] = np.where(drawn[..., 3] > 0.5, 0, rgba[frame, ..., 3])
        return dataclasses.replace(self.takes, rgba=rgba)

    def cloud(self, method: str, seed: int) -> Gaussians:
        """The Gaussians that one of the three begins with, about as many of each."""
        sizes = {"gaussians": self.config.hull.gaussians, "opacity": self.config.hull.opacity}
        if method == HULL:
            return hull.initialise(self.turn, self.config.hull)
        if method == TEMPLATE:
            return template.initialise(self.turn, TemplateConfig(frames=self.config.hull.frames, **sizes))
        config = dataclasses.replace(FIELDS[self.preset], **sizes)
        trained = train_radiance_field.train(self.turn, config, self.results(method, seed), seed=seed)
        return radiance_field.extract(config, trained.params, trained.where.grid, jnp.asarray(trained.times))

    def start(self, cloud: Gaussians) -> Refined:
        """Gaussians that are skinned."""
        nodes, canonical = graph.of_gaussians(cloud, self.config.graph), self.takes.pose(0, 0)
        return refine.start(self.takes, cloud, nodes, canonical, self.config.refine.knot)

    def refined(self, cloud: Gaussians, method: str, seed: int) -> Refined:
        """Gaussians and their motion, fitted as the run itself does it."""
        parts = self.takes, cloud, graph.of_gaussians(cloud, self.config.graph), self.takes.pose(0, 0)
        return refine.refine(*parts, self.config.refine, self.results(method, seed), jax.random.key(seed))

    def results(self, method: str, seed: int) -> Path:
        """Where checkpoints of a method go."""
        return self.place / f"{method.replace(' ', '-')}-{seed}"

    def draw(self, fitted: Refined, frames: list[int]) -> list[np.ndarray]:
        """Pictures (h, w, 4) over black, and alphas, of frames by their numbers among all."""
        starts = np.cumsum((0, *self.takes.takes))

        def cloud(frame: int) -> Gaussians:
            take = int(np.searchsorted(starts, frame, "right")) - 1
            return refine.at(fitted, take, int(frame - starts[take]))

        room = footage.room(self.takes, cloud, frames, growth=1)
        drawn = []
        for frame in frames:
            out = render(
                cloud(frame), jax.tree.map(lambda x, k=frame: jnp.asarray(x[k]), self.takes.cameras), config=room
            )
            drawn.append(np.asarray(jnp.concatenate([jnp.clip(out.image, 0, 1), out.alpha[..., None]], axis=-1)))
        return drawn

    def shown(self) -> list[int]:
        """Held-out frames to look at: the middle ones of the first two moving takes."""
        starts = np.cumsum((0, *self.takes.takes))
        held_out = np.flatnonzero(self.takes.held_out)
        middles = [(a + b) / 2 for a, b in itertools.pairwise(starts[1:])]
        return [int(held_out[np.abs(held_out - middle).argmin()]) for middle in middles[:2]]


def films(folder: Path, config: smad.SmadConfig) -> list[Path]:
    """Where the takes of a run lie that it learns from, the slow turn first."""
    return [folder / "film" / f"{name}-{seed}" for name, seed in config.film.train]


def filmed(folder: Path) -> bool:
    """Whether all of them are there."""
    return all((film / capture.MESHES).is_file() for film in films(folder, smad.preset(folder.name)))


def initialisation(folders: list[Path], notebook: Notebook, folder: Path) -> Table:
    """Gaussians of three kinds, refined in the same way; checkpoints go below `folder`, pictures into it."""
    rows: list[list[typing.Any]] = []
    remarks, shown = [], []
    for run in folders:
        video = Video(run, folder / "initialisation" / run.parent.name)
        mark = experiment.fingerprint(video.videos)
        found: dict[str, list[Measured]] = {}
        for method in METHODS:
            names = [f"{video.name}-{video.preset}-{mark}, {method}, seed {seed}" for seed in SEEDS]
            works = [functools.partial(_measured, video, method, seed) for seed in SEEDS]
            found[method] = [notebook.measured(*each) for each in zip(names, works, strict=True)]
            for state in STATES:
                took = min(repeat["seconds"][state] for repeat in found[method])
                for part in PARTS:
                    cells = [pooled(found[method], state, part, metric) for metric in METRICS]
                    rows.append([video.name, method, state, found[method][0]["gaussians"], took, part, *cells])
        remarks += [f"{video.name}: {remark}" for remark in _remarks(found)]
        picture = folder / ("initialisation.png" if len(folders) == 1 else f"initialisation-{video.name}.png")
        _picture(video, picture)
        shown.append((picture.name, f"{video.name}, held-out frames: recorded; refined from {', '.join(METHODS)}"))
    return Table(
        "What Gaussians begin with (SMAD Fig. 6, right)",
        "Made of the slow turn without its held-out frames, then refined on all takes in the same way, for the same "
        "steps, and measured on the same held-out frames over black. As they begin they are only skinned. Beyond the "
        "body: in the pixels of the mask that the template does not cover before it is refined. Means over "
        f"{len(SEEDS)} repeats with other seeds; intervals are over pieces of {PIECE} frames. Seconds, of the quicker "
        "repeat, are those of making and of refining them. The paper prints no numbers: its way, the radiance field, "
        '"improves detail beyond the body" over a template.',
        ["avatar", "Gaussians of", "", "number", "seconds", "frames of", *METRICS],
        rows,
        remarks,
        shown,
    )


def pooled(repeats: list[Measured], state: str, part: str, metric: str) -> Estimate | None:
    """The mean over repeats and frames of a part; its interval is over pieces of takes. None where nothing is known."""
    if metric not in repeats[0][state]:
        return None
    values, pieces = _frames(repeats, state, part, metric)
    return bootstrap(values, pieces)


def ahead(first: list[Measured], second: list[Measured], metric: str) -> tuple[Estimate, str]:
    """By how much the first is higher, frame by frame, in the moving takes once both are refined; and whether that is
    better, worse or no more than what pieces of takes differ by."""
    (ours, pieces), (others, _) = (_frames(repeats, STATES[1], PARTS[1], metric) for repeats in (first, second))
    apart = bootstrap(ours - others, pieces)
    if not apart.low > 0 and not apart.high < 0:
        return apart, "not told apart"
    return apart, "ahead" if (apart.mean > 0) == (BETTER[metric.split(" ")[0]] is max) else "behind"


def _frames(repeats: list[Measured], state: str, part: str, metric: str) -> tuple[np.ndarray, np.ndarray]:
    """The values (k,) of the frames of a part, means over repeats, and to which piece (k,) of a take each belongs."""
    table = np.array([repeat[state][metric] for repeat in repeats])
    chosen = (table[0, :, 0] < repeats[0]["turn"]) == (part == PARTS[0])
    return table[:, chosen, 1].mean(0), table[0, chosen, 0] // PIECE


def _remarks(found: dict[str, list[Measured]]) -> list[str]:
    """Whether the paper's ordering holds, and where the hull stands."""
    said = []
    for metric in [metric for metric in METRICS if metric in found[FIELD][0][STATES[1]]]:
        apart, word = ahead(found[FIELD], found[TEMPLATE], metric)
        holds = {"ahead": "as in the paper", "behind": "the paper has it the other way"}.get(word, word)
        beside, other = ahead(found[HULL], found[FIELD], metric)
        said.append(
            f"{metric}, moving takes, refined: {FIELD} less {TEMPLATE} {apart:.2g} ({holds}); {HULL} less {FIELD} "
            f"{beside:.2g} ({other})"
        )
    means = [
        [_frames([repeat], STATES[1], PARTS[1], "PSNR")[0].mean() for repeat in repeats] for repeats in found.values()
    ]
    return [*said, f"repeats with other seeds are at most {np.ptp(means, axis=1).max():.2g} dB apart in PSNR"]


def _measured(video: Video, method: str, seed: int) -> Measured:
    """One kind of Gaussians on every held-out frame, as they begin and refined; pictures go to its folder."""
    place = video.results(method, seed)
    place.mkdir(parents=True, exist_ok=True)
    clock = Clock(place / "seconds.json")
    video.turn.images()  # Films are read before a clock runs.
    cloud = clock.run(STATES[0], lambda: video.cloud(method, seed))
    refined = clock.run(STATES[1], lambda: video.refined(cloud, method, seed))
    exr.write_png(place / "shown.png", _bytes(np.concatenate(video.draw(refined, video.shown()))))
    perceptual = lpips.load("alex") if pretrained.available("alex") else None
    return {
        "gaussians": len(cloud),
        "seconds": clock.seconds,
        "turn": video.takes.takes[0],
        **{s: _values(video, f, perceptual) for s, f in zip(STATES, (video.start(cloud), refined), strict=True)},
    }


def _values(video: Video, fitted: Refined, perceptual: lpips.Network | None) -> dict[str, list[tuple[int, float]]]:
    """By metric the numbers of frames and what was measured of each."""
    whole, beyond = refine.quality(fitted, video.takes, perceptual), refine.quality(fitted, video.beyond)
    found = (whole, whole.psnr), (whole, whole.masked_psnr), (beyond, beyond.masked_psnr), (whole, whole.ssim)
    columns = dict(zip(METRICS, (*found, (whole, whole.lpips)), strict=True))
    return {
        metric: list(zip(quality.frames.tolist(), values.tolist(), strict=True))
        for metric, (quality, values) in columns.items()
        if values is not None
    }


def _picture(video: Video, path: Path) -> None:
    """What was recorded in some frames, and what was fitted to others: a row for each frame, cut to the figure."""
    frames = video.shown()
    drawn = [exr.read_png(video.results(method, SEEDS[0]) / "shown.png")[..., :3] for method in METHODS]
    columns = [video.takes.rgba[frames][..., :3], *(np.stack(np.split(c, len(frames))) for c in drawn)]
    inside = [np.argwhere(video.takes.rgba[frame, ..., 3] > 0) for frame in frames]
    middles = [(places.min(0) + places.max(0)) // 2 for places in inside]
    half = max(np.ptp(places, axis=0).max() for places in inside) // 2 + ROOM
    rows = [
        np.concatenate([np.pad(c[k], ((half,) * 2, (half,) * 2, (0, 0)))[_window(at, half)] for c in columns], axis=1)
        for k, at in enumerate(middles)
    ]
    exr.write_png(path, np.concatenate(rows).repeat(ENLARGED, axis=0).repeat(ENLARGED, axis=1))


def _window(middle: np.ndarray, half: int) -> tuple[slice, ...]:
    """A square about a pixel of a picture that was padded by half of its side."""
    return tuple(slice(int(at), int(at) + 2 * half) for at in middle)


def _bytes(picture: np.ndarray) -> np.ndarray:
    return np.round(255 * np.clip(picture, 0, 1)).astype(np.uint8)
