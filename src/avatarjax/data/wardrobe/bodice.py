"""The close-fitting upper part of a robe or dress, cut from the skin: where it ends, and how it stands off the body."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float
from scipy import sparse
from scipy.sparse import linalg

from avatarjax.data.body import Body, Rig
from avatarjax.data.wardrobe import assembly, visibility
from avatarjax.data.wardrobe.garments import Piece, smoothstep

_SKIN = ("body", "helper-l-eye", "helper-r-eye")


@dataclasses.dataclass(frozen=True, eq=False)
class Bodice:
    """A bodice from the neck to height `waist`, with sleeves `sleeve` metres long from the shoulder joint.

    shoulder (3,) the left shoulder joint and arm (3,) the direction of the left upper arm; neck the height of the neck
    joint; dip how far the neckline is below it in front. Metres in the rest pose; left and right are alike.
    """

    shoulder: Float[np.ndarray, "3"]
    arm: Float[np.ndarray, "3"]
    neck: float
    waist: float
    sleeve: float
    dip: float = 0.03

    def along(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Metres from the shoulder joint along the upper arm, on the arm; minus one elsewhere."""
        x = np.abs(p[:, 0])
        along = (np.stack([x, p[:, 1], p[:, 2]], axis=1) - self.shoulder) @ self.arm
        return np.where(x > self.shoulder[0] - 0.01 + 0.35 * np.clip(self.shoulder[1] - p[:, 1], 0, None), along, -1.0)

    def taper(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """1 on the trunk, 0 where the sleeves end: how thick cloth is that goes on as a separate sleeve."""
        return smoothstep(self.along(p), self.sleeve, self.sleeve - 0.09)

    def collar(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Metres above the neckline, which is lower in front than behind and runs over the shoulders."""
        level = self.neck - 0.008 - self.dip * smoothstep(p[:, 2], -0.02, 0.07)
        return p[:, 1] - level - 0.8 * np.clip(np.abs(p[:, 0]) - 0.055, 0, None)

    def covered(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """1 where the bodice is, 0 on bare skin."""
        along = self.along(p)
        inside = smoothstep(self.collar(p), 0.003, -0.003) * smoothstep(along, self.sleeve + 0.005, self.sleeve - 0.005)
        return inside * np.where(along > -0.5, 1.0, smoothstep(p[:, 1], self.waist - 0.06, self.waist - 0.05))


def fit(rig: Rig, *, waist: float, sleeve: float, dip: float = 0.03) -> Bodice:
    """The bodice for a skeleton; lengths in metres."""
    joint = rig.heads.astype(np.float64)
    shoulder, elbow = joint[rig.index("LeftArm")], joint[rig.index("LeftForeArm")]
    arm = (elbow - shoulder) / np.linalg.norm(elbow - shoulder)
    return Bodice(shoulder, arm, float(joint[rig.index("Neck"), 1]), waist, sleeve, dip)


def visible_skin(body: Body, bare: Float[np.ndarray, "v 3"]) -> Piece:
    """The skin of the shaped body (v, 3) without what nobody can see."""
    whole = assembly.body_piece(body, bare, _SKIN, "body")
    shown = visibility.seen(whole.vertices, whole.faces, assembly.vertex_normals(whole.vertices, whole.faces))
    # Faces go only where all of their surroundings are hidden.
    near = np.zeros_like(shown)
    near[whole.faces[shown[whole.faces].any(axis=1)]] = True
    keep = np.zeros(len(bare), bool)
    used = np.unique(body.faces[np.isin(body.parts, [body.groups.index(g) for g in _SKIN])])
    keep[used] = near
    return assembly.body_piece(body, bare, ("body",), "body", keep=keep)


def span(skin: Piece, over: Bool[np.ndarray, " v"]) -> Piece:
    """The skin with some of its vertices, `over` (v,), drawn tight as a membrane between the others: what cloth or hair
    does over a hollow, a nipple or an ear."""
    count, faces = len(skin.vertices), skin.faces
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    graph = sparse.coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count)).tocsr()
    graph = ((graph + graph.T) > 0).astype(np.float64)
    laplacian = (sparse.diags(np.asarray(graph.sum(1)).ravel()) - graph).tocsr()[over]
    fixed = skin.vertices[~over].astype(np.float64)
    vertices = skin.vertices.copy()
    vertices[over] = linalg.spsolve(laplacian[:, over].tocsc(), -(laplacian[:, ~over] @ fixed))
    return dataclasses.replace(skin, vertices=vertices)


def put_on(
    skin: Piece, loose: Float[np.ndarray, " v"], thick: Float[np.ndarray, " v"], rounds: int = 24
) -> tuple[Piece, Float[np.ndarray, "v 3"]]:
    """The skin as a garment: smoothed by `loose` (v,) in [0, 1] and `thick` (v,) metres outside; and its normals."""
    smooth = assembly.relax(skin.vertices, skin.faces, loose.astype(np.float32), rounds)
    normals = assembly.vertex_normals(smooth, skin.faces)
    vertices = (smooth + normals * thick[:, None]).astype(np.float32)
    return dataclasses.replace(skin, vertices=vertices), assembly.vertex_normals(vertices, skin.faces)
