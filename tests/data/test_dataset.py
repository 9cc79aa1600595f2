"""The dataset folder: built alike every time, and refused with the culprit's name where it is not whole."""

import dataclasses
import json
import shutil

import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import posmap
from avatarjax.data import building, dataset
from avatarjax.io import weights


@pytest.fixture
def folder(tiny_folder, tmp_path):
    """A copy to damage."""
    return shutil.copytree(tiny_folder, tmp_path / "data")


def edit(folder, change):
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(manifest))


def test_an_interrupted_build_goes_on_and_ends_alike(folder, tiny_folder, tiny_spec):
    """As if the process had been killed: no manifest, some clips not there, one file half written."""
    whole = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").unlink()
    (folder / "building.json").write_text(json.dumps({"version": dataset.VERSION, "spec": whole["spec"]}))
    (folder / "clips" / ".train-003.x.safetensors").write_bytes(b"half")
    kept = folder / "clips" / "held_out-002.safetensors"
    before = kept.stat().st_mtime_ns
    for name in ("train-003", "truth-000"):
        (folder / "clips" / f"{name}.safetensors").unlink()
    with pytest.raises(ValueError, match="no finished dataset"):
        dataset.load(folder)
    building.build(folder, tiny_spec, progress=False)
    assert dataset.fingerprint(folder) == dataset.fingerprint(tiny_folder)
    assert kept.stat().st_mtime_ns == before
    assert not (folder / "building.json").exists()


def test_what_another_spec_has_left_is_not_used(tmp_path, tiny_spec):
    (tmp_path / "clips").mkdir()
    (tmp_path / "clips" / "train-000.safetensors").write_bytes(b"other")
    building._begin(tmp_path, tiny_spec)
    assert not (tmp_path / "clips").exists()


def test_it_matches_its_spec(tiny_folder, tiny_spec):
    assert dataset.matches(tiny_folder, tiny_spec)


@pytest.mark.parametrize(
    "change", [{"size": 64}, {"seed": 1}, {"script": (1, 2)}, {"image_views": 3}, {"held_out_frames": 61}]
)
def test_it_matches_no_other_spec(tiny_folder, tiny_spec, change):
    assert not dataset.matches(tiny_folder, dataclasses.replace(tiny_spec, **change))


def test_shapes_are_those_of_the_spec(tiny_data, tiny_spec):
    texels = len(tiny_data.atlas.rows)
    frames = 20 * tiny_spec.transition_frames
    assert tiny_data.atlas.size == tiny_spec.size
    assert tiny_data.train.texels.shape == (frames, texels, 3)
    assert tiny_data.held_out.texels.shape == (frames, texels, 3)
    assert tiny_data.truth.texels.shape == (len(tiny_spec.script), texels, 3)
    assert tiny_data.standing_images.rgba.shape == (1, 2, 32, 32, 4)
    assert tiny_data.train_images.rgba.shape == (2, 2, 32, 32, 4)
    assert tiny_data.held_out_images.rgba.shape[1:] == (2, 32, 32, 4)


def test_held_out_motion_is_the_same_transitions_in_another_way(tiny_data):
    train, held = tiny_data.train, tiny_data.held_out
    np.testing.assert_array_equal(train.actions[::60], held.actions[::60])
    np.testing.assert_array_equal(train.actions[59::60], held.actions[59::60])
    running = np.flatnonzero(train.actions[::60]) * 60
    closest = np.abs(held.texels[running, None] - train.texels[None, running]).mean((2, 3)).min(1)
    assert (closest > 1e-4).all()  # other phases of the gait; metres


def test_vertices_lie_where_the_texels_do(tiny_folder, tiny_data):
    """Kept as float16 relative to the root: right to half a millimetre, wherever in the world the figure is."""
    arrays, _ = weights.load_arrays(tiny_folder / "clips" / "train-007.safetensors")
    assert arrays["vertices"].dtype == np.float16
    texels = posmap.encode(tiny_data.atlas, jnp.asarray(arrays["vertices"][-1], jnp.float32))
    np.testing.assert_allclose(texels, arrays["texels"][-1], atol=6e-4)


def test_the_truth_is_pictured_from_four_sides_that_follow(tiny_folder, tiny_data):
    """The root is in the middle of every picture's width, the soles at the height they have in the world."""
    pictures = dataset.truth_pictures(tiny_folder)
    assert pictures.shape == (len(tiny_data.truth.actions), 4, 32, 32, 4)
    cameras = dataset.cardinal_cameras(32)
    roots = tiny_data.truth.roots * np.array([0, 1, 0], np.float32)
    upscaler = posmap.build_upscaler(tiny_data.atlas, 64)
    for frame in (0, 9, len(pictures) - 1):
        points = np.asarray(posmap.upscale(upscaler, jnp.asarray(tiny_data.truth.texels[frame]))) + roots[frame]
        for view in range(4):
            column, row = pixels_of(points, cameras, view)
            assert near_opaque(pictures[frame, view, ..., 3])[row, column].mean() > 0.98


def pixels_of(points, cameras, view):
    """Columns and rows (n,) in which camera `view` sees points (n, 3)."""
    world_to_camera, intrinsics = np.asarray(cameras.world_to_camera[view]), np.asarray(cameras.intrinsics[view])
    seen = (points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]) @ intrinsics.T
    return np.floor(seen[:, :2] / seen[:, 2:]).astype(int).T


def near_opaque(alpha):
    """Pixels that are not transparent, or have such a neighbour."""
    padded = np.pad(alpha > 0, 1)
    height, width = alpha.shape
    return np.any([padded[y : y + height, x : x + width] for y in range(3) for x in range(3)], axis=0)


