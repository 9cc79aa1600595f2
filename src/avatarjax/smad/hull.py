"""Gaussians from the visual hull: what all silhouettes of a turning person allow, coloured by what was seen of it.

A stand-in for the deformable radiance field of SMAD's baselines (section 3) that takes a second instead of hours: the
hull (Laurentini 1994, "The visual hull concept") of the masks in the body frame, in which the turning person is seen
from all around. It is as good as the person holds still in that frame: limbs and cloth move, so that a voxel only has
to lie inside most silhouettes, and hollows that no silhouette shows are filled.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterable

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8
from scipy import ndimage
from scipy.spatial import cKDTree

from avatarjax import cameras as pinhole
from avatarjax.cameras import Camera
from avatarjax.data.recording import MonocularVideo
from avatarjax.gaussians import Gaussians
from avatarjax.smad import views, voxels
from avatarjax.smad.voxels import Grid

# Normals come from occupancy that is blurred by so many voxels: less shows the steps, more rounds limbs away.
_BLUR = 1.5
# A voxel is hidden where another lies in front of it by more than so many edges; surfaces slant and are steps.
_HIDDEN = 3.0
# Views along the normal count most: pixels at the rim of a silhouette mix with the background.
_FACING = 2


@dataclasses.dataclass(frozen=True)
class HullConfig:
    """box: where the body may be, metres in its frame, about the root; the grid then shrinks to what is there.
    resolution: voxels along its longest side. fraction: of the frames that see a voxel, those in whose silhouette it
    must lie; the default is for a person who turns and else stands still; a dancer's legs need 0.7 and are blurred.
    frames: at most so many are used, spread evenly. gaussians: about so many come out, of this opacity."""

    box: tuple[tuple[float, float, float], tuple[float, float, float]] = ((-1.0, -1.3, -1.0), (1.0, 1.3, 1.0))
    resolution: int = 96
    fraction: float = 0.95
    frames: int = 120
    gaussians: int = 5000
    opacity: float = 0.8

    def __post_init__(self):
        if not 0 < self.fraction <= 1 or not 0 < self.opacity < 1:
            raise ValueError(f"fraction {self.fraction} must lie in (0, 1], opacity {self.opacity} in (0, 1)")
        for name in ("resolution", "frames", "gaussians"):
            if getattr(self, name) < 4:
                raise ValueError(f"{name} is {getattr(self, name)}: at least 4 are needed")


@typing.no_type_check
@flax.struct.dataclass
class Hull:
    """Which voxels (x, y, z) of a grid in the body frame the silhouettes allow."""

    grid: Grid
    occupied: Bool[Array, "x y z"]


def initialise(video: MonocularVideo, config: HullConfig = HullConfig()) -> Gaussians:
    """Canonical Gaussians (SMAD's G^c, Fig. 2) of the person in a video, in the body frame.

    Raises ValueError where masks are empty or do not fit the camera, and where no voxel lies in enough silhouettes.
    """
    chosen = views.spread(len(video), config.frames)
    hull = carve(video.masks[chosen], views.of_video(video, chosen), config)
    points, normals = shell(hull)
    colors = paint_from(video, chosen, points, normals, float(hull.grid.edge))
    return voxels.to_gaussians(points, colors, config.gaussians, config.opacity)


def carve(masks: Bool[np.ndarray, "f h w"], cameras: Camera, config: HullConfig = HullConfig()) -> Hull:
    """The hull of silhouettes (f, h, w) that were seen by cameras (f,) of the body frame.

    A coarse grid over the whole box finds where the body is, a fine one over that holds the hull.
    """
    if not len(masks) or masks.shape != (len(cameras.world_to_camera), cameras.height, cameras.width):
        size = f"({len(cameras.world_to_camera)}, {cameras.height}, {cameras.width})"
        raise ValueError(f"masks have shape {masks.shape}, the cameras' pictures {size}: give one mask for each frame")
    if not masks.any():
        raise ValueError(f"all {len(masks)} masks are empty: foreground must be True")
    pictures = jnp.asarray(masks)
    coarse = voxels.fill(*config.box, max(16, config.resolution // 2))
    taken = np.argwhere(_allowed(pictures, cameras, coarse, config))
    edge, corner = float(coarse.edge), np.asarray(coarse.low)
    # One voxel more on either side: thin parts reach beyond the middles of coarse voxels.
    fine = voxels.fill(corner + (taken.min(0) - 1) * edge, corner + (taken.max(0) + 2) * edge, config.resolution)
    return Hull(fine, jnp.asarray(_allowed(pictures, cameras, fine, config)))


@jax.jit
def counts(
    masks: Bool[Array, "f h w"], cameras: Camera, points: Float[Array, "n 3"]
) -> tuple[Int[Array, " n"], Int[Array, " n"]]:
    """In how many silhouettes each point lies, and how many frames see it at all."""

    def add(totals, frame):
        mask, camera = frame
        row, column, seen, _ = _pixels(camera, points)
        return (totals[0] + (seen & mask[row, column]), totals[1] + seen), None

    zeros = jnp.zeros(len(points), jnp.int32)
    return jax.lax.scan(add, (zeros, zeros), (masks, cameras))[0]


def shell(hull: Hull) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """The middles of the voxels at the hull's surface, metres, and unit normals that point out of it."""
    occupied = np.asarray(hull.occupied)
    at = voxels.surface(occupied)
    blurred = ndimage.gaussian_filter(occupied.astype(np.float32), _BLUR, mode="constant")
    slopes = np.gradient(np.pad(blurred, 1))
    normals = -np.stack([slope[1:-1, 1:-1, 1:-1][at] for slope in slopes], axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    return np.asarray(hull.grid.centres)[at.reshape(-1)], normals


def paint(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    edge: float,
    pictures: Iterable[UInt8[np.ndarray, "h w 3"]],
    masks: Bool[np.ndarray, "f h w"],
    cameras: Camera,
) -> Float[np.ndarray, "n 3"]:
    """Colours (n, 3) in [0, 1] of points of a surface: the mean of what frames show of them, weighed by how they face.

    `edge` is the distance of the points to their neighbours. A point counts in a frame where it faces the camera,
    nothing lies in front of it and the mask has it; one that no frame shows takes the colour of the nearest that was
    seen. Pictures (h, w, 3) uint8 come one for each mask and camera. Raises ValueError where no point was ever seen.
    """
    sums, weights = jnp.zeros((len(points), 3)), jnp.zeros(len(points))
    surface = jnp.asarray(points, jnp.float32), jnp.asarray(normals, jnp.float32), jnp.asarray(edge, jnp.float32)
    for k, picture in enumerate(pictures):
        camera = jax.tree.map(lambda x, k=k: x[k], cameras)
        sums, weights = _add_picture(sums, weights, *surface, jnp.asarray(picture), jnp.asarray(masks[k]), camera)
    total, seen = np.asarray(weights), np.asarray(weights) > 0
    if not seen.any():
        raise ValueError("no frame shows any of the surface: check that poses and cameras are of one world")
    colors = np.asarray(sums) / np.where(seen, total, 1)[:, None]
    _, nearest = cKDTree(points[seen]).query(points)
    return colors[seen][nearest]


def paint_from(
    video: MonocularVideo,
    frames: Int[np.ndarray, " k"],
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    edge: float,
) -> Float[np.ndarray, "n 3"]:
    """`paint` with some frames of a video, by their rising numbers (k,); points lie in the body frame."""
    wanted = set(frames.tolist())
    pictures = (frame for k, frame in enumerate(video.frames()) if k in wanted)
    return paint(points, normals, edge, pictures, video.masks[frames], views.of_video(video, frames))


def _allowed(masks: Bool[Array, "f h w"], cameras: Camera, grid: Grid, config: HullConfig) -> Bool[np.ndarray, "x y z"]:
    inside, seen = counts(masks, cameras, grid.centres)
    # What the picture cuts off in most frames is not known to be empty or full: it is left out.
    kept = (inside >= config.fraction * seen) & (2 * seen >= len(masks))
    if not kept.any():
        raise ValueError(
            f"no voxel of the box {config.box} lies in {config.fraction:.0%} of the silhouettes: check that poses and "
            "cameras are of one world, or lower the fraction"
        )
    return np.asarray(kept).reshape(grid.shape)


@jax.jit
def _add_picture(
    sums: Float[Array, "n 3"],
    weights: Float[Array, " n"],
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    edge: Float[Array, ""],
    picture: UInt8[Array, "h w 3"],
    mask: Bool[Array, "h w"],
    camera: Camera,
) -> tuple[Float[Array, "n 3"], Float[Array, " n"]]:
    row, column, visible = visible_at(points, edge, mask, camera)
    towards = camera.position[None] - points
    cosine = jnp.sum(normals * towards, -1) / jnp.maximum(jnp.linalg.norm(towards, axis=-1), 1e-6)
    weight = jnp.where(visible, jnp.maximum(cosine, 0.0) ** _FACING, 0.0)
    return sums + weight[:, None] * picture[row, column].astype(jnp.float32) / 255, weights + weight


def visible_at(
    points: Float[Array, "n 3"], edge: Float[Array, ""], mask: Bool[Array, "h w"], camera: Camera
) -> tuple[Int[Array, " n"], Int[Array, " n"], Bool[Array, " n"]]:
    """Row and column of the pixel of each point, and whether that shows it: the mask has it and no other point lies in
    front of it. `edge` is the distance of the points to their neighbours."""
    row, column, seen, depth = _pixels(camera, points)
    # A depth buffer with cells as wide as the points lie apart, so that a surface in front leaves no gaps.
    focal = camera.intrinsics[0, 0]
    cell = jnp.maximum(1.0, 1.5 * focal * edge / jnp.median(jnp.maximum(depth, edge)))
    place = (row / cell).astype(jnp.int32), (column / cell).astype(jnp.int32)
    front = jnp.full(mask.shape, jnp.inf).at[place].min(jnp.where(seen, depth, jnp.inf))
    return row, column, seen & mask[row, column] & (depth < front[place] + _HIDDEN * edge)


def _pixels(
    camera: Camera, points: Float[Array, "n 3"]
) -> tuple[Int[Array, " n"], Int[Array, " n"], Bool[Array, " n"], Float[Array, " n"]]:
    """Row and column of the pixel of each point, whether it is in the picture (else they are 0), and its depth."""
    place, depth = pinhole.project(camera, points)
    u, v = place[:, 0], place[:, 1]
    seen = (depth > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    row, column = (jnp.where(seen, x, 0).astype(jnp.int32) for x in (v, u))
    return row, column, seen, depth
