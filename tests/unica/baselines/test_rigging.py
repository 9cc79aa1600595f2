"""Automatic rigging: known weights come back, and constraints hold where they cannot."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import rotations
from avatarjax.unica.baselines import rigging

FRAMES, BONES, POINTS = 30, 4, 50


@pytest.fixture(scope="module")
def motion():
    keys = jax.random.split(jax.random.key(0), 3)
    quats = jax.random.normal(keys[0], (FRAMES, BONES, 4)) * 0.3 + jnp.asarray([1.0, 0, 0, 0])[None, None]
    shift = 0.3 * jax.random.normal(keys[1], (FRAMES, BONES, 3))
    transforms = jnp.concatenate([rotations.to_matrix(quats), shift[..., None]], axis=-1)
    return transforms, jax.random.normal(keys[2], (POINTS, 3))


def mixtures(key):
    """Weights with zeros among them, as skinning has."""
    raw = jnp.maximum(jax.random.normal(key, (POINTS, BONES)), 0.0) + 1e-3 * jnp.eye(BONES)[jnp.arange(POINTS) % BONES]
    return raw / raw.sum(1, keepdims=True)


def test_weights_that_made_the_examples_come_back(motion):
    transforms, reference = motion
    true = rigging.Rigged(mixtures(jax.random.key(1)), reference)
    found = rigging.fit(reference, transforms, rigging.pose(true, transforms))
    np.testing.assert_allclose(found.weights, true.weights, atol=2e-3)
    np.testing.assert_allclose(rigging.pose(found, transforms), rigging.pose(true, transforms), atol=2e-3)


def test_weights_stay_on_the_simplex_and_beat_every_single_bone(motion):
    transforms, reference = motion
    points = jax.random.normal(jax.random.key(2), (FRAMES, POINTS, 3))
    found = rigging.fit(reference, transforms, points)
    assert (found.weights >= 0).all()
    np.testing.assert_allclose(found.weights.sum(1), 1.0, atol=1e-5)

    def error(weights):
        posed = rigging.pose(rigging.Rigged(weights, reference), transforms)
        return jnp.mean(jnp.sum((posed - points) ** 2, -1), axis=0)

    ours = error(found.weights)
    for bone in range(BONES):
        assert (ours <= error(jnp.tile(jnp.eye(BONES)[bone], (POINTS, 1))) * 1.001).all()


def test_from_reference_undoes_the_reference_pose(motion):
    transforms, points = motion
    weights = jnp.tile(jnp.eye(BONES)[0], (POINTS, 1))
    relative = rigging.from_reference(transforms[3], transforms)
    standing = rigging.pose(rigging.Rigged(weights, points), transforms[3:4])[0]
    again = rigging.pose(rigging.Rigged(weights, standing), relative)
    np.testing.assert_allclose(again, rigging.pose(rigging.Rigged(weights, points), transforms), atol=1e-4)
