"""4D-DRESS: a fabricated take, seen as it was filmed; what is missing or damaged is named."""

import pickle

import numpy as np
import pytest

from avatarjax import cameras, data
from avatarjax.io import exr

WIDTH, HEIGHT = 30, 40
FRAMES = range(11, 14)
VIEWS = {"0028": (3.0, 1.2, 0.5), "0004": (0.2, 1.0, 3.0)}


def view(camera):
    return cameras.look_at(VIEWS[camera], (0.0, 1.0, 0.0), width=WIDTH, height=HEIGHT)


def write_pickle(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(value))


def entry(camera):
    matrices = np.asarray(view(camera).intrinsics, np.float64), np.asarray(view(camera).world_to_camera, np.float64)
    return {"intrinsics": matrices[0], "extrinsics": matrices[1][:3]}


@pytest.fixture
def take(tmp_path):
    folder = tmp_path / "00148" / "Inner" / "Take7"
    for k in FRAMES:
        for shade, camera in enumerate(VIEWS):
            image = np.full((HEIGHT, WIDTH, 3), 100 * shade + k, np.uint8)
            mask = np.zeros((HEIGHT, WIDTH, 1), np.uint8)
            mask[5 : 5 + k, 4:9] = 255
            exr.write_png(folder / "Capture" / camera / "images" / f"capture-f{k:05d}.png", image)
            exr.write_png(folder / "Capture" / camera / "masks" / f"mask-f{k:05d}.png", mask)
        parameters = {
            "global_orient": np.array([0, 0.1 * k, 0]),
            "body_pose": np.zeros(69),
            "transl": np.array([0.1 * k, 1.0, 0.0]),
            "betas": np.zeros(10),
        }
        write_pickle(folder / "SMPL" / f"mesh-f{k:05d}_smpl.pkl", parameters)
    write_pickle(folder / "Capture" / "cameras.pkl", {name: entry(name) for name in VIEWS})
    return folder


@pytest.mark.parametrize("camera", [None, "0004", "0028"])
def test_a_take_is_a_monocular_video_of_one_camera(take, camera):
    video = data.load_monocular(take, camera=camera)
    chosen = camera or "0004"
    assert len(video) == len(FRAMES) and video.fps == 30
    np.testing.assert_allclose(video.camera.world_to_camera, view(chosen).world_to_camera, atol=1e-6)
    np.testing.assert_allclose(video.camera.intrinsics, view(chosen).intrinsics, rtol=1e-6)
    assert (video.camera.width, video.camera.height) == (WIDTH, HEIGHT)
    np.testing.assert_array_equal(video.images()[:, 0, 0, 1], [100 * list(VIEWS).index(chosen) + k for k in FRAMES])
    np.testing.assert_array_equal(video.masks.sum((1, 2)), [5 * k for k in FRAMES])


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_an_opaque_alpha_channel_is_no_foreground(take, channels):
    mask = np.zeros((HEIGHT, WIDTH, channels), np.uint8)
    mask[3:7, 2:5] = 1
    if channels in (2, 4):
        mask[..., -1] = 255
    exr.write_png(take / "Capture" / "0004" / "masks" / "mask-f00011.png", mask)
    assert data.load_monocular(take).masks[0].sum() == 12


def test_poses_are_of_the_pelvis_in_the_takes_own_world(take):
    poses = data.load_monocular(take).poses
    path = np.array([[0.1 * k - 0.002, 1.0 - 0.223, 0.028] for k in FRAMES])
    np.testing.assert_allclose(poses.root_translation, path, atol=1e-6)
    np.testing.assert_allclose(poses.root_rotation[:, 0, 2], np.sin([0.1 * k for k in FRAMES]), atol=1e-6)
    assert poses.rotations.shape == (len(FRAMES), 24, 3, 3)


def test_an_unknown_camera_is_answered_with_those_there_are(take):
    with pytest.raises(ValueError, match=r"cameras\.pkl has no camera '0076': choose one of 0004, 0028"):
        data.load_monocular(take, camera="0076")


@pytest.mark.parametrize(
    ("gone", "match"),
    [
        ("Capture/cameras.pkl", r"cameras\.pkl does not exist"),
        ("Capture/0004/masks/mask-f00012.png", r"mask-f00012\.png does not exist, but .*capture-f00012\.png does"),
        ("SMPL/mesh-f00011_smpl.pkl", r"mesh-f00011_smpl\.pkl does not exist, but .*capture-f00011\.png does"),
        ("Capture/0004/images/capture-f00012.png", "frame 12 is missing"),
    ],
)
def test_what_is_missing_is_named(take, gone, match):
    (take / gone).unlink()
    with pytest.raises(ValueError, match=match):
        data.load_monocular(take)


def test_a_take_without_pictures_is_named(take):
    for path in (take / "Capture" / "0004" / "images").iterdir():
        path.unlink()
    with pytest.raises(ValueError, match=r"images holds no capture-f\*\.png"):
        data.load_monocular(take)


@pytest.mark.parametrize(
    ("cameras_file", "match"),
    [
        ({}, "holds no cameras"),
        ([1], "must hold a dictionary"),
        ({"0004": {}}, "camera 0004 is damaged .* needs intrinsics 3x3 and extrinsics 3x4"),
        ({"0004": {**entry("0004"), "intrinsics": np.eye(2)}}, r"shapes \(2, 2\), \(3, 4\)"),
        ({"0004": {**entry("0004"), "extrinsics": np.ones((3, 4))}}, "its rotation is none"),
        ({"../../x": entry("0004")}, "not a file inside"),
    ],
)
def test_wrong_cameras_are_named(take, cameras_file, match):
    write_pickle(take / "Capture" / "cameras.pkl", cameras_file)
    with pytest.raises(ValueError, match=rf"cameras\.pkl.*{match}"):
        data.load_monocular(take)


def test_other_folders_have_one_camera(tmp_path):
    with pytest.raises(ValueError, match="filmed by one camera: camera='0004'"):
        data.load_monocular(tmp_path, camera="0004")
