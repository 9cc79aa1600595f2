"""Samples against the files they come from, and the order in which they are loaded."""

import dataclasses
import json
import shutil

import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import posmap
from avatarjax.data import dataset, samples, sequences
from avatarjax.io import exr, weights
from avatarjax.posmap import groups as public_groups

SOURCES = [samples.FrameSource, samples.GroupSource, samples.ImageSource]
CLIP_FRAMES = 60


@pytest.fixture(scope="module")
def frames(tiny_folder):
    return samples.FrameSource(tiny_folder, "held_out", check=False)


@pytest.fixture(scope="module")
def groups(tiny_folder):
    return samples.GroupSource(tiny_folder, check=False)


@pytest.fixture(scope="module")
def pictures(tiny_folder):
    return samples.ImageSource(tiny_folder, check=False)


@pytest.fixture(scope="module")
def drawn(tiny_folder):
    """A source that believes no picture to be in the folder."""
    source = samples.ImageSource(tiny_folder, on_demand=True, check=False)
    source.poses = np.full_like(source.poses, -1)
    return source


def clip(folder, split, sequence):
    return weights.load_arrays(folder / "clips" / f"{split}-{sequence:03d}.safetensors")[0]


class TestFrames:
    def test_every_frame_of_the_split_is_one(self, frames):
        assert len(frames) == 20 * CLIP_FRAMES

    @pytest.mark.parametrize("k", [0, 59, 60, 437, -1])
    def test_they_are_what_the_clips_hold(self, frames, tiny_folder, k):
        sequence, frame = divmod(k % len(frames), CLIP_FRAMES)
        sample, arrays = frames[k], clip(tiny_folder, "held_out", sequence)
        assert (int(sample["sequence"]), int(sample["frame"])) == (sequence, frame)
        assert sample["vertices"].dtype == np.float32
        files = {"vertices": "vertices", "root": "roots", "action": "actions", "quats": "quats", "hips": "hips"}
        for name, stored in files.items():
            np.testing.assert_array_equal(sample[name], arrays[stored][frame])

    def test_the_world_is_the_root_and_what_is_relative_to_it(self, frames):
        """Texels of the vertices are those of the clip's, in metres in the world."""
        sample = frames[200]
        texels = posmap.encode(frames.atlas, jnp.asarray(sample["vertices"] + sample["root"]))
        np.testing.assert_allclose(posmap.root(frames.atlas, texels), sample["root"], atol=6e-4)

    @pytest.mark.parametrize("k", [1200, -1201])
    def test_numbers_beyond_the_end_are_refused(self, frames, k):
        with pytest.raises(IndexError):
            frames[k]


class TestGroups:
    def test_every_window_inside_a_clip_is_one(self, groups, tiny_data):
        ends = sequences.group_ends(np.asarray(tiny_data.train.sequence))
        assert len(groups) == len(ends) == 20 * (CLIP_FRAMES - 3)

    def test_windows_are_those_of_the_whole_recording_in_order(self, groups, tiny_data):
        ends = sequences.group_ends(np.asarray(tiny_data.train.sequence))
        for k in (0, 56, 57, 600, len(groups) - 1):
            sequence, third = divmod(int(ends[k]) - 1, CLIP_FRAMES)
            sample = groups[k]
            assert (int(sample["sequence"]), int(sample["frame"])) == (sequence, third)

    @pytest.mark.parametrize("k", [0, 56, 57, 333, -1])
    def test_they_are_normalised_as_unica_does(self, groups, tiny_data, k):
        """`posmap.normalize_group` of the world's texels, as a picture with background 0."""
        sample, train, atlas = groups[k], tiny_data.train, tiny_data.atlas
        third = int(sample["sequence"]) * CLIP_FRAMES + int(sample["frame"])
        window = slice(third - 2, third + 2)
        assert len(set(train.sequence[window].tolist())) == 1
        world = jnp.asarray(train.texels[window] + train.roots[window][:, None])
        wanted, origin = posmap.normalize_group(atlas, world)
        assert sample["posmaps"].shape == (4, 32, 32, 3)
        foreground = sample["posmaps"][:, np.asarray(atlas.rows), np.asarray(atlas.cols)]
        np.testing.assert_allclose(foreground, wanted, atol=1e-6)
        np.testing.assert_allclose(sample["origin"], origin, atol=2e-6)
        assert not sample["posmaps"][:, ~sample["mask"]].any() and sample["mask"].sum() == len(atlas.rows)

    def test_the_action_is_that_of_the_third_frame(self, groups, tiny_data):
        """Where the key changes inside a clip it is seen one frame late or early in any other frame."""
        changes = np.flatnonzero(np.diff(tiny_data.train.actions[:CLIP_FRAMES])) + 1
        for third in (int(changes[0]) - 1, int(changes[0])):
            sample = groups[third - 2]
            assert int(sample["frame"]) == third
            assert int(sample["action"]) == int(tiny_data.train.actions[third])


