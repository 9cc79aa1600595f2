"""Linear yardsticks of dynamics: what each can and cannot know of a cloth that follows poses late."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.smad import dynamics, graph, linear, preset, train_dynamics
from avatarjax.smad.driving import Pose
from avatarjax.smad.train_dynamics import Take

CONFIG = dynamics.sized(preset("ci"), 1)
POINTS = np.random.default_rng(0).normal(size=(12, 3)) * 0.3
FRAMES, LATE = 90, 9


def following(seed):
    """A root that goes up and down, and nodes that are moved by its height some frames ago: fewer than a window spans,
    and more than it would if it were not spread out."""
    rng = np.random.default_rng(seed)
    t = np.arange(FRAMES) / 30
    height = 0.2 * sum(np.sin(f * t + p) for f, p in zip(rng.uniform(2, 6, 3), rng.uniform(0, 6, 3), strict=True))
    height = height - height[0]
    path = np.stack([0 * t, height, 0 * t], axis=1)
    before = height[np.maximum(np.arange(FRAMES) - LATE, 0)]
    positions = POINTS + np.array([0.3, 0.0, 0.1]) + before[:, None, None] * POINTS[:, ::-1]
    eye = jnp.eye(3)
    poses = Pose(jnp.tile(eye, (FRAMES, 1, 1, 1)), jnp.tile(eye, (FRAMES, 1, 1)), jnp.asarray(path, jnp.float32))
    return Take(poses, jnp.asarray(positions, jnp.float32))


TAKES = [following(seed) for seed in range(3)]
UNSEEN = following(9)
SYSTEM = train_dynamics.fit_system(CONFIG, graph.build(POINTS, 4), None, TAKES)
RECORDED = train_dynamics.record(CONFIG, SYSTEM, TAKES)


def fit(recorded, **options):
    return linear.fit(recorded.offsets, recorded.features, recorded.first, **options)


def rollout(model):
    surface = dynamics.surfaces(SYSTEM, UNSEEN.poses)
    return surface + jax.jit(linear.rollout)(model, dynamics.pose_features(CONFIG, SYSTEM, UNSEEN.poses))


def error(**options):
    found = rollout(fit(RECORDED, **options))
    return float(jnp.sqrt(jnp.mean((found - UNSEEN.positions)[20:] ** 2)))


def test_the_mean_drape_is_the_mean_offset():
    model = fit(RECORDED, components=0)
    np.testing.assert_allclose(model.mean, np.asarray(RECORDED.offsets).mean(0), atol=1e-6)
    found = rollout(model)
    np.testing.assert_allclose(found, np.broadcast_to(POINTS + np.asarray(model.mean), found.shape), atol=1e-5)


def test_regression_knows_what_its_window_spans():
    spanned = error(components=1, window=6, stride=2, ridge=1e-5)
    assert spanned < 0.05 * error(components=0)
    assert error(components=1, window=2, stride=1, ridge=1e-5) > 3 * spanned


def test_a_state_space_remembers_what_its_window_does_not_span():
    short = {"components": 1, "window": 2, "stride": 1, "ridge": 1e-6}
    assert error(lags=2, **short) < 0.8 * error(**short)


def test_a_take_knows_nothing_of_the_take_before():
    alone = train_dynamics.record(CONFIG, SYSTEM, TAKES[:1])
    twice = train_dynamics.record(CONFIG, SYSTEM, [TAKES[0], TAKES[0]])
    one, two = (fit(r, components=1, ridge=1e-3) for r in (alone, twice))
    np.testing.assert_allclose(two.weights, one.weights, rtol=1e-3, atol=1e-5)


def test_poses_like_none_before_move_little_further_than_any():
    model = fit(RECORDED, components=1)
    window = jnp.full((model.window, RECORDED.features.shape[1]), 50.0)
    far = np.abs(np.tensordot(np.asarray(RECORDED.offsets) - model.mean[None], model.basis[0], 2)).max()
    np.testing.assert_allclose(model.reach, far, rtol=1e-5)
    moved = linear.predict(model, window, jnp.zeros((0, 1)))
    np.testing.assert_allclose(np.abs(moved), linear.REACH * far, rtol=1e-5)


def test_more_components_than_frames_are_refused():
    with pytest.raises(ValueError, match="270"):
        fit(RECORDED, components=271)
