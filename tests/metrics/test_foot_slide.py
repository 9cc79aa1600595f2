import numpy as np
import pytest

from avatarjax.metrics import foot_slide


@pytest.fixture
def walk():
    """12 frames: the left foot stands in 0-4 and 8-11, the right one never; toes are two points beside the ball."""
    balls = np.zeros((12, 2, 3))
    balls[:, 1] = (0.2, 0.5, 0.0)
    balls[5:8, 0, 1] = 0.1
    balls[8:, 0, 2] = 0.6
    return balls[:, :, None] + np.array([[-0.03, 0.0, 0.0], [0.03, 0.005, 0.0]]), balls


def test_feet_that_stand_do_not_slide(walk):
    np.testing.assert_allclose(foot_slide.foot_slides(*walk), [0, 0])


def test_contacts_are_where_the_lowest_point_is_near_the_ground(walk):
    expected = np.ones((12, 2), bool)
    expected[5:8, 0] = expected[:, 1] = False
    np.testing.assert_array_equal(foot_slide.contacts(walk[0]), expected)


def test_every_to_and_fro_counts_but_not_a_rise(walk):
    toes, balls = walk
    balls[1:5, 0, 0] = [0.01, 0.0, 0.01, 0.0]
    balls[1:5, 0, 1] = 0.3
    np.testing.assert_allclose(foot_slide.foot_slides(toes, balls), [0.04, 0], rtol=1e-5)


def test_the_left_foot_comes_first(walk):
    toes, balls = walk
    toes, balls = toes[:, ::-1].copy(), balls[:, ::-1].copy()
    balls[3, 1, 0] += 0.02
    toes[:5, 0, 0, 1] = 0.0
    np.testing.assert_allclose(foot_slide.foot_slides(toes, balls), [0, 0.04, 0], rtol=1e-5, atol=1e-7)


def test_one_frame_is_no_contact(walk):
    toes, balls = walk
    toes[2, 1, :, 1] = 0.0
    assert len(foot_slide.foot_slides(toes, balls)) == 2


def test_a_motion_without_contacts_has_no_slides(walk):
    assert foot_slide.foot_slides(walk[0] + np.array([0, 1.0, 0]), walk[1]).shape == (0,)


@pytest.fixture(scope="module")
def standing():
    """A grid of points on two soles 0.1 m wide and 0.3 m long at x = +-0.1, and a hundred points above."""
    x, z = np.meshgrid([0.05, 0.15], np.linspace(-0.1, 0.2, 8), indexing="ij")
    left = np.stack([x.ravel(), np.full(16, 0.002), z.ravel()], -1)
    above = np.random.default_rng(0).uniform([-0.3, 0.2, -0.2], [0.3, 1.8, 0.2], (100, 3))
    return np.concatenate([above, left, left * [-1, 1, 1]]).astype(np.float32)


def test_the_front_halves_of_the_soles_are_found(standing):
    feet = foot_slide.surface_feet(standing)
    assert feet.toes.shape == (2, 8)
    points = standing[feet.toes]
    assert (points[0, :, 0] > 0).all() and (points[1, :, 0] < 0).all()
    assert (points[..., 2] > 0.05).all() and (points[..., 1] < 0.03).all()


def test_a_surface_that_moves_while_it_stands_slides_by_that(standing):
    feet = foot_slide.surface_feet(standing)
    moved = standing + np.linspace(0, 1, 5)[:, None, None] * np.array([0.03, 0, 0.04])
    np.testing.assert_allclose(feet.slides(moved.astype(np.float32)), [0.05, 0.05], rtol=1e-4)


def test_a_figure_without_a_right_foot_is_refused(standing):
    with pytest.raises(ValueError, match="the right foot"):
        foot_slide.surface_feet(np.abs(standing))


def test_what_is_not_finite_is_refused(walk, standing):
    toes, balls = walk
    balls[2, 0, 1] = np.nan
    with pytest.raises(ValueError, match="balls must be finite"):
        foot_slide.foot_slides(toes, balls)
    with pytest.raises(ValueError, match="standing must be finite"):
        foot_slide.surface_feet(standing * np.float32(np.nan))


def test_balls_of_other_frames_are_refused(walk):
    with pytest.raises(ValueError, match=r"balls must have the shape \(12, 2, 3\)"):
        foot_slide.foot_slides(walk[0], walk[1][:-1])
