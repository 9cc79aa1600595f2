"""The door: every kind of folder gives the same sequence, axes and time are ours, and each mistake names its fix."""

import dataclasses
import json
import subprocess
import sys

import import_figures as figures
import numpy as np
import pytest
import trimesh

from avatarjax import data
from avatarjax.data.importers import axes, roots
from avatarjax.io import exr

FRAMES = 6


@pytest.fixture
def walk():
    _, faces, uvs = figures.figure()
    return figures.walk(FRAMES), faces, uvs


def load(path, **arguments):
    return data.load_mesh_sequence(path, **{"actions": "forward", **arguments})


@pytest.mark.parametrize("kind", ["obj", "ply", "glb", "npz", "one npz", "blender ply"])
def test_every_kind_of_folder_gives_the_same_sequence(tmp_path, walk, kind):
    vertices, faces, uvs = walk
    folder = tmp_path / "frames"
    if kind == "one npz":
        folder.mkdir()
        np.savez(folder / "walk.npz", vertices=vertices, faces=faces, uvs=uvs)
    elif kind == "blender ply":
        figures.write_frames(folder, "ply", vertices @ axes.matrix("z", "-y"), faces)
    else:
        figures.write_frames(folder, kind, vertices, faces, uvs)
    sequence = load(folder)
    np.testing.assert_allclose(sequence.vertices, vertices, atol=2e-6)
    np.testing.assert_array_equal(sequence.faces, faces)
    if kind in ("obj", "one npz"):
        np.testing.assert_allclose(sequence.uvs, uvs, atol=1e-6)
    assert sequence.vertices.dtype == np.float32 and sequence.actions.dtype == np.int32
    assert sequence.actions.tolist() == [1] * FRAMES and sequence.sequence.tolist() == [0] * FRAMES
    assert sequence.joints is None and sequence.texture is None


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_coordinates_and_polygons_of_a_ply(tmp_path, encoding):
    vertices, faces, _ = figures.figure()
    header = f"ply\nformat {encoding} 1.0\nelement vertex {len(vertices)}\n"
    header += "".join(f"property float {name}\n" for name in "xyzst")
    header += f"element face {len(faces) // 2}\nproperty list uchar int vertex_indices\nend_header\n"
    table = np.concatenate([vertices, vertices[:, :2] * 0.5], axis=1).astype("<f4")
    # Any four vertices make a polygon: only indices matter here.
    quads = faces.ravel()[: len(faces) // 2 * 4].reshape(-1, 4)
    if encoding == "ascii":
        rows = [" ".join(map(repr, row)) for row in table.astype(float).tolist()]
        body = "\n".join(rows + [" ".join(map(str, [4, *quad])) for quad in quads.tolist()]).encode() + b"\n"
    else:
        body = table.tobytes() + b"".join(b"\x04" + quad.astype("<i4").tobytes() for quad in quads)
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    sequence = load(tmp_path / "a.ply")
    np.testing.assert_allclose(sequence.vertices[0], vertices, atol=1e-6)
    triangles = {tuple(sorted(face)) for face in sequence.faces.tolist()}
    assert len(sequence.faces) == 2 * len(quads) and tuple(sorted(quads[0, :3].tolist())) in triangles
    np.testing.assert_allclose(sequence.uvs, 0.5 * vertices[sequence.faces][..., :2], atol=1e-6)


@pytest.mark.parametrize("preset", ["unreal", "unreal-mesh"])
def test_an_unreal_export_comes_back_upright_in_metres(tmp_path, walk, preset):
    vertices, faces, uvs = walk
    theirs = 100 * vertices @ axes.matrix(*axes.PRESETS[preset])
    figures.write_frames(tmp_path / "frames", "obj", theirs, faces, uvs)
    sequence = load(tmp_path / "frames", axes=preset)
    np.testing.assert_allclose(sequence.vertices, vertices, atol=1e-5)
    # The reflection does not turn the surface inside out, and corners keep their coordinates.
    np.testing.assert_array_equal(sequence.faces, faces)
    np.testing.assert_allclose(sequence.uvs, uvs, atol=1e-6)


def test_the_root_is_the_waist(tmp_path, walk):
    vertices, faces, _ = walk
    figures.write_frames(tmp_path, "npz", vertices, faces)
    roots = load(tmp_path).roots
    middle = 0.58 * figures.HEIGHT
    np.testing.assert_allclose(roots[0], [0, middle, 0], atol=0.08)
    np.testing.assert_allclose(np.diff(roots[:, 2]), 0.04, atol=1e-5)
    np.testing.assert_allclose(load(tmp_path, root=[0, 5]).roots, vertices[:, [0, 5]].mean(1), atol=1e-6)
    for root, match in (([10**6], "the mesh has"), ("Hips", "has no joints"), ([], "vertex indices")):
        with pytest.raises(ValueError, match=match):
            load(tmp_path, root=root)


def test_a_finely_meshed_patch_does_not_pull_the_waist(tmp_path, walk):
    vertices, faces, _ = walk
    points, triangles = vertices[0], faces
    for _ in range(2):
        points, triangles = trimesh.remesh.subdivide(points, triangles)
    for _ in range(2):
        middle = points[triangles].mean(axis=1)
        patch = (np.abs(middle[:, 1] - 0.58 * figures.HEIGHT) < 0.1) & (middle[:, 2] > 0.09)
        points, triangles = trimesh.remesh.subdivide(points, triangles, np.flatnonzero(patch))
    np.savez(tmp_path / "a.npz", vertices=points, faces=triangles)
    assert abs(load(tmp_path / "a.npz").roots[0, 2]) < 0.03
    assert points[roots.waist_vertices(points[None].astype(np.float32)), 2].mean() > 0.05


def test_arrays_that_do_not_fit_each_other_are_refused(tmp_path, walk):
    vertices, faces, _ = walk
    figures.write_frames(tmp_path, "npz", vertices, faces)
    sequence = load(tmp_path)
    for name, value in (
        ("actions", sequence.actions[1:]),
        ("faces", faces + 10**6),
        ("roots", sequence.roots * np.nan),
    ):
        with pytest.raises(ValueError, match=r"entries, expected|faces must use|not finite"):
            dataclasses.replace(sequence, **{name: value})


def test_time_becomes_thirty_frames_a_second(tmp_path, walk):
    vertices, faces, _ = walk
    np.savez(tmp_path / "a.npz", vertices=vertices, faces=faces, fps=15.0, actions=["idle"] * 3 + ["left"] * 3)
    sequence = data.load_mesh_sequence(tmp_path / "a.npz")
    np.testing.assert_allclose(sequence.vertices[::2], vertices, atol=1e-6)
    np.testing.assert_allclose(sequence.vertices[1::2], (vertices[1:] + vertices[:-1]) / 2, atol=1e-6)
    assert sequence.actions.tolist() == [0] * 6 + [3] * 5
    faster = data.load_mesh_sequence(tmp_path / "a.npz", fps=60.0)
    np.testing.assert_allclose(faster.vertices, vertices[::2], atol=1e-6)
    picked = data.load_mesh_sequence(tmp_path / "a.npz", fps=60.0, start=1, stop=6, every=2)
    np.testing.assert_allclose(picked.vertices, vertices[1:6:2], atol=1e-6)
    assert picked.actions.tolist() == [0, 3, 3]


def test_subfolders_are_sequences_in_natural_order(tmp_path, walk):
    vertices, faces, uvs = walk
    for name in ("take_10", "take_2"):
        figures.write_frames(tmp_path / name, "obj", vertices + (name == "take_2"), faces, uvs)
    (tmp_path / "actions.json").write_text(json.dumps({"take_2": ["idle"] * FRAMES, "take_10": [4] * FRAMES}))
    sequence = data.load_mesh_sequence(tmp_path)
    assert sequence.sequence_names == ("take_2", "take_10")
    assert sequence.actions.tolist() == [0] * FRAMES + [4] * FRAMES
    np.testing.assert_array_equal(sequence.sequence, np.repeat([0, 1], FRAMES))
    np.testing.assert_allclose(sequence.vertices[0], vertices[0] + 1, atol=1e-5)


def test_folder_names_of_the_public_release_say_the_action(tmp_path, walk):
    vertices, faces, _ = walk
    for name in ("run_00001_Forward", "run_00002_Left"):
        figures.write_frames(tmp_path / name, "npz", vertices, faces)
    assert data.load_mesh_sequence(tmp_path).actions.tolist() == [1] * FRAMES + [3] * FRAMES


@pytest.mark.parametrize("first", [0, 1])
def test_an_actions_table_counts_as_the_files_or_from_zero(tmp_path, walk, first):
    vertices, faces, _ = walk
    figures.write_frames(tmp_path, "npz", vertices, faces)
    rows = [f"{k + first},{'idle' if k < 2 else 'Left'}" for k in range(FRAMES)]
    (tmp_path / "actions.csv").write_text("\n".join(["frame,action", *rows]))
    assert data.load_mesh_sequence(tmp_path).actions.tolist() == [0, 0, 3, 3, 3, 3]
    assert data.load_mesh_sequence(tmp_path, start=1, stop=3).actions.tolist() == [0, 3]


def test_own_action_names(tmp_path, walk):
    vertices, faces, _ = walk
    figures.write_frames(tmp_path, "npz", vertices, faces)
    sequence = load(tmp_path, actions="bow", action_names=("idle", "bow"))
    assert sequence.actions.tolist() == [1] * FRAMES and sequence.action_names == ("idle", "bow")


@pytest.mark.parametrize(
    ("rows", "match"),
    [
        ("frame,action\n0,idle", "1 actions for 6 frames"),
        ("frame,action\n" + "\n".join(f"{k},idle" for k in range(9)), "9 actions for 6 frames"),
        (
            "frame,action\n" + "\n".join(f"{k},moonwalk" for k in range(6)),
            "unknown action 'moonwalk': known are 0 idle",
        ),
        ("frame,action\n0,idle\n0,idle", "line 3: frame '0' must be a whole number that occurs once"),
        ("time,key\n0,idle", "needs a header frame,action"),
        ("", "needs a header frame,action"),
        ("sequence,frame,action\nother,0,idle", "actions of the sequences other"),
    ],
)
def test_wrong_action_tables_are_named(tmp_path, walk, rows, match):
    vertices, faces, _ = walk
    figures.write_frames(tmp_path, "npz", vertices, faces)
    (tmp_path / "actions.csv").write_text(rows)
    with pytest.raises(ValueError, match=rf"actions\.csv.*{match}"):
        data.load_mesh_sequence(tmp_path)


def test_actions_are_needed(tmp_path, walk):
    vertices, faces, _ = walk
    figures.write_frames(tmp_path, "npz", vertices, faces)
    with pytest.raises(ValueError, match=r"write actions\.csv"):
        data.load_mesh_sequence(tmp_path)
    with pytest.raises(ValueError, match="2 actions for 6 frames"):
        load(tmp_path, actions=["idle", "left"])
    with pytest.raises(ValueError, match=r"missing\.csv does not exist"):
        load(tmp_path, actions=tmp_path / "missing.csv")


def test_textures_are_found_named_and_packed(tmp_path, walk):
    vertices, faces, uvs = walk
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 255, (8, 8, 3), dtype=np.uint8) for _ in range(2)]
    figures.write_frames(tmp_path, "obj", vertices, faces, uvs)
    exr.write_png(tmp_path / "textures" / "normal.png", images[0])
    np.testing.assert_array_equal(load(tmp_path).texture, images[0])
    exr.write_png(tmp_path / "textures" / "skin_albedo.png", images[1])
    np.testing.assert_array_equal(load(tmp_path).texture, images[1])
    np.testing.assert_array_equal(load(tmp_path, textures=tmp_path / "textures" / "normal.png").texture, images[0])
    (tmp_path / "textures" / "skin_albedo.png").rename(tmp_path / "textures" / "other.png")
    with pytest.raises(ValueError, match=r"several images \(normal.png, other.png\)"):
        load(tmp_path)


