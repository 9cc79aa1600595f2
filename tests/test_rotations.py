"""Rotations: properties over random quaternions, and SciPy as an oracle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from avatarjax import rotations

BATCHES = [(), (5,), (2, 3)]


def quaternions(batch=(7,), seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(*batch, 4)), jnp.float32)


def up_to_sign(q):
    return q * np.sign(q[..., :1])


@pytest.mark.parametrize("batch", BATCHES, ids=str)
def test_matrix_matches_scipy(batch):
    q = quaternions(batch)
    expected = Rotation.from_quat(np.asarray(q).reshape(-1, 4), scalar_first=True).as_matrix().reshape(*batch, 3, 3)
    np.testing.assert_allclose(rotations.to_matrix(q), expected, atol=1e-6)


@pytest.mark.parametrize("batch", BATCHES, ids=str)
def test_product_of_quaternions_is_the_product_of_matrices(batch):
    a, b = quaternions(batch, 1), quaternions(batch, 2)
    expected = rotations.to_matrix(a) @ rotations.to_matrix(b)
    np.testing.assert_allclose(rotations.to_matrix(rotations.multiply(a, b)), expected, atol=1e-6)


@pytest.mark.parametrize("batch", BATCHES, ids=str)
def test_quaternion_of_a_matrix_is_the_one_with_positive_w(batch):
    q = rotations.normalize(quaternions(batch))
    np.testing.assert_allclose(rotations.from_matrix(rotations.to_matrix(q)), up_to_sign(q), atol=1e-6)


@pytest.mark.parametrize("axis", np.eye(3))
def test_half_turns_come_back_from_their_matrices(axis):
    matrix = jnp.asarray(Rotation.from_rotvec(np.pi * axis).as_matrix(), jnp.float32)
    np.testing.assert_allclose(rotations.to_matrix(rotations.from_matrix(matrix)), matrix, atol=1e-6)


@settings(max_examples=30, deadline=None, database=None)
@given(st.lists(st.floats(-1.75, 1.75, width=32), min_size=3, max_size=3))
def test_rotation_vector_round_trip(vector):
    vector = jnp.asarray(vector, jnp.float32)
    back = rotations.to_axis_angle(rotations.from_axis_angle(vector))
    np.testing.assert_allclose(back, vector, atol=1e-5)


@pytest.mark.parametrize("length", [0.0, 1e-6, 1e-4, 1e-2, 1.0, 3.0])
def test_rotation_vector_matches_scipy(length):
    vector = length * np.array([2.0, -1.0, 2.0]) / 3
    expected = Rotation.from_rotvec(vector).as_quat(scalar_first=True)
    np.testing.assert_allclose(rotations.from_axis_angle(jnp.asarray(vector, jnp.float32)), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("function", "point"),
    [
        (rotations.normalize, jnp.zeros(4)),
        (rotations.to_matrix, jnp.zeros(4)),
        (rotations.from_matrix, jnp.eye(3)),
        (rotations.from_axis_angle, jnp.zeros(3)),
        (rotations.to_axis_angle, jnp.asarray([1.0, 0, 0, 0])),
        (rotations.to_axis_angle, jnp.asarray([-1.0, 0, 0, 0])),
        (rotations.to_axis_angle, jnp.zeros(4)),
    ],
)
def test_gradient_is_finite_at_identity_and_zero(function, point):
    assert np.all(np.isfinite(jax.jacobian(function)(point)))


def test_rotation_vector_has_the_right_slope_at_zero():
    jacobian = jax.jacobian(rotations.from_axis_angle)(jnp.zeros(3))
    np.testing.assert_allclose(jacobian, np.vstack([np.zeros(3), np.eye(3) / 2]), atol=1e-7)


@pytest.mark.parametrize(("weight", "end"), [(0.0, 0), (1.0, 1)])
def test_interpolation_ends_at_its_ends(weight, end):
    pair = [rotations.normalize(quaternions((5,), seed)) for seed in (0, 1)]
    got = rotations.nlerp(*pair, jnp.full(5, weight))
    np.testing.assert_allclose(up_to_sign(got), up_to_sign(pair[end]), atol=1e-6)


def test_interpolation_takes_the_shorter_arc():
    q = rotations.normalize(quaternions((5,)))
    np.testing.assert_allclose(rotations.nlerp(q, -q, jnp.full(5, 0.5)), q, atol=1e-6)


def test_yaw_turns_the_face_from_z_to_x():
    yaw = jnp.asarray([0.0, np.pi / 2, 0.3])
    face = rotations.yaw_matrix(yaw) @ jnp.asarray([0.0, 0.0, 1.0])
    np.testing.assert_allclose(face, jnp.stack([jnp.sin(yaw), 0 * yaw, jnp.cos(yaw)], axis=-1), atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_similarity_fit_recovers_a_similarity(seed):
    rng = np.random.default_rng(seed)
    source = jnp.asarray(rng.normal(size=(20, 3)), jnp.float32)
    rotation = rotations.to_matrix(quaternions((), seed))
    target = 1.7 * source @ rotation.T + jnp.asarray([[1.0, -2.0, 0.5]])
    scale, fitted, translation = rotations.similarity_fit(source, target)
    np.testing.assert_allclose(scale, 1.7, rtol=1e-5)
    np.testing.assert_allclose(fitted, rotation, atol=1e-5)
    np.testing.assert_allclose(translation, [1.0, -2.0, 0.5], atol=1e-5)


def test_similarity_fit_of_a_mirror_image_is_still_a_rotation():
    source = jnp.asarray(np.random.default_rng(0).normal(size=(20, 3)), jnp.float32)
    _, rotation, _ = rotations.similarity_fit(source, source * jnp.asarray([[-1.0, 1.0, 1.0]]))
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=1e-5)


def test_similarity_fit_ignores_points_without_weight():
    source = jnp.asarray(np.random.default_rng(0).normal(size=(20, 3)), jnp.float32)
    target = source.at[0].set(100.0)
    scale, _, _ = rotations.similarity_fit(source, target, jnp.ones(20).at[0].set(0.0))
    np.testing.assert_allclose(scale, 1.0, rtol=1e-5)


def test_the_nearest_rotation_is_that_of_the_polar_decomposition():
    rng = np.random.default_rng(0)
    turns = np.asarray(rotations.to_matrix(quaternions((200,))), np.float64)
    mixed = rng.normal(size=(200, 3, 3))
    matrices = turns @ (mixed @ mixed.swapaxes(1, 2) * 0.1 + np.eye(3))
    u, _, vt = np.linalg.svd(matrices)
    nearest = jax.jit(lambda m: rotations.to_matrix(rotations.nearest(m)))
    np.testing.assert_allclose(nearest(jnp.asarray(matrices, jnp.float32)), u @ vt, atol=2e-3)
    np.testing.assert_allclose(nearest(jnp.asarray(turns, jnp.float32)), turns, atol=2e-6)


def test_gradients_of_the_nearest_rotation_are_those_of_the_polar_decomposition(monkeypatch):
    rng = np.random.default_rng(1)
    turns = np.asarray(rotations.to_matrix(quaternions((50,))), np.float64)
    # Near to turns the power iteration is exact, and so comparable with finite differences of the decomposition.
    matrices = turns @ (np.eye(3) + 0.02 * rng.normal(size=(50, 3, 3)))
    weights = rng.normal(size=(50, 3, 3))

    def value(matrices):
        u, _, vt = np.linalg.svd(matrices)
        return np.sum(weights * (u @ vt), axis=(1, 2))

    expected = np.zeros_like(matrices)
    for i, j in np.ndindex(3, 3):
        step = np.zeros((3, 3))
        step[i, j] = 1e-6
        expected[:, i, j] = (value(matrices + step) - value(matrices - step)) / 2e-6

    def summed(m):
        return jnp.sum(jnp.asarray(weights, jnp.float32) * rotations.to_matrix(rotations.nearest(m)))

    held = jax.grad(summed)(jnp.asarray(matrices, jnp.float32))
    monkeypatch.setattr(rotations, "_HELD", 0.0)
    found = jax.grad(summed)(jnp.asarray(matrices, jnp.float32))
    np.testing.assert_allclose(found, expected, atol=2e-3)
    # Three equal singular values resist a turn by two of them: a twentieth of the trace takes 7 % off.
    np.testing.assert_allclose(held, expected / 1.075, atol=0.02)
    monkeypatch.undo()
    # A plane, a line and nothing leave turns open: their gradients are finite.
    flat = jnp.stack([jnp.diag(jnp.array(x)) for x in ([1.0, 1, 0], [1.0, 0, 0], [0.0, 0, 0])])
    assert np.isfinite(jax.grad(lambda m: jnp.sum(rotations.nearest(m)))(flat)).all()
