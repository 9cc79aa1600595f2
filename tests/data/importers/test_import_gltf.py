"""glTF: closed forms of every interpolation, accessors, skins, morphs, and the emotes against another evaluator."""

import contextlib
import json
import os
from pathlib import Path

import import_figures as figures
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation, Slerp

from avatarjax import data
from avatarjax.data.importers import gltf_file, gltf_mesh

EMOTES = Path(os.environ.get("AVATARJAX_RAW_ASSETS", "")) / "dcl_emotes"
needs_emotes = pytest.mark.skipif(
    not os.environ.get("AVATARJAX_RAW_ASSETS"), reason="AVATARJAX_RAW_ASSETS does not name the raw assets"
)
SECONDS = np.arange(31) / 30


def node_clip(path, interpolation, target, keys, values):
    gltf = figures.GltfBuilder(nodes=[{"name": "bone"}])
    sampler = {"input": gltf.add(keys), "output": gltf.add(values), "interpolation": interpolation}
    channel = {"sampler": 0, "target": {"node": 0, "path": target}}
    gltf.document["animations"] = [{"name": "clip", "samplers": [sampler], "channels": [channel]}]
    return data.load_gltf_animation(gltf.write(path))


def test_linear_translation(tmp_path):
    animation = node_clip(tmp_path / "a.glb", "LINEAR", "translation", [0, 0.5, 1], [[0, 0, 0], [1, 2, 3], [1, 0, 0]])
    expected = [[np.interp(t, [0, 0.5, 1], y) for y in ([0, 1, 1], [0, 2, 0], [0, 3, 0])] for t in SECONDS]
    np.testing.assert_allclose(animation.positions[:, 0], expected, atol=1e-6)
    assert animation.fps == 30 and animation.clip == "clip" and animation.names == ("bone",)


