"""SMPL's parameters: where both conventions put a stiff body, what may hold them, and what is refused."""

import os
import pickle

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avatarjax.data.importers import smpl

WORLD = Rotation.from_rotvec([0.4, -0.9, 0.2]).as_matrix()


def easymocap(frames=1, seed=0):
    rng = np.random.default_rng(seed)
    poses = 0.3 * rng.normal(size=(frames, 72))
    poses[:, :3] = 0
    return {"poses": poses, "Rh": rng.normal(size=(frames, 3)), "Th": rng.normal(size=(frames, 3))}


def smplx(frames=1, seed=0):
    rng = np.random.default_rng(seed)
    sizes = {"global_orient": 3, "body_pose": 69, "transl": 3}
    return {name: 0.3 * rng.normal(size=(frames, size)) for name, size in sizes.items()}


def save(path, parameters):
    if path.suffix == ".pkl":
        path.write_bytes(pickle.dumps(parameters))
    elif path.suffix == ".npz":
        np.savez(path, **parameters)
    else:
        np.save(path, parameters, allow_pickle=True)
    return path


def body(poses, points):
    """World points (f, n, 3) of what is rigid to the pelvis, given in SMPL's rest shape."""
    return (points - smpl.PELVIS) @ np.swapaxes(poses.root_rotation, 1, 2) + poses.root_translation[:, None]


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".pkl"])
def test_easymocap_turns_about_the_models_origin(tmp_path, suffix):
    parameters = easymocap(3)
    poses = smpl.read_poses([save(tmp_path / f"a{suffix}", parameters)], WORLD)
    points = np.random.default_rng(1).normal(size=(5, 3))
    turned = np.einsum("fij,nj->fni", Rotation.from_rotvec(parameters["Rh"]).as_matrix(), points)
    np.testing.assert_allclose(body(poses, points), (turned + parameters["Th"][:, None]) @ WORLD.T, atol=1e-5)


def test_smplx_turns_about_the_pelvis(tmp_path):
    parameters = smplx(2)
    poses = smpl.read_poses([save(tmp_path / "a.pkl", parameters)], WORLD)
    points = np.random.default_rng(1).normal(size=(5, 3))
    turns = Rotation.from_rotvec(parameters["global_orient"]).as_matrix()
    world = np.einsum("fij,nj->fni", turns, points - smpl.PELVIS) + smpl.PELVIS + parameters["transl"][:, None]
    np.testing.assert_allclose(body(poses, points), world @ WORLD.T, atol=1e-5)


def test_joints_are_rotations_to_their_parents(tmp_path):
    parameters = smplx()
    poses = smpl.read_poses([save(tmp_path / "a.pkl", parameters)], np.eye(3))
    assert poses.rotations.shape == (1, 24, 3, 3) and poses.rotations.dtype == np.float32
    np.testing.assert_array_equal(poses.rotations[:, 0], np.eye(3)[None])
    elbow = poses.names.index("left_elbow")
    expected = Rotation.from_rotvec(parameters["body_pose"].reshape(23, 3)[elbow - 1]).as_matrix()
    np.testing.assert_allclose(poses.rotations[0, elbow], expected, atol=1e-6)


def test_a_root_among_the_poses_turns_first(tmp_path):
    parameters = easymocap()
    parameters["poses"][:, :3] = [0.2, 0.5, -0.1]
    poses = smpl.read_poses([save(tmp_path / "a.npy", parameters)], np.eye(3))
    expected = Rotation.from_rotvec(parameters["Rh"]) * Rotation.from_rotvec([0.2, 0.5, -0.1])
    np.testing.assert_allclose(poses.root_rotation, expected.as_matrix(), atol=1e-6)
    np.testing.assert_array_equal(poses.rotations[:, 0], np.eye(3)[None])


def test_poses_without_the_root_are_the_same(tmp_path):
    whole = easymocap()
    part = {**whole, "poses": whole["poses"][:, 3:]}
    a, b = (smpl.read_poses([save(tmp_path / f"{k}.npy", p)], np.eye(3)) for k, p in enumerate((whole, part)))
    np.testing.assert_array_equal(a.rotations, b.rotations)


def test_files_follow_each_other(tmp_path):
    paths = [save(tmp_path / f"{k}.npy", easymocap(seed=k)) for k in range(3)]
    poses = smpl.read_poses(paths, np.eye(3))
    assert len(poses) == 3
    np.testing.assert_array_equal(smpl.read_poses(paths[1:2], np.eye(3)).root_rotation[0], poses.root_rotation[1])


def test_the_skeleton_is_a_tree_with_mirrored_sides():
    assert len(smpl.NAMES) == len(smpl.PARENTS) == len(set(smpl.NAMES)) == 24
    assert all(parent < joint for joint, parent in enumerate(smpl.PARENTS)) and smpl.PARENTS[0] == -1
    mirror = {"left": "right", "right": "left"}
    for name, parent in zip(smpl.NAMES[1:], smpl.PARENTS[1:], strict=True):
        side, _, rest = name.partition("_")
        if side in mirror:
            other = smpl.NAMES[smpl.PARENTS[smpl.NAMES.index(f"{mirror[side]}_{rest}")]]
            up = smpl.NAMES[parent]
            assert other == up or other.partition("_")[2] == up.partition("_")[2]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"Th": "far"}, "Th is no array of numbers"),
        ({"Th": np.zeros(2)}, r"Th has shape \(2,\), expected 3 a frame"),
        ({"Th": np.full(3, np.nan)}, "Th is not finite"),
        ({"Th": np.zeros((2, 3))}, "one of each for every frame: .*'Th': 2"),
        ({"poses": np.zeros(71)}, "expected 72 or 69"),
    ],
)
def test_wrong_parameters_are_named(tmp_path, change, match):
    path = save(tmp_path / "a.npy", {**easymocap(), **change})
    with pytest.raises(ValueError, match=rf"a\.npy.*({match})"):
        smpl.read_poses([path], np.eye(3))


def test_missing_parameters_are_named(tmp_path):
    path = save(tmp_path / "a.pkl", {"betas": np.zeros(10)})
    with pytest.raises(ValueError, match="no global_orient, only betas: needs poses, Rh and Th, or"):
        smpl.read_poses([path], np.eye(3))


@pytest.mark.parametrize("name", ["a.npy", "a.npz", "a.pkl"])
def test_damaged_files_are_named(tmp_path, name):
    path = save(tmp_path / name, easymocap())
    path.write_bytes(path.read_bytes()[:-60])
    with pytest.raises(ValueError, match=rf"{name[0]}\.{name[2:]} is"):
        smpl.read_parameters(path)
    with pytest.raises(ValueError, match=r"gone\.npy does not exist"):
        smpl.read_parameters(tmp_path / "gone.npy")
    with pytest.raises(ValueError, match="must hold a dictionary"):
        smpl.read_parameters(save(tmp_path / "b.pkl", [1]))


class Runs:
    def __reduce__(self):
        return os.mkdir, ("ran",)


@pytest.mark.parametrize("name", ["a.npy", "a.pkl"])
def test_code_is_refused_and_not_run(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    path = save(tmp_path / name, {"poses": Runs()})
    with pytest.raises(ValueError, match="holds more than arrays"):
        smpl.read_parameters(path)
    assert list(tmp_path.iterdir()) == [path]
