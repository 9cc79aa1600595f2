"""A dataset folder as Grain sources: frames, groups of position maps, and pictures, by number, without loading all.

    source = samples.GroupSource("runs/data/cowgirl/small")
    for batch in samples.loader(source, batch=32, seed=0): ...

A source is a sequence (`len`, `[k]`) of dicts of NumPy arrays; files are opened where they are needed. `loader` gives a
`grain.MapDataset`: the same seed gives the same order on every machine, and iterators of it can be saved and resumed.
"""

from __future__ import annotations

import functools
import os
import typing
from collections.abc import Callable, Iterable
from pathlib import Path

import jax
import numpy as np
from safetensors import safe_open

from avatarjax import posmap
from avatarjax.data import dataset, manifest
from avatarjax.data.mesh_renderer import MeshRenderer
from avatarjax.io import exr, weights
from avatarjax.posmap import groups

Sample = dict[str, typing.Any]


class _Source:
    """Frames of one split in order: `starts` (n + 1,) says at which number each of its n clips begins."""

    def __init__(self, folder: str | os.PathLike, split: str = "train", *, check: bool = True):
        self.folder, self.split = Path(folder), split
        found = dataset.read_manifest(self.folder)
        if split not in found["clips"]:
            raise ValueError(f"{folder} has no split {split!r}; it has {', '.join(found['clips'])}")
        if check:
            manifest.check(self.folder, found, dataset.AGAIN)
        self.spec = found["spec"]
        self.actions = tuple(found["actions"])
        self.starts = np.concatenate([[0], np.cumsum(found["clips"][split])])

    def frames(self, sequence: int, start: int, stop: int, names: tuple[str, ...]) -> Sample:
        """Some arrays of the frames start to stop of a clip; only their part of the file is read."""
        path = self.folder / "clips" / f"{self.split}-{sequence:03d}.safetensors"
        with safe_open(str(path), framework="numpy") as file:
            return {name: file.get_slice(name)[start:stop] for name in names}

    def place(self, k: int) -> tuple[int, int]:
        """(sequence, frame) of frame number k of the split."""
        sequence = int(np.searchsorted(self.starts, k, side="right") - 1)
        return sequence, int(k - self.starts[sequence])

    @functools.cached_property
    def figure(self) -> dict[str, np.ndarray]:
        """The avatar's own arrays."""
        return weights.load_arrays(self.folder / "avatar.safetensors")[0]

    @functools.cached_property
    def atlas(self) -> posmap.Atlas:
        """The avatar's atlas."""
        return dataset.atlas_of(self.figure, int(self.spec["size"]))


class FrameSource(_Source):
    """Single frames: vertices (v, 3) float32 relative to the root, root (3,) metres in the world, action (), quats
    (j, 4) local rotations, hips (3,), sequence and frame.

    Raises ValueError for a dataset that was built without vertices.
    """

    def __init__(self, folder: str | os.PathLike, split: str = "train", *, check: bool = True):
        super().__init__(folder, split, check=check)
        if self.spec["vertices"] == "none":
            raise ValueError(f"{folder} holds no vertices: build it with vertices float16 or float32")

    def __len__(self) -> int:
        return int(self.starts[-1])

    def __getitem__(self, k: int) -> Sample:
        sequence, frame = self.place(range(len(self))[k])
        names = ("vertices", "roots", "actions", "quats", "hips")
        vertices, root, action, quats, hips = (a[0] for a in self.frames(sequence, frame, frame + 1, names).values())
        return {
            "vertices": vertices.astype(np.float32),
            "root": root,
            "action": action,
            "quats": quats,
            "hips": hips,
            "sequence": np.int32(sequence),
            "frame": np.int32(frame),
        }


class GroupSource(_Source):
    """Windows of four consecutive frames, stride one, as UNICA trains on them: posmaps (4, h, w, 3) in the normalised
    space of the third frame with background 0, mask (h, w), action () that drives the third frame to the fourth,
    origin (3,) the third frame's root in the world, sequence and frame (of the third)."""

    def __init__(self, folder: str | os.PathLike, split: str = "train", *, check: bool = True):
        super().__init__(folder, split, check=check)
        self.windows = np.concatenate([[0], np.cumsum(np.maximum(np.diff(self.starts) - 3, 0))])

    def __len__(self) -> int:
        return int(self.windows[-1])

    def __getitem__(self, k: int) -> Sample:
        k = range(len(self))[k]
        sequence = int(np.searchsorted(self.windows, k, side="right") - 1)
        first = int(k - self.windows[sequence])
        found = self.frames(sequence, first, first + 4, ("texels", "roots", "actions"))
        atlas, roots = self.atlas, found["roots"]
        texels = found["texels"] + (roots - roots[2:3])[:, None]
        side = int(self.spec["size"])
        rows, columns = np.asarray(atlas.rows), np.asarray(atlas.cols)
        maps = np.zeros((4, side, side, 3), np.float32)
        maps[:, rows, columns] = float(atlas.scale) * texels + 0.5
        mask = np.zeros((side, side), bool)
        mask[rows, columns] = True
        return {
            "posmaps": maps,
            "mask": mask,
            "action": found["actions"][2],
            "origin": roots[2],
            "sequence": np.int32(sequence),
            "frame": np.int32(first + 2),
        }


