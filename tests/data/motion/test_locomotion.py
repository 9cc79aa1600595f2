"""The keyboard runner: directions, turn frames, determinism, contact with the ground."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.data import body as bodies
from avatarjax.data import skinning
from avatarjax.data.motion import clips, locomotion
from avatarjax.metrics import responsiveness

DIRECTIONS = {1: (0, 1), 2: (0, -1), 3: (1, 0), 4: (-1, 0)}
BEFORE, AFTER = 40, 50


@pytest.fixture(scope="module")
def runner():
    _, rig = bodies.shape(bodies.load_body(), {"caucasian-female-young": 1.0})
    return rig, clips.load_clips(rig)


@pytest.fixture(scope="module")
def play(runner):
    """The motion of a script of keys, the last of which is held on: all of one length, which compiles once."""

    def play(script, key):
        held = script + script[-1:] * (BEFORE + AFTER - len(script))
        motion = locomotion.simulate(*runner, jnp.array(held), key)
        return jax.tree.map(lambda x: x[: len(script)], motion)

    return play


PAIRS = [(a, b) for a in range(5) for b in range(5) if a != b]
KEYS = jax.random.split(jax.random.key(0), len(PAIRS))


def script(pair):
    return [pair[0]] * BEFORE + [pair[1]] * AFTER


@pytest.fixture(scope="module")
def transitions(runner):
    """One motion of every ordered pair of different actions."""
    actions = jnp.array([script(pair) for pair in PAIRS])
    motions = jax.vmap(lambda a, k: locomotion.simulate(*runner, a, k))(actions, KEYS)
    return {pair: jax.tree.map(lambda x, i=i: x[i], motions) for i, pair in enumerate(PAIRS)}


@pytest.mark.parametrize("action", DIRECTIONS)
def test_a_key_moves_the_root_in_its_direction(transitions, action):
    step = np.asarray(transitions[0, action].roots)[-1] - np.asarray(transitions[0, action].roots)[-2]
    np.testing.assert_allclose(step[[0, 2]] / np.linalg.norm(step), DIRECTIONS[action], atol=0.02)
    assert step[1] == 0


@pytest.mark.parametrize("pair", [(1, 2), (2, 1), (3, 4), (4, 3), (1, 3), (1, 4), (2, 3), (3, 1), (4, 2)])
def test_turns_take_twelve_frames_for_a_half_and_nine_for_a_quarter(transitions, pair):
    wanted = locomotion.LocomotionConfig().directions[pair[1] - 1]
    directions = responsiveness.movement_directions(np.asarray(transitions[pair].roots))
    frames = responsiveness.turn_frames(directions, BEFORE, wanted)
    half = sorted(pair) in ([1, 2], [3, 4])
    assert abs(frames - (12 if half else 9)) <= 1


def test_half_a_turn_always_goes_the_same_way(play):
    headings = play([1] * 7 + [2] * 40 + [1] * 43, jax.random.key(1)).headings
    assert headings[46] == pytest.approx(np.pi, abs=0.02)
    assert headings[-1] == pytest.approx(2 * np.pi, abs=0.02)


def test_letting_go_of_the_key_stops_the_runner(transitions):
    for action in DIRECTIONS:
        motion = transitions[action, 0]
        assert motion.speeds[BEFORE - 1] > 2
        assert motion.speeds[-1] == pytest.approx(0, abs=1e-2)


def test_an_action_drives_its_frame_to_the_next(play):
    motion = play([0] * 10 + [1] + [0] * 9, jax.random.key(2))
    assert motion.speeds[10] == 0 and motion.speeds[11] > 0
    np.testing.assert_array_equal(motion.roots[10], motion.roots[0])
    assert motion.roots[11, 2] > 0


def test_a_held_first_key_starts_at_full_speed(runner, play):
    motion = play([1] * 20, jax.random.key(2))
    np.testing.assert_allclose(motion.speeds, float(runner[1].run_speed), rtol=1e-5)


def test_one_key_gives_one_motion_and_another_key_another(play):
    first, again, other = (play([1] * 20, jax.random.key(k)) for k in (5, 5, 6))
    np.testing.assert_array_equal(first.transforms, again.transforms)
    assert np.abs(np.asarray(first.local_quats - other.local_quats)).max() > 0.05


def test_vmap_equals_the_loop(transitions, play):
    for pair in ((0, 1), (3, 2)):
        alone = play(script(pair), KEYS[PAIRS.index(pair)])
        for a, b in zip(jax.tree.leaves(transitions[pair]), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a, b, atol=2e-4)


def test_the_feet_do_not_enter_the_ground_and_return_to_it(runner, transitions):
    for motion in transitions.values():
        soles = jax.vmap(skinning.sole_points, in_axes=(None, 0))(runner[0], motion.transforms)
        lowest = np.asarray(soles[..., 1].min(axis=(1, 2)))
        assert lowest.min() > -1e-4
        assert np.percentile(lowest, 50) < 0.03


def test_a_standing_figure_has_a_foot_on_the_ground(runner, transitions):
    transforms = transitions[1, 0].transforms[-10:]
    soles = jax.vmap(skinning.sole_points, in_axes=(None, 0))(runner[0], transforms)
    np.testing.assert_allclose(soles[..., 1].min(axis=(1, 2)), 0, atol=1e-4)


def test_no_pose_jumps_at_a_transition(runner, transitions):
    steady = transitions[0, 1].local_quats[-25:]
    fastest = np.abs(np.diff(steady, axis=0)).max()
    for pair, motion in transitions.items():
        if 0 not in pair:
            continue
        # The hips carry the heading, which turns faster than any joint.
        steps = np.abs(np.diff(np.asarray(motion.local_quats)[:, 1:], axis=0)).max(axis=(1, 2))
        assert steps[BEFORE - 2 : BEFORE + 15].max() < 1.3 * fastest, pair


def test_the_motion_turns_with_the_world(play):
    key = jax.random.key(3)
    north, west = play([1] * 15 + [3] * 25, key), play([3] * 15 + [2] * 25, key)
    turn = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], np.float32)
    np.testing.assert_allclose(np.einsum("ab,fjbc->fjac", turn, north.transforms), west.transforms, atol=1e-3)