def test_pictures_show_the_texels_of_their_pose(tiny_data):
    """A texel's place in the picture is opaque, or beside an opaque pixel: texels lie on the surface."""
    upscaler = posmap.build_upscaler(tiny_data.atlas, 64)
    for images in (tiny_data.standing_images, tiny_data.train_images, tiny_data.held_out_images):
        cameras = dataset.cylinder_cameras(32)
        for pose in range(len(images.texels)):
            points = np.asarray(posmap.upscale(upscaler, jnp.asarray(images.texels[pose])))
            low, high = points.min(0), points.max(0)
            boxed = (points - (low + high) / 2) / (high - low).max()
            for slot, view in enumerate(images.view[pose]):
                column, row = pixels_of(boxed, cameras, view)
                assert near_opaque(images.rgba[pose, slot, ..., 3])[row, column].mean() > 0.98


def test_transparent_pixels_are_outside_and_the_figure_is_coloured(tiny_data):
    rgba = tiny_data.train_images.rgba
    assert (rgba[:, :, [0, -1], 0, 3] == 0).all()
    opaque = rgba[rgba[..., 3] == 255][:, :3].astype(float)
    assert len(opaque) > 100 and opaque.std(0).min() > 10


def test_cylinder_cameras_look_at_the_middle_from_one_distance():
    cameras = dataset.cylinder_cameras(32)
    rotation, shift = np.asarray(cameras.world_to_camera[:, :3, :3]), np.asarray(cameras.world_to_camera[:, :3, 3])
    centres = -np.einsum("kji,kj->ki", rotation, shift)
    np.testing.assert_allclose(np.linalg.norm(centres[:, [0, 2]], axis=1), 1.75, atol=1e-4)
    assert centres[:, 1].min() >= -0.2 - 1e-5 and centres[:, 1].max() <= 0.6 + 1e-5
    np.testing.assert_allclose(shift[:, :2], 0, atol=1e-5)
    azimuth = np.sort(np.arctan2(centres[:, 0], centres[:, 2]))
    gaps = np.diff(np.append(azimuth, azimuth[0] + 2 * np.pi))
    assert len(cameras.world_to_camera) == 50 and gaps.max() < 3 * 2 * np.pi / 50


class TestDamage:
    def test_a_truncated_file_is_named(self, folder):
        path = folder / "clips" / "held_out-004.safetensors"
        path.write_bytes(path.read_bytes()[:-10])
        with pytest.raises(ValueError, match=r"held_out-004\.safetensors is damaged.*--stage data"):
            dataset.load(folder)

    def test_a_flipped_bit_is_noticed(self, folder, tiny_data):
        view = int(tiny_data.train_images.view[0, 0])
        path = folder / "images" / "train" / f"{0:05d}_{view:02d}.png"
        content = bytearray(path.read_bytes())
        content[-20] ^= 1
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"\.png is damaged"):
            dataset.load(folder)

    def test_a_missing_file_is_named(self, folder):
        (folder / "clips" / "truth-000.safetensors").unlink()
        with pytest.raises(ValueError, match=r"truth-000\.safetensors is missing: build it again"):
            dataset.load(folder)

    def test_a_folder_without_manifest_is_unfinished(self, folder, tiny_spec):
        (folder / "manifest.json").unlink()
        assert not dataset.matches(folder, tiny_spec)
        with pytest.raises(ValueError, match="no finished dataset"):
            dataset.load(folder)

    @pytest.mark.parametrize(
        "text",
        [
            "",
            '{"version": 1',
            "[]",
            "3",
            '{"version": VERSION, "spec": {}}',
            '{"version": VERSION, "spec": {}, "files": []}',
            '{"version": VERSION, "spec": {"size": 32}, "files": {}}',
            '{"version": VERSION, "spec": [], "files": {"a": 3}}',
        ],
    )
    def test_a_damaged_manifest_is_named(self, folder, tiny_spec, text):
        (folder / "manifest.json").write_text(text.replace("VERSION", str(dataset.VERSION)))
        assert not dataset.matches(folder, tiny_spec)
        with pytest.raises(ValueError, match=r"manifest\.json is damaged.*--stage data"):
            dataset.load(folder)

    @pytest.mark.parametrize(
        "name", ["../secret.safetensors", "/etc/passwd", "clips/../../x.safetensors", "C:x", "a\\b"]
    )
    def test_a_manifest_that_names_other_files_is_refused(self, folder, tiny_spec, name):
        edit(folder, lambda m: m["files"].update({name: {"bytes": 0, "sha256": ""}}))
        assert not dataset.matches(folder, tiny_spec)
        with pytest.raises(ValueError, match=r"manifest\.json names .*not a file of this dataset"):
            dataset.load(folder)

    def test_another_version_is_refused(self, folder, tiny_spec):
        edit(folder, lambda m: m.update(version=99))
        assert not dataset.matches(folder, tiny_spec)
        with pytest.raises(ValueError, match=r"data of version 99.*build it again"):
            dataset.load(folder)


def test_other_data_have_another_fingerprint(folder, tiny_folder):
    edit(folder, lambda m: m["files"]["clips/train-000.safetensors"].update(sha256="0" * 64))
    assert dataset.fingerprint(folder) != dataset.fingerprint(tiny_folder)


@pytest.mark.parametrize("views", [{"image_views": 0}, {"standing_views": 51}])
def test_impossible_numbers_of_views_are_refused(tiny_spec, views):
    with pytest.raises(ValueError, match="1 to 50 views"):
        dataclasses.replace(tiny_spec, **views)
