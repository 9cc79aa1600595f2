import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from avatarjax.nets import blocks
from tests.parameters import random_module


def dense(layer, x):
    out = x @ np.asarray(layer.kernel[...], np.float64)
    return out if layer.bias is None else out + np.asarray(layer.bias[...], np.float64)


def softmax(x):
    e = np.exp(x - x.max(-1, keepdims=True))
    return e / e.sum(-1, keepdims=True)


def attention_by_hand(module, x, context):
    x, context = np.asarray(x, np.float64), np.asarray(context, np.float64)
    q, k, v = dense(module.query, x), dense(module.key, context), dense(module.value, context)
    width = q.shape[-1] // module.heads
    heads = []
    for h in range(module.heads):
        part = slice(h * width, (h + 1) * width)
        weight = softmax(q[..., part] @ k[..., part].swapaxes(-1, -2) / np.sqrt(width))
        heads.append(weight @ v[..., part])
    return dense(module.out, np.concatenate(heads, -1))


def test_sinusoidal_embedding_is_the_formula():
    positions = np.array([0.0, 1.0, 17.5, 999.0])
    got = blocks.sinusoidal_embedding(jnp.asarray(positions, jnp.float32), 8)
    angles = positions[:, None] * 10_000.0 ** (-np.arange(4) / 4)[None]
    np.testing.assert_allclose(got, np.concatenate([np.cos(angles), np.sin(angles)], -1), atol=1e-4)


def test_doubling_repeats_every_pixel(key):
    x = jax.random.normal(key, (2, 3, 5, 4))
    np.testing.assert_array_equal(blocks.double(x), np.repeat(np.repeat(x, 2, 1), 2, 2))


@pytest.mark.parametrize("kernel, stride", [(3, 1), (1, 1), (3, 2)])
def test_convolutions_divide_the_image_by_their_stride(key, kernel, stride):
    conv = blocks.conv(2, 6, rngs=nnx.Rngs(0), kernel=kernel, stride=stride)
    assert conv(jnp.zeros((1, 8, 12, 2))).shape == (1, 8 // stride, 12 // stride, 6)


@pytest.mark.parametrize("heads", [1, 2, 4])
def test_self_attention_is_softmax_attention(key, heads):
    module = random_module(lambda: blocks.Attention(8, heads, rngs=nnx.Rngs(1)))
    x = 3 * jax.random.normal(key, (2, 5, 8))
    np.testing.assert_allclose(module(x), attention_by_hand(module, x, x), atol=1e-5)


def test_cross_attention_is_softmax_attention_over_the_context(key):
    module = random_module(lambda: blocks.Attention(8, 2, 3, rngs=nnx.Rngs(1)))
    a, b = jax.random.split(key)
    x, context = 3 * jax.random.normal(a, (2, 5, 8)), 3 * jax.random.normal(b, (2, 7, 3))
    np.testing.assert_allclose(module(x, context), attention_by_hand(module, x, context), atol=1e-5)


def test_one_context_token_reaches_all_tokens_alike(key):
    module = random_module(lambda: blocks.Attention(8, 2, 3, rngs=nnx.Rngs(1)))
    out = module(jax.random.normal(key, (1, 5, 8)), jnp.ones((1, 1, 3)))
    np.testing.assert_allclose(out, jnp.broadcast_to(out[:, :1], out.shape), atol=1e-6)


def test_feed_forward_is_the_gated_formula(key):
    module = random_module(lambda: blocks.FeedForward(4, 3, rngs=nnx.Rngs(0)))
    x = jax.random.normal(key, (1, 6, 4))
    up = dense(module.up, np.asarray(x, np.float64))
    value, gate = up[..., :12], up[..., 12:]
    gelu = 0.5 * gate * (1 + np.tanh(np.sqrt(2 / np.pi) * (gate + 0.044715 * gate**3)))
    np.testing.assert_allclose(module(x), dense(module.down, value * gelu), atol=1e-5)


class TestResidualBlock:
    @staticmethod
    def without_second_convolution(outputs):
        block = random_module(lambda: blocks.ResidualBlock(16, outputs, rngs=nnx.Rngs(0)))
        block.conv2.kernel[...] = jnp.zeros((3, 3, outputs, outputs))
        block.conv2.bias[...] = jnp.zeros(outputs)
        return block

    def test_without_its_second_convolution_it_is_the_identity(self, key):
        x = jax.random.normal(key, (2, 4, 4, 16))
        np.testing.assert_array_equal(jax.jit(self.without_second_convolution(16))(x), x)

    def test_other_widths_pass_through_a_linear_skip(self, key):
        block = self.without_second_convolution(24)
        x = jax.random.normal(key, (2, 4, 4, 16))
        linear = np.asarray(x) @ np.asarray(block.skip.kernel[...])[0, 0] + np.asarray(block.skip.bias[...])
        np.testing.assert_allclose(jax.jit(block)(x), linear, atol=1e-5)

    def test_each_sample_gets_its_own_embedding(self, key):
        block = jax.jit(random_module(lambda: blocks.ResidualBlock(16, 16, 6, rngs=nnx.Rngs(0))))
        x = jnp.asarray(np.repeat(jax.random.normal(key, (1, 4, 4, 16)), 2, axis=0))
        embedding = jnp.asarray([[0.0] * 6, [5.0] * 6])
        out = np.asarray(block(x, embedding))
        assert np.abs(out[0] - out[1]).max() > 1e-2
        np.testing.assert_allclose(block(x, embedding[::-1]), out[::-1], atol=1e-5)


def test_octaves_are_the_coordinates_and_waves_of_halving_periods():
    x = np.array([[0.25, -0.5]], np.float32)
    angles = np.concatenate([np.pi * x, 2 * np.pi * x], axis=1)
    expected = np.concatenate([x, np.sin(angles), np.cos(angles)], axis=1)
    np.testing.assert_allclose(blocks.octaves(jnp.asarray(x), 2), expected, atol=1e-6)