class TestImages:
    def test_stored_pictures_are_the_files(self, pictures, tiny_folder, tiny_data):
        images = tiny_data.train_images
        assert len(pictures) == images.view.size
        for k in range(len(pictures)):
            pose, slot = divmod(k, images.view.shape[1])
            sample = pictures[k]
            path = dataset.image_path(tiny_folder, "train", pose, int(images.view[pose, slot]))
            np.testing.assert_array_equal(sample["rgba"], exr.read_png(path))
            np.testing.assert_array_equal(sample["texels"], images.texels[pose])
            assert int(sample["view"]) == int(images.view[pose, slot])

    def test_shapes(self, pictures):
        shapes = {name: np.shape(value) for name, value in pictures[0].items()}
        texels = len(pictures.atlas.rows)
        assert shapes == {
            "rgba": (32, 32, 4),
            "texels": (texels, 3),
            "world_to_camera": (4, 4),
            "intrinsics": (3, 3),
            "box_centre": (3,),
            "box_side": (),
            "view": (),
            "sequence": (),
            "frame": (),
        }

    def test_the_camera_is_that_of_the_view(self, pictures):
        sample, cameras = pictures[1], dataset.cylinder_cameras(32)
        np.testing.assert_array_equal(sample["world_to_camera"], cameras.world_to_camera[int(sample["view"])])

    def test_the_box_holds_the_figure(self, pictures):
        sample = pictures[2]
        boxed = (sample["texels"] - sample["box_centre"]) / sample["box_side"]
        # Texels between the upscaled ones may stick out a little.
        assert np.abs(boxed).max() < 0.53 and np.abs(boxed).max() > 0.45

    def test_on_demand_every_frame_is_seen_from_every_view(self, drawn, tiny_folder):
        assert len(drawn) == 20 * CLIP_FRAMES * dataset.VIEWS
        sample = drawn[(61 * 50) + 7]
        assert [int(sample[name]) for name in ("sequence", "frame", "view")] == [1, 1, 7]

    def test_drawn_pictures_are_the_stored_ones(self, drawn, pictures):
        """But for vertices that the folder holds as float16, which moves edges by a hundredth of a pixel."""
        for k in range(len(pictures)):
            stored = pictures[k]
            frame = int(stored["sequence"]) * CLIP_FRAMES + int(stored["frame"])
            again = drawn[frame * dataset.VIEWS + int(stored["view"])]
            difference = np.abs(again["rgba"].astype(float) - stored["rgba"])
            assert (stored["rgba"][..., 3] > 0).mean() > 0.05
            assert difference.mean() < 0.5
            for name in ("texels", "world_to_camera", "box_centre"):
                np.testing.assert_array_equal(again[name], stored[name])

    def test_on_demand_what_is_stored_is_not_drawn(self, tiny_folder, pictures, monkeypatch):
        source = samples.ImageSource(tiny_folder, on_demand=True, check=False)
        monkeypatch.setattr(samples, "MeshRenderer", None)
        stored = pictures[0]
        frame = int(stored["sequence"]) * CLIP_FRAMES + int(stored["frame"])
        again = source[frame * dataset.VIEWS + int(stored["view"])]
        np.testing.assert_array_equal(again["rgba"], stored["rgba"])


