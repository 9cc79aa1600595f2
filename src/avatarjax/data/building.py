"""Making a dataset's folder: from the simulated avatars, or from meshes that somebody else has recorded.

A build that was interrupted goes on where it stopped: a clip's file is written after everything else of the clip, and
the manifest after all files.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import hashlib
import json
import shutil
import threading
import typing
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from avatarjax import posmap
from avatarjax.cameras import Camera
from avatarjax.data import avatars, dataset, dressing, manifest, sequences
from avatarjax.data.dataset import DatasetSpec
from avatarjax.data.importers.mesh_sequence import MeshSequence
from avatarjax.data.mesh_renderer import MeshRenderer, PosedMesh
from avatarjax.data.sequences import Take
from avatarjax.io import atomic, exr, weights
from avatarjax.physics.xpbd import XPBDConfig

# Simulating and rendering release the interpreter: so many clips at a time keep two cores busy.
_WORKERS = 2
_NOTE = "building.json"  # lies beside what an unfinished build has made
# Of recorded sequences, every so many-th is held out.
_HELD_OUT = 5
_GREY = np.full((4, 4, 3), 190, np.uint8)


@dataclasses.dataclass(frozen=True)
class _Plan:
    """The keys of a split's sequences, and which of their poses are pictured: (sequence, frame) and views (p, k)."""

    scripts: list[np.ndarray]
    poses: list[tuple[int, int]]
    views: np.ndarray


class _Simulated:
    """The clips of one of our avatars under all transitions."""

    actions: tuple[str, ...] = sequences.ACTIONS

    def __init__(self, spec: DatasetSpec):
        self.spec = spec
        self.avatar = avatars.build(spec.avatar)
        self.faces, self.uvs, self.texture = self.avatar.faces, self.avatar.uvs, self.avatar.texture
        self.cloth = XPBDConfig(substeps=spec.cloth_steps)
        self.scripts = {
            "train": sequences.SCRIPTS[spec.scripts](spec.transition_frames, spec.seed),
            "held_out": sequences.transition_scripts(spec.held_out_frames, spec.seed + 1),
            "truth": [np.asarray(spec.script, np.int32)],
        }
        self.work = sum(len(s) + sequences.LEAD_IN for scripts in self.scripts.values() for s in scripts)
        self._motions: dict[tuple[str, int], typing.Any] = {}

    def reference(self) -> np.ndarray:
        return dressing.settle(self.avatar, avatars.a_pose(self.avatar.rig), self.cloth)

    def standing(self) -> np.ndarray:
        return dressing.settle(self.avatar, avatars.standing_pose(self.avatar.rig), self.cloth)

    def description(self) -> tuple[dict[str, typing.Any], dict[str, typing.Any]]:
        avatar = self.avatar
        arrays = {"rest": avatar.vertices, "weights": avatar.weights, "parts": avatar.parts}
        arrays |= {"heads": avatar.rig.heads, "tails": avatar.rig.tails}
        names = {"part_names": avatar.part_names, "joints": avatar.rig.names, "parents": avatar.rig.parents}
        return arrays, names

    def prepare(self) -> None:
        """Run the controller for all clips in one compiled batch."""
        rng = np.random.default_rng(self.spec.seed + 4)
        every = [(name, k) for name, scripts in self.scripts.items() for k in range(len(scripts))]
        facing = rng.integers(0, 4, len(every)) * (np.pi / 2)
        facing[[name == "truth" for name, _ in every]] = 0
        # The report's script begins from standing, as a rollout does.
        leads = [0 if name == "truth" else int(self.scripts[name][k][0]) for name, k in every]
        scripts = [self.scripts[name][k] for name, k in every]
        motions = sequences.simulate(self.avatar, scripts, facing, leads, self.spec.seed)
        self._motions = dict(zip(every, motions, strict=True))

    def skip(self, split: str, k: int) -> int:
        return len(self.scripts[split][k]) + sequences.LEAD_IN

    def take(self, split: str, k: int, atlas: posmap.Atlas, advance: Callable[[int], None]) -> tuple[Take, np.ndarray]:
        return sequences.take(self.avatar, atlas, self._motions[split, k], self.scripts[split][k], self.cloth, advance)


