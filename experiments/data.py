"""Build an avatar's training data and look at it: clothes simulated over all transitions, pictures, measured quality.

    python -m experiments.data --avatar cowgirl                  # preset small: minutes on a laptop
    python -m experiments.data --avatar monk --preset ci         # a minute or two
    python -m experiments.data --avatar all --preset paper       # UNICA's 6,253 frames an avatar, 500 poses in 8 views
    python -m experiments.data --avatar cowgirl --performances   # films six motions for SMAD as well

Results lie in OUT/data/AVATAR/PRESET/: dataset/ (read it with avatarjax.data.samples), contact_sheet.png, preview.mp4,
quality.json, report.html and, if asked for, monocular/ (read it with avatarjax.data.load_monocular). An interrupted
build goes on where it stopped; a finished one is reused.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

from avatarjax import cameras
from avatarjax.cameras import Camera
from avatarjax.data import avatars, building, capture, cloth_quality, dataset, sequences, skinning
from avatarjax.data.mesh_renderer import MeshRenderer
from avatarjax.data.motion import performances
from avatarjax.data.motion.locomotion import LocomotionConfig, Motion
from avatarjax.data.wardrobe.assembly import AvatarMesh
from avatarjax.io import atomic, exr, video, weights
from avatarjax.metrics import foot_slide, published, responsiveness
from avatarjax.metrics.report import Report
from avatarjax.metrics.statistics import Estimate, bootstrap
from avatarjax.physics.xpbd import XPBDConfig
from experiments import command_line
from experiments.clock import Clock

SCRIPT = (1,) * 30 + (2,) * 30 + (3,) * 30 + (0,) * 30
# Preset: side of the position maps, upscaled, frames of a transition and of a held-out one, poses, views, pixels,
# steps of the cloth a frame.
PRESETS = {
    "ci": (32, 128, 60, 60, 24, 4, 64, 8),
    "small": (64, 256, 150, 100, 160, 8, 256, 32),
    "paper": (128, 1024, None, 150, 500, 8, 512, 32),
}
# Of the clips' frames, so many are looked at for penetration and strain.
MEASURED = 600


@dataclasses.dataclass
class Args:
    """Build and preview an avatar's data."""

    avatar: str = "cowgirl"
    """Which avatar: monk, cowgirl, survival, berserker, ghostlady, or all."""
    preset: str = "small"
    """Sizes: ci, small or paper."""
    performances: bool = False
    """Also film a slow turn and five free motions with one camera, as SMAD needs them."""
    seed: int = 0
    """Seed of gait phases, turning points and chosen poses."""
    out: Path = Path("runs")
    """Folder under which results go, as OUT/data/AVATAR/PRESET/."""


def spec(avatar: str, preset: str, seed: int) -> dataset.DatasetSpec:
    """What the dataset of an avatar and preset is made of. Raises ValueError for names there are not."""
    if avatar not in avatars.names():
        raise ValueError(f"unknown avatar {avatar!r}: choose one of {', '.join(avatars.names())}, or all")
    if preset not in PRESETS:
        raise ValueError(f"unknown preset {preset!r}: choose one of {', '.join(PRESETS)}")
    size, upscaled, frames, held_out, poses, views, pixels, steps = PRESETS[preset]
    return dataset.DatasetSpec(
        avatar=avatar,
        size=size,
        upscaled=upscaled,
        transition_frames=frames,
        held_out_frames=held_out,
        image_poses=poses,
        image_views=views,
        standing_views=dataset.VIEWS,
        image_size=pixels,
        script=SCRIPT,
        seed=seed,
        cloth_steps=steps,
        vertices="float16",
    )


