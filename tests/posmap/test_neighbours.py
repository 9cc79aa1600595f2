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
