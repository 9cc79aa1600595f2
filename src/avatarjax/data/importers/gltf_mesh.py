"""Skinned, morphed and rigid glTF meshes as vertices per frame (glTF 2.0, 3.7: skins, morph targets, materials)."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from avatarjax.data.importers import gltf_animation, gltf_file, textures
from avatarjax.data.importers.gltf_file import GltfFile
from avatarjax.data.importers.raw import (
    Material,
    RawFrame,
    RawMesh,
    RawSequence,
    check_faces,
    check_vertices,
    corner_uvs,
)

_TRIANGLES = 4
_GREY = (200, 200, 200)


def read(files: Sequence[Path], root: Path, clips: Sequence[str | None], frames: slice) -> RawMesh:
    """Sequences from the clips of one file, or from one clip of each of several files, all meshes of a file joined.

    Clips are sampled 30 times a second; `frames` picks samples of each. Raises ValueError that names the file where it
    holds a skeleton but no mesh, where two files hold different meshes, or anything is damaged.
    """
    sequences, first = [], None
    for path in files:
        file = gltf_file.read(path, root)
        for clip in clips:
            with gltf_file.damage(path):
                times, tracks, name = gltf_animation.sample_clip(file, clip, gltf_animation.FPS)
                frame, vertices = _evaluate(file, tracks, len(times))
                joints = None
                if file.entries("skins"):
                    world = gltf_animation.world_matrices(file, tracks, len(times))[frames]
                    joints = gltf_animation.skeleton(file, world, gltf_animation.FPS, name)
            first = first or frame
            if first.vertices.shape != frame.vertices.shape or not np.array_equal(first.faces, frame.faces):
                raise ValueError(f"{path} holds another mesh than {files[0]}: export every clip with the same mesh")
            if not len(vertices[frames]):
                raise ValueError(f"{path} has {len(times)} samples, none is left by start, stop and every")
            label = path.stem if len(files) > 1 else name or path.stem
            sequences.append(RawSequence(label, vertices[frames], tuple(range(len(times))), None, joints))
    assert first is not None and first.face_materials is not None
    source = str(files[0] if len(files) == 1 else files[0].parent)
    return RawMesh(
        tuple(sequences),
        first.faces,
        first.uvs,
        first.materials,
        first.face_materials,
        source,
        gltf_animation.FPS,
        "gltf",
    )


def has_clips(path: Path) -> bool:
    """Whether a glTF file holds an animation."""
    return bool(gltf_file.read(path).entries("animations"))


def read_frame(path: Path, root: Path) -> RawFrame:
    """A glTF file at rest: its meshes where its nodes put them."""
    file = gltf_file.read(path, root)
    with gltf_file.damage(path):
        frame, vertices = _evaluate(file, {}, 1)
    return dataclasses.replace(frame, vertices=vertices[0])


def _evaluate(file: GltfFile, tracks: dict[tuple[int, str], np.ndarray], frames: int) -> tuple[RawFrame, np.ndarray]:
    world = gltf_animation.world_matrices(file, tracks, frames)
    order, _ = gltf_animation.node_order(file)
    parts: list[RawFrame] = []
    moved: list[np.ndarray] = []
    materials = _Materials(file)
    for index in order:
        node = file.entries("nodes")[index]
        if "mesh" not in node:
            continue
        mesh = file.entry("meshes", node["mesh"])
        weights = tracks.get((index, "weights"))
        if weights is None:
            rest = node.get("weights", mesh.get("weights"))
            weights = None if rest is None else np.tile(np.array(rest, np.float64), (frames, 1))
        matrices = _skin_matrices(file, node["skin"], world) if "skin" in node else None
        for primitive in mesh["primitives"]:
            if primitive.get("mode", _TRIANGLES) != _TRIANGLES:
                raise ValueError(f"{file.path}: mesh {mesh.get('name', '')!r} is not made of triangles: triangulate it")
            part = _primitive(file, primitive, materials)
            parts.append(part)
            shaped = _morph(file, primitive, part.vertices, weights, frames)
            if matrices is not None:
                moved.append(_skin(file, primitive, shaped, matrices))
            else:
                moved.append(_move(shaped, world[:, index, :3]).astype(np.float32))
    if not parts:
        raise ValueError(
            f"{file.path} has no mesh: for its skeleton use load_gltf_animation, or export the mesh with its armature"
        )
    return _join(parts, materials), check_vertices(np.concatenate(moved, axis=1), file.path)


def _join(parts: list[RawFrame], materials: _Materials) -> RawFrame:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts[:-1], strict=True)])
    uvs = None
    if any(part.uvs is not None for part in parts):
        # Parts without coordinates are of one colour: any place in its tile will do.
        each = [np.full((len(p.faces), 3, 2), 0.5, np.float32) if p.uvs is None else p.uvs for p in parts]
        uvs = np.concatenate(each)
    vertices = np.concatenate([part.vertices for part in parts])
    return RawFrame(
        vertices,
        faces,
        uvs,
        tuple(materials.all),
        np.concatenate([p.face_materials for p in parts if p.face_materials is not None]),
    )


def _move(vertices: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    return np.einsum("fab,fvb->fva", matrices[:, :, :3], vertices) + matrices[:, None, :, 3]


def _primitive(file: GltfFile, primitive: dict[str, typing.Any], materials: _Materials) -> RawFrame:
    attributes = primitive["attributes"]
    if "POSITION" not in attributes:
        raise ValueError(f"{file.path} has a mesh without positions: export it again")
    vertices = check_vertices(file.accessor(attributes["POSITION"]), file.path)
    if "indices" in primitive:
        corners = file.accessor(primitive["indices"])[:, 0].astype(np.int64)
    else:
        corners = np.arange(len(vertices))
    if len(corners) % 3:
        raise ValueError(f"{file.path}: {len(corners)} indices are no whole number of triangles: export it again")
    faces = check_faces(corners.reshape(-1, 3), len(vertices), file.path)
    material, channel, transform = materials.place(primitive.get("material"))
    uvs, name = None, f"TEXCOORD_{channel}"
    if name in attributes:
        # glTF counts v down from the top of the image.
        flat = file.accessor(attributes[name]).astype(np.float64) * transform["scale"] + transform["offset"]
        uvs = corner_uvs(flat * (1.0, -1.0) + (0.0, 1.0), faces, len(vertices), file.path)
    return RawFrame(vertices, faces, uvs, (), np.full(len(faces), material))


def _morph(
    file: GltfFile, primitive: dict[str, typing.Any], vertices: np.ndarray, weights: np.ndarray | None, frames: int
) -> np.ndarray:
    """Vertices (f, v, 3) with morph targets, or (1, v, 3) where nothing changes them."""
    targets = primitive.get("targets", [])
    if not targets or weights is None:
        return vertices[None].astype(np.float64)
    if weights.shape[1] != len(targets):
        raise ValueError(f"{file.path}: {weights.shape[1]} weights for {len(targets)} morph targets: export it again")
    result = np.tile(vertices.astype(np.float64), (frames, 1, 1))
    for k, target in enumerate(targets):
        if "POSITION" in target:
            delta = file.accessor(target["POSITION"])
            if delta.shape != vertices.shape:
                raise ValueError(f"{file.path}: morph target {k} has {len(delta)} vertices, not {len(vertices)}")
            result += weights[:, k, None, None] * delta
    return result


def _skin_matrices(file: GltfFile, skin: int, world: np.ndarray) -> np.ndarray:
    """Bind pose to world (f, j, 4, 4): joint times inverse bind matrix."""
    entry = file.entry("skins", skin)
    joints = entry["joints"]
    if "inverseBindMatrices" not in entry:
        return world[:, joints]
    inverse = file.accessor(entry["inverseBindMatrices"])
    if inverse.shape != (len(joints), 16):
        raise ValueError(f"{file.path}: {len(inverse)} inverse bind matrices for {len(joints)} joints: export it again")
    return world[:, joints] @ inverse.reshape(-1, 4, 4).transpose(0, 2, 1)


def _skin(file: GltfFile, primitive: dict[str, typing.Any], vertices: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    """Linear blend skinning (f, v, 3) float32 of vertices (f or 1, v, 3); the node's own place does not count."""
    attributes, count, joints = primitive["attributes"], vertices.shape[1], matrices.shape[1]
    dense = np.zeros((count, joints))
    rows = np.arange(count)
    sets = 0
    while f"JOINTS_{sets}" in attributes and f"WEIGHTS_{sets}" in attributes:
        index = file.accessor(attributes[f"JOINTS_{sets}"]).astype(np.int64)
        weight = file.accessor(attributes[f"WEIGHTS_{sets}"])
        if index.shape != (count, 4) or weight.shape != (count, 4) or index.max() >= joints:
            raise ValueError(f"{file.path}: its skinning weights do not fit its {joints} joints: export it again")
        for k in range(4):
            np.add.at(dense, (rows, index[:, k]), weight[:, k])
        sets += 1
    totals = dense.sum(axis=1)
    if not sets or (totals <= 0).any():
        raise ValueError(f"{file.path} has vertices that follow no joint: normalise the skinning weights")
    dense /= totals[:, None]
    result = np.empty((len(matrices), count, 3), np.float32)
    for frame, each in enumerate(matrices):
        blended = (dense @ each[:, :3].reshape(joints, 12)).reshape(count, 3, 4)
        own = vertices[frame if len(vertices) > 1 else 0]
        result[frame] = np.einsum("vab,vb->va", blended[..., :3], own) + blended[..., 3]
    return result


