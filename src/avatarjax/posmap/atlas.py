"""The six-view atlas: which point of the surface each texel of a position map stands for.

A mesh sequence has one topology, so its position maps need one ray cast: every texel keeps the triangle and the
barycentric coordinates that it saw on the A-pose, and a posed frame is a gather from then on. The layout is that of the
public UNICA data (see `windows`), so that their files load unchanged.
"""

from __future__ import annotations

import dataclasses
import typing

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int


@dataclasses.dataclass(frozen=True)
class Window:
    """Where one orthographic view lies in the map, and how it looks at the A-pose.

    `right` and `down` are the world axes (axis, sign) along a texel's column and row before the window is turned;
    `turned` windows are stored rotated by 90 degrees clockwise.
    """

    name: str
    row: int
    col: int
    height: int
    width: int
    right: tuple[int, int]
    down: tuple[int, int]
    turned: bool = False


def windows(size: int) -> tuple[Window, ...]:
    """The six windows of a map of side `size`, a multiple of 32, in proportion to the public layout at 128.

    Raises ValueError for another size.
    """
    if size < 32 or size % 32:
        raise ValueError(f"a position map's side must be a multiple of 32, got {size}")
    u = size // 32
    return (
        Window("back", 0, 0, 24 * u, 12 * u, (0, -1), (1, -1)),
        Window("front", 0, 12 * u, 24 * u, 12 * u, (0, 1), (1, -1)),
        Window("right", 0, 24 * u, 24 * u, 8 * u, (2, 1), (1, -1)),
        Window("left", 24 * u, 0, 8 * u, 24 * u, (2, -1), (1, -1), turned=True),
        Window("below", 24 * u, 24 * u, 4 * u, 8 * u, (0, 1), (2, -1)),
        Window("above", 28 * u, 24 * u, 4 * u, 8 * u, (0, 1), (2, 1)),
    )


@typing.no_type_check
@flax.struct.dataclass
class Atlas:
    """The surface points of one avatar's position maps; t foreground texels in row-major order.

    corners (t, 3) vertex ids of the triangle seen by each texel and barycentric (t, 3) where in it; rows, cols (t,) the
    texel; waist (t,) non-negative weights with sum 1 whose weighted mean is the root (UNICA 3.3: the centre of the
    waist); reference (t, 3) the A-pose positions in metres; scale () brings the longest A-pose axis to 0.7; size is the
    side of the map.
    """

    corners: Int[Array, "t 3"]
    barycentric: Float[Array, "t 3"]
    rows: Int[Array, "t"]
    cols: Int[Array, "t"]
    waist: Float[Array, "t"]
    reference: Float[Array, "t 3"]
    scale: Float[Array, ""]
    size: int = flax.struct.field(pytree_node=False)

    @property
    def mask(self) -> Bool[Array, "size size"]:
        """Foreground of every frame's map."""
        return jnp.zeros((self.size, self.size), bool).at[self.rows, self.cols].set(True)


LONGEST_AXIS = 0.7  # UNICA 3.3: of the A-pose in normalised units
WAIST_BAND = (0.55, 0.61)  # of the A-pose height, where a standing figure's waist lies


def build_atlas(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    size: int,
    *,
    waist: Bool[np.ndarray, "v"] | None = None,
) -> Atlas:
    """Cast one ray per texel at the A-pose mesh and keep what it hits.

    `vertices` (v, 3) metres, y up, facing +z; `faces` (f, 3). `waist` (v,) marks the vertices whose mean is the root;
    without it, a band of the height near the axis of the body is taken. All views have one scale, chosen so that the
    front view fits its window; views from above and below are cropped about their centre, as in the public data.
    Raises ValueError for an empty or non-finite mesh or a figure of which no waist is visible.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    if not len(faces) or not np.isfinite(vertices).all():
        raise ValueError(f"the A-pose mesh has {len(faces)} faces and must have only finite vertices")
    low, high = vertices.min(0), vertices.max(0)
    extent = high - low
    window_rows, window_cols, side_cols = 24 * size // 32, 12 * size // 32, 8 * size // 32
    texel = 1.001 * max(extent[1] / window_rows, extent[0] / window_cols, extent[2] / side_cols)

    hit = np.full((size, size), -1)
    where = np.zeros((size, size, 3))
    for window in windows(size):
        face, point = _cast(vertices, faces, window, (low + high) / 2, texel)
        block = np.s_[window.row : window.row + window.height, window.col : window.col + window.width]
        hit[block], where[block] = face, point

    rows, cols = np.nonzero(hit >= 0)
    corners = faces[hit[rows, cols]]
    barycentric = _barycentric(vertices[corners], where[rows, cols])
    reference = np.einsum("tk,tkc->tc", barycentric, vertices[corners])
    weights = _waist_weights(reference, low, high) if waist is None else waist[corners].mean(1).astype(np.float64)
    if weights.sum() <= 0:
        raise ValueError(f"no texel of the {size}x{size} atlas shows the waist: mark other vertices as `waist`")
    return Atlas(
        corners=jnp.asarray(corners, jnp.int32),
        barycentric=jnp.asarray(barycentric, jnp.float32),
        rows=jnp.asarray(rows, jnp.int32),
        cols=jnp.asarray(cols, jnp.int32),
        waist=jnp.asarray(weights / weights.sum(), jnp.float32),
        reference=jnp.asarray(reference, jnp.float32),
        scale=jnp.asarray(LONGEST_AXIS / extent.max(), jnp.float32),
        size=size,
    )


def _cast(vertices, faces, window: Window, centre, texel: float):
    """First hits of one view's parallel rays: face (h, w), -1 for none, and point (h, w, 3), in the stored turn."""
    import trimesh

    height, width = (window.width, window.height) if window.turned else (window.height, window.width)
    right, down = np.zeros(3), np.zeros(3)
    right[window.right[0]], down[window.down[0]] = window.right[1], window.down[1]
    forward = np.cross(right, down)
    i, j = np.mgrid[:height, :width]
    offset = ((j + 0.5 - width / 2) * texel)[..., None] * right + ((i + 0.5 - height / 2) * texel)[..., None] * down
    origins = (centre + offset - 10 * np.ptp(vertices, axis=0).max() * forward).reshape(-1, 3)
    directions = np.broadcast_to(forward, origins.shape)

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    face = mesh.ray.intersects_first(origins, directions)
    triangle = vertices[faces[face]]
    normal = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
    slope = np.einsum("nc,nc->n", normal, directions)
    distance = np.einsum("nc,nc->n", normal, triangle[:, 0] - origins) / np.where(slope == 0, 1, slope)
    point = origins + distance[:, None] * directions
    face, point = face.reshape(height, width), point.reshape(height, width, 3)
    return (np.rot90(face, -1), np.rot90(point, -1)) if window.turned else (face, point)


def _barycentric(triangles, points):
    """Barycentric coordinates (t, 3) of points (t, 3) in triangles (t, 3, 3), clipped into the triangle."""
    import trimesh

    coordinates = np.clip(trimesh.triangles.points_to_barycentric(triangles, points), 0, 1)
    return coordinates / coordinates.sum(1, keepdims=True)


def _waist_weights(reference, low, high):
    height = (reference[:, 1] - low[1]) / (high[1] - low[1])
    near_axis = np.abs(reference[:, 0] - (low[0] + high[0]) / 2) < 0.12 * (high[1] - low[1])
    return ((height > WAIST_BAND[0]) & (height < WAIST_BAND[1]) & near_axis).astype(np.float64)
