"""Free-form performances: smooth, on the ground, the same for the same seed."""

import jax
import numpy as np
import pytest

from avatarjax.data import body as bodies
from avatarjax.data import skinning
from avatarjax.data.motion import choreography, footlock, performances
from avatarjax.metrics import foot_slide

DYNAMIC = performances.NAMES[1:]


@pytest.fixture(scope="module")
def rig():
    return bodies.shape(bodies.load_body(), {"caucasian-female-young": 1.0})[1]


@pytest.fixture(scope="module")
def played(rig):
    return {name: jax.tree.map(np.asarray, performances.perform(rig, name, 1)) for name in performances.NAMES}


@pytest.fixture(scope="module")
def joints(rig, played):
    place = jax.jit(jax.vmap(lambda t: skinning.joint_positions(rig, t)))
    return {name: np.asarray(place(motion.transforms)) for name, motion in played.items()}


@pytest.mark.parametrize("name", performances.NAMES)
def test_a_performance_is_finite_and_as_long_as_it_says(played, name):
    motion = played[name]
    assert len(motion.transforms) == performances.frame_count(name)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(motion))


@pytest.mark.parametrize("name", performances.NAMES)
def test_poses_and_transforms_agree(rig, played, name):
    motion = played[name]
    built = jax.jit(skinning.forward_kinematics)(rig, motion.local_quats[77], motion.hips[77])
    np.testing.assert_allclose(built, motion.transforms[77], atol=1e-4)


@pytest.mark.parametrize("name", performances.NAMES)
def test_nothing_pops(rig, played, joints, name):
    quats = played[name].local_quats[:, : rig.index("LeftHandIndex1")]
    cosines = np.abs((quats[1:] * quats[:-1]).sum(-1)).clip(0, 1)
    assert np.degrees(2 * np.arccos(cosines)).max() < 70
    assert np.linalg.norm(np.diff(joints[name], axis=0), axis=-1).max() < 0.5


@pytest.mark.parametrize("name", DYNAMIC)
def test_feet_are_planted(rig, played, name):
    feet = skinning.feet(rig, played[name].transforms)
    slides = foot_slide.foot_slides(feet.toes, feet.balls)
    assert np.median(slides) < 0.005 and np.percentile(slides, 90) < 0.015
    assert feet.soles[..., 1].min() > -0.005


@pytest.mark.parametrize("name", DYNAMIC)
def test_no_leg_goes_through_the_other(rig, joints, name):
    left, right = (joints[name][:, bones[1:3]] for bones in footlock.leg_bones(rig))
    assert np.linalg.norm(left[:, :, None] - right[:, None], axis=-1).min() > 0.08


def test_the_turn_goes_round_once_at_an_even_rate(rig, played):
    motion = played["turn"]
    steps = np.diff(motion.headings)
    np.testing.assert_allclose(steps, 2 * np.pi / len(motion.headings), rtol=1e-3)
    shape = np.linalg.norm(motion.transforms[:, :, [0, 2], 3] - motion.roots[:, None, [0, 2]], axis=-1)
    np.testing.assert_allclose(shape, np.broadcast_to(shape[:1], shape.shape), atol=1e-4)


def test_the_dynamic_ones_do_what_their_names_say(rig, played, joints):
    toes = footlock.leg_bones(rig)[:, 3]
    assert np.ptp(np.unwrap(played["arcs"].headings)) > 2
    assert np.ptp(played["spins"].headings) > 6
    assert joints["kicks"][:, toes, 1].max(axis=0).min() > 0.5
    in_the_air = ~foot_slide.contacts(skinning.feet(rig, played["jumps"].transforms).toes).any(axis=1)
    assert (np.diff(in_the_air.astype(int)) == 1).sum() >= 3
    assert np.ptp(played["dance"].roots[:, [0, 2]], axis=0).max() > 0.2


def test_a_seed_gives_one_motion_and_another_seed_another(rig, played):
    again, other = (performances.perform(rig, "kicks", seed) for seed in (1, 2))
    np.testing.assert_array_equal(again.transforms, played["kicks"].transforms)
    assert np.abs(np.asarray(other.transforms) - played["kicks"].transforms).max() > 0.05


def test_an_unknown_performance_is_refused(rig):
    with pytest.raises(ValueError, match="moonwalk"):
        performances.perform(rig, "moonwalk")


def test_a_score_without_keys_is_refused(rig):
    with pytest.raises(ValueError, match="two keys"):
        choreography.play(rig, choreography.Score(30))
