import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import posmap, rotations


def test_maps_and_texels_round_trip_whatever_the_background(atlas, key):
    texels = jax.random.uniform(key, atlas.reference.shape)
    for background in (0.0, 0.5, -1.0):
        picture = posmap.to_map(atlas, texels, background)
        np.testing.assert_array_equal(posmap.from_map(atlas, picture), texels)
        assert (np.asarray(picture)[~np.asarray(atlas.mask)] == background).all()


def test_encode_under_vmap_equals_a_loop(figure, atlas, key):
    frames = jnp.asarray(figure[0])[None] + jax.random.normal(key, (3, 1, 3))
    batched = jax.vmap(lambda v: posmap.encode(atlas, v))(frames)
    for one, frame in zip(batched, frames, strict=True):
        np.testing.assert_allclose(one, posmap.encode(atlas, frame), atol=1e-6)


def test_group_normalisation_is_the_papers_formula(atlas, key):
    group = atlas.reference[None] + jax.random.normal(key, (4, 1, 3))
    normalised, origin = posmap.normalize_group(atlas, group)
    np.testing.assert_allclose(origin, posmap.root(atlas, group[2]), atol=1e-6)
    np.testing.assert_allclose(posmap.root(atlas, normalised[2]), 0.5, atol=1e-5)
    step = normalised[3] - normalised[2]
    np.testing.assert_allclose(step, atlas.scale * (group[3] - group[2]), atol=1e-5)


def test_normalisation_round_trips(atlas, key):
    origin = jax.random.normal(key, (3,))
    there = posmap.normalize(atlas, atlas.reference, origin)
    np.testing.assert_allclose(posmap.denormalize(atlas, there, origin), atlas.reference, atol=1e-5)


@pytest.mark.parametrize("degrees", [-170, -90, -10, 0, 45, 90, 179])
def test_heading_of_a_turned_figure_is_the_turn(atlas, degrees):
    yaw = jnp.asarray(np.deg2rad(degrees), jnp.float32)
    turned = atlas.reference @ rotations.yaw_matrix(yaw).T + jnp.array([[3.0, 0.0, -2.0]])
    assert float(posmap.heading(atlas, turned)) == pytest.approx(float(yaw), abs=1e-4)
