"""The Gaussians pytree and its similarity transform."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import Gaussians, rotations
from avatarjax import gaussians as clouds


def cloud(n=6):
    rng = np.random.default_rng(0)
    shapes = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "logit_opacities": (n,), "colors": (n, 3)}
    return Gaussians(**{name: jnp.asarray(rng.normal(size=shape), jnp.float32) for name, shape in shapes.items()})


def transform(gaussians, *arguments):
    return clouds.transform(gaussians, *arguments)


def covariances(gaussians):
    axes = rotations.to_matrix(gaussians.quats) * gaussians.scales[:, None, :]
    return axes @ axes.mT


ROTATION = rotations.to_matrix(jnp.asarray([0.3, -0.5, 0.7, 0.2]))
TRANSLATION = jnp.asarray([0.4, -1.0, 2.0])


def test_length_is_the_number_of_gaussians():
    assert len(cloud(6)) == 6


def test_scales_and_opacities_are_the_activated_fields():
    gaussians = cloud()
    np.testing.assert_allclose(gaussians.scales, np.exp(gaussians.log_scales), rtol=1e-6)
    np.testing.assert_allclose(gaussians.opacities, 1 / (1 + np.exp(-gaussians.logit_opacities)), rtol=1e-6)


def test_absent_sh_is_no_leaf():
    assert len(jax.tree.leaves(cloud())) == 5


@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_transform_moves_covariances_as_the_points(scale):
    gaussians = cloud()
    expected = scale**2 * ROTATION @ covariances(gaussians) @ ROTATION.T
    np.testing.assert_allclose(covariances(transform(gaussians, scale, ROTATION, TRANSLATION)), expected, atol=1e-4)


def test_transform_moves_the_means():
    gaussians = cloud()
    expected = 0.5 * np.asarray(gaussians.means) @ np.asarray(ROTATION).T + np.asarray(TRANSLATION)
    np.testing.assert_allclose(transform(gaussians, 0.5, ROTATION, TRANSLATION).means, expected, atol=1e-6)


def test_transform_and_its_inverse_are_the_identity():
    gaussians = cloud()
    there = transform(gaussians, 2.0, ROTATION, TRANSLATION)
    back = transform(there, 0.5, ROTATION.T, -0.5 * ROTATION.T @ TRANSLATION)
    np.testing.assert_allclose(back.means, gaussians.means, atol=1e-5)
    np.testing.assert_allclose(covariances(back), covariances(gaussians), atol=1e-4)
