"""The one door for everybody's own mesh sequences: whatever lies at a path, as arrays in our axes at 30 fps."""

from __future__ import annotations

import dataclasses
import os
import typing
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from avatarjax.data.importers import actions as action_tables
from avatarjax.data.importers import axes as file_axes
from avatarjax.data.importers import gltf_mesh, mesh_folder, roots, textures
from avatarjax.data.importers.gltf_animation import SkeletonAnimation
from avatarjax.data.importers.raw import RawMesh, RawSequence

FPS = 30.0


@typing.no_type_check
@dataclasses.dataclass(frozen=True, eq=False)
class MeshSequence:
    """One mesh over f frames of one or more sequences, in our axes: metres, y up, facing +z, left at +x; 30 fps.

    vertices (f, v, 3) world; faces (g, 3); uvs (g, 3, 2) per corner, v up, or None; texture (h, w, 3) display sRGB or
    None; actions (f,) ids into action_names, where actions[k] drives frame k to k + 1; sequence (f,) index into
    sequence_names; roots (f, 3) the moving root, metres; joints over the same f frames, or None; source says where it
    is from. Raises ValueError where these do not fit each other.
    """

    vertices: Float[np.ndarray, "f v 3"]
    faces: Int[np.ndarray, "g 3"]
    uvs: Float[np.ndarray, "g 3 2"] | None
    texture: UInt8[np.ndarray, "h w 3"] | None
    actions: Int[np.ndarray, " f"]
    action_names: tuple[str, ...]
    sequence: Int[np.ndarray, " f"]
    sequence_names: tuple[str, ...]
    roots: Float[np.ndarray, "f 3"]
    joints: SkeletonAnimation | None
    source: str

    def __post_init__(self) -> None:
        frames = len(self.vertices)
        for name, length in (("actions", frames), ("sequence", frames), ("roots", frames), ("uvs", len(self.faces))):
            value = getattr(self, name)
            if value is not None and len(value) != length:
                raise ValueError(f"{self.source}: {name} has {len(value)} entries, expected {length}")
        if self.faces.size == 0 or self.faces.min() < 0 or self.faces.max() >= self.vertices.shape[1]:
            raise ValueError(f"{self.source}: faces must use the vertices 0 to {self.vertices.shape[1] - 1}")
        if not (np.isfinite(self.vertices).all() and np.isfinite(self.roots).all()):
            raise ValueError(f"{self.source}: a vertex or root is not finite")


