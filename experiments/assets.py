"""Build the shipped asset file: a MakeHuman body, its rig and a few motion clips, as one small safetensors file.

    python -m experiments.assets --mpfb2 DIR --emotes DIR [--out FILE]

Takes about five seconds and writes the same bytes every time. ASSETS.md says what is kept and where it is from.
"""

from __future__ import annotations

import dataclasses
import gzip
import json
from pathlib import Path

import numpy as np

from avatarjax.data import body
from avatarjax.data.motion import clips, retargeting
from avatarjax.io import weights

# The body, the eyeballs, and MakeHuman's helper geometry for clothes: shells around the whole body and under the waist.
GROUPS = ("body", "helper-l-eye", "helper-r-eye", "helper-tights", "helper-skirt", "helper-hair")
TARGETS = (
    "caucasian-female-young",
    "caucasian-male-young",
    "caucasian-male-old",
    "asian-female-young",
    "asian-male-old",
    "african-male-young",
    "universal-female-young-averagemuscle-minweight",
    "universal-female-young-minmuscle-minweight",
    "universal-female-young-maxmuscle-averageweight",
    "universal-male-young-maxmuscle-averageweight",
    "universal-male-old-minmuscle-minweight",
)
# A clip that loops ends on a copy of its first frame, which is dropped.
CLIPS = {"idle": True, "run": True, "walk": True, "jump": False, "wave": False, "clap": False, "dance": False}


@dataclasses.dataclass(frozen=True)
class Config:
    """Where the raw downloads lie and where the asset goes."""

    mpfb2: Path = Path("../shared/data/assets/mpfb2")
    emotes: Path = Path("../shared/data/assets/dcl_emotes")
    out: Path = body.ASSET


def read_obj(path: Path) -> tuple[np.ndarray, np.ndarray, dict[str, list]]:
    """Vertices (n, 3) in the file's unit, texture coordinates (m, 2), and per group its faces of (vertex, uv) pairs."""
    vertices, uvs, groups, group = [], [], {}, ""
    for line in path.read_text().splitlines():
        tag, *values = line.split() or [""]
        if tag == "v":
            vertices.append([float(x) for x in values])
        elif tag == "vt":
            uvs.append([float(x) for x in values[:2]])
        elif tag == "g":
            group = values[0]
        elif tag == "f":
            corners = [[int(i or 0) - 1 for i in ([*c.split("/"), "0"])[:2]] for c in values]
            groups.setdefault(group, []).append(corners)
    return np.array(vertices), np.array(uvs), groups


def read_target(path: Path, count: int) -> np.ndarray:
    """The dense offsets (count, 3) of a MakeHuman target, in the unit of the base mesh."""
    offsets = np.zeros((count, 3))
    for line in gzip.decompress(path.read_bytes()).decode().splitlines():
        if line and not line.startswith("#"):
            index, *delta = line.split()
            offsets[int(index)] = [float(x) for x in delta]
    return offsets


def read_rig(path: Path, groups: dict[str, list]) -> tuple[tuple[str, ...], tuple[int, ...], list[list[list[int]]]]:
    """Bone names (parents first), parent indices, and the vertices whose mean is each bone's head and tail."""
    bones = json.loads(path.read_text())["bones"]
    order: list[str] = []
    while len(order) < len(bones):
        order += [n for n in bones if n not in order and (not bones[n]["parent"] or bones[n]["parent"] in order)]

    def support(end: dict) -> list[int]:
        if end["strategy"] == "CUBE":
            return sorted({v for face in groups[end["cube_name"]] for v, _ in face})
        return [end["vertex_index"]] if end["strategy"] == "VERTEX" else end["vertex_indices"]

    supports = [[support(bones[n]["head"]), support(bones[n]["tail"])] for n in order]
    parents = tuple(order.index(bones[n]["parent"]) if bones[n]["parent"] else -1 for n in order)
    return tuple(n.split(":")[1] for n in order), parents, supports


