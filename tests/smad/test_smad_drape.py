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
    """The offsets under each window, whatever was before."""
    before = jnp.zeros(len(found.basis))
    at = jax.vmap(lambda window: drape.offsets(found, drape.components(found, window, before)))
    return at(jnp.asarray(poses, jnp.float32))


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
    np.testing.assert_allclose(lie(found, jnp.full((1, WINDOW, 2), 50.0))[0], found.mean, atol=1e-7)


def test_more_components_than_frames_are_refused(takes):
    with pytest.raises(ValueError, match="3 components need as many frames, there are 2"):
        fit([x[:2] for x in takes])


LAG = 6


def trailing(seed, frames=FRAMES):
    """A feature that jumps from time to time, and two nodes that follow it more slowly than a window is long: what a
    window says of them is not enough."""
    rng = np.random.default_rng(seed)
    push = np.repeat(rng.uniform(-1, 1, frames // 12), 12)
    place = np.full(frames, push[0])
    for k in range(1, frames):
        place[k] = place[k - 1] + 0.06 * (push[k] - place[k - 1])
    return push[:, None], 0.1 * place[:, None, None] * np.ones((1, 2, 3))


def roll(found, poses):
    """Offsets in every frame of a take, begun at rest under its first window."""
    poses = jnp.asarray(poses, jnp.float32)

    def at(memory, window):
        now = drape.components(found, window, memory[-1])
        return jnp.concatenate([now[None], memory[:-1]]), drape.offsets(found, now)

    return jax.lax.scan(at, jnp.repeat(drape.at_rest(found, poses[0])[None], LAG, axis=0), poses)[1]


def test_with_a_memory_what_comes_late_is_followed_from_rest():
    parts = [trailing(seed) for seed in range(20)]
    features, offsets = (jnp.asarray(np.concatenate(x)) for x in zip(*parts, strict=True))
    learned = offsets, features, jnp.repeat(jnp.arange(20) * FRAMES, FRAMES)
    features, truth = trailing(99)
    errors = {}
    for memory in (0, LAG):
        options = {"components": 1, "window": WINDOW, "stride": STRIDE, "ridge": 0.01, "memory": memory}
        found = drape.fit(*learned, **options)
        assert (found.past is None) == (memory == 0)
        errors[memory] = np.abs(np.asarray(roll(found, windows(features))) - truth).mean()
    assert errors[LAG] < 0.3 * errors[0]


def test_with_every_window_a_centre_a_memory_is_a_kernel_of_both(takes):
    """And far from every past what is left is a share of what windows say."""
    offsets, features, first = (np.asarray(x, np.float64) for x in takes)
    count, first = len(features), first.astype(int)
    found = fit(takes, ridge=0.2, centres=count, memory=LAG)
    poses = jnp.asarray(windows(features, first), jnp.float32)
    flat = (offsets - offsets.mean(0)).reshape(count, -1)
    wanted = flat @ np.asarray(found.basis, np.float64).reshape(3, -1).T
    before = wanted[np.maximum(np.arange(count) - LAG, first)]
    apart = np.sum((before[:, None] - before[None]) ** 2, axis=2)
    alone = np.asarray(jax.vmap(lambda window: kernel.near(found.kernel, window))(poses), np.float64)
    both = alone * (drape.ANYHOW + (1 - drape.ANYHOW) * np.exp(-apart / (kernel.WIDTH * 2 * before.var(0).sum())))
    expected = both @ np.linalg.solve(both + 0.2 * np.eye(count), wanted)
    here = [drape.components(found, poses[k], jnp.asarray(before[k], jnp.float32)) for k in (0, 40, 300)]
    np.testing.assert_allclose(here, expected[[0, 40, 300]], atol=2e-4)
    lost = drape.components(found, poses[40], jnp.full(3, 50.0))
    np.testing.assert_allclose(lost, drape.ANYHOW * alone[40] @ np.asarray(found.weights), atol=1e-4)


def test_at_rest_it_stays(takes):
    found = fit(takes, centres=100, memory=LAG)
    window = jnp.asarray(windows(np.asarray(takes[1], np.float64)[:FRAMES])[0], jnp.float32)
    rest = drape.at_rest(found, window)
    np.testing.assert_allclose(drape.components(found, window, rest), rest, atol=1e-4)
