"""Rollouts from true frames: they start where the recording is, and answer its keys."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import posmap
from avatarjax.unica import forecast
from avatarjax.unica.rollout import reset, rollout


def test_three_standing_frames_are_the_reset_state(avatar, key):
    root = np.asarray(posmap.root(avatar.atlas, avatar.standing))
    texels = np.broadcast_to(np.asarray(avatar.standing) - root, (3, *avatar.standing.shape))
    state = forecast.state_at(avatar, texels, np.broadcast_to(root, (3, 3)), key)
    for found, expected in zip(
        jax.tree.leaves((state.context, state.offset)),
        jax.tree.leaves((reset(avatar, key).context, reset(avatar, key).offset)),
        strict=True,
    ):
        np.testing.assert_allclose(found, expected, atol=1e-5)


def test_it_is_the_rollout_from_that_state(avatar, tiny_data, key):
    recording = tiny_data.held_out
    texels, roots = forecast.forecast(avatar, recording, np.array([10]), 3, key)
    assert texels.shape == (1, 3, *recording.texels.shape[1:])
    state = forecast.state_at(avatar, recording.texels[10:13], recording.roots[10:13], jax.random.split(key, 1)[0])
    frames = rollout(avatar, state, jnp.asarray(recording.actions[12:15]), gaussians=False)[1]
    np.testing.assert_allclose(roots[0], frames.root, atol=1e-4)
    np.testing.assert_allclose(texels[0], forecast.surfaces(avatar.atlas, frames), atol=1e-4)


def test_surfaces_are_relative_to_their_own_roots(avatar, tiny_data, key):
    texels, _ = forecast.forecast(avatar, tiny_data.held_out, np.array([0]), 2, key)
    np.testing.assert_allclose(np.einsum("t,sftc->sfc", avatar.atlas.waist, texels), 0, atol=1e-4)


def test_it_does_not_matter_where_in_the_world_a_recording_lies(avatar, tiny_data, key):
    recording = tiny_data.held_out
    moved = recording.replace(roots=recording.roots + np.array([5.0, 0.0, -3.0], np.float32))
    here = forecast.forecast(avatar, recording, np.array([20]), 2, key)
    there = forecast.forecast(avatar, moved, np.array([20]), 2, key)
    np.testing.assert_allclose(there[0], here[0], atol=1e-3)
    np.testing.assert_allclose(there[1] - np.array([5.0, 0.0, -3.0]), here[1], atol=1e-3)


def test_a_sequence_that_ends_too_early_is_refused(avatar, tiny_data, key):
    with pytest.raises(ValueError, match="no 63 frames of one sequence"):
        forecast.forecast(avatar, tiny_data.held_out, np.array([0]), 60, key)
