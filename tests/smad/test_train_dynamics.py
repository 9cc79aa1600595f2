"""Learning dynamics from tracks: starting states, losses, and a pendulum-like cloth that is learned."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import rotations
from avatarjax.smad import config as configs
from avatarjax.smad import drape, driving, dynamics, graph, train_dynamics
from avatarjax.smad.config import DynamicsConfig
from avatarjax.smad.driving import Pose
from avatarjax.smad.train_dynamics import Take
from avatarjax.train import Run, StageConfig

BASE = dynamics.sized(configs.preset("ci"), 1)
CONFIG = dataclasses.replace(
    BASE,
    deformer=dataclasses.replace(BASE.deformer, hidden=16, message=8, decoder=(16, 8), pose_width=16),
    dynamics=DynamicsConfig(frames=8, target_stage=StageConfig(60, 32, 1e-2), stage=StageConfig(150, 8, 2e-2)),
)
POINTS = np.random.default_rng(0).normal(size=(16, 3)) * 0.3
FREQUENCY, DAMPING = 9.0, 4.0


def swinging(seed, frames=70):
    """A root that is pushed about, and nodes of which the lower hang on springs in the world."""
    rng = np.random.default_rng(seed)
    pushes = np.repeat(rng.normal(size=(frames // 7 + 1, 3)) * [4, 0, 4], 7, axis=0)[:frames]
    velocity = np.cumsum(pushes * CONFIG.dt, axis=0)
    path = np.cumsum((velocity - velocity.mean(0)) * CONFIG.dt, axis=0)
    turn = np.asarray(rotations.yaw_matrix(jnp.asarray(0.5)))
    loose = np.clip(-2 * POINTS[:, 1:2], 0, 1)
    offset, speed, offsets = np.zeros((16, 3)), np.zeros((16, 3)), []
    before = np.concatenate([path[:1], path[:1], path])
    for k in range(frames):
        lurch = (before[k + 2] - 2 * before[k + 1] + before[k]) / CONFIG.dt**2
        speed = speed + CONFIG.dt * (-loose * lurch @ turn - FREQUENCY**2 * offset - DAMPING * speed)
        offset = offset + CONFIG.dt * speed
        offsets.append(offset)
    poses = Pose(
        jnp.tile(jnp.eye(3), (frames, 1, 1, 1)),
        jnp.tile(jnp.asarray(turn), (frames, 1, 1)),
        jnp.asarray(path, jnp.float32),
    )
    return Take(poses, jnp.asarray(POINTS + np.stack(offsets), jnp.float32))


@pytest.fixture(scope="module")
def takes():
    return [swinging(0), swinging(1, 40), *(swinging(seed) for seed in range(2, 7))]


@pytest.fixture(scope="module")
def system(takes):
    return train_dynamics.fit_system(CONFIG, graph.build(POINTS, 4), None, takes)


@pytest.fixture(scope="module")
def bare(system):
    """Without a drape, which has takes so short by heart and leaves no swing to be learned."""
    return system.replace(drape=None)


@pytest.fixture(scope="module")
def trained(bare, takes, tmp_path_factory):
    return train_dynamics.train(CONFIG, bare, takes, Run(tmp_path_factory.mktemp("run"), 0, "swinging"))


def test_a_state_is_what_the_recording_says(system, takes):
    recorded = train_dynamics.record(CONFIG, system, takes)
    frame, params = 70 + 25, dynamics.init(CONFIG, system, jax.random.key(0))
    state = train_dynamics.state_at(CONFIG, params, system, recorded, jnp.asarray(frame))
    np.testing.assert_allclose(dynamics.positions(system, state), takes[1].positions[25], atol=1e-5)
    steps = np.diff(np.asarray(takes[1].positions[:26]), axis=0)[::-1] / CONFIG.dt
    np.testing.assert_allclose(np.moveaxis(np.asarray(state.velocities), 1, 0)[:12], steps[:12], atol=2e-3)
    np.testing.assert_allclose(
        state.driven[1],
        driving.to_world(jax.tree.map(lambda x: x[24], takes[1].poses), jnp.asarray(POINTS, jnp.float32)),
        atol=1e-5,
    )


def test_a_state_knows_nothing_of_the_take_before(system, takes):
    recorded = train_dynamics.record(CONFIG, system, takes)
    params = dynamics.init(CONFIG, system, jax.random.key(0))
    state = train_dynamics.state_at(CONFIG, params, system, recorded, jnp.asarray(70))
    np.testing.assert_array_equal(state.velocities, 0.0)
    np.testing.assert_array_equal(state.driven[0], state.driven[1])
    np.testing.assert_array_equal(state.window, np.broadcast_to(state.window[0], state.window.shape))


def test_the_equilibrium_departs_from_the_drape(system, takes):
    recorded = train_dynamics.record(CONFIG, system, takes)
    params, frame = dynamics.init(CONFIG, system, jax.random.key(0)), jnp.asarray(40)
    state = train_dynamics.calm_at(CONFIG, params, system, recorded, frame)
    window = train_dynamics.window_at(CONFIG, recorded, frame)[:: CONFIG.deformer.pose_stride]
    now = drape.components(system.drape, window, recorded.draped[40 - CONFIG.dynamics.memory])
    np.testing.assert_allclose(state.offset, drape.offsets(system.drape, now), atol=1e-6)
    assert np.abs(state.offset - recorded.offsets[40]).mean() < 0.5 * np.abs(recorded.offsets[40]).mean()
    without = dataclasses.replace(CONFIG, dynamics=dataclasses.replace(CONFIG.dynamics, components=0))
    assert train_dynamics.fit_system(without, system.graph, None, takes).drape is None


def test_rollouts_and_recordings_remember_the_same_drape(system, takes):
    """Also shortly after the start, before which the cloth hung at rest."""
    params = dynamics.init(CONFIG, system, jax.random.key(0))
    recorded = train_dynamics.record(CONFIG, system, takes[:2])
    poses = takes[1].poses
    state = dynamics.reset(CONFIG, params, system, jax.tree.map(lambda x: x[0], poses))
    advance = jax.jit(dynamics.step, static_argnums=0)
    for frame in range(1, 11):
        state, _ = advance(CONFIG, params, system, state, jax.tree.map(lambda x, k=frame: x[k], poses))
        if frame in (3, 10):
            begun = train_dynamics.calm_at(CONFIG, params, system, recorded, jnp.asarray(70 + frame))
            assert state.draped.shape == (CONFIG.dynamics.memory, CONFIG.dynamics.components)
            np.testing.assert_allclose(state.draped, begun.draped, atol=1e-5)
            np.testing.assert_allclose(state.equilibrium, begun.equilibrium, atol=1e-5)


def test_what_is_unlike_all_that_was_learned_from_has_the_usual_equilibrium(bare, takes):
    recorded = train_dynamics.record(CONFIG, bare, takes)
    params = dynamics.init(CONFIG, bare, jax.random.key(0))
    target = jax.random.normal(jax.random.key(1), params["target"].shape)
    params = params | {"target": target}
    system = train_dynamics.knowing(CONFIG, params, bare, recorded)
    window = train_dynamics.window_at(CONFIG, recorded, jnp.asarray(40))
    known, here = (dynamics.settled(CONFIG, params, s, window) for s in (bare, system))
    np.testing.assert_allclose(here, known, atol=0.02 * float(jnp.abs(known).max()))
    every = [train_dynamics.window_at(CONFIG, recorded, jnp.asarray(k)) for k in range(len(recorded.first))]
    mean = jnp.mean(jax.vmap(lambda w: dynamics.settled(CONFIG, params, bare, w))(jnp.stack(every)), axis=0)
    np.testing.assert_allclose(dynamics.settled(CONFIG, params, system, window + 50), mean, atol=1e-4)
    apart = dynamics.settled(CONFIG, params, bare, window + 50) - mean
    assert float(jnp.abs(apart).max()) > 0.1
    free = dataclasses.replace(CONFIG, equilibrium=False)
    assert train_dynamics.knowing(free, params, bare, recorded) is bare


def test_the_terms_of_the_loss_are_as_printed(bare):
    system, params = bare, dynamics.init(CONFIG, bare, jax.random.key(0))
    poses = jax.tree.map(lambda x: x[:2], swinging(0).poses)
    still = [dynamics.reset(CONFIG, params, system, jax.tree.map(lambda x, k=k: x[k], poses)) for k in range(2)]
    states = jax.tree.map(lambda *x: jnp.stack(x), *still)
    velocities = jnp.zeros_like(states.velocities).at[:, :, 0].set(0.3)
    stretched = states.replace(offset=0.1 * jnp.asarray(POINTS, jnp.float32)[None].repeat(2, 0), velocities=velocities)
    found = train_dynamics.losses(system, jnp.zeros((2, 16, 3)), stretched)
    i, j = np.asarray(system.graph.edges).T
    lengths = np.linalg.norm(POINTS[i] - POINTS[j], axis=1)
    unit = float(system.scaling.offset)
    np.testing.assert_allclose(found["data"], np.mean((0.1 * POINTS) ** 2) / unit**2, rtol=1e-4)
    np.testing.assert_allclose(found["isometry"], np.mean((0.1 * lengths) ** 2) / unit**2, rtol=1e-3)
    np.testing.assert_allclose(found["damping"], 0.09 / float(system.scaling.velocity) ** 2, rtol=1e-4)


def test_swinging_is_learned_better_than_holding_still(bare, trained):
    unseen = swinging(7)
    found = train_dynamics.replay(CONFIG, trained, bare, unseen, 0)
    truth = np.asarray(unseen.positions[1:])
    error = np.sqrt(np.mean((np.asarray(found) - truth) ** 2))
    still = np.sqrt(np.mean((truth - POINTS) ** 2))
    assert error < 0.6 * still


def test_rollouts_leave_the_equilibrium_alone(system, takes, tmp_path):
    run = Run(tmp_path, 0, "swinging")
    before = train_dynamics.train_target(CONFIG, system, train_dynamics.record(CONFIG, system, takes), run)
    after = train_dynamics.train(CONFIG, system, takes, run)
    window = jax.random.normal(jax.random.key(1), (CONFIG.deformer.pose_span, CONFIG.deformer.pose))
    settled = [dynamics.settled(CONFIG, params, system, window) for params in (before, after)]
    np.testing.assert_array_equal(*settled)
    assert np.abs(after["inertia"] - before["inertia"]).max() > 1e-3


def test_what_hangs_loose_has_learned_inertia(takes, tmp_path):
    # Without an equilibrium that knows of accelerations already.
    config = dataclasses.replace(CONFIG, equilibrium=False)
    system = train_dynamics.fit_system(config, graph.build(POINTS, 4), None, takes)
    inertia = np.asarray(train_dynamics.train(config, system, takes, Run(tmp_path, 0, "swinging"))["inertia"])
    loose, stiff = POINTS[:, 1] < -0.3, POINTS[:, 1] > 0.1
    assert inertia[loose].mean() > 3 * np.abs(inertia[stiff]).mean()


@pytest.mark.parametrize(
    "wrong, message",
    [
        (lambda takes: [], "no takes"),
        (lambda takes: [takes[0].replace(positions=takes[0].positions[:, :5])], "16 nodes"),
        (lambda takes: [jax.tree.map(lambda x: x[:2], takes[0])], "3 frames"),
    ],
)
def test_wrong_takes_are_refused(takes, wrong, message):
    with pytest.raises(ValueError, match=message):
        train_dynamics.fit_system(CONFIG, graph.build(POINTS, 4), None, wrong(takes))
