"""Colours by what other frames show: the weights as printed, what is seen, and that it can be learned."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import cameras
from avatarjax.gaussians import Gaussians
from avatarjax.smad import fusion
from avatarjax.smad.fusion import FusionConfig, Views

COUNT = 3
CONFIG = FusionConfig(attention=False, rho=0.1)
AHEAD = jnp.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def cloud():
    unit = jnp.tile(jnp.array([1.0, 0, 0, 0]), (COUNT, 1))
    return Gaussians(jnp.zeros((COUNT, 3)), jnp.zeros((COUNT, 3)), unit, jnp.zeros(COUNT), jnp.full((COUNT, 3), 0.2))


@pytest.fixture(scope="module")
def views():
    """From ahead and, 60 degrees further round, from the side; the last Gaussian is seen by none, the second by one."""
    colors = jnp.stack([jnp.full((COUNT, 3), 0.8), jnp.full((COUNT, 3), 0.5)])
    seen = jnp.array([[True, False, False], [True, True, False]])
    side = jnp.array([np.sin(np.pi / 3), 0.0, np.cos(np.pi / 3)], jnp.float32)
    return Views(colors, seen, jnp.stack([AHEAD, side]))


def test_views_count_by_their_confidence(cloud, views):
    params = fusion.init(CONFIG, jax.random.key(0))
    found = np.asarray(fusion.fuse(CONFIG, params, views, cloud, AHEAD).colors)[:, 0]
    side = np.exp(-(1 - 0.5) / (2 * 0.1))
    expected = [(0.2 + 0.8 + side * 0.5) / (2 + side), (0.2 + side * 0.5) / (1 + side), 0.2]
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    even = dataclasses.replace(CONFIG, confidence=False)
    found = np.asarray(fusion.fuse(even, params, views, cloud, AHEAD).colors)[:, 0]
    np.testing.assert_allclose(found, [0.5, 0.35, 0.2], rtol=1e-5)


def test_attention_chooses_among_views(cloud, views):
    config = FusionConfig(width=1, confidence=False)
    params = fusion.init(config, jax.random.key(0))
    # Queries ask for what is bright.
    params |= {"query": jnp.full((6, 1), 10.0), "key": jnp.eye(6)[:, :1] * 10, "own": jnp.asarray(-1e3)}
    found = np.asarray(fusion.fuse(config, params, views, cloud, AHEAD).colors)[:, 0]
    np.testing.assert_allclose(found, [0.8, 0.5, 0.2], atol=1e-3)


def test_a_view_shows_what_nothing_hides():
    camera = cameras.orbit(np.zeros(1), target=(0, 0, 0), distance=3.0, heights=0.0, width=32, height=32, fov_y=0.6)
    front, behind, outside = [0.03, 0.03, 0.2], [0.03, 0.03, -0.4], [0.5, 0.03, 0.0]
    means = jnp.asarray([[front, behind, outside]], jnp.float32)
    picture = np.zeros((1, 32, 32, 4), np.uint8)
    picture[0, 10:22, 10:22] = [255, 0, 51, 255]
    found = fusion.gather(means, jnp.asarray(0.05), jnp.asarray(picture), camera)
    np.testing.assert_array_equal(found.seen, [[True, False, False]])
    np.testing.assert_allclose(found.features[0, 0], [1, 0, 0.2], atol=1e-6)
    np.testing.assert_allclose(found.directions[0], AHEAD, atol=1e-6)


def test_numbers_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="rho 0"):
        FusionConfig(rho=0.0)
