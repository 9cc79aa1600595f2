import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avatarjax.data import avatars, dataset, skinning
from avatarjax.metrics import joints


@pytest.fixture(scope="module")
def known():
    """Points that move freely, joints made of them with known weights, and the regressor fitted to both."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(60, 12, 3))
    weights = rng.dirichlet(np.ones(12), size=4)
    truth = np.einsum("jt,ntc->njc", weights, points)
    return points, truth, weights, joints.fit(points, truth, nearest=12, ridge=1e-9)


def test_known_weights_are_found(known):
    _, _, weights, fitted = known
    np.testing.assert_allclose(
        np.take_along_axis(weights, np.asarray(fitted.points), axis=1), fitted.weights, atol=1e-5
    )


def test_the_joints_come_back(known):
    points, truth, _, fitted = known
    np.testing.assert_allclose(joints.regress(fitted, points.astype(np.float32)), truth, atol=1e-5)


@pytest.mark.parametrize("ridge", [1e-9, 1e-2, 10.0])
def test_weights_have_sum_one_however_they_are_shrunk(known, ridge):
    fitted = joints.fit(known[0], known[1], nearest=7, ridge=ridge)
    np.testing.assert_allclose(fitted.weights.sum(axis=1), 1, atol=1e-5)


def test_turning_and_moving_the_points_turns_and_moves_the_joints(known):
    points, fitted = known[0].astype(np.float32), known[3]
    turn = Rotation.from_rotvec([0.3, -1.2, 0.5]).as_matrix().astype(np.float32)
    shift = np.array([7.0, -2.0, 3.0], np.float32)
    expected = np.asarray(joints.regress(fitted, points)) @ turn.T + shift
    np.testing.assert_allclose(joints.regress(fitted, points @ turn.T + shift), expected, atol=1e-5)


def test_only_points_nearby_are_used():
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.normal(0, 0.1, (20, 9, 3)), rng.normal(5, 0.1, (20, 9, 3))], axis=1)
    fitted = joints.fit(points, points[:, :9].mean(1, keepdims=True), nearest=9)
    np.testing.assert_array_equal(fitted.points[0], np.arange(9))


@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
def test_any_batch_of_points_is_regressed(known, batch):
    points = np.broadcast_to(known[0][0], (*batch, 12, 3)).astype(np.float32)
    found = joints.regress(known[3], points)
    assert found.shape == (*batch, 4, 3)
    one = joints.regress(known[3], points[(0,) * len(batch)])
    np.testing.assert_allclose(found, np.broadcast_to(one, found.shape), rtol=1e-6, atol=2e-7)


def test_gradients_are_finite(known):
    gradient = jax.grad(lambda p: joints.regress(known[3], p).sum())(known[0].astype(np.float32))
    assert np.isfinite(gradient).all()


def test_joints_inside_a_clothed_figure_are_found_in_sequences_it_has_not_seen(tiny_folder):
    rig = avatars.build("cowgirl").rig
    body = [rig.index(name) for name in ("Hips", "Head", "LeftForeArm", "RightLeg", "LeftFoot")]
    clouds, truths = [], []
    for split in ("train", "held_out"):
        takes = [dataset.load_take(tiny_folder, split, k) for k in range(6)]
        clouds.append(np.concatenate([t.texels for t in takes])[::3])
        paths = [np.asarray(skinning.joint_paths(rig, t.quats, t.hips)) - t.roots[:, None] for t in takes]
        truths.append(np.concatenate(paths)[::3, body])
    fitted = joints.fit(clouds[0], truths[0])
    error = np.linalg.norm(np.asarray(joints.regress(fitted, clouds[1])) - truths[1], axis=-1)
    assert error.mean() < 0.02


@pytest.mark.parametrize(
    "change, message",
    [
        ({"nearest": 0}, "nearest must be at least 1"),
        ({"ridge": 0.0}, "ridge positive"),
        ({"joints": np.zeros((59, 4, 3))}, r"joints must have the shape \(60, any, 3\)"),
        ({"points": np.full((60, 12, 3), np.nan)}, "points must be finite"),
    ],
)
def test_what_does_not_fit_is_refused(known, change, message):
    with pytest.raises(ValueError, match=message):
        joints.fit(**({"points": known[0], "joints": known[1]} | change))
