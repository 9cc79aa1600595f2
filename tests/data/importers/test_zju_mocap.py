"""ZJU-MoCap: a fabricated sequence, seen as it was filmed; what is missing or damaged is named."""

import shutil

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avatarjax import cameras, data
from avatarjax.io import exr

WIDTH, HEIGHT, FRAMES = 48, 40, 3
INTRINSICS = np.array([[60.0, 0, 25.0], [0, 62.0, 19.0], [0, 0, 1]])
POINT = np.array([0.1, 0.2, 1.1])  # In the dataset's world, z up.
NAMES = ("Camera_B1", "Camera_B2")


def camera_at(yaw):
    """A camera three metres from the axis, upright in a z-up world: R (3, 3), T (3,)."""
    forward = np.array([np.sin(yaw), np.cos(yaw), 0.0])
    rotation = np.stack([np.cross(forward, [0, 0, 1.0]), [0, 0, -1.0], forward])
    return rotation, -rotation @ (np.array([0, 0, 1.0]) - 3 * forward)


def pixel(rotation, translation, coefficients):
    """Where OpenCV's model sees the point; pixel centres at whole numbers."""
    x, y, z = rotation @ POINT + translation
    x, y = x / z, y / z
    k1, k2, p1, p2, k3 = coefficients
    r = x * x + y * y
    radial = 1 + k1 * r + k2 * r**2 + k3 * r**3
    seen = x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x), y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y
    return (INTRINSICS @ [*seen, 1])[:2]


def write(folder, *, coefficients=(0.0,) * 5, first=0, long_names=False):
    """A sequence in which a soft dot is all there is to see."""
    views = [camera_at(yaw) for yaw in (0.3, 1.4)]
    cams = {
        "K": [INTRINSICS] * 2,
        "D": [np.array(coefficients)[:, None]] * 2,
        "R": [r for r, _ in views],
        "T": [1000 * t[:, None] for _, t in views],
    }
    ims = []
    for k in range(first, first + FRAMES):
        ims.append({"ims": []})
        for c, name in enumerate(NAMES):
            file = f"{name}/CoreView_313_Camera_({c})_{k:04d}_2019.jpg" if long_names else f"{name}/{k:06d}.jpg"
            u, v = pixel(*views[c], coefficients)
            grid_v, grid_u = np.mgrid[:HEIGHT, :WIDTH]
            dot = np.exp(-((grid_u - u) ** 2 + (grid_v - v) ** 2) / 18)
            rgb = np.round(250 * dot)[..., None].repeat(3, -1).astype(np.uint8)
            exr.write_png(folder / file, rgb)
            mask = (folder / "mask_cihp" / file).with_suffix(".png")
            exr.write_png(mask, np.where(dot > 0.3, 7, 0).astype(np.uint8)[..., None])
            ims[-1]["ims"].append(file)
        parameters = {
            "poses": np.zeros((1, 72)),
            "Rh": Rotation.from_matrix([[1, 0, 0], [0, 0, -1], [0, 1, 0]]).as_rotvec()[None],
            "Th": np.array([[0.1 * k, 0.2, 1.2]]),
            "shapes": np.zeros((1, 10)),
        }
        (folder / "new_params").mkdir(exist_ok=True)
        np.save(folder / "new_params" / f"{k}.npy", parameters, allow_pickle=True)
    np.save(folder / "annots.npy", {"cams": cams, "ims": ims}, allow_pickle=True)


@pytest.fixture
def sequence(tmp_path):
    write(tmp_path / "CoreView_377")
    return tmp_path / "CoreView_377"


def centre(weights):
    v, u = np.mgrid[: weights.shape[0], : weights.shape[1]]
    return np.array([(u * weights).sum(), (v * weights).sum()]) / weights.sum() + 0.5


@pytest.mark.parametrize("coefficients", [(0.0,) * 5, (-0.25, 0.08, 0.004, -0.003, 0.02)], ids=["pinhole", "lens"])
def test_a_point_is_seen_where_our_camera_projects_it(tmp_path, coefficients):
    write(tmp_path, coefficients=coefficients)
    x, y, z = POINT
    for name in NAMES:
        video = data.load_monocular(tmp_path, camera=name)
        expected = np.asarray(cameras.project(video.camera, jnp.asarray([[x, z, -y]]))[0][0])
        picture = video.images()[1].mean(-1)
        assert picture.max() > 200
        np.testing.assert_allclose(centre(picture), expected, atol=0.15)
        np.testing.assert_allclose(centre(video.masks[1]), expected, atol=0.5)


