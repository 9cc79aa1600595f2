"""One avatar's training data in a folder: built once, checked when it is read, never half there.

The manifest is written last and lists every file's size and SHA-256: a folder without one is unfinished, and a file
that does not fit it is named.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import hashlib
import json
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
from avatarjax.data import avatars, sequences
from avatarjax.data.mesh_renderer import MeshRenderer
from avatarjax.data.sequences import Recording
from avatarjax.io import atomic, weights

VERSION = 2
VIEWS = 50  # on the cylinder (UNICA B.1)
LEAD_IN = 15  # idle frames before the report's script
_GOLDEN = np.pi * (3 - np.sqrt(5))


@dataclasses.dataclass(frozen=True)
class DatasetSpec:
    """What a dataset is made of; two datasets with equal specs are equal."""

    avatar: str
    size: int
    upscaled: int
    transition_frames: int
    held_out_frames: int
    image_poses: int
    image_views: int
    standing_views: int
    image_size: int
    script: tuple[int, ...]
    seed: int = 0

    def __post_init__(self):
        if not 1 <= self.image_views <= VIEWS or not 1 <= self.standing_views <= VIEWS:
            raise ValueError(
                f"there are 1 to {VIEWS} views a pose, asked for {self.image_views} and {self.standing_views}"
            )


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


_FILES = {f"{field.name}.safetensors" for field in dataclasses.fields(Dataset)}


def cylinder_cameras(size: int) -> Camera:
    """The 50 cameras of UNICA B.1, on a cylinder about the unit cube of a normalised pose, square pictures.

    Azimuths follow the golden angle, so that any few of them are spread; heights go from -0.2 to 0.6.
    """
    k = np.arange(VIEWS)
    heights = -0.2 + 0.8 * ((k * 0.618034) % 1)
    return cameras.orbit(k * _GOLDEN, target=(0, 0, 0), distance=1.75, heights=heights, width=size, height=size)


def build(folder: Path, spec: DatasetSpec, *, progress: bool = True) -> None:
    """Simulate, encode and render the dataset; several minutes at paper scale. An older one in `folder` is replaced."""
    folder = Path(folder)
    (folder / "manifest.json").unlink(missing_ok=True)
    avatar = avatars.build(spec.avatar)
    atlas = posmap.build_atlas(avatars.a_pose(avatar), avatar.faces, spec.size)
    standing_vertices = avatars.standing_pose(avatar)
    standing = posmap.encode(atlas, jnp.asarray(standing_vertices))

    plans = {
        "train": sequences.transition_scripts(spec.transition_frames, spec.seed),
        "held_out": sequences.transition_scripts(spec.held_out_frames, spec.seed + 1),
        # The controller begins in steady motion: from standing, as a rollout does, takes a moment of idling first.
        "truth": np.asarray([(0,) * LEAD_IN + spec.script], np.int32),
    }
    rng = np.random.default_rng(spec.seed + 3)
    headings = {name: rng.integers(0, 4, len(scripts)) * (np.pi / 2) for name, scripts in plans.items()}
    headings["truth"] = np.zeros(1)
    motions = sequences.simulate(avatar, plans, headings, spec.seed)
    recordings = {}
    for name in tqdm(plans, desc="position maps", unit="set", disable=not progress):
        recordings[name] = sequences.record(avatar, atlas, plans[name], motions[name])
    recordings["truth"] = jax.tree.map(lambda x: x[LEAD_IN:], recordings["truth"])

    painter = _Painter(avatar, atlas, spec)
    tables: dict[str, typing.Any] = {"atlas": atlas, **recordings, "standing": {"texels": standing}}
    root = posmap.root(atlas, standing)
    tables["standing_images"] = painter.paint(
        np.asarray(standing - root[None])[None],
        lambda _: standing_vertices - np.asarray(root),
        np.arange(spec.standing_views)[None],
        "standing pose",
        progress,
    )
    for name, poses in (("train", spec.image_poses), ("held_out", max(8, spec.image_poses // 6))):
        recording, motion = recordings[name], motions[name]
        length = motion.headings.shape[1]
        chosen = np.sort(rng.choice(len(recording.actions), min(poses, len(recording.actions)), replace=False))
        views = np.stack([rng.permutation(VIEWS)[: spec.image_views] for _ in chosen])

        def vertices(k, chosen=chosen, motion=motion, recording=recording, length=length):
            sequence, frame = divmod(int(chosen[k]), length)
            world = sequences.vertices_of(avatar, motion, sequence, slice(frame, frame + 1))[0]
            return world - recording.roots[chosen[k]]

        tables[f"{name}_images"] = painter.paint(
            recording.texels[chosen], vertices, views, f"{name.replace('_', '-')} pictures", progress
        )
    _write(folder, spec, tables)


class _Painter:
    """Renders poses in the box of their upscaled points, where the appearance network works."""

    def __init__(self, avatar: avatars.AvatarMesh, atlas: posmap.Atlas, spec: DatasetSpec):
        self.renderer = MeshRenderer(avatar.faces, avatar.uvs, avatar.texture)
        self.cameras = cylinder_cameras(spec.image_size)
        upscaler = posmap.build_upscaler(atlas, spec.upscaled)
        self.points = jax.jit(lambda texels: posmap.upscale(upscaler, texels))

    def paint(self, texels, vertices, views, label: str, progress: bool) -> Images:
        """`vertices(k)` gives pose k's mesh in the frame of its `texels` (p, t, 3); `views` (p, k)."""
        poses, count = views.shape
        rgba = np.zeros((poses, count, self.cameras.height, self.cameras.width, 4), np.uint8)

        def one(k: int) -> None:
            points = np.asarray(self.points(jnp.asarray(texels[k])))
            low, high = points.min(0), points.max(0)
            boxed = (vertices(k) - (low + high) / 2) / (high - low).max()
            posed = self.renderer.pose(boxed.astype(np.float32))
            for slot, view in enumerate(views[k]):
                camera = jax.tree.map(lambda x, v=view: x[v], self.cameras)
                rgba[k, slot] = posed.render(camera)

        with concurrent.futures.ThreadPoolExecutor() as pool:
            done = pool.map(one, range(poses))
            for _ in tqdm(done, total=poses, desc=label, unit="pose", disable=not progress):
                pass
        return Images(np.asarray(texels, np.float32), views.astype(np.int32), rgba)