class _Recorded:
    """The sequences of recorded meshes; every fifth is held out, or the last fifth of a single one."""

    def __init__(self, meshes: MeshSequence):
        self.meshes = meshes
        self.faces, self.actions = meshes.faces, meshes.action_names
        plain = meshes.uvs is None or meshes.texture is None
        self.uvs = np.full((len(meshes.faces), 3, 2), 0.5, np.float32) if plain else meshes.uvs
        self.texture = _GREY if plain else meshes.texture
        runs = [np.flatnonzero(meshes.sequence == k) for k in np.unique(meshes.sequence)]
        if len(runs) == 1:
            end = max(4, len(runs[0]) * (_HELD_OUT - 1) // _HELD_OUT)
            runs = [runs[0][:end], runs[0][end:]]
        held = [k for k in range(len(runs)) if k % _HELD_OUT == _HELD_OUT - 1] or [len(runs) - 1]
        short = [k for k, run in enumerate(runs) if len(run) < 4]
        if short:
            raise ValueError(
                f"{meshes.source}: sequence {short[0]} has {len(runs[short[0]])} frames, a group of maps needs four"
            )
        self.frames = {
            "train": [run for k, run in enumerate(runs) if k not in held],
            "held_out": [runs[k] for k in held],
            "truth": [runs[held[0]]],
        }
        self.scripts = {name: [meshes.actions[run] for run in chosen] for name, chosen in self.frames.items()}
        self.work = sum(len(run) for chosen in self.frames.values() for run in chosen)

    def reference(self) -> np.ndarray:
        idle = np.flatnonzero(self.meshes.actions == 0)
        vertices = self.meshes.vertices[idle[0] if len(idle) else 0]
        middle = (vertices.min(0) + vertices.max(0)) / 2
        return (vertices - middle * np.array([1, 0, 1])).astype(np.float32)

    standing = reference

    def description(self) -> tuple[dict[str, typing.Any], dict[str, typing.Any]]:
        return {}, {"source": self.meshes.source}

    def prepare(self) -> None:
        pass

    def skip(self, split: str, k: int) -> int:
        return len(self.frames[split][k])

    def take(self, split: str, k: int, atlas: posmap.Atlas, advance: Callable[[int], None]) -> tuple[Take, np.ndarray]:
        run = self.frames[split][k]
        none = np.zeros((len(run), 0, 4), np.float32), np.zeros((len(run), 3), np.float32)
        found = sequences.encode(atlas, self.meshes.vertices[run], self.meshes.actions[run], *none)
        advance(len(run))
        return found


def describe(meshes: MeshSequence) -> str:
    """What a dataset's spec says of recorded meshes: where they are from, and a digest of what they are."""
    digest = hashlib.sha256()
    for array in (meshes.vertices, meshes.faces, meshes.actions, meshes.uvs, meshes.texture):
        digest.update(b"" if array is None else np.ascontiguousarray(array).tobytes())
    return f"{Path(meshes.source).name} {digest.hexdigest()[:12]}"


def build(folder: Path, spec: DatasetSpec, meshes: MeshSequence | None = None, *, progress: bool = True) -> None:
    """Make the dataset in `folder` from our simulated avatar or, where they are given, from recorded `meshes`.

    Takes minutes at paper scale and shows how long is left. Goes on where an earlier build with the same spec was
    interrupted; anything else in the folder is replaced. Raises ValueError where spec and meshes do not belong
    together, or a sequence is too short.
    """
    if spec.source != ("" if meshes is None else describe(meshes)):
        raise ValueError(f"the spec is of source {spec.source!r}, not of these meshes: use building.describe(meshes)")
    folder = Path(folder)
    _begin(folder, spec)
    maker = _Maker(folder, spec, _Simulated(spec) if meshes is None else _Recorded(meshes), progress)
    source, plans = maker.source, maker.plans
    with tqdm(total=source.work, desc="clips", unit="frame", disable=not progress) as bar:
        lock = threading.Lock()

        def advance(frames: int) -> None:
            with lock:
                bar.update(frames)

        source.prepare()
        with concurrent.futures.ThreadPoolExecutor(_WORKERS) as pool:
            every = [(name, k) for name, plan in plans.items() for k in range(len(plan.scripts))]
            jobs = [pool.submit(maker.clip, name, k, advance) for name, k in every]
            try:
                for job in concurrent.futures.as_completed(jobs):
                    job.result()
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
    for name, plan in plans.items():
        if plan.poses:
            index = {"sequence": [p[0] for p in plan.poses], "frame": [p[1] for p in plan.poses], "view": plan.views}
            weights.save_tree(dataset.table_path(folder, name), {k: np.asarray(v, np.int32) for k, v in index.items()})
    note = folder / _NOTE
    files = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file() and p != note)
    clips = {name: [len(script) for script in plan.scripts] for name, plan in plans.items()}
    content = {"spec": dataclasses.asdict(spec), "actions": source.actions, "clips": clips}
    manifest.write(folder, dataset.VERSION, files, **content)
    note.unlink()


def unfinished(folder: Path, spec: DatasetSpec) -> bool:
    """Whether a build of this spec was interrupted in `folder`, and `build` would go on with it."""
    note = folder / _NOTE
    same = note.is_file() and note.read_text(encoding="utf-8") == _wanted(spec)
    return same and not (folder / manifest.NAME).exists()


def _wanted(spec: DatasetSpec) -> str:
    return json.dumps({"version": dataset.VERSION, "spec": dataclasses.asdict(spec)})