class ImageSource(_Source):
    """Pictures of poses: rgba (h, w, 4) uint8 with straight alpha, texels (t, 3) metres relative to the root,
    world_to_camera (4, 4) and intrinsics (3, 3) of a camera that sees the pose in its box [-0.5, 0.5]^3, box_centre
    (3,) and box_side () in metres relative to the root, view, sequence and frame.

    Without `on_demand` these are the pictures in the folder; with it, all frames of the split in all 50 views, drawn
    when they are asked for unless they are in the folder (which needs vertices in the dataset).
    """

    def __init__(self, folder: str | os.PathLike, split: str = "train", *, on_demand: bool = False, check: bool = True):
        super().__init__(folder, split, check=check)
        if on_demand and self.spec["vertices"] == "none":
            raise ValueError(f"{folder} holds no vertices to draw: build it with vertices float16 or float32")
        self.on_demand = on_demand
        index = weights.load_arrays(self.folder / "images" / f"{split}.safetensors")[0]
        self.poses = np.stack([index["sequence"], index["frame"]], axis=1)
        self.views = index["view"]
        self.cameras = jax.tree.map(np.asarray, dataset.cylinder_cameras(int(self.spec["image_size"])))

    def __len__(self) -> int:
        return int(self.starts[-1]) * dataset.VIEWS if self.on_demand else self.views.size

    def __getitem__(self, k: int) -> Sample:
        k = range(len(self))[k]
        if self.on_demand:
            frame, view = divmod(k, dataset.VIEWS)
            sequence, frame = self.place(frame)
        else:
            pose, slot = divmod(k, self.views.shape[1])
            (sequence, frame), view = self.poses[pose].tolist(), int(self.views[pose, slot])
        texels = self.frames(sequence, frame, frame + 1, ("texels",))["texels"][0]
        box = self._box(texels)
        return {
            "rgba": self._picture(sequence, frame, view, box),
            "texels": texels,
            "world_to_camera": self.cameras.world_to_camera[view],
            "intrinsics": self.cameras.intrinsics[view],
            "box_centre": np.asarray(box.centre),
            "box_side": np.asarray(box.side),
            "view": np.int32(view),
            "sequence": np.int32(sequence),
            "frame": np.int32(frame),
        }

    def _picture(self, sequence: int, frame: int, view: int, box: posmap.Box) -> np.ndarray:
        pose = np.flatnonzero((self.poses == [sequence, frame]).all(axis=1))
        if len(pose) and view in self.views[pose[0]]:
            return exr.read_png(dataset.image_path(self.folder, self.split, int(pose[0]), view))
        vertices = self.frames(sequence, frame, frame + 1, ("vertices",))["vertices"][0].astype(np.float32)
        boxed = (vertices - np.asarray(box.centre)) / np.asarray(box.side)
        return self._renderer.render(boxed, jax.tree.map(lambda x: x[view], self.cameras))

    @functools.cached_property
    def _renderer(self) -> MeshRenderer:
        return MeshRenderer(self.figure["faces"], self.figure["uvs"], exr.read_png(self.folder / "texture.png"))

    @functools.cached_property
    def _box(self) -> Callable[[np.ndarray], posmap.Box]:
        upscaler = posmap.build_upscaler(self.atlas, int(self.spec["upscaled"]))
        return jax.jit(lambda texels: posmap.bounding_box(posmap.upscale(upscaler, texels)))


def loader(source: typing.Any, *, batch: int, seed: int, epochs: int | None = 1, drop_remainder: bool = True):
    """A `grain.MapDataset` of shuffled batches of a source; `epochs` None repeats for ever.

    Iterate over it, index it, or turn it into a `grain.IterDataset` whose iterator has `get_state` and `set_state`.
    """
    import grain

    data = grain.MapDataset.source(source).shuffle(seed=seed)
    return data.repeat(epochs).batch(batch, drop_remainder=drop_remainder)


def write_groups(source: GroupSource, out: str | os.PathLike, numbers: Iterable[int]) -> list[Path]:
    """Write some groups in the layout of the public UNICA files (`posmap.groups`); returns their folders.

    A folder is called SPLIT-SEQUENCE_FRAME_Action, after its third frame.
    """
    written = []
    for k in numbers:
        sample = source[k]
        action = source.actions[int(sample["action"])].capitalize()
        name = groups.group_name(f"{source.split}-{sample['sequence']:03d}", int(sample["frame"]), action)
        mask = np.broadcast_to(sample["mask"], sample["posmaps"].shape[:3])
        groups.write_group(Path(out) / name, groups.to_public(sample["posmaps"], mask))
        written.append(Path(out) / name)
    return written