def _write(folder: Path, spec: DatasetSpec, tables: dict[str, typing.Any]) -> None:
    files = {}
    for name, tree in tables.items():
        path = folder / f"{name}.safetensors"
        weights.save_tree(path, tree)
        files[path.name] = {"bytes": path.stat().st_size, "sha256": _digest(path)}
    manifest = {"version": VERSION, "spec": dataclasses.asdict(spec), "actions": sequences.ACTIONS, "files": files}
    atomic.write_text(folder / "manifest.json", json.dumps(manifest, indent=2))


def matches(folder: Path, spec: DatasetSpec) -> bool:
    """Whether `folder` has a finished dataset of exactly this spec."""
    try:
        manifest = _manifest(Path(folder))
    except ValueError:
        return False
    return manifest["version"] == VERSION and manifest["spec"] == json.loads(json.dumps(dataclasses.asdict(spec)))


def load(folder: Path) -> Dataset:
    """Read a dataset and check every file against the manifest.

    Raises ValueError that names what is missing, unfinished or damaged, and says how to build it again.
    """
    folder = Path(folder)
    manifest = _manifest(folder)
    again = "build it again with --stage data"
    if manifest["version"] != VERSION:
        raise ValueError(f"{folder} has data of version {manifest['version']}, this is version {VERSION}: {again}")
    for name, expected in manifest["files"].items():
        path = folder / name
        if not path.is_file():
            raise ValueError(f"{path} is missing: {again}")
        if path.stat().st_size != expected["bytes"] or _digest(path) != expected["sha256"]:
            raise ValueError(f"{path} is damaged (its checksum is not the manifest's): {again}")

    def arrays(name):
        return weights.load_arrays(folder / f"{name}.safetensors")[0]

    atlas = arrays("atlas")
    size = int(manifest["spec"]["size"])
    return Dataset(
        atlas=posmap.Atlas(**{k: jnp.asarray(v) for k, v in atlas.items()}, size=size),
        standing=jnp.asarray(arrays("standing")["texels"]),
        **{name: Recording(**arrays(name)) for name in ("train", "held_out", "truth")},
        **{name: Images(**arrays(name)) for name in ("standing_images", "train_images", "held_out_images")},
    )


def fingerprint(folder: Path) -> str:
    """A short name of the data's content, by which checkpoints know what they were trained on."""
    return hashlib.sha256(json.dumps(_manifest(Path(folder))["files"], sort_keys=True).encode()).hexdigest()[:12]


def _manifest(folder: Path) -> dict[str, typing.Any]:
    path = folder / "manifest.json"
    if not path.is_file():
        raise ValueError(f"{folder} has no finished dataset (no manifest.json): build it with --stage data")
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        described = {name: (file["bytes"], file["sha256"]) for name, file in manifest["files"].items()}
        missing = {"version", "spec"} - manifest.keys() | {"size"} - manifest["spec"].keys() | _FILES - described.keys()
        if missing:
            raise KeyError(", ".join(sorted(missing)))
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        raise ValueError(f"{path} is damaged ({error!r}): build the dataset again with --stage data") from error
    # A manifest is data: it may name files of its own folder only.
    for name in manifest["files"]:
        if Path(name).name != name or not name.endswith(".safetensors"):
            raise ValueError(f"{path} names {name!r}, which is not a file of this dataset")
    return manifest


def _digest(path: Path) -> str:
    with path.open("rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()
