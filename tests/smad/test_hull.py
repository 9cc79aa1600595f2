"""The visual hull of things of known shape: what it holds, how close it lies, its colours, and what is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import cameras, splat
from avatarjax.smad import hull, views
from avatarjax.smad.hull import HullConfig
from tests.smad import turning

CONFIG = HullConfig(resolution=40, fraction=1.0, gaussians=1500)
RADII = np.array([0.35, 0.6, 0.2])


@pytest.fixture(scope="module")
def film():
    return turning.video()


def carve(film, config=CONFIG):
    every = np.arange(len(film))
    return hull.carve(film.masks, views.of_video(film, every), config)


@pytest.fixture(scope="module")
def carved(film):
    return carve(film)


def centres(carved):
    return np.asarray(carved.grid.centres), np.asarray(carved.occupied).reshape(-1)


def test_an_ellipsoid_is_inside_of_its_hull(carved):
    points, occupied = centres(carved)
    # What lies a voxel below the surface: a pixel is foreground where the ray of its middle hits.
    inside = np.linalg.norm(points / (RADII - float(carved.grid.edge)), axis=1) < 1
    assert inside.sum() > 1000 and occupied[inside].all()


def test_the_hull_lies_within_a_voxel_of_an_ellipsoid(carved):
    """Seen from all around, slightly from above: a hull fits tightly all over but at the poles."""
    points, _ = hull.shell(carved)
    below = points[np.abs(points[:, 1]) < 0.4]
    edge = float(carved.grid.edge)
    outside = np.linalg.norm(below / (RADII + 1.5 * edge), axis=1)
    assert (outside < 1).mean() > 0.97
    assert (np.linalg.norm(below / (RADII - 2 * edge), axis=1) > 1).all()


def test_a_box_has_a_flat_faced_hull():
    carved = carve(turning.video(turning.box, frames=36))
    points, occupied = centres(carved)
    edge = float(carved.grid.edge)
    half = np.array([0.3, 0.5, 0.25])
    middle = np.abs(points[:, 1]) < 0.3
    inside = (np.abs(points) < half - edge).all(1)
    outside = (np.abs(points[:, [0, 2]]) > half[[0, 2]] + 1.5 * edge).any(1) & middle
    assert occupied[inside].all() and not occupied[outside].any()


def test_the_grid_shrinks_to_what_is_there(carved):
    low, high = np.asarray(carved.grid.low), np.asarray(carved.grid.high)
    assert (low < -RADII).all() and (high > RADII).all()
    assert (low > -RADII - 0.4).all() and (high < RADII + 0.4).all()


def test_normals_point_out_of_an_ellipsoid(carved):
    points, normals = hull.shell(carved)
    expected = points / RADII**2
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-4)
    assert np.median((normals * expected).sum(1)) > 0.95


def test_colours_are_those_of_the_thing(film):
    cloud = hull.initialise(film, CONFIG)
    x = np.asarray(cloud.means)[:, 0]
    for side, color in ((x > 0.05, turning.RED), (x < -0.05, turning.BLUE)):
        assert side.sum() > 200
        assert np.abs(np.asarray(cloud.colors)[side] - color / 255).max(1).mean() < 0.03


def sheet(half, count, z):
    """Points of a square about the z axis."""
    line = np.linspace(-half, half, count)
    return np.stack([*np.meshgrid(line, line), np.full((count, count), z)], -1).reshape(-1, 3)


def test_hidden_points_do_not_take_the_colour_of_what_hides_them():
    """A white square stands before a larger blue one."""
    camera = jax.tree.map(lambda x: x[None], cameras.look_at((0, 0, 3), (0, 0, 0), width=64, height=64))
    front, behind = sheet(0.3, 30, 0.5), sheet(0.6, 60, 0.0)
    reach = 0.3 / 2.5 * float(camera.intrinsics[0, 0, 0])
    v, u = np.abs(np.mgrid[:64, :64] + 0.5 - 32)
    picture = np.where(((u < reach) & (v < reach))[..., None], [255, 255, 255], [0, 0, 255]).astype(np.uint8)
    points = np.concatenate([front, behind])
    normals = np.tile([0.0, 0, 1], (len(points), 1))
    colors = hull.paint(points, normals, 0.02, [picture], np.ones((1, 64, 64), bool), camera)
    covered = np.abs(behind[:, :2]).max(1) < 0.3
    np.testing.assert_allclose(colors[: len(front)][np.abs(front[:, :2]).max(1) < 0.28], 1, atol=1e-6)
    assert covered.sum() > 500
    np.testing.assert_allclose(colors[len(front) :][covered], np.tile([0, 0, 1], (covered.sum(), 1)), atol=1e-6)


def test_the_cloud_looks_like_the_thing(film):
    cloud = hull.initialise(film, CONFIG)
    seen = views.of_video(film, np.array([0, 7]))
    for k, frame in enumerate((0, 7)):
        camera = jax.tree.map(lambda x, k=k: x[k], seen)
        drawn = splat.render(cloud, camera, background=jnp.full(3, 230 / 255))
        assert splat.l1(drawn.image, jnp.asarray(film.images()[frame] / 255, jnp.float32)) < 0.03
        assert np.abs(np.asarray(drawn.alpha) - film.masks[frame]).mean() < 0.05


def test_most_silhouettes_are_enough_for_what_moves():
    film = turning.video(sway=0.06)
    strict, loose = (carve(film, dataclasses.replace(CONFIG, fraction=f)) for f in (1.0, 0.7))
    volume = [np.asarray(c.occupied).sum() * float(c.grid.edge) ** 3 for c in (strict, loose)]
    true = 4 / 3 * np.pi * RADII.prod()
    assert volume[0] < 0.8 * true < volume[1]


def test_a_camera_for_each_frame_gives_the_same_hull(film, carved):
    np.testing.assert_array_equal(carve(turning.moving_camera(film)).occupied, carved.occupied)


def test_wrong_input_is_refused(film):
    seen = views.of_video(film, np.arange(len(film)))
    with pytest.raises(ValueError, match="all 24 masks are empty"):
        hull.carve(np.zeros_like(film.masks), seen, CONFIG)
    with pytest.raises(ValueError, match=r"masks have shape \(24, 32, 64\), the cameras' pictures \(24, 64, 64\)"):
        hull.carve(film.masks[:, :32], seen, CONFIG)
    with pytest.raises(ValueError, match=r"masks have shape \(5, 64, 64\)"):
        hull.carve(film.masks[:5], seen, CONFIG)
    with pytest.raises(ValueError, match="lies in 100% of the silhouettes"):
        hull.carve(film.masks, seen, dataclasses.replace(CONFIG, box=((2.0, 2.0, 2.0), (3.0, 3.0, 3.0))))
    with pytest.raises(ValueError, match=r"fraction 0.0 must lie in \(0, 1\]"):
        HullConfig(fraction=0.0)
    with pytest.raises(ValueError, match="gaussians is 3"):
        HullConfig(gaussians=3)