def make(args: Args, name: str) -> dict[str, float]:
    """Build, measure and show one avatar's data; returns the measured numbers."""
    wanted = spec(name, args.preset, args.seed)
    folder = args.out / "data" / name / (args.preset if args.seed == 0 else f"{args.preset}-seed{args.seed}")
    clock = Clock(folder / "seconds.json")
    if dataset.matches(folder / "dataset", wanted):
        print(f"{name}: the dataset in {folder / 'dataset'} was finished before, reused")
    else:
        print(f"{name}: simulating and drawing into {folder / 'dataset'}")
        resumed = building.unfinished(folder / "dataset", wanted)
        clock.run("dataset", lambda: building.build(folder / "dataset", wanted), resumed=resumed)
    avatar = avatars.build(name)
    clips = _Clips(folder / "dataset")
    numbers, means = clock.run("measuring", lambda: measure(avatar, clips, wanted))
    size = sum(p.stat().st_size for p in (folder / "dataset").rglob("*") if p.is_file())
    numbers |= {"dataset megabytes": size / 1e6, "dataset minutes": clock.seconds.get("dataset", 0.0) / 60}
    clock.run("pictures", lambda: show(avatar, clips, folder))
    films = {}
    if args.performances:
        films = clock.run("performances", lambda: film(avatar, args, wanted, folder / "monocular"))
    found = numbers | {"means": {what: mean._asdict() for what, mean in means.items()}, "performances": films}
    atomic.write_text(folder / "quality.json", json.dumps(found, indent=1))
    write_report(folder, name, args, numbers, means, films, clock.seconds)
    print(f"{name}: open {folder / 'report.html'}")
    return numbers


