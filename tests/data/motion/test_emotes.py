"""Emotes as extra actions: names, playing in place, return to the keys' motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.data import body as bodies
from avatarjax.data import skinning
from avatarjax.data.motion import clips, locomotion
from avatarjax.metrics import foot_slide

CONFIG = locomotion.LocomotionConfig(emotes=("wave", "jump"))
WAVE, JUMP = 5, 6


@pytest.fixture(scope="module")
def rig():
    return bodies.shape(bodies.load_body(), {"caucasian-female-young": 1.0})[1]


@pytest.fixture(scope="module")
def played(rig):
    """A run, an emote, standing, another run: one motion for each emote."""
    looping = clips.load_clips(rig, CONFIG.emotes)
    scripts = jnp.array([[1] * 15 + [emote] * 70 + [0] * 20 + [3] * 15 for emote in (WAVE, JUMP)])
    run = jax.jit(jax.vmap(lambda a: locomotion.simulate(rig, looping, a, jax.random.key(0), CONFIG)))
    motions = run(scripts)
    return [jax.tree.map(lambda x, i=i: np.asarray(x[i]), motions) for i in range(2)]


def test_the_larger_vocabulary_has_names():
    assert locomotion.action_names() == ("idle", "forward", "backward", "left", "right")
    assert locomotion.action_names(CONFIG) == ("idle", "forward", "backward", "left", "right", "wave", "jump")


def test_a_running_figure_stops_before_it_plays_and_stays_there(played):
    for motion in played:
        assert motion.speeds[15] > 2
        np.testing.assert_allclose(motion.speeds[45:105], 0, atol=0.02)
        np.testing.assert_allclose(motion.roots[45:105] - motion.roots[45], 0, atol=0.02)
        np.testing.assert_allclose(motion.headings[40:100], motion.headings[40], atol=0.02)


def test_each_emote_does_what_its_name_says(rig, played):
    wave, jump = played
    idle = np.asarray(clips.load_clip("idle", rig).quats[0])
    for bone in ("RightArm", "LeftArm"):
        apart = np.abs((wave.local_quats[40:85, rig.index(bone)] * idle[rig.index(bone)]).sum(-1))
        if apart.min() < 0.8:
            break
    else:
        raise AssertionError("no arm is raised to wave")
    assert jump.hips[40:85, 1].max() > 1.2 > wave.hips[40:85, 1].max()


def test_a_held_key_plays_it_again(played):
    high = played[1].hips[20:86, 1] > 1.2
    assert (np.diff(high.astype(int)) == 1).sum() >= 2


def test_afterwards_the_figure_stands_and_runs_as_ever(played):
    for motion in played:
        assert motion.speeds[-1] > 2
        assert motion.roots[-1, 0] > motion.roots[104, 0] + 0.5


def test_feet_stay_down_in_place(rig, played):
    for motion in played:
        feet = skinning.feet(rig, motion.transforms)
        assert np.percentile(foot_slide.foot_slides(feet.toes, feet.balls), 90) < 0.01
        assert feet.soles[..., 1].min() > -0.005


def test_an_emote_is_entered_smoothly(rig, played):
    quats = played[0].local_quats[10:105, : rig.index("LeftHandIndex1")]
    cosines = np.abs((quats[1:] * quats[:-1]).sum(-1)).clip(0, 1)
    assert np.degrees(2 * np.arccos(cosines)).max() < 45


def test_an_unknown_emote_is_refused(rig):
    with pytest.raises(ValueError, match="moonwalk"):
        clips.load_clips(rig, ("moonwalk",))
