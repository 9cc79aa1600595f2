"""Local frames of the surface: orthonormal, outwards, and turning with the figure."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import posmap, rotations

NONE = jnp.asarray([1.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def tangents(atlas):
    return posmap.tangents(atlas)


@pytest.fixture(scope="module")
def rest(atlas, tangents):
    return posmap.frames(tangents, atlas.reference)


def test_frames_are_orthonormal_everywhere(rest):
    products = np.einsum("tij,tik->tjk", rest.axes, rest.axes)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(rest.axes), 1, atol=1e-5)
    assert np.mean(rest.known) > 0.8


def test_normals_point_outwards(figure, atlas, rest):
    """Those of the ellipsoid's texels are its own, in the views that see them well."""
    body = (np.abs(atlas.reference[:, 0]) < 0.12) & (np.asarray(rest.known) > 0)
    gradient = (np.asarray(atlas.reference) - [0, 0.85, 0]) / np.square([0.2, 0.85, 0.15])
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    cosine = (gradient * np.asarray(rest.axes)[:, :, 2]).sum(1)[body]
    assert np.median(cosine) > 0.97 and (cosine > 0).mean() > 0.98


def test_views_are_seen_from_their_sides(atlas, rest):
    sides = {"front": [0, 0, 1], "back": [0, 0, -1], "right": [-1, 0, 0], "left": [1, 0, 0]}
    for window in posmap.windows(atlas.size):
        if window.name in sides:
            rows, cols = np.asarray(atlas.rows) - window.row, np.asarray(atlas.cols) - window.col
            inside = (rows >= 0) & (rows < window.height) & (cols >= 0) & (cols < window.width)
            inside &= np.asarray(rest.known) > 0
            facing = np.asarray(rest.axes)[inside, :, 2] @ np.array(sides[window.name])
            assert abs(np.median(facing)) > 0.5
            assert np.median(facing) > 0 or window.name in ("left", "right")


@pytest.mark.parametrize("seed", range(3))
def test_a_rigid_turn_turns_every_frame_by_the_same(atlas, tangents, rest, seed):
    quat = rotations.normalize(jax.random.normal(jax.random.key(seed), (4,)))
    moved = atlas.reference @ rotations.to_matrix(quat).T + jnp.asarray([[3.0, -1.0, 2.0]])
    found = posmap.turns(rest, posmap.frames(tangents, moved), quat)
    matrices = rotations.to_matrix(found)
    expected = np.broadcast_to(rotations.to_matrix(quat), matrices.shape)
    np.testing.assert_allclose(matrices, expected, atol=1e-3)


def test_tangents_grow_with_the_figure(atlas, tangents, rest):
    twice = posmap.frames(tangents, 2 * atlas.reference)
    known = np.asarray(rest.known) > 0
    np.testing.assert_allclose(twice.lengths[known], 2 * rest.lengths[known], rtol=1e-4)


def test_the_gap_between_arm_and_body_is_no_surface(atlas, tangents):
    """A tangent never joins points that lie further apart than a few texels do."""
    across = np.einsum("tk,tkc->tc", tangents.across, posmap.around(tangents.neighbours, atlas.reference))
    lengths = np.linalg.norm(across, axis=1)
    assert lengths.max() < 4 * np.median(lengths[lengths > 0])


def test_unknown_frames_turn_as_they_are_told(atlas, tangents, rest):
    quat = jnp.asarray([0.0, 1.0, 0.0, 0.0])
    found = posmap.turns(rest._replace(known=jnp.zeros_like(rest.known)), rest, quat)
    np.testing.assert_array_equal(found, np.broadcast_to(quat, found.shape))


def test_gradients_are_finite_where_texels_coincide(atlas, tangents):
    def loss(texels):
        return jnp.sum(posmap.frames(tangents, texels).axes ** 3)

    assert np.isfinite(jax.grad(loss)(jnp.zeros_like(atlas.reference))).all()
    assert np.isfinite(jax.grad(loss)(atlas.reference)).all()
