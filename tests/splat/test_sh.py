"""Spherical harmonics: orthonormal, in the order and with the signs of 3D Gaussian Splatting."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import look_at, render
from avatarjax.splat import harmonics, view_colors
from tests.splat.scenes import random_gaussians


def test_harmonics_are_orthonormal():
    heights, weights = np.polynomial.legendre.leggauss(8)
    angles = np.arange(16) * 2 * np.pi / 16
    z, angle = (x.reshape(-1) for x in np.meshgrid(heights, angles, indexing="ij"))
    radius = np.sqrt(1 - z * z)
    points = jnp.asarray(np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1), jnp.float32)
    values = np.asarray(harmonics(points, 3), np.float64)
    products = np.einsum("n,nj,nk->jk", np.repeat(weights, 16) * 2 * np.pi / 16, values, values)
    np.testing.assert_allclose(products, np.eye(16), atol=1e-5)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_each_degree_is_the_start_of_the_next(degree):
    points = jax.random.normal(jax.random.key(0), (7, 3))
    points = points / jnp.linalg.norm(points, axis=1, keepdims=True)
    values = harmonics(points, degree)
    assert values.shape == (7, (degree + 1) ** 2)
    np.testing.assert_array_equal(values, harmonics(points, 3)[:, : values.shape[1]])


def test_degree_one_is_the_direction_as_minus_y_z_minus_x():
    values = harmonics(jnp.asarray([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), 1)[:, 1:]
    c = np.sqrt(3 / (4 * np.pi))
    np.testing.assert_allclose(values, [[0, 0, -c], [-c, 0, 0], [0, c, 0]], atol=1e-6)


def test_degree_four_is_refused():
    with pytest.raises(ValueError, match="degree must be 0 to 3, got 4"):
        harmonics(jnp.zeros((1, 3)), 4)


def test_colors_follow_the_side_from_which_a_gaussian_is_seen():
    cloud = random_gaussians(n=1, spread=0.0).replace(colors=jnp.full((1, 3), 0.5), logit_opacities=jnp.asarray([4.0]))
    # The coefficient of -x: lighter where the direction of view has a negative x, that is seen from +x.
    cloud = cloud.replace(sh=jnp.zeros((1, 3, 3)).at[0, 2].set(0.5))
    right, left = (look_at((x, 0.0, 0.0), (0.0, 0.0, 0.0), width=9, height=9) for x in (3.0, -3.0))
    seen = [float(view_colors(cloud, camera)[0, 0]) for camera in (right, left)]
    np.testing.assert_allclose(seen, [0.5 + 0.5 * 0.48860251, 0.5 - 0.5 * 0.48860251], atol=1e-6)
    bright, dark = (render(cloud, camera).image[4, 4, 0] for camera in (right, left))
    np.testing.assert_allclose(bright / dark, seen[0] / seen[1], rtol=1e-4)


def test_colors_are_never_negative():
    cloud = random_gaussians(n=5)
    cloud = cloud.replace(sh=jnp.full((5, 15, 3), -9.0))
    camera = look_at((0.3, 0.2, 3.0), (0.0, 0.0, 0.0), width=8, height=8)
    assert np.all(view_colors(cloud, camera) >= 0)


def test_gaussian_in_the_camera_has_finite_gradients():
    cloud = random_gaussians(n=2, spread=0.0)
    camera = look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), width=8, height=8)
    cloud = cloud.replace(means=jnp.asarray([[0.0, 0.0, 3.0], [0.0, 0.0, 0.0]]), sh=jnp.ones((2, 8, 3)))
    gradients = jax.grad(lambda g: jnp.sum(render(g, camera).image))(cloud)
    assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(gradients))
    assert np.any(gradients.sh[1])


def test_coefficients_that_are_not_finite_leave_their_gaussian_out():
    cloud = random_gaussians(n=4).replace(sh=jnp.zeros((4, 3, 3)).at[1, 0, 0].set(jnp.nan))
    output = render(cloud, look_at((0.3, 0.2, 3.0), (0.0, 0.0, 0.0), width=8, height=8))
    assert int(output.info.non_finite) == 1 and np.all(np.isfinite(output.image))
