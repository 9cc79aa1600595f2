"""Constants of systems whose constants are known, found again from their motion."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.physics import mass_spring_damper as msd
from avatarjax.physics.identify import IdentifyConfig, identify

DT = 1 / 60
STEPS = 40


def chain():
    """Five masses in a row with springs of 20 to 60 N/m, started out of rest."""
    rng = np.random.default_rng(0)
    rest = np.stack([0.1 * np.arange(5), np.zeros(5), np.zeros(5)], axis=1)
    edges = np.stack([np.arange(4), np.arange(1, 5)], axis=1)
    true = msd.connect(rest, edges, np.asarray([20.0, 60.0, 35.0, 50.0]), np.asarray([0.2, 0.3, 0.2, 0.1, 0.4]), 0.3)
    return true, *(jnp.asarray(x, jnp.float32) for x in (rest, 0.5 * rng.normal(size=rest.shape)))


def moved(springs, position, velocity, external=None):
    external = jnp.zeros((STEPS, *position.shape)) if external is None else external
    return msd.simulate(springs, position, velocity, external, DT)[0], external


def fit(start, observed, position, velocity, external, **changes):
    run = jax.jit(identify, static_argnames=("dt", "config"))
    return run(start, observed, position, velocity, external, dt=DT, config=IdentifyConfig(**changes))


@pytest.fixture(scope="module")
def scene():
    true, position, velocity = chain()
    return true, position, velocity, *moved(true, position, velocity)


def test_stiffness_and_damping_are_recovered_from_a_clean_trajectory(scene):
    true, position, velocity, observed, external = scene
    start = true.replace(stiffness=jnp.full(4, 30.0), damping=jnp.full(5, 0.1))
    found = fit(start, observed, position, velocity, external)
    assert bool(found.converged) and int(found.steps) < 30
    np.testing.assert_allclose(found.springs.stiffness, true.stiffness, rtol=1e-3)
    np.testing.assert_allclose(found.springs.damping, true.damping, rtol=1e-3)
    assert float(found.residual) < 1e-6


def test_with_noise_of_a_millimetre_they_are_recovered_to_a_few_per_cent(scene):
    """The motion is of 10 cm: a hundredth of it as noise. What is left is the noise."""
    true, position, velocity, observed, external = scene
    noisy = observed + 1e-3 * jnp.asarray(np.random.default_rng(1).normal(size=observed.shape), jnp.float32)
    start = true.replace(stiffness=jnp.full(4, 30.0), damping=jnp.full(5, 0.1))
    found = fit(start, noisy, position, velocity, external)
    assert bool(found.converged)
    np.testing.assert_allclose(found.springs.stiffness, true.stiffness, rtol=0.03)
    np.testing.assert_allclose(found.springs.damping, true.damping, rtol=0.03)
    assert float(found.residual) == pytest.approx(1e-3, rel=0.1)


def test_a_shared_factor_is_recovered_and_what_is_fixed_stays(scene):
    true, position, velocity, observed, external = scene
    start = true.replace(stiffness=1.7 * true.stiffness)
    found = fit(start, observed, position, velocity, external, stiffness="shared", damping="fixed")
    np.testing.assert_allclose(found.springs.stiffness, true.stiffness, rtol=1e-4)
    np.testing.assert_array_equal(found.springs.damping, true.damping)
    np.testing.assert_array_equal(found.springs.mass, true.mass)


def test_ratios_of_masses_are_recovered_at_their_total(scene):
    true, position, velocity, observed, external = scene
    start = true.replace(mass=jnp.full(5, 0.24))
    found = fit(start, observed, position, velocity, external, stiffness="fixed", damping="fixed", mass="nodes")
    np.testing.assert_allclose(found.springs.mass, true.mass, rtol=1e-3)


def test_a_search_cut_short_says_so(scene):
    true, position, velocity, observed, external = scene
    start = true.replace(stiffness=jnp.full(4, 30.0))
    found = fit(start, observed, position, velocity, external, max_steps=2)
    assert not bool(found.converged) and np.isfinite(found.residual)


def test_a_constant_that_the_motion_says_nothing_of_stays_where_it_started(scene):
    """Without any motion no spring is ever stretched."""
    true, position, *_ = scene
    still = jnp.zeros_like(position)
    found = fit(true, *(x for x in (moved(true, position, still)[0], position, still)), jnp.zeros((STEPS, 5, 3)))
    np.testing.assert_allclose(found.springs.stiffness, true.stiffness, rtol=1e-5)


@pytest.mark.parametrize("window", [1, 7])
def test_pieces_of_a_clean_trajectory_give_the_same_constants(scene, window):
    """Their starts, of observed positions and differences of these, are exact; 7 leaves five steps out."""
    true, position, velocity, observed, external = scene
    start = true.replace(stiffness=jnp.full(4, 30.0), damping=jnp.full(5, 0.1))
    found = fit(start, observed, position, velocity, external, window=window)
    np.testing.assert_allclose(found.springs.stiffness, true.stiffness, rtol=2e-3)
    assert float(found.residual) < 1e-6


def bar():
    """A strip of 2 x 8 masses with all diagonals: the left half of 300 N/m, the right half of 30."""
    rest = np.asarray([[0.1 * x, 0.1 * y, 0.0] for x in range(8) for y in range(2)])
    distance = np.linalg.norm(rest[:, None] - rest[None], axis=2)
    edges = np.argwhere(np.triu(distance < 0.15, 1))
    middle = rest[edges].mean(1)[:, 0]
    return rest, edges, middle


def test_rigid_and_soft_parts_are_told_apart_without_being_told():
    """Every edge starts at one stiffness; shaken at random, each of the rigid half ends far above all soft ones."""
    rest, edges, middle = bar()
    true = msd.connect(rest, edges, np.where(middle < 0.35, 300.0, 30.0), 0.2, 0.5)
    position = jnp.asarray(rest, jnp.float32)
    force = jnp.asarray(3 * np.random.default_rng(2).normal(size=(STEPS, len(rest), 3)), jnp.float32)
    observed, _ = moved(true, position, jnp.zeros_like(position), force)
    observed = observed + 1e-4 * jnp.asarray(np.random.default_rng(3).normal(size=observed.shape), jnp.float32)
    start = true.replace(stiffness=jnp.full(len(edges), 100.0))
    near = fit(start, observed, position, jnp.zeros_like(position), force, window=4)
    found = fit(near.springs, observed, position, jnp.zeros_like(position), force)
    assert bool(near.converged) and bool(found.converged)
    stiffness = np.asarray(found.springs.stiffness)
    assert stiffness[middle < 0.35].min() > 3 * stiffness[middle > 0.35].max()
    np.testing.assert_allclose(np.median(stiffness[middle < 0.35]), 300, rtol=0.05)


def test_steps_that_do_not_match_are_refused(scene):
    true, position, velocity, observed, external = scene
    with pytest.raises(ValueError, match="39 observed steps, but 40"):
        identify(true, observed[1:], position, velocity, external, DT)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stiffness": "fixed", "damping": "fixed"}, "nothing is left"),
        ({"tolerance": 0.0}, "tolerance 0.0"),
        ({"window": 0}, "window of 0"),
    ],
)
def test_searches_for_nothing_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(IdentifyConfig(), **changes)