class _Materials:
    """The materials in use, their base colour images decoded once each."""

    def __init__(self, file: GltfFile) -> None:
        self.file = file
        self.all: list[Material] = []
        self._places: dict[int | None, tuple[int, int, dict[str, typing.Any]]] = {}
        self._images: dict[int, np.ndarray] = {}

    def place(self, index: int | None) -> tuple[int, int, dict[str, typing.Any]]:
        """Where in `all` a material is, which TEXCOORD set it uses, and the offset and scale of its coordinates."""
        if index not in self._places:
            transform: dict[str, typing.Any] = {"offset": (0.0, 0.0), "scale": (1.0, 1.0)}
            entry = {} if index is None else self.file.entry("materials", index)
            base = entry.get("pbrMetallicRoughness", {})
            factor = base.get("baseColorFactor", [c / 255 for c in _GREY] if index is None else [1.0] * 3)
            red, green, blue = (round(255 * _display(c)) for c in factor[:3])
            reference, image = base.get("baseColorTexture"), None
            if reference is not None:
                image = self._image(self.file.entry("textures", reference["index"]).get("source"))
                changed = reference.get("extensions", {}).get("KHR_texture_transform", {})
                if changed.get("rotation"):
                    raise ValueError(f"{self.file.path} rotates a texture in its material: bake the coordinates")
                transform.update({k: changed[k] for k in transform if k in changed})
            self.all.append(Material(image, (red, green, blue), entry.get("name", "")))
            channel = 0 if reference is None else reference.get("texCoord", 0)
            self._places[index] = len(self.all) - 1, channel, transform
        return self._places[index]

    def _image(self, index: int | None) -> np.ndarray | None:
        if index is None:
            return None
        if index not in self._images:
            entry = self.file.entry("images", index)
            if "bufferView" in entry:
                data, start, end, _ = self.file.view(entry["bufferView"])
                self._images[index] = textures.decode(data[start:end], f"{self.file.path}, image {index}")
            elif entry.get("uri", "").startswith("data:"):
                self._images[index] = textures.decode(
                    self.file.resource(entry["uri"]), f"{self.file.path}, image {index}"
                )
            else:
                folder = self.file.path.parent
                target = textures.named_image(self.file.root, folder, entry.get("uri", ""), self.file.path)
                self._images[index] = textures.read(target)
        return self._images[index]


def _display(linear: float) -> float:
    """A linear colour factor as display sRGB (IEC 61966-2-1)."""
    linear = min(max(linear, 0.0), 1.0)
    return 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055