def test_materials_of_an_obj_become_one_texture(tmp_path):
    vertices, faces, uvs = figures.figure()
    image = np.random.default_rng(0).integers(0, 255, (8, 12, 3), dtype=np.uint8)
    exr.write_png(tmp_path / "textures" / "cloth.png", image)
    (tmp_path / "a.mtl").write_text("newmtl skin\nKd 1 0 0\nnewmtl cloth\nmap_Kd C:\\art\\cloth.png\n")
    figures.write_obj(tmp_path / "a_1.obj", vertices, faces, uvs, material="a.mtl")
    text = (tmp_path / "a_1.obj").read_text().splitlines()
    first = next(k for k, line in enumerate(text) if line.startswith("f "))
    text.insert(first + len(faces) // 2, "usemtl cloth")
    (tmp_path / "a_1.obj").write_text("\n".join(text))
    sequence = load(tmp_path)
    from avatarjax.data import mesh_renderer

    half = len(faces) // 2
    middle = sequence.uvs.mean(axis=1)
    np.testing.assert_allclose(mesh_renderer.sample_texture(sequence.texture, middle[:half]), [[255, 0, 0]] * half)
    expected = mesh_renderer.sample_texture(image, uvs.mean(axis=1)[half:])
    found = mesh_renderer.sample_texture(sequence.texture, middle[half:])
    np.testing.assert_allclose(found, expected, atol=0.1)


@pytest.mark.parametrize("name", ["../secret.png", "/etc/hostname", "missing.png"])
def test_textures_outside_or_missing_are_refused(tmp_path, walk, name):
    vertices, faces, uvs = walk
    exr.write_png(tmp_path / "secret.png", np.zeros((4, 4, 3), np.uint8))
    figures.write_obj(tmp_path / "in" / "a.obj", vertices[0], faces, uvs, material="a.mtl")
    (tmp_path / "in" / "a.mtl").write_text(f"newmtl skin\nmap_Kd {name}\n")
    with pytest.raises(ValueError, match=r"a\.mtl names.*(not a file inside|missing)"):
        load(tmp_path / "in")
    with pytest.raises(ValueError, match=r"nowhere\.png does not exist"):
        figures.write_obj(tmp_path / "out" / "a.obj", vertices[0], faces, uvs)
        load(tmp_path / "out", textures=tmp_path / "nowhere.png")


def test_frames_that_are_not_one_mesh_are_named(tmp_path, walk):
    vertices, faces, uvs = walk
    folder = tmp_path / "f"
    figures.write_frames(folder, "obj", vertices, faces, uvs)
    third = folder / "frame_003.obj"
    whole = third.read_text()

    def expect(match):
        with pytest.raises(ValueError, match=match):
            load(folder)

    figures.write_obj(third, vertices[2], faces[::-1], uvs)
    expect(r"frame_003\.obj has another topology.*same order")
    figures.write_obj(third, vertices[2][:-1], faces[:100], uvs[:100])
    expect(r"frame_003\.obj has another topology \(783 vertices, 100 faces\)")
    third.write_text(whole.replace(whole.splitlines()[4], "v 1 nan 2", 1))
    expect(r"frame_003\.obj: vertex 4 is not finite")
    third.write_text(whole.replace(whole.splitlines()[4], "v 1 two 2", 1))
    expect(r"frame_003\.obj has a vertex that is not three numbers")
    third.write_text("")
    expect(r"frame_003\.obj is empty")
    third.unlink()
    expect(r"frame 3 is missing before .*frame_004\.obj")
    third.write_text(whole)
    (folder / "frame_3.obj").write_text(whole)
    expect("has the frame number 3 of another file")
    (folder / "frame_3.obj").rename(folder / "other_7.obj")
    expect("different series of frames")
    (folder / "other_7.obj").rename(folder / "frame_007.ply")
    expect(r"different kinds \(\.obj, \.ply\)")


def test_meshes_that_are_none_are_named(tmp_path, walk):
    vertices, faces, uvs = walk
    path = tmp_path / "a.obj"

    def expect(match):
        with pytest.raises(ValueError, match=match):
            load(path)

    figures.write_obj(path, vertices[0], faces[:0])
    expect(r"a\.obj has 0 faces")
    figures.write_obj(path, vertices[0], faces + len(vertices[0]))
    expect(r"a\.obj: faces use vertices")
    path.write_text(path.read_text() + "vt 0 0\nf 1/1 2/1 3/9\n")
    expect(r"a\.obj")
    figures.write_obj(path, vertices[0], faces, uvs)
    path.write_text(path.read_text().replace("vt ", "# ", 1))
    expect(r"a\.obj: faces use texture coordinates up to")
    path = tmp_path / "a.npz"
    np.savez(path, vertices=vertices, faces=faces, uvs=uvs[1:])
    expect(r"a\.npz: texture coordinates of shape .* fit neither")
    np.savez(path, vertices=vertices, faces=faces, uvs=uvs[1:, 0])
    expect(r"a\.npz: texture coordinates of shape .* fit neither")
    np.savez(path, faces=faces)
    expect(r"a\.npz has no array 'vertices'")
    np.savez(path, vertices=vertices[..., :2], faces=faces)
    expect(r"a\.npz: vertices must be numbers of shape")
    np.savez(path, vertices=np.array([{"a": 1}], object), faces=faces)
    expect(r"a\.npz is not a whole NPZ file of plain arrays")
    path.write_bytes(b"")
    expect(r"a\.npz is empty")
    broken = vertices.copy()
    broken[2, 7] = np.inf
    np.savez(path, vertices=broken, faces=faces)
    expect(r"a\.npz: frame 2, vertex 7 is not finite")
    path = tmp_path / "a.ply"
    path.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n")
    expect(r"a\.ply cannot be read as PLY")


def test_axes_and_units_are_held_against_the_figure(tmp_path, walk):
    vertices, faces, _ = walk
    figures.write_frames(tmp_path, "npz", vertices * 100, faces)
    with pytest.raises(ValueError, match="pass up='y'"):
        load(tmp_path, up="z")
    with pytest.raises(ValueError, match="pass unit='cm'"):
        load(tmp_path, unit="m")
    np.testing.assert_allclose(load(tmp_path, unit="m", check=False).vertices, vertices * 100, rtol=1e-5)
    np.testing.assert_allclose(load(tmp_path, unit=0.01, up="y").vertices, vertices, atol=1e-5)


def test_other_data_name_their_loader(tmp_path):
    for name, content, match in (
        ("scene/point_cloud/x", "", "load_gaussian_scene"),
        ("maps/0-w_00001_Idle/1.exr", "", "load_position_maps"),
        ("maps2/avatar/0-w_00001_Idle/1.exr", "", "load_position_maps"),
        ("video/masks/0.png", "", "load_monocular"),
        ("fbx/a.fbx", "", r"a\.fbx cannot be read, export it as OBJ, PLY, GLB or NPZ"),
        ("nothing/readme.txt", "", "holds no mesh frames"),
    ):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
        (tmp_path / "video").mkdir(exist_ok=True)
        (tmp_path / "video" / "cameras.json").write_text("{}")
        with pytest.raises(ValueError, match=match):
            load(tmp_path / name.split("/")[0])
    (tmp_path / "cloud.ply").write_bytes(b"ply\nproperty float f_dc_0\n")
    with pytest.raises(ValueError, match="load_gaussian_scene"):
        load(tmp_path / "cloud.ply")
    for path, match in (("gone", "does not exist"), ("fbx/a.fbx", r"export it as one of these")):
        with pytest.raises(ValueError, match=match):
            load(tmp_path / path)


@pytest.mark.parametrize("arguments", [{"every": 0}, {"start": -1}, {"start": 4, "stop": 4}, {"start": 99}])
def test_no_frames_left_is_an_error(tmp_path, walk, arguments):
    vertices, faces, _ = walk
    figures.write_frames(tmp_path, "npz", vertices, faces)
    with pytest.raises(ValueError, match=r"pick no frames|none is left"):
        load(tmp_path, **arguments)


def test_importing_the_package_reads_no_importer():
    code = "import sys, avatarjax.data; sys.exit(any('importers' in name for name in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    assert data.load_mesh_sequence.__name__ == "load_mesh_sequence"
    with pytest.raises(AttributeError, match="load_everything"):
        _ = data.load_everything
