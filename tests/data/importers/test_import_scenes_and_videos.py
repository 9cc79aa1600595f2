"""Public position maps, Gaussian scenes and monocular folders: round trips, real inputs, and what is refused."""

import json
import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import cameras, data
from avatarjax.data.importers.monocular import Poses
from avatarjax.gaussians import Gaussians
from avatarjax.io import exr, ply
from avatarjax.posmap import groups

PUBLIC = os.environ.get("AVATARJAX_UNICA_PUBLIC", "")
AVATARS = [p for p in sorted(Path(PUBLIC).iterdir()) if p.is_dir()] if PUBLIC else []


def write_group(folder, index, action, seed=0, hole=0.5):
    rng = np.random.default_rng(seed)
    raw = rng.uniform(0.1, 0.9, (4, 8, 8, 3)).astype(np.float32)
    raw[:, np.random.default_rng(7).random((8, 8)) < hole] = 0
    groups.write_group(folder / groups.group_name("2-w", index, action), raw)
    return raw


def test_groups_come_in_order_in_our_axes(tmp_path):
    raw = {index: write_group(tmp_path, index, action, index) for index, action in ((12, "Left"), (3, "Idle"))}
    maps = data.load_position_maps(tmp_path)
    assert maps.index.tolist() == [3, 12] and maps.labels.tolist() == [0, 3] and maps.sequence.tolist() == [0, 0]
    assert maps.sequence_names == ("2-w",)
    for k, index in enumerate((3, 12)):
        np.testing.assert_array_equal(maps.maps[k], groups.from_public(raw[index])[0])
    one = data.load_position_maps(tmp_path / "2-w_00012_Left")
    np.testing.assert_array_equal(one.maps[0], maps.maps[1])


def test_wrong_groups_are_named(tmp_path):
    write_group(tmp_path / "a", 1, "Idle")
    write_group(tmp_path / "b", 1, "Moonwalk")
    with pytest.raises(ValueError, match="choose one avatar of a, b"):
        data.load_position_maps(tmp_path)
    with pytest.raises(ValueError, match="unknown action 'Moonwalk': known are 0 idle"):
        data.load_position_maps(tmp_path / "b")
    assert data.load_position_maps(tmp_path / "b", action_names=("idle", "moonwalk")).labels.tolist() == [1]
    write_group(tmp_path / "a", 2, "Idle", hole=0.3)
    with pytest.raises(ValueError, match="00002_Idle has another size or foreground"):
        data.load_position_maps(tmp_path / "a")
    (tmp_path / "a" / "2-w_00002_Idle" / "3.exr").unlink()
    with pytest.raises(ValueError, match=r"3\.exr does not exist"):
        data.load_position_maps(tmp_path / "a")
    (tmp_path / "c").mkdir()
    with pytest.raises(ValueError, match="holds no position-map groups"):
        data.load_position_maps(tmp_path / "c")


@pytest.mark.skipif(not AVATARS, reason="AVATARJAX_UNICA_PUBLIC does not name the public groups")
@pytest.mark.parametrize("folder", AVATARS, ids=lambda p: p.name)
def test_public_groups_stand_in_our_axes(folder):
    maps = data.load_position_maps(folder)
    assert maps.maps.shape == (1, 4, 128, 128, 3) and maps.labels.tolist() == [0]
    width, height, depth = np.ptp(maps.maps[0, 0][maps.mask], axis=0)
    assert height > 0.65 and height > 2 * width and width > 0.9 * depth
    with pytest.raises(ValueError, match="use load_position_maps"):
        data.load_mesh_sequence(folder)


