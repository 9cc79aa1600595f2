import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.nets import submanifold

SIDE = 7
ROOM = 60


@pytest.fixture(scope="module", params=[submanifold._TILE, 32], ids=["one tile", "tiles that overlap"])
def grid(request):
    """Half of the voxels of a small grid in a list with room to spare, features and kernels; the room not a multiple of
    the tile."""
    rng = np.random.default_rng(0)
    chosen = rng.choice(SIDE**3, 55, replace=False)
    voxel = np.zeros((ROOM, 3), np.int32)
    voxel[:55] = np.stack(np.unravel_index(chosen, (SIDE,) * 3), -1)
    x, kernel = rng.normal(size=(ROOM, 3)), rng.normal(size=(27, 3, 4))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(submanifold, "_TILE", request.param)
        yield jnp.asarray(voxel), jnp.asarray(55), jnp.asarray(x, jnp.float32), jnp.asarray(kernel, jnp.float32)


def test_neighbours_equal_a_loop_over_all_pairs(grid):
    voxel, count, *_ = grid
    found = submanifold.neighbours(voxel, count, SIDE)
    expected = np.full((ROOM, 27), ROOM)
    for i in range(int(count)):
        for k, step in enumerate(submanifold.STEPS):
            there = np.flatnonzero((np.asarray(voxel[: int(count)]) == np.asarray(voxel[i]) + step).all(1))
            expected[i, k] = there[0] if len(there) else ROOM
    np.testing.assert_array_equal(found, expected)


def dense(voxel, count, x, kernel):
    """The same on the whole grid with XLA's convolution, read where there are voxels."""
    at = tuple(voxel[: int(count)].T)
    image = jnp.zeros((1, SIDE, SIDE, SIDE, x.shape[1])).at[0, *at].set(x[: int(count)])
    numbers = ("NDHWC", "DHWIO", "NDHWC")
    y = jax.lax.conv_general_dilated(
        image, kernel.reshape(3, 3, 3, *kernel.shape[1:]), (1, 1, 1), "SAME", dimension_numbers=numbers
    )
    return jnp.zeros((len(x), kernel.shape[2])).at[: int(count)].set(y[0][at])


def sparse(voxel, count, x, kernel):
    return submanifold.convolve(x, kernel, submanifold.neighbours(voxel, count, SIDE), count)


def test_the_convolution_equals_a_dense_one(grid):
    np.testing.assert_allclose(sparse(*grid), dense(*grid), atol=1e-5)


def test_its_gradients_equal_a_dense_ones(grid):
    voxel, count, x, kernel = grid

    def gradients(convolution):
        return jax.grad(lambda x, w: jnp.sum(jnp.sin(convolution(voxel, count, x, w))), argnums=(0, 1))(x, kernel)

    found, expected = gradients(sparse), gradients(dense)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), found, expected)
    assert not np.any(found[0][int(count) :])


def test_many_clouds_at_once_equal_one_after_the_other(grid):
    voxel, count, x, kernel = grid
    counts = jnp.stack([count, count - 20])
    together = jax.jit(jax.vmap(sparse, (None, 0, None, None)))(voxel, counts, x, kernel)
    for one, n in zip(together, counts, strict=True):
        np.testing.assert_allclose(one, sparse(voxel, n, x, kernel), atol=1e-5)