def test_step_holds_each_key(tmp_path):
    animation = node_clip(tmp_path / "a.glb", "STEP", "translation", [0, 0.5, 1], [[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    np.testing.assert_allclose(animation.positions[:, 0, 0], np.floor(SECONDS * 2 + 1e-6), atol=1e-6)


def test_cubic_spline_of_a_parabola_is_the_parabola(tmp_path):
    # Tangents are derivatives in seconds; a Hermite spline reproduces every cubic.
    keys = np.array([0.0, 0.25, 1.0])
    values = np.stack([np.stack([2 * k - 1, k * k - k, 2 * k - 1])[:, None] * [1, 0, 0] for k in keys])
    animation = node_clip(tmp_path / "a.glb", "CUBICSPLINE", "translation", keys, values.reshape(-1, 3))
    np.testing.assert_allclose(animation.positions[:, 0, 0], SECONDS**2 - SECONDS, atol=1e-6)


def test_linear_rotation_is_spherical_and_takes_the_short_way(tmp_path):
    quats = Rotation.from_rotvec([[0, 0, 0], [0.3, 2.0, -0.4]]).as_quat()
    oracle = Slerp([0, 1], Rotation.from_quat(quats))(SECONDS).as_matrix()
    quats[1] *= -1
    animation = node_clip(tmp_path / "a.glb", "LINEAR", "rotation", [0, 1], quats)
    np.testing.assert_allclose(animation.rotations[:, 0], oracle, atol=1e-6)
    np.testing.assert_allclose(animation.local_rotations, animation.rotations, atol=1e-6)


def test_cubic_rotation_stays_a_rotation(tmp_path):
    still = [0, 0, 0, 0]
    ends = [figures.half_turn_about_y(0.0), figures.half_turn_about_y(1.0)]
    values = [still, ends[0], still, still, ends[1], still]
    animation = node_clip(tmp_path / "a.glb", "CUBICSPLINE", "rotation", [0, 1], values)
    np.testing.assert_allclose(np.linalg.det(animation.transforms[:, 0, :3, :3]), 1, atol=1e-6)
    angle = np.arctan2(animation.transforms[:, 0, 0, 2], animation.transforms[:, 0, 0, 0])
    s = 3 * SECONDS**2 - 2 * SECONDS**3
    expected = 2 * np.arctan2(s * np.sin(0.5), 1 - s + s * np.cos(0.5))
    np.testing.assert_allclose(angle, expected, atol=1e-6)


def test_scale_and_parents_compose(tmp_path):
    gltf = figures.GltfBuilder(
        nodes=[{"name": "tip", "translation": [0, 2, 0]}, {"name": "base", "scale": [0.5] * 3, "children": [0]}]
    )
    animation = data.load_gltf_animation(gltf.write(tmp_path / "a.gltf"))
    assert animation.names == ("base", "tip") and animation.parents == (-1, 0)
    np.testing.assert_allclose(animation.positions[0, 1], [0, 1, 0], atol=1e-6)


@pytest.mark.parametrize("dtype", ["i1", "u1", "i2", "u2"])
def test_normalised_integers(tmp_path, dtype):
    largest = np.iinfo(dtype).max
    gltf = figures.GltfBuilder()
    index = gltf.add([[0], [largest], [np.iinfo(dtype).min]], dtype, normalized=True)
    values = gltf_file.read(gltf.write(tmp_path / "a.glb")).accessor(index)[:, 0]
    np.testing.assert_allclose(values, [0, 1, -1 if dtype[0] == "i" else 0])


def test_sparse_and_interleaved_accessors(tmp_path):
    gltf = figures.GltfBuilder()
    where, what = gltf.view(np.array([1, 3], "<u2").tobytes()), gltf.view(np.array([[7.0], [9.0]], "<f4").tobytes())
    sparse = {
        "count": 2,
        "indices": {"bufferView": where, "componentType": 5123},
        "values": {"bufferView": what},
    }
    gltf.document["accessors"] += [{"componentType": 5126, "count": 5, "type": "SCALAR", "sparse": sparse}]
    pairs = gltf.view(np.arange(8, dtype="<f4").tobytes())
    gltf.document["bufferViews"][pairs]["byteStride"] = 8
    gltf.document["accessors"] += [
        {"bufferView": pairs, "byteOffset": 4, "componentType": 5126, "count": 4, "type": "SCALAR"}
    ]
    file = gltf_file.read(gltf.write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(file.accessor(0)[:, 0], [0, 7, 0, 9, 0])
    np.testing.assert_array_equal(file.accessor(1)[:, 0], [1, 3, 5, 7])


def test_a_skinned_figure_follows_its_joint(tmp_path):
    quats = [figures.half_turn_about_y(0), figures.half_turn_about_y(np.pi / 2)]
    path = figures.skinned_figure(
        tmp_path / "a.glb", rotation=([0, 1], quats), translation=([0, 1], [[0, 0.9, 0], [0, 0.9, 3]])
    )
    sequence = data.load_mesh_sequence(path)
    vertices, faces, _ = figures.figure()
    turn = Rotation.from_rotvec(np.pi / 2 * SECONDS[:, None] * [0, 1, 0]).as_matrix()
    expected = np.einsum("fab,vb->fva", turn, vertices) + SECONDS[:, None, None] * [0, 0, 3]
    np.testing.assert_allclose(sequence.vertices, expected, atol=1e-5)
    np.testing.assert_array_equal(sequence.faces, faces)
    # The clip is named like an action, and every frame shows it.
    assert (sequence.actions == 1).all() and sequence.sequence_names == ("forward",)
    assert sequence.joints.names == ("hips", "head") and sequence.joints.parents == (-1, 0)
    np.testing.assert_allclose(sequence.joints.positions[:, 1], SECONDS[:, None] * [0, 0, 3] + [[0, 1.9, 0]], atol=1e-5)
    hips = data.load_mesh_sequence(path, root="hips").roots
    np.testing.assert_allclose(hips, sequence.joints.positions[:, 0])


def test_clips_are_chosen_by_name(tmp_path):
    path = figures.skinned_figure(tmp_path / "a.glb", clip="walking", translation=([0, 1], [[0, 0.9, 0]] * 2))
    assert len(data.load_mesh_sequence(path, clip="walking", actions="forward").actions) == 31
    with pytest.raises(ValueError, match=r"no clip 'running'.*'walking'"):
        data.load_mesh_sequence(path, clip="running", actions="forward")
    with pytest.raises(ValueError, match="nothing says which action"):
        data.load_mesh_sequence(path)
    with pytest.raises(ValueError, match="says its times"):
        data.load_mesh_sequence(path, actions="idle", fps=60.0)
    with pytest.raises(ValueError, match="no joint 'tail': choose one of hips, head"):
        data.load_mesh_sequence(path, actions="idle", root="tail")


def test_a_folder_of_clips_is_one_mesh_in_sequences(tmp_path):
    for name in ("idle", "left"):
        figures.skinned_figure(tmp_path / f"{name}.glb", clip="x", translation=([0, 0.5], [[0, 0.9, 0]] * 2))
    sequence = data.load_mesh_sequence(tmp_path)
    assert sequence.sequence_names == ("idle", "left")
    np.testing.assert_array_equal(sequence.actions, [0] * 16 + [3] * 16)
    np.testing.assert_array_equal(sequence.sequence, [0] * 16 + [1] * 16)
    assert len(sequence.joints.transforms) == 32


def test_morph_targets_add_up(tmp_path):
    vertices, faces, _ = figures.figure()
    gltf = figures.GltfBuilder(nodes=[{"mesh": 0}])
    primitive = {
        "attributes": {"POSITION": gltf.add(vertices)},
        "indices": gltf.add(faces.ravel(), "u4"),
        "targets": [{"POSITION": gltf.add(0 * vertices + [0, 0, 1])}, {"POSITION": gltf.add(0 * vertices + [1, 0, 0])}],
    }
    gltf.document["meshes"] = [{"primitives": [primitive], "weights": [0, 0]}]
    sampler = {"input": gltf.add([0, 1]), "output": gltf.add([0, 0, 1, 2])}
    gltf.document["animations"] = [
        {"name": "idle", "samplers": [sampler], "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}]}
    ]
    sequence = data.load_mesh_sequence(gltf.write(tmp_path / "a.glb"))
    expected = vertices[None] + SECONDS[:, None, None] * np.array([2, 0, 1])
    np.testing.assert_allclose(sequence.vertices, expected, atol=1e-5)


def test_a_static_file_is_what_trimesh_reads(tmp_path):
    vertices, faces, _ = figures.figure()
    scene = trimesh.Scene()
    move = trimesh.transformations.rotation_matrix(0.4, [0, 1, 0], [0.2, 0, 0])
    scene.add_geometry(trimesh.Trimesh(vertices, faces, process=False), transform=move)
    scene.export(tmp_path / "a.glb")
    frame = gltf_mesh.read_frame(tmp_path / "a.glb", tmp_path)
    oracle = trimesh.load_scene(tmp_path / "a.glb", process=False).to_mesh()
    np.testing.assert_allclose(data.load_mesh_sequence(tmp_path / "a.glb", actions="idle").vertices[0], oracle.vertices,
                               atol=1e-6)  # fmt: skip
    np.testing.assert_array_equal(frame.faces, oracle.faces)


def test_textured_materials_are_what_trimesh_reads(tmp_path):
    from PIL import Image

    vertices, faces, _ = figures.figure()
    pixels = np.random.default_rng(0).integers(0, 255, (16, 24, 3), dtype=np.uint8)
    uv = (vertices[:, :2] * [0.5, 0.5] + [0.5, 0.0]).astype(np.float32)
    visual = trimesh.visual.TextureVisuals(uv=uv, image=Image.fromarray(pixels))
    trimesh.Trimesh(vertices, faces, visual=visual, process=False).export(tmp_path / "a.glb")
    sequence = data.load_mesh_sequence(tmp_path / "a.glb", actions="idle")
    np.testing.assert_array_equal(sequence.texture, pixels)
    np.testing.assert_allclose(sequence.uvs, uv[faces], atol=1e-6)


@pytest.mark.parametrize("uri", ["../secret.bin", "/etc/hostname", "%2e%2e/secret.bin", "file:///etc/hostname"])
def test_buffers_outside_the_folder_are_refused(tmp_path, uri):
    (tmp_path / "secret.bin").write_bytes(b"\0" * 64)
    (tmp_path / "inner").mkdir()
    gltf = figures.GltfBuilder(nodes=[{}])
    index = gltf.add([[1.0]])
    path = gltf.write(tmp_path / "inner" / "a.gltf", uri=uri)
    with pytest.raises(ValueError, match="not a file inside"):
        gltf_file.read(path).accessor(index)


def test_damaged_files_are_named(tmp_path):
    path = figures.skinned_figure(tmp_path / "a.glb", translation=([0, 1], [[0, 0.9, 0]] * 2))
    whole = path.read_bytes()
    for content, match in ((b"", "empty"), (b"nothing", "not a binary glTF"), (whole[:-40], "truncated")):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=rf"a\.glb.*{match}"):
            data.load_gltf_animation(path)
    with pytest.raises(ValueError, match="does not exist"):
        data.load_gltf_animation(tmp_path / "b.glb")
    gltf = figures.GltfBuilder(nodes=[{}], extensionsRequired=["KHR_draco_mesh_compression"])
    with pytest.raises(ValueError, match=r"KHR_draco_mesh_compression.*without compression"):
        data.load_gltf_animation(gltf.write(path))
    gltf = figures.GltfBuilder(nodes=[{"children": [1]}, {"children": [0]}])
    with pytest.raises(ValueError, match="cycle"):
        data.load_gltf_animation(gltf.write(path))
    figures.skinned_figure(path, translation=([0, 1], [[0, 0.9, 0], [0, np.nan, 0]]))
    with pytest.raises(ValueError, match="NaN"):
        data.load_mesh_sequence(path)


def test_any_damage_to_the_document_is_a_value_error(tmp_path):
    path = figures.skinned_figure(tmp_path / "a.gltf", rotation=([0, 1], [[0, 0, 0, 1]] * 2))
    whole = path.read_text()

    def places(node, at=()):
        items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
        for key, value in items:
            yield (*at, key)
            yield from places(value, (*at, key))

    for at in places(json.loads(whole)):
        for replacement in (None, "x", -7, []):
            document = json.loads(whole)
            node = document
            for key in at[:-1]:
                node = node[key]
            node[at[-1]] = replacement
            path.write_text(json.dumps(document))
            with contextlib.suppress(ValueError):
                data.load_mesh_sequence(path, actions="idle")


@needs_emotes
@pytest.mark.parametrize("name", ["idle", "walk", "jump", "dance"])
def test_an_emote_stands_and_agrees_with_the_retargeting(name):
    from avatarjax.data.motion import retargeting

    animation = data.load_gltf_animation(EMOTES / f"{name}.glb")
    assert all(parent < k for k, parent in enumerate(animation.parents))
    place = {bone: k for k, bone in enumerate(animation.names)}
    first = animation.positions[0]
    assert 1.4 < np.ptp(first[:, 1]) < 1.9
    assert first[place["Avatar_LeftUpLeg"], 0] > first[place["Avatar_RightUpLeg"], 0]
    orientations, hips = retargeting.bone_orientations(EMOTES / f"{name}.glb")
    frames = min(len(hips), len(animation.transforms))
    np.testing.assert_allclose(animation.positions[:frames, place["Avatar_Hips"]], hips[:frames], atol=1e-5)
    arm = animation.rotations[:frames, place["Avatar_LeftForeArm"]]
    # The retargeting mixes quaternions linearly: a fraction of a degree between keys.
    np.testing.assert_allclose(arm, orientations["LeftForeArm"][:frames], atol=1e-2)


@needs_emotes
def test_a_skeleton_without_a_mesh_names_the_other_loader():
    with pytest.raises(ValueError, match="use load_gltf_animation"):
        data.load_mesh_sequence(EMOTES / "walk.glb", actions="forward")
