"""SMPL's skeleton, and poses from its published parameters (Loper et al. 2015, "SMPL"); no SMPL model is needed.

A file holds the parameters of one frame or of f, as a dictionary of arrays in .npy or .pkl, or as .npz, in one of two
conventions. Rotations are rotation vectors, radians; lengths are metres.

poses (72,), Rh (3,), Th (3,)                          EasyMocap, ZJU-MoCap: x = Rh smpl(poses) + Th, Rh about the
                                                       model's origin; 69 poses leave out the root's
global_orient (3,), body_pose (69,), transl (3,)       smplx, 4D-DRESS: x = smpl(global_orient, body_pose) + transl,
                                                       which turns about the pelvis

The origin of SMPL's rest shape lies above its pelvis. Both conventions come out as a rotation about the pelvis and the
pelvis' place in the world, like our own recordings. That place needs the rest shape's pelvis, for which that of the
mean shape is taken: under the first convention the result is rigid to the body all the same, under the second it is
off by as much as the person's own pelvis lies elsewhere in their rest shape, a few centimetres, the same in all frames.
"""

from __future__ import annotations

import typing
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from avatarjax.data.recording import Poses
from avatarjax.io import pickles

NAMES = (
    "pelvis",
    "left_hip",
    "right_hip",
    "spine1",
    "left_knee",
    "right_knee",
    "spine2",
    "left_ankle",
    "right_ankle",
    "spine3",
    "left_foot",
    "right_foot",
    "neck",
    "left_collar",
    "right_collar",
    "head",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_hand",
    "right_hand",
)
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
# Of the mean shape, metres in the rest shape's own axes: x to the left, y up, z ahead.
PELVIS = np.array([-0.002, -0.223, 0.028])


def read_poses(paths: Sequence[Path], world: Float[np.ndarray, "3 3"]) -> Poses:
    """The poses of all frames of these files, in their order; `world` turns the files' world axes to ours.

    rotations (f, 24, 3, 3) with the root's identity, root_rotation (f, 3, 3), root_translation (f, 3) of the pelvis.
    Raises ValueError that names the file for parameters that are missing, damaged, not finite or of wrong size.
    """
    parts = [_read(path) for path in paths]
    joints, orientations, pelvises = (np.concatenate(part) for part in zip(*parts, strict=True))
    rotations = Rotation.from_rotvec(joints.reshape(-1, 3)).as_matrix().reshape(len(joints), 24, 3, 3)
    return Poses(
        rotations.astype(np.float32),
        (world @ orientations).astype(np.float32),
        (pelvises @ world.T).astype(np.float32),
        NAMES,
        PARENTS,
    )


def _read(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotation vectors of joints (f, 24, 3), the root's zero; orientation (f, 3, 3) and place (f, 3) of the pelvis."""
    parameters = read_parameters(path)
    if "Rh" in parameters:
        turn = Rotation.from_rotvec(_array(parameters, "Rh", (3,), path))
        poses = _array(parameters, "poses", (72, 69), path)
        root, body = (poses[:, :3], poses[:, 3:]) if poses.shape[1] == 72 else (np.zeros((len(poses), 3)), poses)
        shift = _array(parameters, "Th", (3,), path)
        _count(path, Rh=turn, poses=poses, Th=shift)
        orientation = turn * Rotation.from_rotvec(root)
        pelvis = turn.apply(PELVIS) + shift
    else:
        orientation = Rotation.from_rotvec(_array(parameters, "global_orient", (3,), path))
        body = _array(parameters, "body_pose", (69,), path)
        shift = _array(parameters, "transl", (3,), path)
        _count(path, global_orient=orientation, body_pose=body, transl=shift)
        pelvis = PELVIS + shift
    joints = np.concatenate([np.zeros((len(body), 1, 3)), body.reshape(-1, 23, 3)], axis=1)
    return joints, orientation.as_matrix(), pelvis


def read_parameters(path: Path) -> dict[str, typing.Any]:
    """The dictionary of arrays in a .npz, .npy or .pkl file, read without running code.

    Raises ValueError that names the file where it is missing, damaged, or holds something else.
    """
    if path.suffix == ".npz":
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
                return dict(archive)
        except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path} is not a whole NPZ file of plain arrays ({error})") from error
    found = pickles.load_npy(path) if path.suffix == ".npy" else pickles.load_arrays(path)
    if not isinstance(found, dict):
        raise ValueError(f"{path} must hold a dictionary of arrays, got {type(found).__name__}")
    return found


def _array(
    parameters: dict[str, typing.Any], name: str, widths: tuple[int, ...], path: Path
) -> Float[np.ndarray, "f w"]:
    """One parameter as rows of the first of the widths that divides it."""
    if name not in parameters:
        keys = "poses, Rh and Th, or global_orient, body_pose and transl"
        raise ValueError(f"{path} has no {name}, only {', '.join(map(str, parameters))}: needs {keys}")
    try:
        values = np.asarray(parameters[name], np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {name} is no array of numbers ({error})") from error
    width = next((w for w in widths if values.size and values.size % w == 0), None)
    if width is None:
        raise ValueError(f"{path}: {name} has shape {values.shape}, expected {' or '.join(map(str, widths))} a frame")
    if not np.isfinite(values).all():
        raise ValueError(f"{path}: {name} is not finite: fit this frame again, or leave it out")
    return values.reshape(-1, width)


def _count(path: Path, **parts: typing.Any) -> None:
    lengths = {name: len(part) for name, part in parts.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"{path} does not hold one of each for every frame: {lengths}")
