"""The scenes of the benchmarks are what they say, and the pieces of benchmarks/splat.py work on a tiny scene."""

import math

import jax
import numpy as np
import pytest

from avatarjax import Gaussians, rotations
from benchmarks import floor, scenes, splat, splat_contenders, timing

CLOUDS = [scenes.body_cloud, scenes.needle_cloud]
TINY = splat_contenders.Scene("body", 300, 32)


@pytest.mark.parametrize("cloud", CLOUDS)
def test_clouds_are_finite_and_of_opacity_09(cloud):
    gaussians = cloud(500)
    assert len(gaussians) == 500
    assert all(np.isfinite(x).all() and x.dtype == np.float32 for x in jax.tree.leaves(gaussians))
    np.testing.assert_allclose(gaussians.opacities, 0.9, rtol=1e-6)
    assert gaussians.colors.min() >= 0 and gaussians.colors.max() <= 1


@pytest.mark.parametrize("cloud", CLOUDS)
def test_clouds_follow_from_their_seed(cloud):
    same = zip(jax.tree.leaves(cloud(200, seed=3)), jax.tree.leaves(cloud(200, seed=3)), strict=True)
    assert all(np.array_equal(a, b) for a, b in same)
    assert not np.array_equal(cloud(200, seed=3).means, cloud(200, seed=4).means)


def test_body_covers_its_surface_once():
    """In the geometric mean, since the sizes are jittered: 2.255 square metres of capsules, 1.8 m high."""
    gaussians = scenes.body_cloud(20_000)
    mean_area = np.exp(np.mean(gaussians.log_scales[:, 0] + gaussians.log_scales[:, 1]))
    assert 20_000 * mean_area == pytest.approx(2.255, rel=0.01)
    assert float(np.ptp(gaussians.means[:, 1])) == pytest.approx(1.8, abs=0.01)
    np.testing.assert_allclose(np.median(gaussians.scales[:, 2] / gaussians.scales[:, 0]), 0.3, rtol=0.02)


def test_body_gaussians_lie_flat_on_the_surface():
    """On the trunk's side the third axis is horizontal and points away from its middle."""
    gaussians = scenes.body_cloud(5_000)
    means = np.asarray(gaussians.means)
    side = (np.abs(np.hypot(means[:, 0], means[:, 2]) - 0.15) < 1e-4) & (np.abs(means[:, 1] - 1.1) < 0.14)
    normals = np.asarray(rotations.to_matrix(gaussians.quats)[..., 2])
    assert side.sum() > 100
    np.testing.assert_allclose(normals[side] * 0.15, means[side] * [1, 0, 1], atol=1e-5)


def test_needles_are_twelve_times_as_long_as_wide_at_the_same_place_and_area():
    body, needles = scenes.body_cloud(500), scenes.needle_cloud(500)
    np.testing.assert_array_equal(needles.means, body.means)
    longer = needles.scales / body.scales
    np.testing.assert_allclose(longer, np.tile([math.sqrt(12), 1 / math.sqrt(12), 1], (500, 1)), rtol=1e-5)
    axes, body_axes = (np.asarray(rotations.to_matrix(x.quats)) for x in (needles, body))
    np.testing.assert_allclose(axes[..., 2], body_axes[..., 2], atol=1e-6)
    # Directions of lines are spread evenly where the mean of the doubled angle's cosine and sine is zero.
    angle = np.arctan2(*(np.sum(axes[..., 0] * body_axes[..., k], axis=1) for k in (1, 0)))
    assert abs(np.mean(np.exp(2j * angle))) < 0.1


def test_camera_sees_the_whole_figure():
    camera = scenes.body_camera(64)
    means = scenes.body_cloud(2_000).means @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[None, :3, 3]
    pixels = np.asarray(means @ camera.intrinsics.T)
    pixels = pixels[:, :2] / pixels[:, 2:]
    assert pixels.min() > 0 and pixels.max() < 64
    assert np.ptp(pixels[:, 1]) == pytest.approx(0.9 * 64, rel=0.05)


@pytest.fixture(scope="module")
def picture():
    return splat_contenders.ours(TINY).image()


@pytest.mark.parametrize("make", [splat_contenders.prototype, splat_contenders.naive])
def test_contenders_draw_our_picture(make, picture):
    # The prototype is older than the house rule about ranks.
    with jax.numpy_rank_promotion("allow"):
        np.testing.assert_allclose(make(TINY).image(), picture, atol=1e-4)


def test_torch_draws_our_picture_and_gradient():
    pytest.importorskip("torch")
    from benchmarks import splat_torch

    cloud, camera = TINY.make()
    renderer = splat_torch.Renderer(cloud, camera)
    ours = splat_contenders.ours(TINY)
    np.testing.assert_allclose(renderer.image().numpy(), ours.image(), atol=2e-4)
    wanted: Gaussians = ours.backward()[1]  # pyright: ignore[reportIndexIssue]
    fields = ("means", "log_scales", "quats", "logit_opacities", "colors")
    for name, gradient in zip(fields, renderer.gradient(TINY.weights()), strict=True):
        scale = np.abs(getattr(wanted, name)).max()
        np.testing.assert_allclose(gradient.numpy(), getattr(wanted, name), atol=1e-3 * scale)


def test_too_large_a_scene_is_refused_by_the_naive_renderer():
    with pytest.raises(timing.Unavailable, match="too large"):
        splat_contenders.naive(splat_contenders.Scene("body", *scenes.SIZES[1]))


def test_a_contender_is_prepared_and_timed():
    calls = []
    contender = timing.Contender(lambda: calls.append("f"), lambda: calls.append("b"), lambda: np.zeros((1, 1, 3)))
    prepared = contender.prepare(timing.FORWARD)
    assert prepared.compile >= 0
    times = contender.burst(timing.BACKWARD, 4, limit=1.0)
    assert len(times) == 4 and all(t >= 0 for t in times)
    assert calls == ["f"] + ["b"] * 5
    assert len(contender.burst(timing.FORWARD, 4, limit=0.0)) == 1


def test_table_says_ratios_and_what_is_missing():
    prepared = {which: timing.Prepared(1.0, 2_000_000) for which in (timing.FORWARD, timing.BACKWARD)}
    counts = {"intersections": 10_000, "dropped": 0}

    def result(milliseconds):
        times = {which: [1e-3 * milliseconds] * 3 for which in (timing.FORWARD, timing.BACKWARD)}
        return splat.Result(times, prepared, counts)

    results = {"ours": result(5), "ours, two devices": result(4), "prototype": result(10), "naive": "too large"}
    scene = splat_contenders.Scene("body", *scenes.SIZES[2])
    lines = list(splat.table(scene, results, dict.fromkeys(results, 0.0), {1: 1e9, 2: 2e9}))
    assert "10,000 intersections" in lines[0]
    assert "0.50" in lines[2] and "0.40" in lines[3] and "1.00" in lines[4] and "too large" in lines[5]
    assert "two devices: 0.40, reached" in lines[-1]


def test_floor_counts_operations_of_all_pairs():
    seconds = splat.floor_seconds(intersections=1000, flops=1e9)
    assert seconds[timing.FORWARD] == pytest.approx(1000 * 32 * sum(floor.FORWARD_FLOPS.values()) / 1e9)
    assert sum(floor.FORWARD_FLOPS.values()) == pytest.approx(45, abs=5)
    assert sum(floor.BACKWARD_FLOPS.values()) == pytest.approx(65, abs=5)


def test_floor_kernel_runs():
    assert np.isfinite(floor._kernel(1)()).all()
