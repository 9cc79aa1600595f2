import numpy as np
import pytest

from avatarjax.metrics import responsiveness

YAW = np.array([0.0, 0.0, np.pi, np.pi / 2, -np.pi / 2])
MOVES = np.array([0.0, 1.0, 1.0, 1.0, 1.0])
STEP = 0.1  # metres a frame


def path(directions):
    """Roots that go one step in each direction (yaw; None stands still)."""
    steps = [(0, 0, 0) if d is None else (STEP * np.sin(d), 0, STEP * np.cos(d)) for d in directions]
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def test_directions_are_yaw_with_0_along_z_and_a_quarter_turn_along_x():
    yaw = [0.0, np.pi / 2, -np.pi / 2, 3.0]
    np.testing.assert_allclose(responsiveness.movement_directions(path(yaw)), yaw, atol=1e-9)


def test_angles_wrap():
    np.testing.assert_allclose(responsiveness.angle_between([np.pi - 0.1, 0.2], [-np.pi + 0.1, -0.3]), [0.2, 0.5])


class TestTurnFrames:
    def turning(self, frames, after=20):
        """Straight on for 10 frames, then a quarter turn in `frames` equal steps, then straight on."""
        return np.array([0.0] * 10 + [np.pi / 2 * (k + 1) / frames for k in range(frames)] + [np.pi / 2] * after)

    def test_an_instant_turn_takes_none(self):
        assert responsiveness.turn_frames(self.turning(1), 10, np.pi / 2) == 0

    @pytest.mark.parametrize("frames", [5, 9, 18])
    def test_a_slow_turn_ends_where_it_enters_the_tolerance(self, frames):
        angles = 90 * (1 - np.arange(1, frames + 1) / frames)
        expected = int(np.argmax(angles < 12))
        assert responsiveness.turn_frames(self.turning(frames), 10, np.pi / 2) == expected

    def test_swinging_out_again_starts_the_count_anew(self):
        directions = self.turning(1)
        directions[14] = 0.0
        assert responsiveness.turn_frames(directions, 10, np.pi / 2) == 5

    def test_one_that_never_settles_has_none(self):
        assert responsiveness.turn_frames(np.zeros(40), 10, np.pi / 2) is None

    def test_one_that_settles_too_late_to_hold_has_none(self):
        assert responsiveness.turn_frames(self.turning(5, after=5), 10, np.pi / 2) is None
        assert responsiveness.turn_frames(self.turning(5, after=5), 10, np.pi / 2, hold=5) == 4


class TestTransitionFrames:
    def test_the_wait_before_the_turn_does_not_count(self):
        waiting = np.array([0.0] * 17 + list(np.deg2rad([15, 30, 45, 60, 75])) + [np.pi / 2] * 20)
        assert responsiveness.turn_frames(waiting, 10, np.pi / 2) == 12
        assert responsiveness.transition_frames(waiting, 10, 0.0, np.pi / 2) == 5

    def test_a_turn_that_starts_at_once_takes_as_long_either_way(self):
        turn = np.array([0.0] * 10 + [0.5, 1.0] + [np.pi / 2] * 20)
        assert responsiveness.transition_frames(turn, 10, 0.0, np.pi / 2) == 2
        assert responsiveness.turn_frames(turn, 10, np.pi / 2) == 2

    def test_an_instant_turn_after_a_wait_takes_none(self):
        assert responsiveness.transition_frames(np.array([0.0] * 15 + [np.pi] * 20), 10, 0.0, np.pi) == 0

    def test_one_that_never_settles_has_none(self):
        assert responsiveness.transition_frames(np.zeros(40), 10, 0.0, np.pi) is None


@pytest.fixture(scope="module")
def obedient():
    """Idle, W, S with a slow half turn, then A at once."""
    turn = [np.pi * (k + 1) / 6 for k in range(6)]
    directions = [None] * 40 + [0.0] * 40 + turn + [np.pi] * 34 + [np.pi / 2] * 40
    actions = np.repeat([0, 1, 2, 3], 40)
    return responsiveness.responses(path(directions)[:-1], actions, YAW, MOVES)


class TestResponses:
    def test_every_segment_has_a_record(self, obedient):
        assert [(r["start"], r["action"]) for r in obedient] == [(0, 0), (40, 1), (80, 2), (120, 3)]

    def test_speeds_are_metres_a_second(self, obedient):
        np.testing.assert_allclose([r["speed"] for r in obedient], [0, 3, 3, 3], atol=1e-9)

    def test_an_obedient_path_has_no_heading_error(self, obedient):
        np.testing.assert_allclose([r["heading_error"] for r in obedient[1:]], 0, atol=1e-6)
        assert "heading_error" not in obedient[0]

    def test_turns_are_between_the_two_keys_and_none_from_standing(self, obedient):
        assert obedient[1]["turn"] is None
        np.testing.assert_allclose([r["turn"] for r in obedient[2:]], [180, 90])

    def test_turn_frames_are_counted_from_the_key(self, obedient):
        assert [r["turn_frames"] for r in obedient[1:]] == [0, 5, 0]

    def test_a_turn_has_transition_frames_and_a_start_has_none(self, obedient):
        assert [r["transition_frames"] for r in obedient[1:]] == [None, 5, 0]

    def test_a_constant_wrong_heading_is_its_error(self):
        records = responsiveness.responses(path([np.deg2rad(30)] * 60)[:-1], np.full(60, 1), YAW, MOVES)
        assert records[0]["heading_error"] == pytest.approx(30)

    def test_a_turn_counts_only_while_its_key_is_held(self):
        """W, S, W, S: the first S is ignored; that the second is obeyed is none of its merit."""
        directions = [0.0] * 90 + [np.pi] * 30
        actions = np.repeat([1, 2, 1, 2], 30)
        records = responsiveness.responses(path(directions)[:-1], actions, YAW, MOVES)
        assert [r["turn_frames"] for r in records[1:]] == [None, 0, 0]

    def test_a_key_pressed_at_the_last_frame_has_a_finite_speed(self):
        records = responsiveness.responses(path([0.0] * 30), np.array([1] * 30 + [2]), YAW, MOVES)
        assert np.isfinite(records[-1]["speed"])

    def test_roots_that_are_not_finite_are_refused(self):
        roots = path([0.0] * 30)
        roots[4, 1] = np.nan
        with pytest.raises(ValueError, match=r"roots must be finite.*\(4, 1\)"):
            responsiveness.responses(roots, np.ones(31, int), YAW, MOVES)

    def test_an_action_that_there_is_not_is_refused(self):
        with pytest.raises(ValueError, match="actions must be 0 to 4, got 1 to 5"):
            responsiveness.responses(path([0.0] * 30), np.array([1] * 30 + [5]), YAW, MOVES)
