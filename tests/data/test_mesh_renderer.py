"""The ground-truth renderer against the projection of the camera and known pictures."""

import jax.numpy as jnp
import numpy as np
import pytest

import avatarjax as aj
from avatarjax import cameras
from avatarjax.data.mesh_renderer import MeshRenderer, sample_texture

QUAD = np.array([[0, 1, 2], [0, 2, 3]])
QUAD_UVS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)[QUAD]


def project(camera, points):
    """Pixels (n, 2) of points (n, 3)."""
    return np.asarray(cameras.project(camera, jnp.asarray(points, jnp.float32))[0], np.float64)


def checker():
    return np.kron(np.array([[0, 255], [255, 0]], np.uint8), np.ones((8, 8), np.uint8))[..., None].repeat(3, 2)


@pytest.fixture
def camera():
    return cameras.look_at([0.4, 0.7, 3.0], [0.1, 0.1, 0.0], width=96, height=80)


@pytest.fixture
def square():
    return np.array([[-0.5, -0.4, 0.1], [0.6, -0.4, -0.1], [0.6, 0.5, 0], [-0.5, 0.5, 0.2]], np.float32)


def test_the_silhouette_is_the_projection_to_a_pixel(camera, square):
    image = MeshRenderer(QUAD, QUAD_UVS, checker()).render(square, camera)
    pixels = project(camera, square)
    rows, columns = np.nonzero(image[..., 3])
    assert abs(columns.min() - pixels[:, 0].min()) <= 1 and abs(columns.max() + 1 - pixels[:, 0].max()) <= 1
    assert abs(rows.min() - pixels[:, 1].min()) <= 1 and abs(rows.max() + 1 - pixels[:, 1].max()) <= 1


def test_a_small_triangle_lands_on_its_pixel(camera):
    centre = np.array([0.3, -0.2, 0.15])
    corners = (centre + 0.02 * np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]])).astype(np.float32)
    renderer = MeshRenderer(QUAD[:1], QUAD_UVS[:1], checker())
    image = renderer.render(corners, camera, supersample=8)[..., 3].astype(float)
    rows, columns = np.indices(image.shape) + 0.5
    seen = np.array([(columns * image).sum(), (rows * image).sum()]) / image.sum()
    want = project(camera, corners).mean(0)
    np.testing.assert_allclose(seen, want, atol=0.1)


def test_coverage_is_the_area_of_the_projection(camera, square):
    image = MeshRenderer(QUAD, QUAD_UVS, checker()).render(square, camera, supersample=4)
    x, y = project(camera, square).T
    area = abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2
    assert image[..., 3].sum() / 255 == pytest.approx(area, rel=0.01)


def test_pixels_that_see_nothing_are_all_zero(camera, square):
    image = MeshRenderer(QUAD, QUAD_UVS, checker()).render(square, camera)
    assert (image[image[..., 3] == 0] == 0).all()


def test_nearer_surfaces_hide_others(camera, square):
    black_and_white = np.zeros((4, 8, 3), np.uint8)
    black_and_white[:, 4:] = 255
    faces = np.concatenate([QUAD, QUAD + 4])
    uvs = np.concatenate([np.full((2, 3, 2), 0.1), np.full((2, 3, 2), 0.9)]).astype(np.float32)
    both = np.concatenate([square, square + np.array([0, 0, 0.3], np.float32)])
    image = MeshRenderer(faces, uvs, black_and_white).render(both, camera)
    x, y = project(camera, both[4:]).mean(0).astype(int)
    assert image[y, x, :3].min() > 100


def test_a_mesh_outside_the_view_gives_an_empty_picture(camera, square):
    image = MeshRenderer(QUAD, QUAD_UVS, checker()).render(square + np.array([50, 0, 0], np.float32), camera)
    assert image.shape == (80, 96, 4) and not image.any()


def test_texture_rows_run_down_from_v_one():
    texture = np.zeros((4, 4, 3), np.uint8)
    texture[0, 3] = 200
    np.testing.assert_allclose(sample_texture(texture, np.array([[0.875, 0.875]], np.float32)), [[200] * 3], atol=1)


def test_bilinear_lookup_is_half_way_between_texels():
    texture = np.zeros((2, 2, 3), np.uint8)
    texture[:, 1] = 100
    np.testing.assert_allclose(sample_texture(texture, np.array([[0.5, 0.5]], np.float32)), [[50] * 3], atol=0.2)


def test_vertices_that_are_not_finite_are_refused(camera, square):
    square[0, 0] = np.nan
    with pytest.raises(ValueError, match="finite"):
        MeshRenderer(QUAD, QUAD_UVS, checker()).render(square, camera)


def test_a_mesh_without_its_uvs_is_refused():
    with pytest.raises(ValueError, match="texture coordinates"):
        MeshRenderer(QUAD, QUAD_UVS[:1], checker())


def centre_of(weight):
    """Where the weight (h, w) of a picture lies, pixels."""
    rows, columns = np.indices(weight.shape) + 0.5
    return np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()


def off_centre(camera):
    """The camera with another principal point and pixels that are not square."""
    return camera.replace(intrinsics=camera.intrinsics.at[0, 2].add(-13.0).at[1, 2].add(7.0).at[0, 0].multiply(1.2))


@pytest.mark.parametrize("eye", [[0.4, 0.7, 3.0], [-2.5, 0.1, 1.0], [0.5, 1.5, -2.6]])
@pytest.mark.parametrize("change", [lambda camera: camera, off_centre], ids=["centred", "off centre"])
def test_splats_and_meshes_are_seen_by_the_same_camera(eye, change):
    """An octahedron and a Gaussian at the same place are within a tenth of a pixel of each other in the pictures."""
    camera = change(cameras.look_at(eye, [0.1, 0.1, 0.0], width=112, height=72))
    ends = 0.03 * np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
    faces = np.array([[x, y, z] for x in (0, 3) for y in (1, 4) for z in (2, 5)])
    renderer = MeshRenderer(faces, np.full((8, 3, 2), 0.5, np.float32), checker())
    for place in ([0.0, 0.0, 0.0], [0.3, -0.35, 0.2], [-0.4, 0.5, -0.3]):
        place = np.array(place, np.float32)
        mesh = renderer.render(ends + place[None], camera, supersample=6)[..., 3].astype(np.float64)
        gaussian = aj.Gaussians(
            means=jnp.asarray(place)[None],
            log_scales=jnp.full((1, 3), np.log(0.01)),
            quats=jnp.array([[1.0, 0, 0, 0]]),
            logit_opacities=jnp.array([4.0]),
            colors=jnp.ones((1, 3)),
        )
        splat = np.asarray(aj.render(gaussian, camera).alpha, np.float64)
        assert mesh.sum() > 255 and splat.sum() > 1
        assert np.linalg.norm(centre_of(mesh) - centre_of(splat)) < 0.1
