"""Projection and harmonics against gsplat's own PyTorch code, where gsplat and torch are installed (no GPU needed)."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.splat import SplatConfig, harmonics
from avatarjax.splat.project import DEPTH, EXTENT_X, LOG2_OPACITY, XX, XY, YY, X, Y, project
from tests.splat.scenes import front_camera, random_gaussians

torch = pytest.importorskip("torch")
gsplat = pytest.importorskip("gsplat.cuda._torch_impl")


def to_torch(x):
    return torch.from_numpy(np.array(x))


@pytest.mark.parametrize("eye", [(0.3, 0.4, 3.0), (0.1, 0.0, 0.6)], ids=["outside", "inside"])
def test_projection_is_that_of_gsplat(eye):
    gaussians, camera = random_gaussians(n=200), front_camera(60, 44, eye=eye)
    table, finite = project(gaussians, gaussians.colors, camera, SplatConfig(antialiased=True))
    sharp, _ = project(gaussians, gaussians.colors, camera, SplatConfig())
    quats = to_torch(gaussians.quats / jnp.linalg.norm(gaussians.quats, axis=1, keepdims=True))
    covariances, _ = gsplat._quat_scale_to_covar_preci(quats, to_torch(gaussians.scales), compute_preci=False)
    _, means, depths, conics, compensations = gsplat._fully_fused_projection(
        to_torch(gaussians.means),
        covariances,
        to_torch(camera.world_to_camera)[None],
        to_torch(camera.intrinsics)[None],
        camera.width,
        camera.height,
        calc_compensations=True,
    )
    means, depths, conics, compensations = (x[0].numpy() for x in (means, depths, conics, compensations))
    shown = np.asarray(table[:, EXTENT_X] > 0) & (depths > 0.01)
    assert finite.all() and shown.sum() > 50
    table = np.asarray(table)[shown]
    np.testing.assert_allclose(table[:, [X, Y]], means[shown], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(table[:, DEPTH], depths[shown], rtol=1e-4)
    ours = table[:, [XX, XY, YY]] / (-math.log2(math.e) * np.array([0.5, 1.0, 0.5]))
    np.testing.assert_allclose(ours, conics[shown], rtol=1e-4, atol=1e-4 * np.abs(conics[shown]).max())
    ratio = np.exp2(table[:, LOG2_OPACITY] - np.asarray(sharp)[shown, LOG2_OPACITY])
    np.testing.assert_allclose(ratio, compensations[shown], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_are_those_of_gsplat(degree):
    directions = jax.random.normal(jax.random.key(0), (50, 3))
    unit = directions / jnp.linalg.norm(directions, axis=1, keepdims=True)
    count = (degree + 1) ** 2
    coefficients = jnp.broadcast_to(jnp.eye(count)[None, :, :3], (50, count, 3)) if count >= 3 else jnp.ones((50, 1, 3))
    expected = gsplat._spherical_harmonics(degree, to_torch(directions), to_torch(coefficients)).numpy()
    ours = jnp.sum(harmonics(unit, degree)[..., None] * coefficients, axis=1)
    np.testing.assert_allclose(ours, expected, atol=1e-5)