def test_it_is_a_monocular_video_of_one_camera(sequence):
    video = data.load_monocular(sequence)
    assert len(video) == FRAMES and video.masks.shape == (FRAMES, HEIGHT, WIDTH) and video.masks.dtype == bool
    assert (video.camera.width, video.camera.height) == (WIDTH, HEIGHT)
    np.testing.assert_array_equal(video.images(), data.load_monocular(sequence, camera="Camera_B1").images())
    held = data.load_monocular(sequence, lazy=False)
    shutil.rmtree(sequence)
    assert held.images().shape == (FRAMES, HEIGHT, WIDTH, 3)


def test_the_figure_stands_upright_in_metres(sequence):
    poses = data.load_monocular(sequence).poses
    np.testing.assert_allclose(poses.root_rotation, np.tile(np.eye(3), (FRAMES, 1, 1)), atol=1e-6)
    # The pelvis lies 0.223 below and 0.028 before the model's origin.
    path = np.array([[0.1 * k - 0.002, 1.2 - 0.223, -0.2 + 0.028] for k in range(FRAMES)])
    np.testing.assert_allclose(poses.root_translation, path, atol=1e-6)
    assert poses.names[15] == "head" and poses.parents[15] == 12


def test_long_names_count_from_one(tmp_path):
    write(tmp_path, first=1, long_names=True)
    poses = data.load_monocular(tmp_path, camera="Camera_B2").poses
    np.testing.assert_allclose(poses.root_translation[:, 0], 0.1 * np.arange(1, 4) - 0.002, atol=1e-6)


def test_older_folders_are_read_too(sequence):
    before = data.load_monocular(sequence)
    (sequence / "mask_cihp").rename(sequence / "mask")
    (sequence / "new_params").rename(sequence / "params")
    np.testing.assert_array_equal(data.load_monocular(sequence).masks, before.masks)


def test_an_unknown_camera_is_answered_with_those_there_are(sequence):
    with pytest.raises(ValueError, match=r"annots\.npy has no camera 'B1': choose one of Camera_B1, Camera_B2"):
        data.load_monocular(sequence, camera="B1")


@pytest.mark.parametrize(
    ("gone", "match"),
    [
        ("Camera_B1/000001.jpg", r"000001\.jpg does not exist, which .*annots\.npy names"),
        ("mask_cihp/Camera_B1/000002.png", r"mask_cihp.Camera_B1.000002\.png does not exist"),
        ("new_params/0.npy", r"new_params.0\.npy does not exist"),
        ("mask_cihp", "neither mask_cihp nor mask"),
        ("new_params", "neither new_params nor params"),
    ],
)
def test_what_is_missing_is_named(sequence, gone, match):
    path = sequence / gone
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    with pytest.raises(ValueError, match=match):
        data.load_monocular(sequence)


def damage(cams, name, value):
    return {"cams": {**cams, name: [value, value]}}


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda a: {"cams": {}}, "needs cams with K, D, R and T"),
        (lambda a: {"ims": [{}]}, "needs cams"),
        (lambda a: {"ims": []}, "names no images"),
        (lambda a: {"ims": [*a["ims"], {"ims": ["x.png"]}]}, "not one for each camera"),
        (lambda a: {"ims": [{"ims": ["../../x/0.jpg", "x/0.jpg"]}]}, "not a file inside"),
        (lambda a: {"ims": [{"ims": ["Camera_B1/front.jpg"] * 2}]}, r"names front\.jpg: expected 000000\.jpg"),
        (lambda a: damage(a["cams"], "R", 2 * np.eye(3)), "camera 0 .* its R is no rotation"),
        (lambda a: damage(a["cams"], "K", np.eye(2)), "camera 0 is damaged .* needs K 3x3"),
        (lambda a: damage(a["cams"], "K", np.zeros((3, 3))), "no focal length"),
        (lambda a: damage(a["cams"], "D", np.ones(8)), "camera 0: distortion must be 4 or 5"),
    ],
)
def test_wrong_annotations_are_named(sequence, change, match):
    annotations = np.load(sequence / "annots.npy", allow_pickle=True).item()
    np.save(sequence / "annots.npy", {**annotations, **change(annotations)}, allow_pickle=True)
    with pytest.raises(ValueError, match=rf"annots\.npy.*{match}"):
        data.load_monocular(sequence)


def test_pictures_of_other_sizes_are_named(sequence):
    exr.write_png(sequence / "Camera_B1" / "000002.jpg", np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(ValueError, match=r"000002\.jpg has shape \(8, 8\), the first image \(40, 48\)"):
        data.load_monocular(sequence).images()