class TestDoor:
    @pytest.mark.parametrize("source", SOURCES)
    def test_unknown_splits_are_named(self, source, tiny_folder):
        with pytest.raises(ValueError, match="has no split 'test'; it has train, held_out, truth"):
            source(tiny_folder, "test")

    @pytest.mark.parametrize("source", SOURCES)
    def test_a_folder_that_is_no_dataset_is_refused(self, source, tmp_path):
        with pytest.raises(ValueError, match="no finished dataset"):
            source(tmp_path)

    @pytest.mark.parametrize("source", SOURCES)
    def test_a_damaged_file_is_named(self, source, tiny_folder, tmp_path):
        folder = shutil.copytree(tiny_folder, tmp_path / "data")
        path = folder / "clips" / "train-002.safetensors"
        path.write_bytes(path.read_bytes()[:-1])
        with pytest.raises(ValueError, match=r"train-002\.safetensors is damaged.*--stage data"):
            source(folder)

    def test_pictures_of_a_split_without_any_are_refused(self, tiny_folder):
        with pytest.raises(ValueError, match="truth"):
            samples.ImageSource(tiny_folder, "truth", check=False)

    def test_what_needs_vertices_says_so(self, tiny_folder, tmp_path):
        folder = tmp_path / "data"
        folder.mkdir()
        found = json.loads((tiny_folder / "manifest.json").read_text())
        found["spec"]["vertices"] = "none"
        (folder / "manifest.json").write_text(json.dumps(found))
        with pytest.raises(ValueError, match="holds no vertices"):
            samples.FrameSource(folder, check=False)
        with pytest.raises(ValueError, match="holds no vertices to draw"):
            samples.ImageSource(folder, on_demand=True, check=False)

    def test_whole_folders_pass_the_check(self, tiny_folder):
        assert len(samples.FrameSource(tiny_folder, "truth")) == 20


@dataclasses.dataclass(frozen=True)
class Numbers:
    """A source of its own numbers."""

    count: int

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, k: int) -> np.ndarray:
        return np.int64(range(self.count)[k])


class TestLoader:
    @staticmethod
    def order(**options):
        return [batch.tolist() for batch in samples.loader(Numbers(50), batch=8, **options)]

    def test_one_seed_is_one_order(self):
        assert self.order(seed=3) == self.order(seed=3)
        assert self.order(seed=3) != self.order(seed=4)

    def test_each_sample_comes_once_an_epoch_in_a_new_order(self):
        flat = np.concatenate(self.order(seed=0, epochs=2, drop_remainder=False))
        first, second = flat[:50], flat[50:]
        assert sorted(first) == sorted(second) == list(range(50))
        assert first.tolist() != second.tolist() and first.tolist() != list(range(50))

    def test_the_remainder_is_dropped_or_kept(self):
        assert [len(b) for b in self.order(seed=0)] == [8] * 6
        assert [len(b) for b in self.order(seed=0, drop_remainder=False)] == [8] * 6 + [2]

    def test_without_epochs_it_goes_on_for_ever(self):
        endless = samples.loader(Numbers(5), batch=2, seed=0, epochs=None)
        assert endless[10_000].shape == (2,)

    def test_an_iterator_resumes_where_its_state_was_saved(self):
        def fresh():
            return iter(samples.loader(Numbers(50), batch=8, seed=1, epochs=2).to_iter_dataset())

        iterator = fresh()
        for _ in range(4):
            next(iterator)
        state = json.loads(json.dumps(iterator.get_state()))
        wanted = [batch.tolist() for batch in iterator]
        resumed = fresh()
        resumed.set_state(state)
        assert [batch.tolist() for batch in resumed] == wanted and len(wanted) == 8

    def test_batches_are_stacked_samples(self, groups):
        batch = samples.loader(groups, batch=3, seed=0)[0]
        assert batch["posmaps"].shape == (3, 4, 32, 32, 3)
        for k in range(3):
            place = int(batch["sequence"][k]) * (CLIP_FRAMES - 3) + int(batch["frame"][k]) - 2
            np.testing.assert_array_equal(batch["posmaps"][k], groups[place]["posmaps"])


def test_groups_are_written_in_the_public_layout(tiny_folder, tmp_path):
    source = samples.GroupSource(tiny_folder, check=False)
    (folder,) = samples.write_groups(source, tmp_path, [3])
    maps, mask = public_groups.from_public(public_groups.read_group(folder))
    np.testing.assert_array_equal(mask[0], source[3]["mask"])
    np.testing.assert_allclose(maps, source[3]["posmaps"], atol=1e-6)
    _, frame, action = public_groups.parse_group_name(folder.name)
    assert frame == source[3]["frame"] and action.lower() == source.actions[int(source[3]["action"])]
