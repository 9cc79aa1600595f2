"""Wavefront OBJ frames with the file's own vertex order and a texture coordinate per corner.

Common loaders, trimesh among them, split vertices along texture seams; a mesh sequence needs the vertices as the
exporter wrote them, so that positions and seams stay apart.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from avatarjax.data.importers import textures
from avatarjax.data.importers.raw import Material, RawFrame, check_faces, check_vertices

_GREY = (200, 200, 200)


def read_vertices(path: Path) -> tuple[np.ndarray, list[str]]:
    """Vertices (v, 3) float32 and the lines that define faces and materials, by which topologies are compared.

    Raises ValueError that names the file where it is empty or holds something that is not a number.
    """
    lines = path.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ").splitlines()
    try:
        vertices = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], np.float64)
    except ValueError as error:
        raise ValueError(f"{path} has a vertex that is not three numbers ({error}): export it again") from error
    if not len(vertices):
        raise ValueError(f"{path} is empty: it has no vertices; export it again")
    return check_vertices(vertices, path), [line.strip() for line in lines if line.startswith(("f ", "usemtl "))]


def read(path: Path, root: Path) -> RawFrame:
    """A whole OBJ file; polygons become fans of triangles, materials come from MTL files inside `root`."""
    vertices, topology = read_vertices(path)
    text = path.read_text(encoding="utf-8", errors="replace")
    coordinates = [line.split()[1:3] for line in text.splitlines() if line.startswith("vt ")]
    libraries = [line.split(None, 1)[1].strip() for line in text.splitlines() if line.startswith("mtllib ")]
    faces, corners, face_materials, names, bare = [], [], [], [""], 0
    current = 0
    for line in topology:
        tag, *words = line.split()
        if tag == "usemtl":
            name = " ".join(words)
            names += [] if name in names else [name]
            current = names.index(name)
            continue
        try:
            polygon = [_corner(word, len(vertices), len(coordinates)) for word in words]
        except ValueError as error:
            raise ValueError(
                f"{path}: the face {line!r} is not made of vertex/texture indices: export it again"
            ) from error
        bare += sum(t is None for _, t in polygon)
        for k in range(1, len(polygon) - 1):
            triangle = polygon[0], polygon[k], polygon[k + 1]
            faces.append([v for v, _ in triangle])
            corners.append([-1 if t is None else t for _, t in triangle])
            face_materials.append(current)
    checked = check_faces(np.array(faces, np.int64).reshape(-1, 3), len(vertices), path)
    return RawFrame(
        vertices,
        checked,
        _uvs(path, coordinates, np.array(corners), bare),
        _materials(path, root, libraries, names),
        np.array(face_materials),
    )


def _corner(word: str, vertex_count: int, uv_count: int) -> tuple[int, int | None]:
    """Vertex and texture index from 0 of `v`, `v/vt`, `v/vt/vn` or `v//vn`; negative indices count from the end."""
    vertex, texture = (*word.split("/"), "")[:2]
    v, t = int(vertex), int(texture) if texture else 0
    return v - 1 if v > 0 else v + vertex_count, None if t == 0 else t - 1 if t > 0 else t + uv_count


def _uvs(path: Path, coordinates: list[list[str]], corners: np.ndarray, bare: int) -> np.ndarray | None:
    if not coordinates or (corners < 0).all():
        return None
    if bare:
        raise ValueError(f"{path}: {bare} face corners have no texture coordinate, others have: unwrap the whole mesh")
    if corners.min() < 0 or corners.max() >= len(coordinates):
        raise ValueError(
            f"{path}: faces use texture coordinates up to {corners.max() + 1}, the file has {len(coordinates)}: "
            "export it again"
        )
    uvs = np.array(coordinates, np.float32)[corners]
    if not np.isfinite(uvs).all():
        raise ValueError(f"{path}: a texture coordinate is not finite: unwrap the mesh again")
    return uvs


def _materials(path: Path, root: Path, libraries: list[str], names: list[str]) -> tuple[Material, ...]:
    known: dict[str, Material] = {}
    images: dict[Path, np.ndarray] = {}
    for library in libraries:
        file = textures.series.inside(root, path.parent, library, path)
        # Exporters name a library even where none was written; plain grey does then.
        if not file.is_file():
            continue
        name, color, image = "", _GREY, None
        for line in [*file.read_text(encoding="utf-8", errors="replace").splitlines(), "newmtl"]:
            tag, _, value = line.strip().partition(" ")
            if tag == "newmtl":
                known[name] = Material(image, color, name)
                name, color, image = value.strip(), _GREY, None
            elif tag == "Kd":
                red, green, blue = (round(255 * min(max(float(x), 0.0), 1.0)) for x in value.split()[:3])
                color = red, green, blue
            elif tag == "map_Kd" and value.strip():
                # Options such as -s 1 1 1 come before the name.
                words = value.strip()
                words = words if not words.startswith("-") else words.split()[-1]
                target = textures.named_image(root, file.parent, words, file)
                if target not in images:
                    images[target] = textures.read(target)
                image = images[target]
    return tuple(known.get(name, Material(None, _GREY, name)) for name in names)
