"""What must hold of every dressed avatar in its rest pose, where the simulation of its cloth begins."""

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from avatarjax.data.wardrobe import assembly


def part(avatar, name):
    """The vertex numbers of a part."""
    return np.unique(avatar.faces[avatar.parts == avatar.part_names.index(name)])


def check(avatar):
    """The mesh is sound, and its cloth is sewn on, evenly meshed, and clear of what it collides with."""
    vertices, faces, free = avatar.vertices, avatar.faces, avatar.reach > 0
    np.testing.assert_allclose(avatar.weights.sum(1), 1, atol=1e-5)
    assert len(vertices) < 22_000
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 1e-9
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    check_seams(len(vertices), edges, avatar.reach)
    # Tips of braids and beards are finer than cloth need be, but few.
    edges = edges[free[edges].all(axis=1)]
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    assert np.percentile(lengths, 3) > 0.005
    assert lengths.max() < 0.06 and np.percentile(lengths, 99.5) < 0.05
    solid = faces[np.array(avatar.solid)[avatar.parts]]
    assert clearance(vertices[avatar.reach > 0.02], vertices, solid).min() > 0.004


def check_seams(count, edges, reach):
    """Every connected sheet that moves has a place that does not, and nothing moves right away from there."""
    _, label = connected_components(sparse.coo_matrix((np.ones(len(edges)), edges.T), (count, count)), directed=False)
    moving = np.unique(label[reach > 0])
    assert len(moving) and np.isin(moving, label[reach == 0]).all()
    assert np.abs(reach[edges[:, 0]] - reach[edges[:, 1]]).max() < 0.12


def clearance(points, vertices, faces):
    """Metres of points outside the nearest vertex or middle of a triangle, along the normal there."""
    normals = assembly.vertex_normals(vertices, faces)
    used = np.unique(faces)
    places = np.concatenate([vertices[used], vertices[faces].mean(1)])
    out = np.concatenate([normals[used], normals[faces].mean(1)])
    out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9)
    _, nearest = cKDTree(places).query(points)
    return ((points - places[nearest]) * out[nearest]).sum(1)
