"""Gaussians on the surface of a body template without clothes: how earlier avatars from one video begin, and what SMAD
sets its own initialisation against (SMAD 1 and 5, Figs. 1c and 6 right).

The template is the shipped body in the shape that its skeleton says, posed by its own skinning. What is worn beyond it,
a skirt or a hat, has no Gaussians of its own at the start: the body shows its colours.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from avatarjax.data import body as bodies
from avatarjax.data import skinning
from avatarjax.data.recording import MonocularVideo
from avatarjax.data.wardrobe.skin import body_piece
from avatarjax.gaussians import Gaussians
from avatarjax.smad import driving, hull, skeletal, views, voxels

# Points drawn at random lie unevenly: what is behind a surface does not show through gaps of so many mean distances.
_GAP = 2.0


@dataclasses.dataclass(frozen=True)
class TemplateConfig:
    """points: on the surface, for their colours to be averaged over. frames: at most so many are used for these, spread
    evenly. gaussians: about so many come out, of this opacity."""

    points: int = 40_000
    frames: int = 120
    gaussians: int = 5000
    opacity: float = 0.8

    def __post_init__(self):
        if not 0 < self.opacity < 1:
            raise ValueError(f"opacity {self.opacity} must lie in (0, 1)")
        for name in ("points", "frames", "gaussians"):
            if getattr(self, name) < 4:
                raise ValueError(f"{name} is {getattr(self, name)}: at least 4 are needed")


def initialise(video: MonocularVideo, config: TemplateConfig = TemplateConfig()) -> Gaussians:
    """Canonical Gaussians of the body under the clothes of the person in a video, in the body frame of its first frame.

    They have the colours of what lies before them in the pictures. Raises ValueError as `posed` does, and where no
    frame shows any of the body.
    """
    vertices, faces = posed(video)
    points, normals = sample(vertices, faces, config.points)
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1).sum() / 2
    edge = _GAP * float(np.sqrt(area / config.points))
    colors = hull.paint_from(video, views.spread(len(video), config.frames), points, normals, edge)
    return voxels.to_gaussians(points, colors, config.gaussians, config.opacity)


def posed(video: MonocularVideo) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """The naked body of the person in a video as vertices (v, 3), metres, and triangles (f, 3), in the body frame of
    the first frame: of all its shapes the one whose joints lie nearest to the recorded ones.

    Raises ValueError for poses that do not say where joints are or whose joints are not those of the body's skeleton.
    """
    body, poses = bodies.load_body(), video.poses
    joints = skeletal.rig_of(poses)
    if joints.names != body.names:
        raise ValueError(
            f"joints {', '.join(joints.names)} are not those of the body, {', '.join(body.names)}: a template needs "
            "poses of the shipped skeleton"
        )
    vertices, rig = bodies.shape(body, bodies.fit(body, np.asarray(joints.heads)))
    bare = body_piece(body, vertices, ("body",), "body")
    first = jax.tree.map(lambda x: x[0], driving.recorded(poses))
    basis = skinning.skinning_basis(jnp.asarray(bare.vertices), jnp.asarray(bare.weights))
    return np.asarray(skinning.skin(basis, jax.jit(skeletal.bones)(rig, first))), bare.faces


def sample(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], count: int
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """`count` points (n, 3) of the surface of a mesh, as many for each area, and unit normals that point out of it; the
    same every time."""
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    found = trimesh.sample.sample_surface(mesh, count, seed=0)
    return np.asarray(found[0], np.float64), np.asarray(mesh.face_normals[found[1]], np.float64)
