"""One avatar's training data in a folder: built clip by clip, checked when it is read, never half there.

    manifest.json                     what it was made of, and every file's size and SHA-256; written last
    avatar.safetensors                faces, uvs, rest vertices, skinning weights, atlas, standing pose
    texture.png
    clips/train-000.safetensors       texels, roots, actions, joint rotations and, if asked for, all vertices
    images/train/00000_07.png         pose 0 from view 7, straight alpha; images/train.safetensors says which pose

A build that was interrupted goes on where it stopped: a clip's file is written after everything else of the clip.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import json
import shutil
import threading
import typing
from pathlib import Path

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8
from tqdm import tqdm

from avatarjax import cameras, posmap
from avatarjax.cameras import Camera
from avatarjax.data import avatars, dressing, manifest, sequences
from avatarjax.data.mesh_renderer import MeshRenderer
from avatarjax.data.sequences import Recording, Take
from avatarjax.io import atomic, exr, weights
from avatarjax.physics.xpbd import XPBDConfig

VERSION = 3
VIEWS = 50  # on the cylinder (UNICA B.1)
SPLITS = ("train", "held_out", "truth")
AGAIN = "build it again with --stage data"
_NOTE = "building.json"  # lies beside what an unfinished build has made
_GOLDEN = np.pi * (3 - np.sqrt(5))
# Simulating and rendering release the interpreter: so many clips at a time keep two cores busy.
_WORKERS = 2


@dataclasses.dataclass(frozen=True)
class DatasetSpec:
    """What a dataset is made of; two datasets with equal specs are equal.

    Sequences have `transition_frames` frames, or those of UNICA Table A for None. `vertices` says whether whole meshes
    are kept, as float16 or float32 relative to the root, and not only the texels of the position maps.
    """

    avatar: str
    size: int
    upscaled: int
    transition_frames: int | None
    held_out_frames: int | None
    image_poses: int
    image_views: int
    standing_views: int
    image_size: int
    script: tuple[int, ...]
    seed: int = 0
    cloth_steps: int = 32
    vertices: typing.Literal["none", "float16", "float32"] = "none"

    def __post_init__(self):
        if not 1 <= self.image_views <= VIEWS or not 1 <= self.standing_views <= VIEWS:
            raise ValueError(
                f"there are 1 to {VIEWS} views a pose, asked for {self.image_views} and {self.standing_views}"
            )
        if self.vertices not in ("none", "float16", "float32"):
            raise ValueError(f"vertices are kept as none, float16 or float32, not {self.vertices!r}")


@typing.no_type_check
@flax.struct.dataclass
class Images:
    """Rendered poses: texels (p, t, 3) relative to their root, view (p, k) ids, RGBA (p, k, h, w, 4) straight alpha."""

    texels: Float[Array, "p t 3"]
    view: Int[Array, "p k"]
    rgba: UInt8[Array, "p k h w 4"]


@typing.no_type_check
@flax.struct.dataclass
class Dataset:
    """Everything a UNICA run trains on and is tested on.

    `train` holds the 20 transitions, `held_out` the same with other seeds, `truth` the controller under the report's
    script; `standing` (t, 3) texels in metres above the world's origin; the three image sets show the standing pose,
    training poses and held-out poses.
    """

    atlas: posmap.Atlas
    train: Recording
    held_out: Recording
    truth: Recording
    standing: Float[Array, "t 3"]
    standing_images: Images
    train_images: Images
    held_out_images: Images


def cylinder_cameras(size: int) -> Camera:
    """The 50 cameras of UNICA B.1, on a cylinder about the unit cube of a normalised pose, square pictures.

    Azimuths follow the golden angle, so that any few of them are spread; heights go from -0.2 to 0.6.
    """
    k = np.arange(VIEWS)
    heights = -0.2 + 0.8 * ((k * 0.618034) % 1)
    return cameras.orbit(k * _GOLDEN, target=(0, 0, 0), distance=1.75, heights=heights, width=size, height=size)


@dataclasses.dataclass(frozen=True)
class _Plan:
    """The sequences of a split, and which of their poses are pictured: (sequence, frame) and views (p, k)."""

    scripts: list[np.ndarray]
    headings: np.ndarray
    poses: list[tuple[int, int]]
    views: np.ndarray


def _plans(spec: DatasetSpec) -> dict[str, _Plan]:
    rng = np.random.default_rng(spec.seed + 3)
    plans = {}
    frames = {"train": spec.transition_frames, "held_out": spec.held_out_frames}
    for offset, name in enumerate(SPLITS):
        if name in frames:
            scripts = sequences.transition_scripts(frames[name], spec.seed + offset)
            headings = rng.integers(0, 4, len(scripts)) * (np.pi / 2)
            wanted = spec.image_poses if name == "train" else max(8, spec.image_poses // 6)
        else:
            scripts, headings, wanted = [np.asarray(spec.script, np.int32)], np.zeros(1), 0
        frame = [(k, f) for k, script in enumerate(scripts) for f in range(len(script))]
        chosen = np.sort(rng.choice(len(frame), min(wanted, len(frame)), replace=False))
        views = np.array([rng.permutation(VIEWS)[: spec.image_views] for _ in chosen], np.int32)
        plans[name] = _Plan(scripts, headings, [frame[k] for k in chosen], views)
    return plans


def build(folder: Path, spec: DatasetSpec, *, progress: bool = True) -> None:
    """Simulate, encode and render the dataset into `folder`; several minutes at paper scale.

    Goes on where an earlier build with the same spec was interrupted; anything else in the folder is replaced.
    """
    folder = Path(folder)
    _begin(folder, spec)
    maker = _Maker(folder, spec, progress)
    plans = _plans(spec)
    total = sum(len(script) + sequences.LEAD_IN for plan in plans.values() for script in plan.scripts)
    with tqdm(total=total, desc="clips", unit="frame", disable=not progress) as bar:
        lock = threading.Lock()

        def advance(frames: int) -> None:
            with lock:
                bar.update(frames)

        with concurrent.futures.ThreadPoolExecutor(_WORKERS) as pool:
            every = [(name, plan, k) for name, plan in plans.items() for k in range(len(plan.scripts))]
            motions = sequences.simulate(
                maker.avatar,
                [plan.scripts[k] for _, plan, k in every],
                np.concatenate([plan.headings for plan in plans.values()]),
                # The report's script begins from standing, as a rollout does.
                [0 if name == "truth" else int(plan.scripts[k][0]) for name, plan, k in every],
                spec.seed,
            )
            jobs = [pool.submit(maker.clip, *clip, m, advance) for clip, m in zip(every, motions, strict=True)]
            try:
                for job in concurrent.futures.as_completed(jobs):
                    job.result()
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
    for name, plan in plans.items():
        if plan.poses:
            index = {"sequence": [p[0] for p in plan.poses], "frame": [p[1] for p in plan.poses], "view": plan.views}
            weights.save_tree(_table(folder, name), {k: np.asarray(v, np.int32) for k, v in index.items()})
    note = folder / _NOTE
    files = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file() and p != note)
    clips = {name: [len(script) for script in plan.scripts] for name, plan in plans.items()}
    content = {"spec": dataclasses.asdict(spec), "actions": sequences.ACTIONS, "clips": clips}
    manifest.write(folder, VERSION, files, **content)
    note.unlink()


def _begin(folder: Path, spec: DatasetSpec) -> None:
    """Leave in the folder only what an interrupted build of the same spec has finished."""
    folder.mkdir(parents=True, exist_ok=True)
    note = folder / _NOTE
    wanted = json.dumps({"version": VERSION, "spec": dataclasses.asdict(spec)})
    if (folder / manifest.NAME).exists() or not note.is_file() or note.read_text(encoding="utf-8") != wanted:
        for name in (manifest.NAME, _NOTE, "avatar.safetensors", "texture.png"):
            (folder / name).unlink(missing_ok=True)
        for name in ("clips", "images"):
            shutil.rmtree(folder / name, ignore_errors=True)
        for path in folder.glob("*.safetensors"):
            path.unlink()
        atomic.write_text(note, wanted)
    for path in folder.rglob(".*"):
        path.unlink()  # what a killed process was writing


class _Maker:
    """Makes clips and pictures of one avatar; poses are pictured in the box of their upscaled points, where the
    appearance network works."""

    def __init__(self, folder: Path, spec: DatasetSpec, progress: bool):
        self.folder, self.spec = folder, spec
        self.avatar = avatars.build(spec.avatar)
        self.cloth = XPBDConfig(substeps=spec.cloth_steps)
        path = folder / "avatar.safetensors"
        if path.is_file():
            arrays = weights.load_arrays(path)[0]
            self.atlas, standing = atlas_of(arrays, spec.size), arrays["standing_vertices"]
        else:
            reference = dressing.settle(self.avatar, avatars.a_pose(self.avatar.rig), self.cloth)
            self.atlas = posmap.build_atlas(reference, self.avatar.faces, spec.size)
            standing = dressing.settle(self.avatar, avatars.standing_pose(self.avatar.rig), self.cloth)
        self.renderer = MeshRenderer(self.avatar.faces, self.avatar.uvs, self.avatar.texture)
        self.cameras = cylinder_cameras(spec.image_size)
        upscaler = posmap.build_upscaler(self.atlas, spec.upscaled)
        self.box = jax.jit(lambda texels: posmap.bounding_box(posmap.upscale(upscaler, texels)))
        if not path.is_file():
            self._describe(path, standing, progress)

    def _describe(self, path: Path, standing: np.ndarray, progress: bool) -> None:
        texels = posmap.encode(self.atlas, jnp.asarray(standing))
        root = posmap.root(self.atlas, texels)
        views = tqdm(range(self.spec.standing_views), desc="standing pose", unit="view", disable=not progress)
        self.picture("standing", 0, np.asarray(texels - root[None]), standing - np.asarray(root), views)
        exr.write_png(self.folder / "texture.png", self.avatar.texture)
        avatar = self.avatar
        arrays = {
            "faces": avatar.faces,
            "uvs": avatar.uvs,
            "rest": avatar.vertices,
            "weights": avatar.weights,
            "parts": avatar.parts,
            "standing": texels,
            "standing_vertices": standing,
            "heads": avatar.rig.heads,
            "tails": avatar.rig.tails,
        }
        atlas = {f"atlas/{f.name}": getattr(self.atlas, f.name) for f in _atlas_fields()}
        rig = {"joints": avatar.rig.names, "parents": avatar.rig.parents}
        weights.save_tree(path, {**arrays, **atlas}, part_names=avatar.part_names, **rig)

    def clip(self, split: str, plan: _Plan, k: int, motion, advance) -> None:
        """Simulate sequence k of a split, picture its chosen poses, write it; nothing where that was done before."""
        path = _clip(self.folder, split, k)
        if path.is_file():
            advance(len(motion.headings))
            return
        take, vertices = sequences.take(self.avatar, self.atlas, motion, plan.scripts[k], self.cloth, advance)
        for pose, (sequence, frame) in enumerate(plan.poses):
            if sequence == k:
                self.picture(split, pose, take.texels[frame], vertices[frame], plan.views[pose])
        arrays = {f.name: getattr(take, f.name) for f in dataclasses.fields(Take)}
        if self.spec.vertices != "none":
            arrays["vertices"] = vertices.astype(self.spec.vertices)
        weights.save_tree(path, arrays)

    def picture(self, name: str, pose: int, texels: np.ndarray, vertices: np.ndarray, views) -> None:
        """Write the views of a pose whose `vertices` (v, 3) lie in the frame of its `texels` (t, 3)."""
        box = self.box(jnp.asarray(texels))
        posed = self.renderer.pose((vertices - np.asarray(box.centre)) / np.asarray(box.side))
        for view in views:
            camera = jax.tree.map(lambda x, v=int(view): x[v], self.cameras)
            exr.write_png(image_path(self.folder, name, pose, int(view)), posed.render(camera))


def matches(folder: Path, spec: DatasetSpec) -> bool:
    """Whether `folder` has a finished dataset of exactly this spec."""
    try:
        found = read_manifest(Path(folder))
    except ValueError:
        return False
    return found["spec"] == json.loads(json.dumps(dataclasses.asdict(spec)))


def load(folder: Path) -> Dataset:
    """Read a dataset and check every file against the manifest.

    Raises ValueError that names what is missing, unfinished or damaged, and says how to build it again.
    """
    folder = Path(folder)
    found = read_manifest(folder)
    manifest.check(folder, found, AGAIN)
    arrays = weights.load_arrays(folder / "avatar.safetensors")[0]
    atlas = atlas_of(arrays, int(found["spec"]["size"]))
    takes = {name: [load_take(folder, name, k) for k in range(len(found["clips"][name]))] for name in SPLITS}
    standing = jnp.asarray(arrays["standing"])
    views = np.arange(found["spec"]["standing_views"], dtype=np.int32)[None]
    centred = np.asarray(standing - posmap.root(atlas, standing)[None])[None]
    images = {"standing_images": Images(centred, views, _pictures(folder, "standing", views))}
    for name in ("train", "held_out"):
        index = weights.load_arrays(_table(folder, name))[0]
        texels = [takes[name][k].texels[f] for k, f in zip(index["sequence"], index["frame"], strict=True)]
        images[f"{name}_images"] = Images(np.stack(texels), index["view"], _pictures(folder, name, index["view"]))
    recordings = {name: sequences.join(takes[name]) for name in SPLITS}
    return Dataset(atlas=atlas, standing=standing, **recordings, **images)


def load_take(folder: Path, split: str, k: int) -> Take:
    """One sequence of a split, without its vertices."""
    arrays = weights.load_arrays(_clip(folder, split, k))[0]
    return Take(**{f.name: arrays[f.name] for f in dataclasses.fields(Take)})


def fingerprint(folder: Path) -> str:
    """A short name of the data's content, by which checkpoints know what they were trained on."""
    return manifest.fingerprint(read_manifest(Path(folder)))


