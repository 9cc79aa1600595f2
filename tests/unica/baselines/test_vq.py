"""The codebook against NumPy, and who gets which gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.unica.baselines import vq

RNG = np.random.default_rng(0)
CODEBOOK = RNG.normal(size=(16, 5)).astype(np.float32)


@pytest.mark.parametrize("shape", [(), (7,), (2, 3, 4)])
def test_the_nearest_entry_is_numpys(shape):
    vectors = RNG.normal(size=(*shape, 5)).astype(np.float32)
    distance = np.linalg.norm(vectors[..., None, :].astype(np.float64) - CODEBOOK, axis=-1)
    np.testing.assert_array_equal(vq.nearest(jnp.asarray(CODEBOOK), jnp.asarray(vectors)), distance.argmin(-1))


def test_an_entry_stands_for_itself():
    np.testing.assert_array_equal(vq.nearest(jnp.asarray(CODEBOOK), jnp.asarray(CODEBOOK)), np.arange(16))


def test_the_gradient_of_an_entry_goes_straight_to_its_vector():
    vectors, entries, weights = (jnp.asarray(RNG.normal(size=(3, 5)), jnp.float32) for _ in range(3))
    value, (to_vectors, to_entries) = jax.value_and_grad(
        lambda v, e: jnp.sum(weights * vq.straight_through(v, e)), argnums=(0, 1)
    )(vectors, entries)
    assert float(value) == pytest.approx(float(jnp.sum(weights * entries)), rel=1e-5)
    np.testing.assert_array_equal(to_vectors, weights)
    np.testing.assert_array_equal(to_entries, 0)


def test_entries_are_drawn_to_vectors_and_vectors_commit_a_quarter_as_much():
    vectors, entries = (jnp.asarray(RNG.normal(size=(3, 5)), jnp.float32) for _ in range(2))
    value, gradients = jax.value_and_grad(vq.codebook_loss, argnums=(0, 1))(vectors, entries, 0.25)
    apart = np.asarray(vectors - entries)
    assert float(value) == pytest.approx(1.25 * (apart**2).mean(), rel=1e-5)
    np.testing.assert_allclose(gradients[0], 0.25 * 2 * apart / apart.size, rtol=1e-5)
    np.testing.assert_allclose(gradients[1], -2 * apart / apart.size, rtol=1e-5)


def test_perplexity_counts_the_codes_in_use():
    assert float(vq.perplexity(jnp.array([[3, 3], [3, 3]]), 8)) == pytest.approx(1)
    assert float(vq.perplexity(jnp.array([0, 2, 5, 7]), 8)) == pytest.approx(4)
