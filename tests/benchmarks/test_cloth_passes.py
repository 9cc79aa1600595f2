"""The passes that benchmarks/cloth.py times do the same work."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.physics.cloth import Fabric, sew
from benchmarks import cloth as benchmark


@pytest.fixture(scope="module")
def sheet():
    row, column = np.mgrid[:6, :6]
    vertices = (np.stack([column, 20 - row, 0 * row], axis=-1).reshape(-1, 3) * 0.05).astype(np.float32)
    corner = (np.arange(5)[:, None] * 6 + np.arange(5)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 6, corner + 1], 1), np.stack([corner + 1, corner + 6, corner + 7], 1)]
    )
    reach = np.r_[np.zeros(6), np.ones(30)].astype(np.float32)
    uvs = (vertices[:, :2])[faces]
    none, far = np.zeros((0, 2), np.int32), np.ones(36, np.float32)
    sewn = sew(vertices, faces, uvs, np.zeros(len(faces), np.int32), (Fabric(),), reach, none, far)
    return jax.tree.map(jnp.asarray, sewn)


def test_numpy_colour_after_colour_gives_the_same_positions(sheet):
    start, made = benchmark.strained(sheet), benchmark.passes(sheet)
    np.testing.assert_allclose(made.colours(start), made.ours(start), atol=1e-5)


def test_every_method_lessens_the_strain_and_ours_does_most(sheet):
    start, made = benchmark.strained(sheet), benchmark.passes(sheet)
    left = {name: benchmark.strain(sheet, work(start)) for name, work in made._asdict().items()}
    assert left["ours"] < left["jacobi"] < benchmark.strain(sheet, start)


def test_the_pattern_has_no_strain(sheet):
    assert benchmark.strain(sheet, np.asarray(sheet.rest)) < 1e-6