def load_mesh_sequence(
    path: str | os.PathLike,
    *,
    actions: typing.Any = None,
    action_names: Sequence[str] = action_tables.NAMES,
    up: str = "auto",
    forward: str | None = None,
    handedness: str = "right",
    axes: str | None = None,
    unit: str | float = "auto",
    fps: float | None = None,
    root: typing.Any = "waist",
    textures: str | os.PathLike | None = None,
    clip: str | Sequence[str] | None = None,
    start: int = 0,
    stop: int | None = None,
    every: int = 1,
    check: bool = True,
) -> MeshSequence:
    """Load a mesh sequence: a folder of OBJ, PLY, GLB or NPZ frames (or of such folders), an NPZ file, or glTF clips.

    `actions` is one action, a list, a mapping by sequence or an actions file; by default actions.csv or actions.json in
    the folder, the folder's or clip's name. `axes` is "gltf", "blender", "unreal" or "unreal-mesh"; or say `up`,
    `forward` and `handedness`. `unit` is "auto", "m", "cm", "mm" or metres. `fps` is the frames' own rate (the file's,
    or 30). `root` is "waist", vertex indices, or a joint's name. `start`, `stop` and `every` pick frames of each
    sequence before the rest is resampled to 30 fps: positions linearly, actions by what is held. `check=False` skips
    the plausibility of axes and unit. docs/data_import.md describes layouts and files.

    Raises ValueError that names the file and the fix, or the loader to use, for whatever is not one finite mesh with an
    action for every frame.
    """
    path = Path(path)
    _refer(path)
    if every < 1 or start < 0 or (stop is not None and stop <= start):
        raise ValueError(
            f"start={start}, stop={stop}, every={every} pick no frames: need 0 <= start < stop, every >= 1"
        )
    mesh = _read(path, slice(start, stop, every), clip, fps)
    opening = mesh.sequences[0].vertices[0].astype(np.float64)
    where = f"{mesh.source}, sequence {mesh.sequences[0].name}"
    if mesh.axes is not None and axes is None and up == "auto":
        # The format prescribes its axes, so they are held against the figure as stated ones are.
        up, forward = file_axes.PRESETS[mesh.axes][0], forward or file_axes.PRESETS[mesh.axes][1]
    to_ours = file_axes.choose(
        opening, up=up, forward=forward, handedness=handedness, axes=axes, check=check, source=where
    )
    scale = file_axes.metres(float(np.ptp(opening @ to_ours[1])), unit, check=check, source=where)
    to_ours = to_ours * scale
    if mesh.sequences[0].joints is not None and np.linalg.det(to_ours) < 0:
        raise ValueError(f"{where}: glTF is right-handed, its joints cannot be mirrored: leave out axes and handedness")
    held = _actions(path, mesh, actions, tuple(action_names))
    rate = (fps or mesh.fps or FPS) / every
    if not rate > 0:
        raise ValueError(f"fps must be positive, got {fps}")
    parts = [_resampled(s, held[s.name][slice(start, stop, every)], to_ours, rate) for s in mesh.sequences]
    vertices = np.concatenate([vertices for vertices, _, _ in parts])
    joints = _joined_joints(mesh, [transforms for _, _, transforms in parts])

    faces, uvs = mesh.faces, mesh.uvs
    if np.linalg.det(to_ours) < 0:
        faces, uvs = faces[:, ::-1].copy(), None if uvs is None else uvs[:, ::-1].copy()
        faces, uvs = file_axes.outward(vertices[0], faces, uvs)
    texture, uvs = _texture(path, mesh, uvs, textures)
    return MeshSequence(
        vertices=vertices,
        faces=faces,
        uvs=uvs,
        texture=texture,
        actions=np.concatenate([ids for _, ids, _ in parts]).astype(np.int32),
        action_names=tuple(action_names),
        sequence=np.repeat(np.arange(len(parts), dtype=np.int32), [len(ids) for _, ids, _ in parts]),
        sequence_names=tuple(s.name for s in mesh.sequences),
        roots=roots.roots(vertices, faces, root, joints, source=mesh.source),
        joints=joints,
        source=mesh.source,
    )


def _refer(path: Path) -> None:
    """ValueError that names the right loader for what is no mesh sequence."""
    if not path.exists():
        raise ValueError(f"{path} does not exist")
    if path.is_file():
        suffix = path.suffix.lower()
        if suffix == ".ply" and b"property float f_dc_0" in path.read_bytes()[:65536]:
            raise ValueError(f"{path} is a cloud of Gaussians: use load_gaussian_scene")
        if suffix not in mesh_folder.SUFFIXES:
            kinds = ", ".join(mesh_folder.SUFFIXES)
            raise ValueError(f"{path} is no mesh that can be read ({kinds}): export it as one of these")
        return
    if (path / "point_cloud").is_dir():
        raise ValueError(f"{path} is a scene of Gaussians: use load_gaussian_scene")
    if (path / "masks").is_dir() and (path / "cameras.json").is_file():
        raise ValueError(f"{path} is a monocular video: use load_monocular")
    if any(path.glob("1.exr")) or any(path.glob("*/1.exr")) or any(path.glob("*/*/1.exr")):
        raise ValueError(f"{path} holds position maps: use load_position_maps")


def _read(path: Path, frames: slice, clip: str | Sequence[str] | None, fps: float | None) -> RawMesh:
    files = [path] if path.is_file() else mesh_folder.mesh_files(path)
    clips = [clip] if clip is None or isinstance(clip, str) else list(clip)
    if files and files[0].suffix.lower() in (".glb", ".gltf") and gltf_mesh.has_clips(files[0]):
        if fps is not None:
            raise ValueError(f"{files[0]}: fps={fps} is for numbered frames; a glTF clip says its times in seconds")
        return gltf_mesh.read(files, files[0].parent, clips, frames)
    if clip is not None:
        raise ValueError(f"{path} has no glTF clips to choose clip={clip!r} from")
    return mesh_folder.read(path, frames)


