"""The drape in closed form: an oracle for its regression, and what it says near and far from what it knows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.smad import drape, driving, kernel, linear

FRAMES, STRIDE, WINDOW = 120, 2, 3


def recorded(seed, frames=FRAMES):
    """Two smooth features, and five nodes that follow them in a bent way."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames)[:, None] / 30
    features = np.sin(t * rng.uniform(2, 5, 2) + rng.uniform(0, 6, 2))
    bent = np.stack([features[:, 0] ** 2, np.abs(features[:, 1]), features[:, 0] * features[:, 1]], axis=1)
    return features, 0.1 * bent[:, None] * np.linspace(0.5, 1.5, 5)[None, :, None]


@pytest.fixture(scope="module")
def takes():
    parts = [recorded(seed) for seed in range(4)]
    features, offsets = (np.concatenate(x) for x in zip(*parts, strict=True))
    return jnp.asarray(offsets), jnp.asarray(features), jnp.repeat(jnp.arange(4) * FRAMES, FRAMES)


def fit(takes, **options):
    return drape.fit(*takes, components=3, window=WINDOW, stride=STRIDE, **options)


def windows(features, first=None):
    return driving.windows(features, np.zeros(len(features), int) if first is None else first, WINDOW, STRIDE)


def lie(found, poses):
    return jax.vmap(lambda window: drape.offsets(found, window))(jnp.asarray(poses, jnp.float32))


def test_with_every_window_a_centre_it_is_kernel_ridge_regression(takes):
    offsets, features, first = (np.asarray(x) for x in takes)
    found = fit(takes, ridge=0.2, centres=len(features))
    poses = windows(features.astype(np.float64), first)
    near = np.asarray(jax.vmap(lambda window: kernel.near(found.kernel, window))(jnp.asarray(poses, jnp.float32)))
    flat = (offsets - offsets.mean(0)).reshape(len(offsets), -1)
    expected = near @ np.linalg.solve(near.astype(np.float64) + 0.2 * np.eye(len(near)), flat)
    here = lie(found, poses[::7])
    np.testing.assert_allclose(here - found.mean[None], expected[::7].reshape(here.shape), atol=2e-4)


def test_it_bends_where_linear_regression_cannot(takes):
    features, truth = recorded(9)
    straight = linear.fit(*takes, components=3, window=WINDOW, stride=STRIDE, ridge=1e-4)
    bent = lie(fit(takes, ridge=0.01, centres=200), windows(features))
    found = bent, linear.rollout(straight, jnp.asarray(features, jnp.float32))
    errors = [np.abs(np.asarray(x) - truth)[10:].mean() for x in found]
    assert errors[0] < 0.3 * errors[1]


def test_far_from_what_it_knows_it_is_the_mean_drape(takes):
    found = fit(takes, centres=100)
    np.testing.assert_allclose(drape.offsets(found, jnp.full((WINDOW, 2), 50.0)), found.mean, atol=1e-7)


def test_more_components_than_frames_are_refused(takes):
    with pytest.raises(ValueError, match="3 components need as many frames, there are 2"):
        fit([x[:2] for x in takes])
