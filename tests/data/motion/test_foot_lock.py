"""Feet that stay where they land: the legs' inverse kinematics, and what is left of sliding in whole motions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import rotations
from avatarjax.data import body as bodies
from avatarjax.data import skinning
from avatarjax.data.motion import clips, foot_plans, footlock, locomotion
from avatarjax.metrics import foot_slide

FRAMES, TURNING = 120, 50
PAIRS = [(a, b) for a in range(5) for b in range(5) if a != b]


@pytest.fixture(scope="module")
def rig():
    return bodies.shape(bodies.load_body(), {"caucasian-female-young": 1.0})[1]


@pytest.fixture(scope="module")
def transitions(rig):
    looping = clips.load_clips(rig)
    actions = jnp.array([[a] * TURNING + [b] * (FRAMES - TURNING) for a, b in PAIRS])
    keys = jax.random.split(jax.random.key(3), len(PAIRS))
    run = jax.jit(jax.vmap(lambda a, k: locomotion.simulate(rig, looping, a, k)))
    return jax.tree.map(np.asarray, run(actions, keys))


@pytest.fixture(scope="module")
def variants(rig):
    """A run that stops, locked and loose, and the same run that turns instead."""
    looping, key = clips.load_clips(rig), jax.random.key(4)
    loose = locomotion.LocomotionConfig(foot_lock=False)
    stop, turn = (jnp.array([1] * 40 + [action] * 50) for action in (0, 2))
    return {
        "stop": locomotion.simulate(rig, looping, stop, key),
        "turn": locomotion.simulate(rig, looping, turn, key),
        "loose": locomotion.simulate(rig, looping, stop, key, loose),
    }


def _legs(seed, count=300):
    """Random bent legs: hip, knee, ankle and hinge axis."""
    rng = np.random.default_rng(seed)
    hip = rng.normal(size=(count, 3))
    turn = rotations.to_matrix(jnp.asarray(rng.normal(size=(count, 4)), jnp.float32))
    bend = rng.uniform(0.02, 2.2, count)
    zero = np.zeros(count)
    thigh = np.stack([zero, -np.cos(bend / 2), np.sin(bend / 2)], 1) * rng.uniform(0.3, 0.5, (count, 1))
    shank = np.stack([zero, -np.cos(bend / 2), -np.sin(bend / 2)], 1) * rng.uniform(0.3, 0.5, (count, 1))
    place = [hip, hip + np.einsum("nab,nb->na", turn, thigh), hip + np.einsum("nab,nb->na", turn, thigh + shank)]
    return *(jnp.asarray(p, jnp.float32) for p in place), turn[:, :, 0], rng


def _moved(hip, knee, ankle, thigh, shank):
    new_knee = hip + jnp.einsum("nab,nb->na", thigh, knee - hip)
    return new_knee, new_knee + jnp.einsum("nab,nb->na", shank, ankle - knee)


def test_a_leg_reaches_what_it_can_reach_with_rigid_bones():
    hip, knee, ankle, hinge, rng = _legs(0)
    upper, lower = jnp.linalg.norm(knee - hip, axis=1), jnp.linalg.norm(ankle - knee, axis=1)
    reach = rng.uniform(np.abs(upper - lower) + 0.05, footlock.EXACT_REACH * (upper + lower))
    direction = rng.normal(size=(len(hip), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    target = hip + jnp.asarray(direction * reach[:, None], jnp.float32)
    thigh, shank = jax.jit(footlock.two_bone)(hip, knee, ankle, hinge, target)
    for turn in (thigh, shank):
        np.testing.assert_allclose(jnp.einsum("nab,ncb->nac", turn, turn), np.tile(np.eye(3), (300, 1, 1)), atol=1e-4)
        np.testing.assert_allclose(jnp.linalg.det(turn), 1, atol=1e-4)
    np.testing.assert_allclose(_moved(hip, knee, ankle, thigh, shank)[1], target, atol=5e-4)


def test_a_leg_that_is_where_it_should_be_does_not_move():
    hip, knee, ankle, hinge, _ = _legs(1)
    thigh, shank = footlock.two_bone(hip, knee, ankle, hinge, ankle)
    new_knee, new_ankle = _moved(hip, knee, ankle, thigh, shank)
    bent = np.asarray(jnp.linalg.norm(ankle - hip, axis=1)) < 0.98 * np.asarray(
        jnp.linalg.norm(knee - hip, axis=1) + jnp.linalg.norm(ankle - knee, axis=1)
    )
    np.testing.assert_allclose(new_knee[bent], knee[bent], atol=2e-3)
    np.testing.assert_allclose(new_ankle[bent], ankle[bent], atol=5e-4)


def test_over_reach_is_clamped_and_differentiable():
    hip, knee, ankle, hinge, rng = _legs(2)
    target = hip + jnp.asarray(rng.normal(size=(300, 3)), jnp.float32) * 5
    target = target.at[0].set(hip[0]).at[1].set(ankle[1])

    def knees(target):
        thigh, shank = footlock.two_bone(hip, knee, ankle, hinge, target)
        return _moved(hip, knee, ankle, thigh, shank)

    new_knee, new_ankle = knees(target)
    whole = jnp.linalg.norm(knee - hip, axis=1) + jnp.linalg.norm(ankle - knee, axis=1)
    assert np.isfinite(new_ankle).all()
    assert (jnp.linalg.norm(new_ankle - hip, axis=1) <= whole + 1e-5).all()
    np.testing.assert_allclose(jnp.linalg.norm(new_knee - hip, axis=1), jnp.linalg.norm(knee - hip, axis=1), rtol=1e-4)
    gradient = jax.grad(lambda t: sum(jnp.sum(x) for x in knees(t)))(target)
    assert np.isfinite(gradient).all()


def test_placed_feet_are_where_they_were_put(rig):
    clip = clips.load_clip("idle", rig)
    # The hips are lowered so that both feet are in reach.
    quats, hips = clip.quats[5], clip.hips[5] - jnp.array([0, 0.1, 0])
    bones = footlock.leg_bones(rig)
    balls = skinning.joint_positions(rig, skinning.forward_kinematics(rig, quats, clip.hips[5]))[bones[:, 3]]
    feet = foot_plans.level(jnp.array([0.2, -0.4]), jnp.array([0.1, 0.5]))
    toes = jnp.tile(jnp.array([[1.0, 0, 0, 0]]), (2, 1))
    placed, moved = jax.jit(footlock.place_feet)(rig, quats, hips, balls, feet, toes)
    np.testing.assert_allclose(skinning.joint_positions(rig, moved)[bones[:, 3]], balls, atol=5e-4)
    np.testing.assert_allclose(moved[bones[:, 2], :, :3], rotations.to_matrix(feet), atol=1e-4)
    np.testing.assert_allclose(skinning.forward_kinematics(rig, placed, hips), moved, atol=1e-6)


def test_feet_do_not_slide_in_any_transition(rig, transitions):
    feet = [skinning.feet(rig, t) for t in transitions.transforms]
    slides = np.concatenate([foot_slide.foot_slides(f.toes, f.balls) for f in feet])
    assert len(slides) > 150
    assert np.median(slides) < 0.003
    assert np.percentile(slides, 90) < 0.01
    assert slides.max() < 0.05


def test_without_the_lock_they_do(rig, variants):
    feet = skinning.feet(rig, variants["loose"].transforms)
    assert np.median(foot_slide.foot_slides(feet.toes, feet.balls)) > 0.03


def test_no_sole_is_under_the_ground(rig, transitions):
    assert min(skinning.feet(rig, t).soles[..., 1].min() for t in transitions.transforms) > -0.005


def test_standing_feet_do_not_move_at_all(rig, transitions):
    still = transitions.transforms[PAIRS.index((0, 1))][: TURNING - 1]
    feet = still[:, footlock.leg_bones(rig)[:, 2:]]
    np.testing.assert_allclose(feet, np.broadcast_to(feet[:1], feet.shape), atol=1e-3)


def test_a_stopped_figure_stands_on_both_feet(rig, transitions):
    for action in range(1, 5):
        last = transitions.transforms[PAIRS.index((action, 0))][-20:]
        assert foot_slide.contacts(skinning.feet(rig, last).toes).all()


def test_no_joint_of_a_leg_snaps(rig, transitions):
    legs = footlock.leg_bones(rig)[:, :3].ravel()
    quats = transitions.local_quats[:, :, legs]
    cosines = np.abs((quats[:, 1:] * quats[:, :-1]).sum(-1)).clip(0, 1)
    assert np.degrees(2 * np.arccos(cosines)).max() < 60


def test_the_lock_moves_neither_root_nor_heading(variants):
    loose, locked = variants["loose"], variants["stop"]
    np.testing.assert_allclose(loose.roots, locked.roots, atol=1e-6)
    np.testing.assert_allclose(loose.headings, locked.headings, atol=1e-6)
    # The hips sink a little, no more.
    assert np.abs(np.asarray(loose.hips - locked.hips))[:, 1].max() < 0.15


def test_a_frame_knows_nothing_of_later_keys(variants):
    one, other = variants["stop"], variants["turn"]
    np.testing.assert_allclose(one.transforms[:41], other.transforms[:41], atol=1e-5)
    assert np.abs(np.asarray(one.transforms[45] - other.transforms[45])).max() > 0.01