def _actions(path: Path, mesh: RawMesh, actions: typing.Any, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    numbers = {s.name: s.numbers for s in mesh.sequences}
    if len(numbers) != len(mesh.sequences):
        raise ValueError(f"{path} holds two sequences of one name ({', '.join(numbers)}): rename one")
    if actions is not None:
        source = actions if isinstance(actions, str | Path) else "actions"
        return action_tables.resolve(actions, names, numbers, source)
    folder = path if path.is_dir() else path.parent
    found = [folder / name for name in action_tables.FILES if (folder / name).is_file()]
    if len(found) > 1:
        raise ValueError(f"{folder} holds {found[0].name} and {found[1].name}: keep one, or pass actions")
    if found:
        return action_tables.read_actions(found[0], names, numbers)
    known = {name.lower() for name in names}
    given: dict[str, typing.Any] = {}
    for sequence in mesh.sequences:
        given[sequence.name] = sequence.actions
        if sequence.actions is None and sequence.name.lower() in known:
            given[sequence.name] = sequence.name
        if given[sequence.name] is None:
            raise ValueError(
                f"{path}: nothing says which action sequence {sequence.name!r} shows: write actions.csv (frame,action) "
                f"into {folder}, or pass actions, for example actions={names[0]!r}"
            )
    return action_tables.resolve(given, names, numbers, path)


def _resampled(
    sequence: RawSequence, held: np.ndarray, to_ours: np.ndarray, rate: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Vertices, actions and joint transforms of one sequence in our axes at 30 fps."""
    vertices = (sequence.vertices @ to_ours.T.astype(np.float32)).astype(np.float32)
    transforms = None
    if sequence.joints is not None:
        similarity = np.eye(4)
        similarity[:3, :3] = to_ours
        transforms = (similarity @ sequence.joints.transforms).astype(np.float32)
    if abs(rate - FPS) < 1e-6:
        return vertices, held, transforms
    count = len(vertices)
    times = np.arange(int(np.floor((count - 1) * FPS / rate + 1e-6)) + 1) * rate / FPS
    before = np.minimum((times + 1e-6).astype(np.int64), count - 1)
    after, share = np.minimum(before + 1, count - 1), (times - before).astype(np.float32)

    def between(values: np.ndarray) -> np.ndarray:
        weight = share.reshape(-1, *[1] * (values.ndim - 1))
        return values[before] * (1 - weight) + values[after] * weight

    return between(vertices), held[before], None if transforms is None else between(transforms)


def _joined_joints(mesh: RawMesh, transforms: list[np.ndarray | None]) -> SkeletonAnimation | None:
    first = mesh.sequences[0].joints
    known = [each for each in transforms if each is not None]
    if first is None or len(known) != len(transforms):
        return None
    for sequence in mesh.sequences[1:]:
        if sequence.joints is None or sequence.joints.names != first.names:
            raise ValueError(f"{mesh.source}: {sequence.name} has other joints than {mesh.sequences[0].name}")
    return SkeletonAnimation(first.names, first.parents, np.concatenate(known), FPS, first.clip)


def _texture(
    path: Path, mesh: RawMesh, uvs: np.ndarray | None, given: str | os.PathLike | None
) -> tuple[np.ndarray | None, np.ndarray | None]:
    folder = path if path.is_dir() else path.parent
    named = given if given is not None else None
    if named is None and not any(material.image is not None for material in mesh.materials):
        # A texture that only lies there counts for a mesh with coordinates; without them there is nothing to place.
        named = textures.find(folder) if uvs is not None else None
    if named is None:
        return textures.combine(mesh.materials, mesh.face_materials, uvs)
    if uvs is None:
        raise ValueError(f"{path} has no texture coordinates to place {named} by: export the mesh with its UV map")
    return textures.read(named), uvs
