"""Folders of mesh frames, as exported from Unreal or Blender: OBJ, PLY, GLB or NPZ with one topology."""

from __future__ import annotations

import re
import typing
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from avatarjax.data.importers import gltf_mesh, obj, series
from avatarjax.data.importers.raw import (
    Material,
    RawFrame,
    RawMesh,
    RawSequence,
    check_faces,
    check_vertices,
    corner_uvs,
)
from avatarjax.posmap import groups

SUFFIXES = (".obj", ".ply", ".glb", ".gltf", ".npz")
_FOREIGN = (".fbx", ".abc", ".usd", ".usda", ".usdc", ".usdz", ".blend", ".stl", ".dae", ".uasset", ".pkl", ".pickle")
_NUMPY_HINT = "write it with numpy.savez(vertices=(f, v, 3), faces=(g, 3), uvs=..., fps=...)"


def mesh_files(folder: Path) -> list[Path]:
    """The mesh files of a folder in natural order; ValueError where they are of different kinds."""
    files = [p for p in folder.iterdir() if p.is_file() and p.suffix.lower() in SUFFIXES]
    kinds = sorted({p.suffix.lower() for p in files})
    if len(kinds) > 1:
        raise ValueError(f"{folder} holds frames of different kinds ({', '.join(kinds)}): keep one kind")
    return series.natural_order(files)


def sequence_folders(folder: Path) -> list[Path]:
    """Subfolders that hold mesh files, in natural order."""
    return series.natural_order(p for p in folder.iterdir() if p.is_dir() and p.name != "textures" and mesh_files(p))


def read(path: Path, frames: slice) -> RawMesh:
    """A folder of frames, a folder of such folders, or a single file, as one mesh in several sequences.

    `frames` picks frames of each sequence. Raises ValueError that names the file and the fix for frames that are not
    one mesh, damaged, empty, or missing in the series.
    """
    if path.is_file():
        return _combine(path, [(path.stem, [path])], path.parent, frames)
    files, folders = mesh_files(path), sequence_folders(path)
    if files and folders:
        raise ValueError(f"{path} holds frames and folders of frames ({folders[0].name}): keep one of the two")
    if not files and not folders:
        foreign = [p.name for p in path.iterdir() if p.suffix.lower() in _FOREIGN]
        found = f"; {foreign[0]} cannot be read, export it as OBJ, PLY, GLB or NPZ" if foreign else ""
        raise ValueError(f"{path} holds no mesh frames ({', '.join(SUFFIXES)}) and no folders of them{found}")
    listed = [(folder.name, mesh_files(folder)) for folder in folders] or [(path.name, files)]
    return _combine(path, listed, path, frames)


def _combine(path: Path, listed: Sequence[tuple[str, list[Path]]], root: Path, frames: slice) -> RawMesh:
    sequences, first, fps = [], None, None
    for name, files in listed:
        if files[0].suffix.lower() == ".npz" and len(files) == 1:
            frame, sequence, found_fps = _read_array(files[0], name, first, frames)
        else:
            frame, sequence = _read_series(files, name, first, root, frames)
            found_fps = None
        if first is not None and frame is not first and not _same_topology(first, frame):
            raise ValueError(other_topology(files[0], listed[0][1][0], first, frame))
        first = first or frame
        if fps is not None and found_fps is not None and fps != found_fps:
            raise ValueError(f"{files[0]} has {found_fps} frames a second, earlier sequences {fps}: pass fps")
        fps = found_fps if fps is None else fps
        sequences.append(_with_folder_action(sequence))
    assert first is not None
    which = np.zeros(len(first.faces), np.int64) if first.face_materials is None else first.face_materials
    materials = first.materials or (Material(None, (200, 200, 200)),)
    kind = listed[0][1][0].suffix.lower()
    axes = "gltf" if kind in (".glb", ".gltf") else None
    return RawMesh(tuple(sequences), first.faces, first.uvs, materials, which, str(path), fps, axes)


def _with_folder_action(sequence: RawSequence) -> RawSequence:
    """Folders named as in the public release carry their action in their name."""
    if sequence.actions is not None or not re.fullmatch(r".+_\d{5}_[^_]+", sequence.name):
        return sequence
    action = groups.parse_group_name(sequence.name)[2]
    return RawSequence(sequence.name, sequence.vertices, sequence.numbers, action, sequence.joints)


def _same_topology(first: RawFrame, other: RawFrame) -> bool:
    return first.vertices.shape == other.vertices.shape and np.array_equal(first.faces, other.faces)


def other_topology(path: Path, reference: Path, first: RawFrame, other: RawFrame) -> str:
    return (
        f"{path} has another topology ({len(other.vertices)} vertices, {len(other.faces)} faces) than {reference} "
        f"({len(first.vertices)}, {len(first.faces)}): export every frame with the same vertices and faces in the same "
        "order (no remeshing, no frame-dependent modifiers)"
    )


