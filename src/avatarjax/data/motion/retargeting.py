"""Motion from a glTF skeleton onto the `mixamo` rig: world orientations matched bone by bone, then made local again."""

from __future__ import annotations

import os

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from avatarjax.data.importers import gltf_file

FPS = 30.0
# The emote skeletons are exported in centimetres below a root that is in metres.
_CHILD_UNIT = 0.01
# How much of a bone's own turn is kept, against its parent's: the emotes' heads and collar bones rest differently.
_SHARES = {"Head": 0.5, "Shoulder": 0.3}


def bone_orientations(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """World rotation matrices (f, 3, 3) of each bone by name, and the hips' path (f, 3) in metres, at 30 frames a
    second.

    Reads the first animation of a binary glTF file of the Decentraland emotes; bone names lose their `Avatar_` prefix.
    """
    file = gltf_file.read(path)
    nodes, animation = file.entries("nodes"), file.entry("animations", 0)
    inputs = [file.accessor(s["input"])[:, 0] for s in animation["samplers"]]
    start, end = min(t[0] for t in inputs), max(t[-1] for t in inputs)
    times = start + np.arange(round((end - start) * FPS) + 1) / FPS
    tracks = {}
    for channel in animation["channels"]:
        values = file.accessor(animation["samplers"][channel["sampler"]]["output"])
        if channel["target"]["path"] == "rotation":
            # q and -q are one rotation: keep neighbours in one hemisphere so that interpolation takes the short way.
            flips = np.cumprod(np.r_[1.0, np.where((values[1:] * values[:-1]).sum(1) < 0, -1.0, 1.0)])
            values = values * flips[:, None]
        track = [np.interp(times, inputs[channel["sampler"]], values[:, k]) for k in range(values.shape[1])]
        tracks[channel["target"]["node"], channel["target"]["path"]] = np.stack(track, axis=1)

    parent = {child: i for i, node in enumerate(nodes) for child in node.get("children", [])}
    world: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def place(i: int) -> tuple[np.ndarray, np.ndarray]:
        if i not in world:
            still = np.ones((len(times), 1))
            quats = tracks.get((i, "rotation"), still * nodes[i].get("rotation", [0.0, 0.0, 0.0, 1.0]))
            offset = tracks.get((i, "translation"), still * nodes[i].get("translation", [0.0, 0.0, 0.0]))
            local = Rotation.from_quat(quats).as_matrix()
            if i in parent:
                rotation, position = place(parent[i])
                moved = position + np.einsum("fab,fb->fa", rotation, offset) * _CHILD_UNIT
                world[i] = rotation @ local, moved
            else:
                world[i] = local, offset
        return world[i]

    orientations = {node["name"].replace("Avatar_", ""): place(i)[0] for i, node in enumerate(nodes)}
    hips = next(i for i, node in enumerate(nodes) if node["name"] == "Avatar_Hips")
    return orientations, place(hips)[1]


def _shortest_arc(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The rotation matrix of least angle that takes direction a to direction b (neither zero nor opposite)."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1 + a @ b)


def _rest_frame(name: str, direction: np.ndarray) -> np.ndarray:
    """Axes (columns) of a bone in our rest pose, written as the emotes write them: y along the bone, x the hinge."""
    if name == "Hips":
        return np.diag([-1.0, -1.0, 1.0])
    direction = direction / np.linalg.norm(direction)
    if any(part in name for part in ("Shoulder", "Arm", "Hand")):
        side = 1.0 if name.startswith("Left") else -1.0
        hinge = _shortest_arc(np.array([side, 0.0, 0.0]), direction) @ np.array([0.0, 1.0, 0.0])
    else:
        hinge = np.array([-1.0 if "Leg" in name else 1.0, 0.0, 0.0])
    hinge = hinge - direction * (hinge @ direction)
    hinge = hinge / np.linalg.norm(hinge)
    return np.stack([hinge, direction, np.cross(hinge, direction)], axis=1)


def retarget(
    orientations: dict[str, np.ndarray],
    names: tuple[str, ...],
    parents: tuple[int, ...],
    heads: Float[np.ndarray, "j 3"],
    tails: Float[np.ndarray, "j 3"],
) -> Float[np.ndarray, "f j 4"]:
    """Local rotations (f, j, 4) relative to the rig's rest pose that give its bones the world orientations of the clip.

    The thumbs follow the hand (the clip's thumb axes differ); heads and collar bones follow in part. Neighbouring
    frames are in one hemisphere.
    """
    frames = len(orientations["Hips"])
    world = np.zeros((frames, len(names), 3, 3))
    for j, name in enumerate(names):
        if "Thumb" in name:
            world[:, j] = world[:, parents[j]]
            continue
        world[:, j] = orientations[name] @ _rest_frame(name, tails[j] - heads[j]).T
        share = _SHARES.get(name.removeprefix("Left").removeprefix("Right"))
        if share is not None:
            u, _, vt = np.linalg.svd(share * world[:, j] + (1 - share) * world[:, parents[j]])
            world[:, j] = u @ vt
    local = world.copy()
    for j, p in enumerate(parents):
        if p >= 0:
            local[:, j] = world[:, p].transpose(0, 2, 1) @ world[:, j]
    quats = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_quat()[:, [3, 0, 1, 2]].reshape(frames, len(names), 4)
    quats[0] *= np.where(quats[0, :, :1] < 0, -1.0, 1.0)
    flips = np.cumprod(np.where((quats[1:] * quats[:-1]).sum(-1) < 0, -1.0, 1.0), axis=0)
    quats[1:] *= flips[..., None]
    return quats
