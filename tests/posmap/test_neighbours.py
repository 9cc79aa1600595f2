import jax
import jax.numpy as jnp
import numpy as np

from avatarjax import posmap
from avatarjax.posmap.neighbours import SELF, STEPS


def test_neighbours_lie_beside_each_other_in_one_view(atlas):
    found = posmap.neighbours(atlas)
    count = len(atlas.rows)
    place = np.stack([atlas.rows, atlas.cols], -1)
    view = np.full((32, 32), -1)
    for k, w in enumerate(posmap.windows(32)):
        view[w.row : w.row + w.height, w.col : w.col + w.width] = k
    mask = np.asarray(atlas.mask)
    assert found.shape == (count, 9) and (found[:, SELF] == np.arange(count)).all()
    for k, step in enumerate(STEPS):
        beside = place + np.array(step)
        inside = ((beside >= 0) & (beside < 32)).all(1)
        clipped = tuple(np.clip(beside, 0, 31).T)
        expected = inside & mask[clipped] & (view[clipped] == view[tuple(place.T)])
        np.testing.assert_array_equal(found[:, k] < count, expected)
        np.testing.assert_array_equal(place[found[expected, k]], beside[expected])


def test_values_around_a_texel_are_its_neighbours(atlas):
    beside = posmap.neighbours(atlas)
    values = jnp.arange(1.0, 1 + len(beside))[:, None]
    found = np.asarray(posmap.around(jnp.asarray(beside), values))[..., 0]
    np.testing.assert_array_equal(found, np.where(beside < len(beside), beside + 1, 0))


def test_a_convolution_is_a_linear_layer_over_neighbourhoods_and_so_are_its_gradients(atlas):
    beside = jnp.asarray(posmap.neighbours(atlas))
    keys = jax.random.split(jax.random.key(0), 3)
    values, kernel = jax.random.normal(keys[0], (len(beside), 3)), jax.random.normal(keys[1], (9, 3, 5))
    weight = jax.random.normal(keys[2], (len(beside), 5))

    def gathered(values, kernel):
        return posmap.around(beside, values).reshape(len(values), -1) @ kernel.reshape(-1, 5)

    def convolved(values, kernel):
        return posmap.convolve(beside, values, kernel)

    with jax.default_matmul_precision("highest"):
        np.testing.assert_allclose(convolved(values, kernel), gathered(values, kernel), atol=1e-5)
        found, expected = (
            jax.grad(lambda *x, f=f: jnp.sum(weight * f(*x)), argnums=(0, 1))(values, kernel)
            for f in (convolved, gathered)
        )
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-4)