@pytest.fixture
def scene(tmp_path):
    rng = np.random.default_rng(0)
    fields = {"means": 3, "log_scales": 3, "quats": 4, "colors": 3}
    arrays = {name: jnp.asarray(rng.normal(size=(5, width)), jnp.float32) for name, width in fields.items()}
    cloud = Gaussians(**arrays, logit_opacities=jnp.zeros(5), sh=None)
    for iteration in (900, 7000):
        ply.write_ply(tmp_path / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply", cloud)
    camera = cameras.look_at((1.0, 2.0, 3.0), (0.0, 1.0, 0.0), width=40, height=30)
    pose = np.asarray(camera.world_to_camera, np.float64)
    entry = {
        "id": 0,
        "img_name": "0001",
        "width": 40,
        "height": 30,
        "position": np.asarray(camera.position).tolist(),
        "rotation": pose[:3, :3].T.tolist(),
        "fx": float(camera.intrinsics[0, 0]),
        "fy": float(camera.intrinsics[1, 1]),
    }
    (tmp_path / "cameras.json").write_text(json.dumps([entry]))
    return tmp_path, cloud, camera, entry


def test_a_scene_is_its_newest_cloud_and_its_cameras(scene):
    folder, cloud, camera, _ = scene
    loaded = data.load_gaussian_scene(folder)
    assert loaded.iteration == 7000 and loaded.camera_names == ("0001",)
    np.testing.assert_allclose(loaded.gaussians.colors, cloud.colors, atol=1e-6)
    np.testing.assert_allclose(loaded.cameras[0].world_to_camera, camera.world_to_camera, atol=1e-5)
    np.testing.assert_allclose(loaded.cameras[0].intrinsics, camera.intrinsics, rtol=1e-6)
    assert data.load_gaussian_scene(folder, iteration=900).iteration == 900
    alone = data.load_gaussian_scene(folder / "point_cloud" / "iteration_900" / "point_cloud.ply")
    assert alone.cameras == () and alone.iteration is None


def test_wrong_scenes_are_named(scene, tmp_path):
    folder, _, _, entry = scene
    with pytest.raises(ValueError, match="no iteration 5: choose one of 900, 7000"):
        data.load_gaussian_scene(folder, iteration=5)
    with pytest.raises(ValueError, match="no Gaussian scene"):
        data.load_gaussian_scene(folder / "point_cloud")
    for change in ({"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}, {"width": 0}, {"position": [0, 1]}):
        (folder / "cameras.json").write_text(json.dumps([entry, {**entry, **change}]))
        with pytest.raises(ValueError, match=r"cameras\.json, camera 1 is damaged"):
            data.load_gaussian_scene(folder)
    for text, match in (("{}", "a list of cameras"), ("[", "as JSON")):
        (folder / "cameras.json").write_text(text)
        with pytest.raises(ValueError, match=match):
            data.load_gaussian_scene(folder)


def recording(frames=5, moving=False, width=48, height=32):
    k = np.arange(frames)[:, None, None, None]
    ramp = np.linspace(40, 200, width)[None, None, :, None] + 4 * k
    images = np.broadcast_to(ramp, (frames, height, width, 3)).astype(np.uint8)
    masks = np.zeros((frames, height, width), bool)
    masks[:, 8:24, 10:30] = True
    if moving:
        camera = cameras.orbit(
            0.1 * np.arange(frames), target=(0.0, 1.0, 0.0), distance=3.0, width=width, height=height
        )
    else:
        camera = cameras.look_at((0.0, 1.0, 3.0), (0.0, 1.0, 0.0), width=width, height=height)
    angle = 0.2 * np.arange(frames)
    c, s, o, z = np.cos(angle), np.sin(angle), np.ones(frames), np.zeros(frames)
    turns = np.stack([np.stack(row, -1) for row in ((c, z, s), (z, o, z), (-s, z, c))], 1).astype(np.float32)
    rotations = np.stack([turns, np.tile(np.eye(3, dtype=np.float32), (frames, 1, 1))], 1)
    path = np.stack([z, o, angle], -1).astype(np.float32)
    joints = np.array([[0.0, 1.0, 0.0], [0.0, 1.2, 0.0]], np.float32)
    return images, masks, camera, Poses(rotations, turns, path, ("hips", "spine"), (-1, 0), joints)


def test_mattes_round_trip_and_masks_are_what_they_cover_half(tmp_path):
    images, _, camera, poses = recording()
    mattes = np.random.default_rng(0).integers(0, 256, np.shape(images)[:3]).astype(np.uint8)
    data.write_monocular(tmp_path / "take", images, mattes, camera, poses)
    loaded = data.load_monocular(tmp_path / "take")
    np.testing.assert_array_equal(loaded.mattes, mattes)
    np.testing.assert_array_equal(loaded.masks, mattes > 127)
    np.testing.assert_array_equal(loaded.only(np.array([3, 1])).mattes[0], mattes[3])


@pytest.mark.parametrize("moving", [False, True], ids=["one camera", "a camera a frame"])
@pytest.mark.parametrize("as_video", [False, True], ids=["images", "video"])
def test_a_monocular_folder_round_trips(tmp_path, moving, as_video):
    images, masks, camera, poses = recording(moving=moving)
    data.write_monocular(tmp_path / "take", images, masks, camera, poses, as_video=as_video, fps=25)
    assert [p.name for p in tmp_path.iterdir()] == ["take"]
    for lazy in (True, False):
        loaded = data.load_monocular(tmp_path / "take", lazy=lazy)
        assert len(loaded) == 5 and loaded.fps == 25
        np.testing.assert_allclose(loaded.images(), images, atol=8 if as_video else 0)
        np.testing.assert_array_equal(loaded.masks, masks)
        np.testing.assert_array_equal(loaded.mattes, 255 * np.asarray(masks))
        np.testing.assert_allclose(loaded.camera.world_to_camera, camera.world_to_camera, atol=1e-6)
        np.testing.assert_allclose(loaded.camera_at(3).intrinsics.shape, (3, 3))
        np.testing.assert_array_equal(loaded.poses.rotations, poses.rotations)
        np.testing.assert_array_equal(loaded.poses.root_translation, poses.root_translation)
        np.testing.assert_array_equal(loaded.poses.joints, poses.joints)
        assert loaded.poses.names == ("hips", "spine") and loaded.poses.parents == (-1, 0)


def test_writing_is_whole_or_not_at_all(tmp_path):
    images, masks, camera, poses = recording()
    with pytest.raises(ValueError, match="5 frames and 4 masks"):
        data.write_monocular(tmp_path / "take", images, masks[:-1], camera, poses)
    assert not list(tmp_path.iterdir())
    data.write_monocular(tmp_path / "take", images, masks, camera, poses)
    with pytest.raises(ValueError, match="not empty"):
        data.write_monocular(tmp_path / "take", images, masks, camera, poses)
    with pytest.raises(ValueError, match="even sides"):
        odd = recording(width=47)
        data.write_monocular(tmp_path / "odd", *odd, as_video=True)


def test_wrong_monocular_folders_are_named(tmp_path):
    images, masks, camera, poses = recording()
    folder = tmp_path / "take"
    data.write_monocular(folder, images, masks, camera, poses)
    arrays = dict(np.load(folder / "poses.npz"))
    stated = json.loads((folder / "cameras.json").read_text())

    def expect(match):
        with pytest.raises(ValueError, match=match):
            data.load_monocular(folder)

    for change, match in (
        ({"rotations": arrays["rotations"] * 2}, "rotations holds a matrix that is no rotation"),
        ({"rotations": arrays["rotations"][:, 0]}, r"must be of shape \(f, j, 3, 3\)"),
        ({"root_translation": arrays["root_translation"][1:]}, "do not fit 5 frames"),
        ({"names": arrays["names"][:1]}, "1 names for 2 joints"),
        ({"rotations": np.array([None])}, "plain arrays"),
    ):
        np.savez(folder / "poses.npz", **{**arrays, **change})
        expect(rf"poses\.npz.*{match}")
    np.savez(folder / "poses.npz", **{name: arrays[name][:4] for name in arrays if "ro" in name})
    expect("5 frames and 4 poses")
    np.savez(folder / "poses.npz", rotations=arrays["rotations"])
    expect("has no root_rotation, root_translation")
    np.savez(folder / "poses.npz", **arrays)

    for change, match in (
        ({"convention": "opengl"}, "write opencv cameras"),
        ({"cameras": stated["cameras"] * 2}, "5 frames and 2 cameras"),
        ({"cameras": [{"intrinsics": [[1]]}]}, "is damaged"),
        ({"width": 50}, r"00000\.png has shape"),
    ):
        (folder / "cameras.json").write_text(json.dumps({**stated, **change}))
        expect(match)
    (folder / "cameras.json").write_text(json.dumps(stated))
    exr.write_png(folder / "images" / "00007.png", images[0])
    expect("frame 5 is missing")
    (folder / "images" / "00007.png").unlink()
    (folder / "video.mp4").write_bytes(b"no video")
    expect(r"both video\.mp4 and images")
    for path in (folder / "images").iterdir():
        path.unlink()
    (folder / "images").rmdir()
    expect(r"video\.mp4 cannot be read as a video")
    (folder / "poses.npz").unlink()
    expect(r"has no poses\.npz")