def mirrored(joints: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Joints (j, ...) made symmetric in x: the rig's own collar bones rest on vertices that are no mirror images."""
    swapped = [n.replace("Left", "~").replace("Right", "Left").replace("~", "Right") for n in names]
    other = joints[[names.index(n) for n in swapped]] * np.array([-1.0, 1.0, 1.0])
    return (joints + other) / 2


def top_weights(path: Path, names: tuple[str, ...], used: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The four largest skinning weights of each used vertex: bone indices uint8 and weights uint16 of 65535."""
    dense = np.zeros((count, len(names)))
    for bone, entries in json.loads(path.read_text())["weights"].items():
        for vertex, weight in entries:
            dense[vertex, names.index(bone.split(":")[1])] = weight
    dense = dense[used]
    indices = np.argsort(-dense, axis=1, kind="stable")[:, :4]
    values = np.take_along_axis(dense, indices, axis=1)
    values = values / values.sum(1, keepdims=True)
    return indices.astype(np.uint8), np.round(values * 65535).astype(np.uint16)


def build(config: Config) -> dict[str, np.ndarray]:
    """All arrays of the asset by name, and the static metadata under the key `metadata`."""
    vertices, uvs, groups = read_obj(config.mpfb2 / "3dobjs" / "base.obj")
    names, parents, supports = read_rig(config.mpfb2 / "rigs" / "standard" / "rig.mixamo.json", groups)
    quads = np.array([face for g in GROUPS for face in groups[g]])
    used, vertex_faces = np.unique(quads[..., 0], return_inverse=True)
    used_uvs, uv_faces = np.unique(quads[..., 1], return_inverse=True)
    bones, skin = top_weights(config.mpfb2 / "rigs" / "standard" / "weights.mixamo.json", names, used, len(vertices))

    def joints(points: np.ndarray) -> np.ndarray:
        # Heads and tails are means of vertices, so they are as linear in the targets as the vertices are.
        return mirrored(np.array([[points[end].mean(0) for end in bone] for bone in supports]), names)

    def metres(points: np.ndarray) -> np.ndarray:
        return np.round(points * 0.1 / body.QUANTUM).astype(np.int16)

    arrays = {
        "vertices": metres(vertices[used]),
        "joints": (joints(vertices) * 0.1).astype(np.float32),
        "faces": vertex_faces.reshape(-1, 4).astype(np.uint16),
        "uvs": np.round(np.clip(uvs[used_uvs], 0, 1) * 65535).astype(np.uint16),
        "uv_faces": uv_faces.reshape(-1, 4).astype(np.uint16),
        "parts": np.repeat(np.arange(len(GROUPS), dtype=np.uint8), [len(groups[g]) for g in GROUPS]),
        "skin_bones": bones,
        "skin_weights": skin,
    }
    average = joints(vertices)
    for target in TARGETS:
        offsets = read_target(config.mpfb2 / "targets" / "macrodetails" / f"{target}.target.gz", len(vertices))
        arrays[f"targets/{target}"] = metres(offsets[used])
        arrays[f"target_joints/{target}"] = (joints(offsets) * 0.1).astype(np.float32)
        if target in ("caucasian-female-young", "caucasian-male-young"):
            average = average + 0.5 * joints(offsets)
    for name, loops in CLIPS.items():
        orientations, hips = retargeting.bone_orientations(config.emotes / f"{name}.glb")
        quats = retargeting.retarget(orientations, names, parents, average[:, 0], average[:, 1])
        end = -1 if loops else None
        arrays[f"clips/{name}/quats"] = np.round(quats[:end] * clips.QUAT_UNIT).astype(np.int16)
        arrays[f"clips/{name}/hips"] = hips[:end].astype(np.float32)
    arrays["metadata"] = {"names": names, "parents": parents, "groups": GROUPS, "clips": sorted(CLIPS)}
    return arrays


def main(config: Config) -> None:
    """Build the asset and say how large it is."""
    arrays = build(config)
    metadata = arrays.pop("metadata")
    weights.save_tree(config.out, arrays, **metadata)
    print(f"{config.out.name}: {config.out.stat().st_size} bytes, {len(arrays)} arrays")


if __name__ == "__main__":
    import tyro

    main(tyro.cli(Config))
