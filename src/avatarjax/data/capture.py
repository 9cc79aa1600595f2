"""Filming an avatar: what a single camera sees of a motion, with masks, cameras and poses, as SMAD takes it."""

from __future__ import annotations

import collections
import dataclasses
import itertools
import json
import os
import shutil
import typing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8
from scipy import ndimage

from avatarjax import cameras, rotations
from avatarjax.cameras import Camera
from avatarjax.data import dressing
from avatarjax.data.body import Rig
from avatarjax.data.importers.monocular import Poses, write_monocular
from avatarjax.data.mesh_renderer import MeshRenderer, PosedMesh
from avatarjax.data.motion.locomotion import Motion
from avatarjax.data.wardrobe.assembly import AvatarMesh
from avatarjax.io import weights
from avatarjax.physics.xpbd import XPBDConfig

MESHES = "meshes.safetensors"
# Frames over which the operator smooths the path that the camera follows.
_STEADINESS = 10.0
_WALL = 237  # its brightness
# So many chunks of frames may be simulated and not yet drawn.
_AHEAD = 16


class Take(typing.NamedTuple):
    """A take to film: the folder it goes to, and what makes the motion, called when its turn comes."""

    folder: str | os.PathLike
    motion: Callable[[], Motion]


def following_camera(roots: Float[np.ndarray, "f 3"], size: int, azimuth: float = 0.0) -> Camera:
    """A camera (f,) that moves along with the smoothed path (f, 3) of a figure of up to two metres: in front of it, or
    so many radians further round, towards +x."""
    smooth = ndimage.gaussian_filter1d(np.asarray(roots, np.float64), _STEADINESS, axis=0, mode="nearest")
    camera = cameras.orbit(
        np.full(1, azimuth), target=(0, 0.95, 0), distance=4.6, heights=0.4, width=size, height=size, fov_y=0.5
    )
    moved = np.tile(np.eye(4), (len(smooth), 1, 1))
    moved[:, 0, 3], moved[:, 2, 3] = -smooth[:, 0], -smooth[:, 2]
    world_to_camera = np.asarray(camera.world_to_camera)[0] @ moved
    intrinsics = np.broadcast_to(np.asarray(camera.intrinsics)[0], (len(smooth), 3, 3))
    return camera.replace(
        world_to_camera=jnp.asarray(world_to_camera, jnp.float32), intrinsics=jnp.asarray(intrinsics, jnp.float32)
    )


def poses_of(rig: Rig, motion: Motion) -> Poses:
    """A motion as it is recorded: the root's rotation apart from those of the joints."""
    quats = np.array(motion.local_quats, np.float32)
    root_rotation = np.asarray(rotations.to_matrix(jnp.asarray(quats[:, 0])))
    quats[:, 0] = [1, 0, 0, 0]
    return Poses(
        np.asarray(rotations.to_matrix(jnp.asarray(quats))),
        root_rotation,
        np.asarray(motion.hips, np.float32),
        rig.names,
        rig.parents,
        np.asarray(rig.heads, np.float32),
    )


def missing(takes: Sequence[Take], *, size: int = 512, config: XPBDConfig = XPBDConfig()) -> list[Take]:
    """The takes whose folders hold no film of these settings."""

    def there(take: Take) -> bool:
        path = Path(take.folder) / MESHES
        return path.is_file() and weights.load_arrays(path, names=())[1].get("film") == _settings(size, config)

    return [take for take in takes if not there(take)]


def film(
    takes: Sequence[Take],
    avatar: AvatarMesh,
    *,
    size: int = 512,
    config: XPBDConfig = XPBDConfig(),
    progress: Callable[[int], object] | None = None,
) -> None:
    """Simulate motions, film them and write a monocular folder of each.

    Beside what `load_monocular` reads, `meshes.safetensors` holds the true vertices relative to the root translation
    as float16, faces and uvs. An older folder is replaced when its take is done. While frames are drawn the next are
    simulated, and the motions of later takes made, as no one of these keeps two cores busy. `progress` is called with
    numbers of frames that were simulated or drawn.
    """
    count = progress or (lambda _: None)
    with ThreadPoolExecutor(1) as moving:
        motions = [moving.submit(take.motion) for take in takes]

        def simulated() -> Iterator[tuple[int, Float[np.ndarray, "c v 3"]]]:
            for k, motion in enumerate(motions):
                for chunk in dressing.chunks(avatar, motion.result().transforms, config):
                    count(len(chunk))
                    yield k, chunk

        for k, chunks in itertools.groupby(_ahead(simulated()), lambda made: made[0]):
            frames = (frame for _, chunk in chunks for frame in chunk)
            _shoot(Path(takes[k].folder), avatar, motions[k].result(), frames, size, _settings(size, config), count)


def _settings(size: int, config: XPBDConfig) -> str:
    """What tells films of one take apart."""
    return json.dumps({"size": size, "edges": "mattes", **dataclasses.asdict(config)})


def _ahead(items: Iterator[typing.Any]) -> Iterator[typing.Any]:
    """The items, of which so many are made in a thread while one is used."""
    with ThreadPoolExecutor(1) as thread:
        coming = collections.deque(thread.submit(next, items, None) for _ in range(_AHEAD))
        try:
            while (item := coming.popleft().result()) is not None:
                coming.append(thread.submit(next, items, None))
                yield item
        finally:
            for one in coming:
                one.cancel()


def _shoot(
    folder: Path,
    avatar: AvatarMesh,
    motion: Motion,
    frames: Iterator[Float[np.ndarray, "v 3"]],
    size: int,
    settings: str,
    progress: Callable[[int], object],
) -> None:
    """Draw and write a take, whose frames are simulated as they are asked for."""
    camera = following_camera(np.asarray(motion.roots), size)
    renderer = MeshRenderer(avatar.faces, avatar.uvs, avatar.texture)
    hips = np.asarray(motion.hips)
    shots, relative = [], []
    for k, frame in enumerate(frames):
        shots.append(photograph(renderer.pose(frame), jax.tree.map(lambda x, k=k: x[k], camera)))
        relative.append((frame - hips[k]).astype(np.float16))
        progress(1)
    new = folder.with_name(f".{folder.name}.new")
    shutil.rmtree(new, ignore_errors=True)
    images, mattes = zip(*shots, strict=True)
    write_monocular(new, list(images), list(mattes), camera, poses_of(avatar.rig, motion))
    tree = {"vertices": np.stack(relative), "faces": avatar.faces, "uvs": avatar.uvs}
    weights.save_tree(new / MESHES, tree, film=settings)
    shutil.rmtree(folder, ignore_errors=True)
    new.rename(folder)


def photograph(mesh: PosedMesh, camera: Camera) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """A picture of the mesh cut out before a plain wall, and its matte: how much of each pixel it covers, 0 to 255.
    Where it covers some the picture has its colour alone, so that no light of the wall counts as its own."""
    rgba = mesh.render(camera)
    return np.where(rgba[..., 3:] > 0, rgba[..., :3], np.uint8(_WALL)), rgba[..., 3]