def _begin(folder: Path, spec: DatasetSpec) -> None:
    """Leave in the folder only what an interrupted build of the same spec has finished."""
    folder.mkdir(parents=True, exist_ok=True)
    if not unfinished(folder, spec):
        for name in (manifest.NAME, _NOTE, "avatar.safetensors", "texture.png"):
            (folder / name).unlink(missing_ok=True)
        for name in ("clips", "images"):
            shutil.rmtree(folder / name, ignore_errors=True)
        for path in folder.glob("*.safetensors"):
            path.unlink()
        atomic.write_text(folder / _NOTE, _wanted(spec))
    for path in folder.rglob(".*"):
        path.unlink()  # what a killed process was writing


class _Maker:
    """Writes clips and pictures of one figure; poses are pictured in the box of their upscaled points, where the
    appearance network works."""

    def __init__(self, folder: Path, spec: DatasetSpec, source: _Simulated | _Recorded, progress: bool):
        self.folder, self.spec, self.source = folder, spec, source
        self.plans = self._plans()
        path = folder / "avatar.safetensors"
        finished = path.is_file()
        if finished:
            self.atlas = dataset.atlas_of(weights.load_arrays(path)[0], spec.size)
        else:
            self.atlas = posmap.build_atlas(source.reference(), source.faces, spec.size)
        self.renderer = MeshRenderer(source.faces, source.uvs, source.texture)
        self.cameras = dataset.cylinder_cameras(spec.image_size)
        self.cardinal_cameras = dataset.cardinal_cameras(spec.image_size)
        upscaler = posmap.build_upscaler(self.atlas, spec.upscaled)
        self.box = jax.jit(lambda texels: posmap.bounding_box(posmap.upscale(upscaler, texels)))
        if not finished:
            self._describe(path, progress)

    def _plans(self) -> dict[str, _Plan]:
        rng = np.random.default_rng(self.spec.seed + 3)
        wanted = {"train": self.spec.image_poses, "held_out": max(8, self.spec.image_poses // 6), "truth": 0}
        plans = {}
        for name, scripts in self.source.scripts.items():
            frame = [(k, f) for k, script in enumerate(scripts) for f in range(len(script))]
            chosen = np.sort(rng.choice(len(frame), min(wanted[name], len(frame)), replace=False))
            views = np.array([rng.permutation(dataset.VIEWS)[: self.spec.image_views] for _ in chosen], np.int32)
            plans[name] = _Plan(scripts, [frame[k] for k in chosen], views)
        return plans

    def _describe(self, path: Path, progress: bool) -> None:
        standing = self.source.standing()
        texels = posmap.encode(self.atlas, jnp.asarray(standing))
        root = posmap.root(self.atlas, texels)
        views = tqdm(range(self.spec.standing_views), desc="standing pose", unit="view", disable=not progress)
        self.picture("standing", 0, np.asarray(texels - root[None]), standing - np.asarray(root), views)
        exr.write_png(self.folder / "texture.png", self.source.texture)
        arrays, names = self.source.description()
        arrays |= {"faces": self.source.faces, "uvs": self.source.uvs, "standing": texels}
        arrays |= {f"atlas/{f.name}": getattr(self.atlas, f.name) for f in dataset.atlas_fields()}
        weights.save_tree(path, arrays, **names)

    def clip(self, split: str, k: int, advance: Callable[[int], None]) -> None:
        """Make sequence k of a split, picture its chosen poses, write it; nothing where that was done before."""
        path = dataset.clip_path(self.folder, split, k)
        if path.is_file():
            advance(self.source.skip(split, k))
            return
        take, vertices = self.source.take(split, k, self.atlas, advance)
        plan = self.plans[split]
        for pose, (sequence, frame) in enumerate(plan.poses):
            if sequence == k:
                self.picture(split, pose, take.texels[frame], vertices[frame], plan.views[pose])
        if split == "truth":
            for frame in range(min(dataset.TRUTH_FRAMES, len(vertices))):
                standing = vertices[frame] + np.array([0, take.roots[frame, 1], 0], np.float32)
                views = range(dataset.CARDINAL_VIEWS)
                self.draw(split, frame, self.renderer.pose(standing), self.cardinal_cameras, views)
        arrays = {f.name: getattr(take, f.name) for f in dataclasses.fields(Take)}
        if self.spec.vertices != "none":
            arrays["vertices"] = vertices.astype(self.spec.vertices)
        weights.save_tree(path, arrays)

    def picture(self, name: str, pose: int, texels: np.ndarray, vertices: np.ndarray, views: typing.Any) -> None:
        """Write the views of a pose whose `vertices` (v, 3) lie in the frame of its `texels` (t, 3)."""
        box = self.box(jnp.asarray(texels))
        posed = self.renderer.pose((vertices - np.asarray(box.centre)) / np.asarray(box.side))
        self.draw(name, pose, posed, self.cameras, views)

    def draw(self, name: str, pose: int, posed: PosedMesh, cameras: Camera, views: typing.Any) -> None:
        """Write what the cameras of these numbers see."""
        for view in views:
            camera = jax.tree.map(lambda x, v=int(view): x[v], cameras)
            exr.write_png(dataset.image_path(self.folder, name, pose, int(view)), posed.render(camera))
