"""Scripts of key presses, windows of frames, and turns."""

import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import posmap
from avatarjax.data import avatars, dressing, sequences
from avatarjax.physics.xpbd import XPBDConfig


def turning_point(script):
    return int((script == script[0]).sum())


@pytest.fixture(scope="module", params=[60, 150, None])
def scripts(request):
    return sequences.transition_scripts(request.param, 0)


def test_every_ordered_pair_of_actions_has_one_sequence(scripts):
    pairs = {(int(s[0]), int(s[-1])) for s in scripts}
    assert len(scripts) == 20
    assert pairs == {(a, b) for a in range(5) for b in range(5) if a != b}


def test_a_sequence_changes_its_key_once(scripts):
    assert all((np.diff(script) != 0).sum() == 1 for script in scripts)


def test_the_source_is_steady_for_a_third_and_the_target_held_for_half(scripts):
    for script in scripts:
        frames, turn = len(script), turning_point(script)
        assert frames // 3 <= turn < frames // 3 + max(1, frames // 12)
        assert frames - turn >= frames // 2


def test_the_turning_point_varies_and_depends_on_the_seed_alone():
    one, same, other = (sequences.transition_scripts(120, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert len({turning_point(script) for script in one}) > 3
    assert np.any(np.not_equal(one, other))


def test_the_papers_frame_counts_are_those_of_table_a():
    scripts = sequences.transition_scripts(None, 0)
    lengths = {(int(s[0]), int(s[-1])): len(s) for s in scripts}
    assert sum(lengths.values()) == 6253
    assert lengths[0, 1] == 367 and lengths[3, 0] == 234 and lengths[1, 2] == 330
    with pytest.raises(ValueError, match="Table A has 5 actions"):
        sequences.transition_scripts(None, 0, actions=6)


def test_too_short_sequences_are_refused():
    with pytest.raises(ValueError, match=r"at least 60 frames.*got 59"):
        sequences.transition_scripts(59, 0)


class TestChains:
    @pytest.fixture
    def chains(self):
        return sequences.chain_scripts(300, 3)

    def test_they_are_as_long_as_the_transitions(self, chains):
        assert [len(c) for c in chains] == [300] * 20
        assert sum(len(c) for c in sequences.chain_scripts(None, 0)) == 6253

    def test_keys_are_held_as_long_as_they_say(self, chains):
        for chain in chains:
            lengths = np.diff(np.flatnonzero(np.append(True, np.diff(chain) != 0)))
            assert len(lengths) >= 3 and lengths.min() >= 35 and lengths.max() <= 80

    def test_every_ordered_pair_comes_about_equally_often(self, chains):
        pairs = np.zeros((5, 5), int)
        for chain in chains:
            changed = np.flatnonzero(np.diff(chain))
            np.add.at(pairs, (chain[changed], chain[changed + 1]), 1)
        others = pairs[~np.eye(5, dtype=bool)]
        assert others.min() >= 2 and others.max() - others.min() <= 3

    def test_they_depend_on_the_seed_alone(self, chains):
        np.testing.assert_array_equal(chains, sequences.chain_scripts(300, 3))
        assert np.any(np.not_equal(chains, sequences.chain_scripts(300, 4)))


@pytest.mark.parametrize("length", [1, 2, 4, 9])
def test_windows_are_all_those_inside_one_sequence(length):
    sequence = np.repeat([0, 1, 2, 3], [5, 3, 4, 12]).astype(np.int32)
    expected = [e for e in range(length - 1, 24) if len(set(sequence[e - length + 1 : e + 1])) == 1]
    np.testing.assert_array_equal(sequences.group_ends(sequence, length), expected)


def test_windows_longer_than_everything_are_none():
    assert len(sequences.group_ends(np.zeros(3, np.int32), 4)) == 0


class TestTurning:
    actions = np.array([1] * 10 + [2] * 10 + [3] * 4 + [1] * 6, np.int32)
    sequence = np.array([0] * 20 + [1] * 10, np.int32)

    def test_frames_reached_after_the_key_change_count(self):
        """Frame 10 still shows the old key: actions[10] drives it to frame 11."""
        near = sequences.turning(self.actions, self.sequence, (0, 3))
        np.testing.assert_array_equal(np.flatnonzero(near), [11, 12, 13, 25, 26, 27])

    def test_a_window_may_begin_before_the_change(self):
        near = sequences.turning(self.actions, self.sequence, (-2, 1))
        np.testing.assert_array_equal(np.flatnonzero(near), [9, 10, 11, 23, 24, 25])

    def test_a_window_stays_inside_its_sequence(self):
        near = sequences.turning(self.actions, self.sequence, (-15, 100))
        assert near.all()
        near = sequences.turning(self.actions[:25], np.zeros(25, np.int32), (0, 100))
        np.testing.assert_array_equal(np.flatnonzero(near), np.arange(11, 25))
        alone = np.array([0] * 20 + [1] * 10, np.int32)
        near = sequences.turning(np.array([1] * 10 + [2] * 20, np.int32), alone, (-50, 50))
        np.testing.assert_array_equal(np.flatnonzero(near), np.arange(20))

    def test_another_sequence_with_another_key_is_no_turn(self):
        actions = np.array([1] * 5 + [2] * 5, np.int32)
        assert not sequences.turning(actions, np.array([0] * 5 + [1] * 5, np.int32), (0, 25)).any()


class TestRecording:
    def test_texels_are_relative_to_the_root_of_their_frame(self, tiny_data):
        roots = np.einsum("t,ftc->fc", tiny_data.atlas.waist, tiny_data.train.texels)
        np.testing.assert_allclose(roots, 0, atol=1e-5)

    def test_frames_know_their_key_and_sequence(self, tiny_data, tiny_spec):
        scripts = sequences.transition_scripts(tiny_spec.transition_frames, tiny_spec.seed)
        np.testing.assert_array_equal(tiny_data.train.actions, np.concatenate(scripts))
        np.testing.assert_array_equal(tiny_data.train.sequence, np.repeat(np.arange(20), 60))

    @pytest.mark.parametrize("action, direction", [(1, (0, 1)), (2, (0, -1)), (3, (1, 0)), (4, (-1, 0))])
    def test_the_root_walks_where_the_key_points(self, tiny_data, action, direction):
        train = tiny_data.train
        for k in range(20):
            rows = np.flatnonzero((train.sequence == k) & (train.actions == action))
            if len(rows) and rows[-1] % 60 == 59:
                step = (train.roots[rows[-1]] - train.roots[rows[-10]])[[0, 2]]
                np.testing.assert_allclose(step / np.linalg.norm(step), direction, atol=0.1)

    def test_the_figure_stands_on_the_floor(self, tiny_data):
        world = tiny_data.train.texels[..., 1] + tiny_data.train.roots[:, None, 1]
        assert -0.03 < world.min() < 0.1
        assert 1.4 < np.ptp(tiny_data.standing[:, 1]) < 2.1

    def test_standing_texels_are_those_of_the_standing_pose(self, tiny_data, tiny_spec):
        avatar, config = avatars.build("cowgirl"), XPBDConfig(substeps=tiny_spec.cloth_steps)
        standing = dressing.settle(avatar, avatars.standing_pose(avatar.rig), config)
        np.testing.assert_allclose(tiny_data.standing, posmap.encode(tiny_data.atlas, jnp.asarray(standing)), atol=1e-5)