def _read_series(
    files: list[Path], name: str, first: RawFrame | None, root: Path, frames: slice
) -> tuple[RawFrame, RawSequence]:
    numbers = series.frame_numbers(files)
    chosen = list(zip(files, numbers, strict=True))[frames]
    if not chosen:
        raise ValueError(f"sequence {name} has {len(files)} frames, none is left by start, stop and every")
    reference, kind = chosen[0][0], files[0].suffix.lower()
    opening = _read_one(reference, root)
    first = first if first is not None and _same_topology(first, opening) else opening
    # Each OBJ frame repeats the faces as text; equal text is compared instead of parsed.
    text = obj.read_vertices(reference)[1] if kind == ".obj" else None
    vertices = np.empty((len(chosen), *opening.vertices.shape), np.float32)
    vertices[0] = opening.vertices
    for k, (path, _) in enumerate(chosen[1:], 1):
        if kind == ".obj":
            points, topology = obj.read_vertices(path)
            if points.shape == opening.vertices.shape and topology == text:
                vertices[k] = points
                continue
        frame = _read_one(path, root, opening)
        if not _same_topology(opening, frame):
            raise ValueError(other_topology(path, reference, opening, frame))
        vertices[k] = frame.vertices
    return first, RawSequence(name, vertices, numbers)


def _read_one(path: Path, root: Path, first: RawFrame | None = None) -> RawFrame:
    if path.stat().st_size == 0:
        raise ValueError(f"{path} is empty: export this frame again")
    kind = path.suffix.lower()
    if kind == ".obj":
        return obj.read(path, root)
    if kind in (".glb", ".gltf"):
        return gltf_mesh.read_frame(path, root)
    if kind == ".npz":
        arrays = _arrays(path)
        vertices = check_vertices(_needed(arrays, "vertices", path), path)
        if first is not None and "faces" not in arrays:
            return RawFrame(vertices, first.faces, first.uvs)
        faces = check_faces(_needed(arrays, "faces", path), len(vertices), path)
        return RawFrame(vertices, faces, corner_uvs(arrays.get("uvs"), faces, len(vertices), path))
    return _read_ply(path)


def _read_ply(path: Path) -> RawFrame:
    import trimesh

    try:
        with path.open("rb") as stream:
            # process=False and order kept: vertices must stay as exported.
            content = trimesh.exchange.ply.load_ply(stream, fix_texture=False, skip_materials=True)
    except Exception as error:  # trimesh raises whatever its parser met
        raise ValueError(f"{path} cannot be read as PLY ({error}): export it again") from error
    vertices = check_vertices(np.asarray(content.get("vertices", np.zeros((0, 3)))), path)
    polygons = content.get("faces")
    polygons = np.zeros((0, 3), int) if polygons is None else polygons
    faces = check_faces(np.asarray(trimesh.geometry.triangulate_quads(polygons)), len(vertices), path)
    data = content.get("metadata", {}).get("_ply_raw", {}).get("vertex", {}).get("data")
    uvs = None
    if data is not None:
        # A dictionary of columns for ASCII files, a structured array for binary ones.
        names = set(data) if isinstance(data, dict) else set(data.dtype.names or ())
        for u, v in (("s", "t"), ("u", "v"), ("texture_u", "texture_v")):
            if {u, v} <= names:
                uvs = np.stack([np.ravel(data[u]), np.ravel(data[v])], axis=-1)
    return RawFrame(vertices, faces, corner_uvs(uvs, faces, len(vertices), path))


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an NPZ file, never unpickled."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (ValueError, OSError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is not a whole NPZ file of plain arrays ({error}): {_NUMPY_HINT}") from error


def _needed(arrays: dict[str, np.ndarray], name: str, path: Path) -> np.ndarray:
    if name not in arrays:
        raise ValueError(f"{path} has no array {name!r}, only {', '.join(arrays) or 'none'}: {_NUMPY_HINT}")
    return arrays[name]


def _read_array(
    path: Path, name: str, first: RawFrame | None, frames: slice
) -> tuple[RawFrame, RawSequence, float | None]:
    """A sequence in one NPZ file: vertices (f, v, 3) or (v, 3), faces, and optional uvs, actions and fps."""
    if path.stat().st_size == 0:
        raise ValueError(f"{path} is empty: {_NUMPY_HINT}")
    arrays = _arrays(path)
    vertices = check_vertices(_needed(arrays, "vertices", path), path)
    vertices = vertices[None] if vertices.ndim == 2 else vertices
    if vertices.ndim != 3:
        raise ValueError(f"{path}: vertices must be of shape (f, v, 3) or (v, 3), got {vertices.shape}")
    if first is not None and "faces" not in arrays:
        frame = RawFrame(vertices[0], first.faces, first.uvs)
    else:
        faces = check_faces(_needed(arrays, "faces", path), vertices.shape[1], path)
        frame = RawFrame(vertices[0], faces, corner_uvs(arrays.get("uvs"), faces, vertices.shape[1], path))
    actions: typing.Any = None
    if "actions" in arrays:
        actions = arrays["actions"].ravel().tolist()
        if len(actions) != len(vertices):
            raise ValueError(f"{path}: {len(actions)} actions for {len(vertices)} frames: give one for each frame")
    fps = float(arrays["fps"]) if "fps" in arrays and arrays["fps"].size == 1 else None
    if not len(vertices[frames]):
        raise ValueError(f"{path} has {len(vertices)} frames, none is left by start, stop and every")
    return frame, RawSequence(name, vertices[frames], tuple(range(len(vertices))), actions), fps
