"""One avatar's training data in a folder, checked when it is read; `building` makes it.

manifest.json                     what it was made of, and every file's size and SHA-256; written last
avatar.safetensors                faces, uvs, rest vertices, skinning weights, atlas, standing pose
texture.png
clips/train-000.safetensors       texels, roots, actions, joint rotations and, if asked for, all vertices
images/train/00000_07.png         pose 0 from view 7, straight alpha; images/train.safetensors says which pose
images/truth/00000_02.png         frame 0 of the report's script from cardinal view 2, the third of four
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import json
import typing
from pathlib import Path

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from avatarjax import cameras, posmap
from avatarjax.cameras import Camera
from avatarjax.data import manifest, sequences
from avatarjax.data.sequences import Recording, Take
from avatarjax.io import exr, weights

VERSION = 4
VIEWS = 50  # on the cylinder (UNICA B.1)
CARDINAL_VIEWS = 4
TRUTH_FRAMES = 200  # at most so many are pictured (UNICA C.4)
SPLITS = ("train", "held_out", "truth")
AGAIN = "build it again with --stage data"
_GOLDEN = np.pi * (3 - np.sqrt(5))


@dataclasses.dataclass(frozen=True)
class DatasetSpec:
    """What a dataset is made of; two datasets with equal specs are equal.

    Sequences have `transition_frames` frames, or those of UNICA Table A for None; `scripts` says how training sequences
    press keys: the paper's "transitions" or "chains" (`sequences.SCRIPTS`). `vertices` says whether whole meshes
    are kept, as float16 or float32 relative to the root, and not only the texels of the position maps. `source` names
    recorded meshes from which it is made instead of the simulation (`building.describe`).
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
    scripts: typing.Literal["transitions", "chains"] = "transitions"
    vertices: typing.Literal["none", "float16", "float32"] = "none"
    source: str = ""

    def __post_init__(self):
        if not 1 <= self.image_views <= VIEWS or not 1 <= self.standing_views <= VIEWS:
            raise ValueError(
                f"there are 1 to {VIEWS} views a pose, asked for {self.image_views} and {self.standing_views}"
            )
        if self.scripts not in sequences.SCRIPTS:
            raise ValueError(f"training scripts are {' or '.join(sequences.SCRIPTS)}, not {self.scripts!r}")
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


def cardinal_cameras(size: int) -> Camera:
    """Four cameras (UNICA 4.2) that see a standing figure's whole height and a metre around it, square pictures.

    In metres about the ground under the figure's root: front, left side, back, right side.
    """
    azimuths = np.arange(CARDINAL_VIEWS) * np.pi / 2
    return cameras.orbit(azimuths, target=(0, 0.85, 0), distance=4.2, heights=0.6, width=size, height=size, fov_y=0.52)


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
        index = weights.load_arrays(table_path(folder, name))[0]
        texels = [takes[name][k].texels[f] for k, f in zip(index["sequence"], index["frame"], strict=True)]
        images[f"{name}_images"] = Images(np.stack(texels), index["view"], _pictures(folder, name, index["view"]))
    recordings = {name: sequences.join(takes[name]) for name in SPLITS}
    return Dataset(atlas=atlas, standing=standing, **recordings, **images)


def load_take(folder: Path, split: str, k: int) -> Take:
    """One sequence of a split, without its vertices."""
    names = [field.name for field in dataclasses.fields(Take)]
    return Take(**weights.load_arrays(clip_path(folder, split, k), names)[0])


def truth_pictures(folder: Path) -> UInt8[np.ndarray, "f v h w 4"]:
    """The report's script as the meshes do it: its first frames from `cardinal_cameras` that follow the root."""
    frames = min(TRUTH_FRAMES, read_manifest(Path(folder))["clips"]["truth"][0])
    return _pictures(Path(folder), "truth", np.tile(np.arange(CARDINAL_VIEWS), (frames, 1)))


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
    needed = [clip_path(Path(), name, k).as_posix() for name in SPLITS for k in range(count[name])]
    absent = sorted(set(needed) - set(found["files"]))
    if absent:
        raise ValueError(f"{folder / manifest.NAME} is damaged (it does not list {absent[0]}): {AGAIN}")
    return found


def clip_path(folder: Path, split: str, k: int) -> Path:
    """Where a split's clip lies."""
    return folder / "clips" / f"{split}-{k:03d}.safetensors"


def table_path(folder: Path, name: str) -> Path:
    """Which poses of a split are pictured: sequence (p,), frame (p,), view (p, k)."""
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
def atlas_fields() -> tuple[dataclasses.Field, ...]:
    """The fields of an atlas that are arrays."""
    return tuple(f for f in dataclasses.fields(posmap.Atlas) if f.name != "size")


def atlas_of(arrays: dict[str, np.ndarray], size: int) -> posmap.Atlas:
    """The atlas among the arrays of avatar.safetensors."""
    return posmap.Atlas(**{f.name: jnp.asarray(arrays[f"atlas/{f.name}"]) for f in atlas_fields()}, size=size)
