"""What the import tests feed in: a figure of boxes, its walk, and small glTF files built byte by byte."""

import base64
import json
import struct

import numpy as np
import trimesh

# Extents and centres of boxes, metres: legs, feet that point ahead, trunk, head, arms that hang out.
BOXES = [((0.12, 0.85, 0.14), (side * 0.12, 0.475, 0.0)) for side in (1, -1)] + [
    ((0.1, 0.05, 0.26), (side * 0.12, 0.025, 0.07)) for side in (1, -1)
]
BOXES += [((0.36, 0.6, 0.2), (0.0, 1.2, 0.0)), ((0.14, 0.2, 0.18), (0.0, 1.6, 0.01))]
BOXES += [((0.1, 0.6, 0.1), (side * 0.28, 1.15, 0.0)) for side in (1, -1)]
HEIGHT = 1.7


def figure():
    """Vertices (v, 3) metres standing on the ground and facing +z, faces (g, 3) wound outward, uvs (g, 3, 2)."""
    vertices, faces, count = [], [], 0
    for extents, centre in BOXES:
        box = trimesh.creation.box(extents)
        points, triangles = trimesh.remesh.subdivide(*trimesh.remesh.subdivide(box.vertices, box.faces))
        vertices.append(points + np.array(centre))
        faces.append(triangles + count)
        count += len(points)
    vertices, faces = np.concatenate(vertices), np.concatenate(faces)
    uvs = vertices[faces][..., :2] * [0.5, 0.5] + [0.5, 0.0]
    return vertices.astype(np.float32), faces.astype(np.int32), uvs.astype(np.float32)


def walk(frames):
    """The figure (f, v, 3) gliding ahead while its trunk sways: the same topology in each frame."""
    vertices, _, _ = figure()
    k = np.arange(frames)[:, None]
    moved = np.repeat(vertices[None], frames, axis=0)
    moved[..., 0] += 0.05 * np.sin(k) * moved[..., 1]
    moved[..., 2] += 0.04 * k
    return moved.astype(np.float32)


def write_obj(path, vertices, faces, uvs=None, material=None):
    """One OBJ file with texture coordinates of their own indices."""
    lines = [f"mtllib {material}", "usemtl skin"] if material else []
    lines += ["v " + " ".join(repr(float(x)) for x in v) for v in vertices]
    if uvs is None:
        lines += ["f " + " ".join(str(i + 1) for i in face) for face in faces]
    else:
        lines += ["vt " + " ".join(repr(float(x)) for x in uv) for uv in uvs.reshape(-1, 2)]
        lines += [
            "f " + " ".join(f"{i + 1}/{3 * g + c + 1}" for c, i in enumerate(face)) for g, face in enumerate(faces)
        ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def write_frames(folder, suffix, vertices, faces, uvs=None):
    """A folder of numbered frames of one kind."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, frame in enumerate(vertices):
        path = folder / f"frame_{k + 1:03d}.{suffix}"
        if suffix == "obj":
            write_obj(path, frame, faces, uvs)
        elif suffix == "npz":
            np.savez(path, vertices=frame, faces=faces)
        else:
            trimesh.Trimesh(frame, faces, process=False).export(path)


_COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
_WIDTHS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class GltfBuilder:
    """Collects a glTF document and its one buffer."""

    def __init__(self, **document):
        self.document = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": [], **document}
        self.blob = b""

    def view(self, data):
        """Append bytes as a buffer view; its index."""
        self.blob += b"\0" * (-len(self.blob) % 4)
        self.document["bufferViews"].append({"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data)})
        self.blob += data
        return len(self.document["bufferViews"]) - 1

    def add(self, values, dtype="f4", **more):
        """Append an array as an accessor; its index."""
        values = np.asarray(values)
        values = values.reshape(len(values), -1).astype("<" + dtype)
        view = self.view(values.tobytes())
        accessor = {"bufferView": view, "componentType": _COMPONENTS[dtype], "count": len(values)}
        self.document["accessors"].append({**accessor, "type": _WIDTHS[values.shape[1]], **more})
        return len(self.document["accessors"]) - 1

    def write(self, path, uri=None):
        """Write .glb, or .gltf with a data URI or the given one."""
        if path.suffix == ".gltf":
            data = "data:application/octet-stream;base64," + base64.b64encode(self.blob).decode()
            self.document["buffers"] = [{"byteLength": len(self.blob), "uri": uri or data}]
            path.write_text(json.dumps(self.document))
            return path
        self.document["buffers"] = [{"byteLength": len(self.blob)}]
        text = json.dumps(self.document).encode()
        text += b" " * (-len(text) % 4)
        blob = self.blob + b"\0" * (-len(self.blob) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(blob), 0x004E4942) + blob
        path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)
        return path


def half_turn_about_y(angle):
    """The glTF quaternion (x, y, z, w) of a rotation by `angle` about y."""
    return [0.0, float(np.sin(angle / 2)), 0.0, float(np.cos(angle / 2))]


def skinned_figure(path, interpolation="LINEAR", clip="forward", **channels):
    """A glTF file of the figure skinned to a hip joint and a head joint one metre above it.

    `channels` maps rotation, translation or scale of the hip joint to (keys, values).
    """
    vertices, faces, _ = figure()
    gltf = GltfBuilder(scenes=[{"nodes": [0, 2]}], scene=0)
    hips = np.eye(4)
    hips[:3, 3] = [0, -0.9, 0]
    head = np.eye(4)
    head[:3, 3] = [0, -1.9, 0]
    upper = (vertices[:, 1] > 1.45).astype(float)
    joints = np.zeros((len(vertices), 4))
    joints[:, 1] = 1
    primitive = {
        "attributes": {
            "POSITION": gltf.add(vertices),
            "JOINTS_0": gltf.add(joints, "u1"),
            "WEIGHTS_0": gltf.add(np.stack([1 - upper, upper, 0 * upper, 0 * upper], 1) * 255, "u1", normalized=True),
        },
        "indices": gltf.add(faces.ravel(), "u2"),
    }
    inverse = gltf.add(np.stack([hips.T, head.T]))
    gltf.document |= {
        "nodes": [
            {"name": "hips", "translation": [0, 0.9, 0], "children": [1]},
            {"name": "head", "translation": [0, 1, 0]},
            # The place of a skinned mesh's own node does not count.
            {"name": "body", "mesh": 0, "skin": 0, "translation": [5, 5, 5]},
        ],
        "meshes": [{"primitives": [primitive]}],
        "skins": [{"joints": [0, 1], "inverseBindMatrices": inverse}],
    }
    if channels:
        samplers, targets = [], []
        for name, (keys, values) in channels.items():
            samplers.append({"input": gltf.add(keys), "output": gltf.add(values), "interpolation": interpolation})
            targets.append({"sampler": len(samplers) - 1, "target": {"node": 0, "path": name}})
        gltf.document["animations"] = [{"name": clip, "samplers": samplers, "channels": targets}]
    return gltf.write(path)