class _Clips:
    """The training clips of a dataset, vertices in the world."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.lengths = dataset.read_manifest(folder)["clips"]["train"]

    def arrays(self, k: int) -> dict[str, np.ndarray]:
        return weights.load_arrays(self.folder / "clips" / f"train-{k:03d}.safetensors")[0]

    def vertices(self, k: int, frames: np.ndarray) -> np.ndarray:
        clip = self.arrays(k)
        return clip["vertices"][frames].astype(np.float32) + clip["roots"][frames, None]


def measure(
    avatar: AvatarMesh, clips: _Clips, wanted: dataset.DatasetSpec
) -> tuple[dict[str, float], dict[str, Estimate]]:
    """Penetration and strain of the cloth, foot slide and turning frames, over the training clips; of those that have
    many values a clip, the means with intervals over clips."""
    every = max(1, sum(clips.lengths) // MEASURED)
    parts = cloth_quality.simulated_parts(avatar)
    depth, strain = [], {part: [] for part in parts}
    clip_strain = []
    for k, length in enumerate(tqdm(clips.lengths, desc="measuring", unit="clip")):
        vertices = clips.vertices(k, np.arange(k % every, length, every))
        depth.append(cloth_quality.penetration(avatar, vertices))
        for part in parts:
            strain[part].append(cloth_quality.strain(avatar, vertices, part).ravel())
        clip_strain.append(np.mean(np.concatenate([found[-1] for found in strain.values()])))
    depths = np.concatenate(depth)
    by_part = {part: np.concatenate(found) for part, found in strain.items()}
    strains = np.concatenate(list(by_part.values()))
    scripts = sequences.transition_scripts(wanted.transition_frames, wanted.seed)
    motions = sequences.simulate(avatar, scripts, np.zeros(len(scripts)), [int(s[0]) for s in scripts], wanted.seed)
    feet = [skinning.feet(avatar.rig, m.transforms[sequences.LEAD_IN :]) for m in motions]
    each = [foot_slide.foot_slides(f.toes, f.balls) for f in feet]
    slides, clip = np.concatenate(each), np.repeat(np.arange(len(each)), [len(s) for s in each])
    turns = turning(motions, scripts)
    means = {
        "share of vertex-frames under 5 mm deep, mean of the clips": bootstrap([(d <= 0.005).mean() for d in depth]),
        "strain, mean of the clips": bootstrap(clip_strain),
        "foot slide, mm a step": bootstrap(1e3 * slides, clip),
        **{f"frames of a {angle} degree turn": bootstrap(frames) for angle, frames in turns.items() if frames},
    }
    numbers = {
        "frames": float(sum(clips.lengths)),
        "vertices": float(len(avatar.vertices)),
        "simulated vertices": float((avatar.reach > 0).sum()),
        "share of vertex-frames under 5 mm deep": float((depths <= 0.005).mean()),
        "deepest mm": 1e3 * float(depths.max()),
        "strain 99th percentile": float(np.percentile(strains, 99)),
        "strain median": float(np.median(strains)),
        **{f"strain 99th percentile, {part}": float(np.percentile(s, 99)) for part, s in by_part.items()},
        "foot slide median mm a step": 1e3 * float(np.median(slides)),
        "foot slide 90th percentile mm a step": 1e3 * float(np.percentile(slides, 90)),
        **{f"frames of a {angle} degree turn": float(np.median(frames)) for angle, frames in turns.items() if frames},
    }
    return numbers, means


def turning(motions, scripts) -> dict[int, list[int]]:
    """Frames of every turn, by its angle: until the ground root's movement stays within 12 degrees of the new direction
    for 8 frames."""
    yaw = LocomotionConfig().directions
    found: dict[int, list[int]] = {180: [], 90: []}
    for motion, script in zip(motions, scripts, strict=True):
        source, target = int(script[0]), int(script[-1])
        if source and target:
            directions = responsiveness.movement_directions(np.asarray(motion.roots, np.float64)[sequences.LEAD_IN :])
            wanted = float(yaw[target - 1])
            angle = round(float(np.rad2deg(responsiveness.angle_between(yaw[source - 1], wanted))))
            frames = responsiveness.turn_frames(directions, int((script == source).sum()), wanted)
            if frames is not None:
                found[angle].append(frames)
    return found


def four_cameras(size: int) -> Camera:
    """Four cameras around a standing figure, the first half from the front."""
    return cameras.orbit(
        np.arange(4) * np.pi / 2 + 0.35,
        target=(0, 0.88, 0),
        distance=4.6,
        heights=0.35,
        width=size,
        height=size,
        fov_y=0.46,
    )


def views(
    avatar: AvatarMesh, renderer: MeshRenderer, vertices: np.ndarray, size: int, count: int = 4
) -> list[np.ndarray]:
    """Pictures (h, w, 3) of one frame of world vertices from the first `count` of four sides, figure in the middle."""
    hips = avatar.weights[:, avatar.rig.index("Hips")] > 0.5
    posed = renderer.pose((vertices - vertices[hips].mean(0) * np.array([1, 0, 1])).astype(np.float32))
    shown = []
    for k in range(count):
        rgba = posed.render(jax.tree.map(lambda x, k=k: x[k], four_cameras(size))).astype(np.float32)
        alpha = rgba[..., 3:] / 255
        shown.append(np.round(rgba[..., :3] * alpha + 236 * (1 - alpha)).astype(np.uint8))
    return shown


def show(avatar: AvatarMesh, clips: _Clips, folder: Path) -> None:
    """A contact sheet of 6 frames x 4 views, and a video of four transitions seen from the front half and the side."""
    renderer = MeshRenderer(avatar.faces, avatar.uvs, avatar.texture)
    # Standing; running away from the camera's side and towards it; in a half turn; in a quarter turn; stopping.
    moments = [(0, 0.1), (0, 0.9), (5, 0.9), (5, 0.42), (6, 0.42), (4, 0.45)]
    columns = []
    for k, share in moments:
        frame = np.array([int(share * clips.lengths[k])])
        columns.append(np.concatenate(views(avatar, renderer, clips.vertices(k, frame)[0], 320), axis=0))
    exr.write_png(folder / "contact_sheet.png", np.concatenate(columns, axis=1))

    def frames():
        for k in tqdm((0, 5, 6, 4), desc="preview", unit="clip"):
            length = clips.lengths[k]
            for vertices in clips.vertices(k, np.arange(max(0, length // 3 - 20), min(length, length // 3 + 50))):
                yield np.concatenate(views(avatar, renderer, vertices, 256, 2), axis=1)

    video.write_video(folder / "preview.mp4", frames())


def film(
    avatar: AvatarMesh, args: Args, wanted: dataset.DatasetSpec, folder: Path
) -> dict[str, dict[str, float | None]]:
    """Film every performance that was not filmed in these settings before, and measure all."""
    motions = {name: jax.device_get(performances.perform(avatar.rig, name, args.seed)) for name in performances.NAMES}
    takes = [capture.Take(folder / name, lambda name=name: motions[name]) for name in motions]
    settings = {"size": max(128, wanted.image_size), "config": XPBDConfig(substeps=wanted.cloth_steps)}
    missing = capture.missing(takes, **settings)
    frames = 2 * sum(len(take.motion().headings) for take in missing)
    with tqdm(total=frames, desc="filming", unit="frame", disable=not missing) as bar:
        capture.film(missing, avatar, **settings, progress=bar.update)
    return {name: measured(avatar, name, motion, folder / name) for name, motion in motions.items()}


def measured(avatar: AvatarMesh, name: str, motion: Motion, folder: Path) -> dict[str, float | None]:
    """What there is to measure of a performance that was filmed."""
    relative = weights.load_arrays(folder / capture.MESHES)[0]["vertices"].astype(np.float32)
    vertices = relative + np.asarray(motion.hips)[:, None]
    depth = cloth_quality.penetration(avatar, vertices[::8])
    feet = skinning.feet(avatar.rig, motion.transforms)
    slides = foot_slide.foot_slides(feet.toes, feet.balls)
    return {
        "frames": float(len(vertices)),
        "under 5 mm deep": float((depth <= 0.005).mean()),
        "strain 99th percentile": float(np.percentile(cloth_quality.strain(avatar, vertices[::8]), 99)),
        # On a turntable the feet turn with the body.
        "foot slide median mm": None if name == "turn" or not len(slides) else 1e3 * float(np.median(slides)),
    }


def write_report(
    folder: Path,
    name: str,
    args: Args,
    numbers: dict[str, float],
    means: dict[str, Estimate],
    films: dict,
    seconds: dict[str, float],
) -> None:
    """One page with the pictures and the numbers beside their goals."""
    report = Report(f"{name}: training data, preset {args.preset}")
    report.media(
        folder / "contact_sheet.png", "Six moments of the training clips from four sides, drawn by ray casting"
    )
    report.media(folder / "preview.mp4", "Around the turning points of four transitions")
    goals = {
        "share of vertex-frames under 5 mm deep": (0.999, True),
        "strain 99th percentile": (0.10, False),
        "foot slide median mm a step": (10.0, False),
        "frames of a 180 degree turn": (12.0, False),
        "frames of a 90 degree turn": (9.0, False),
        "dataset minutes": (25.0, False),
    }
    rows, verdicts = [], []
    for key, value in numbers.items():
        goal = goals.get(key)
        rows.append((key, None if goal is None else f"{'at least' if goal[1] else 'at most'} {goal[0]:g}", value))
        verdicts.append(None if goal is None else bool(value >= goal[0] if goal[1] else value <= goal[0]))
    report.heading("Measured")
    report.table(
        f"Over {MEASURED} frames of the clips, or all motion", ("what", "goal", "measured"), rows, verdicts=verdicts
    )
    report.text(
        "Depth is measured at simulated vertices and centres of cloth triangles against the skinned mesh itself. "
        "Strain is the relative change of every edge's length, diagonals included, which woven cloth gives way in. "
        "Foot slide is the way of the ball of a foot in one contact. A turn has ended when the movement of the ground "
        "root stays within 12 degrees of the new direction for 8 frames."
    )
    turn = {f"frames of a {angle} degree turn": f"{angle} degrees" for angle in (180, 90)}
    report.table(
        "Means with 95 % bootstrap intervals, of steps over clips", ("what", "mean"), [(k, v) for k, v in means.items()]
    )
    report.comparison(
        "Turns of the controller's ground root, beside the paper's ground truth",
        [(k, means[k], published.UNICA_D_TURNS.at("ground truth", turn[k])) for k in turn if k in means],
    )
    if films:
        report.heading("Performances for SMAD")
        columns = ("performance", *next(iter(films.values())))
        report.table("Filmed by one camera", columns, [(k, *v.values()) for k, v in films.items()])
    command = f"python -m experiments.data --avatar {name} --preset {args.preset} --seed {args.seed}"
    report.environment(command + (" --performances" if args.performances else ""), seconds)
    report.write(folder / "report.html")


def make_all(args: Args) -> None:
    """The dataset of the avatar that is asked for, or of each."""
    for name in avatars.names() if args.avatar == "all" else (args.avatar,):
        make(args, name)


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit status."""
    return command_line.run(make_all, Args, "experiments.data", __doc__, argv)


if __name__ == "__main__":
    raise SystemExit(main())
