import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.nets import serialization


def full_grid(bits):
    axis = np.arange(1 << bits)
    return jnp.asarray(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3), jnp.int32)


@pytest.mark.parametrize("bits", [1, 4, 10])
def test_z_order_interleaves_the_bits(key, bits):
    voxel = jax.random.randint(key, (40, 3), 0, 1 << bits)
    voxel = voxel.at[0].set((1 << bits) - 1)
    expected = []
    for x, y, z in np.asarray(voxel):
        digits = zip(*(format(v, f"0{bits}b") for v in (x, y, z)), strict=True)
        expected.append(int("".join("".join(triple) for triple in digits), 2))
    np.testing.assert_array_equal(serialization.codes(voxel, bits, "z"), expected)


@pytest.mark.parametrize("bits", [1, 2, 3])
@pytest.mark.parametrize("curve", serialization.CURVES)
def test_every_curve_visits_every_voxel_once(bits, curve):
    codes = serialization.codes(full_grid(bits), bits, curve)
    np.testing.assert_array_equal(np.sort(codes), np.arange(8**bits))


@pytest.mark.parametrize("bits", [1, 2, 3])
@pytest.mark.parametrize("curve", ["hilbert", "hilbert-trans"])
def test_a_hilbert_curve_walks_from_face_to_face(bits, curve):
    grid = full_grid(bits)
    path = np.asarray(grid)[np.argsort(serialization.codes(grid, bits, curve))]
    np.testing.assert_array_equal(np.abs(np.diff(path, axis=0)).sum(1), 1)


@pytest.mark.parametrize("curve", serialization.CURVES)
def test_without_its_last_three_bits_a_code_is_that_of_the_voxel_twice_as_wide(key, curve):
    voxel = jax.random.randint(key, (100, 3), 0, 64)
    np.testing.assert_array_equal(serialization.codes(voxel, 6, curve) >> 3, serialization.codes(voxel >> 1, 5, curve))


@pytest.mark.parametrize("curve", ["z", "hilbert"])
def test_the_transposed_curve_swaps_x_and_y(key, curve):
    voxel = jax.random.randint(key, (50, 3), 0, 32)
    np.testing.assert_array_equal(
        serialization.codes(voxel, 5, f"{curve}-trans"), serialization.codes(voxel[:, jnp.array([1, 0, 2])], 5, curve)
    )


def test_points_fall_into_their_voxels_and_outsiders_into_the_border():
    points = jnp.array([[0.0, 0.5, 0.999], [1.0, -3.0, 7.0], [0.249, 0.25, 0.26]])
    np.testing.assert_array_equal(serialization.voxels(points, 4), [[0, 2, 3], [3, 0, 3], [0, 1, 1]])
