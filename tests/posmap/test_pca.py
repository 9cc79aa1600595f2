import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.posmap import pca


@pytest.fixture
def samples(key):
    a, b, c = jax.random.split(key, 3)
    spectrum = 0.6 ** jnp.arange(12.0)
    rotation, _ = jnp.linalg.qr(jax.random.normal(a, (60, 12)))
    return jax.random.normal(b, (200, 12)) * spectrum[None] @ rotation.T + jax.random.normal(c, (60,))[None]


def test_agrees_with_the_exact_decomposition(samples, key):
    fitted = pca.fit(samples, 5, key)
    exact = np.linalg.svd(np.asarray(samples - samples.mean(0)[None], np.float64), full_matrices=False)
    np.testing.assert_allclose(fitted.stddev, exact[1][:5] / np.sqrt(199), rtol=1e-3)
    overlap = np.abs(np.asarray(fitted.basis) @ exact[2][:5].T)
    np.testing.assert_allclose(overlap, np.eye(5), atol=2e-2)


def test_the_basis_is_orthonormal(samples, key):
    basis = pca.fit(samples, 8, key).basis
    np.testing.assert_allclose(basis @ basis.T, np.eye(8), atol=1e-5)


def test_reconstruction_error_falls_with_components(samples, key):
    errors = []
    for components in (1, 4, 8, 12):
        fitted = pca.fit(samples, components, key)
        back = pca.reconstruct(fitted, pca.project(fitted, samples))
        errors.append(float(jnp.abs(back - samples).max()))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1e-4


def test_align_is_idempotent(samples, key):
    fitted = pca.fit(samples, 6, key)
    once = pca.align(fitted, samples[3].reshape(20, 3))
    np.testing.assert_allclose(pca.align(fitted, once), once, atol=1e-5)


def test_too_many_components_are_refused(samples, key):
    with pytest.raises(ValueError, match="components"):
        pca.fit(samples[:5], 10, key)