def read_manifest(folder: Path) -> dict[str, typing.Any]:
    """The manifest of a finished dataset; ValueError says what is wrong with the folder and how to mend it."""
    found = manifest.read(folder, VERSION, ["avatar.safetensors", "texture.png"], AGAIN)
    try:
        count = {name: len(found["clips"][name]) for name in SPLITS}
        _ = int(found["spec"]["size"]), int(found["spec"]["standing_views"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{folder / manifest.NAME} is damaged ({error!r}): {AGAIN}") from error
    needed = [_clip(Path(), name, k).as_posix() for name in SPLITS for k in range(count[name])]
    absent = sorted(set(needed) - set(found["files"]))
    if absent:
        raise ValueError(f"{folder / manifest.NAME} is damaged (it does not list {absent[0]}): {AGAIN}")
    return found


def _clip(folder: Path, split: str, k: int) -> Path:
    return folder / "clips" / f"{split}-{k:03d}.safetensors"


def _table(folder: Path, name: str) -> Path:
    return folder / "images" / f"{name}.safetensors"


def image_path(folder: Path, name: str, pose: int, view: int) -> Path:
    """Where a set's picture lies."""
    return folder / "images" / name / f"{pose:05d}_{view:02d}.png"


def _pictures(folder: Path, name: str, views: np.ndarray) -> np.ndarray:
    """All pictures (p, k, h, w, 4) of a set."""
    paths = [image_path(folder, name, pose, int(view)) for pose, row in enumerate(views) for view in row]
    with concurrent.futures.ThreadPoolExecutor() as pool:
        pixels = np.stack(list(pool.map(exr.read_png, paths)))
    return pixels.reshape(*views.shape, *pixels.shape[1:])


@functools.cache
def _atlas_fields() -> tuple[dataclasses.Field, ...]:
    return tuple(f for f in dataclasses.fields(posmap.Atlas) if f.name != "size")


def atlas_of(arrays: dict[str, np.ndarray], size: int) -> posmap.Atlas:
    """The atlas among the arrays of avatar.safetensors."""
    return posmap.Atlas(**{f.name: jnp.asarray(arrays[f"atlas/{f.name}"]) for f in _atlas_fields()}, size=size)
