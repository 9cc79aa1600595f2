"""Mass-spring-damper systems against closed forms of the continuous and of the discrete equations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import rotations
from avatarjax.physics import mass_spring_damper as msd

DT = 0.01


def chain(count, stiffness=50.0, mass=0.2, damping=0.0):
    rest = np.stack([0.1 * np.arange(count), np.zeros(count), np.zeros(count)], axis=1)
    edges = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    return msd.connect(rest, edges, stiffness, mass, damping), jnp.asarray(rest, jnp.float32)


def tangle(seed=0, count=9, damping=0.0):
    """Random masses on random springs, in a random state."""
    rng = np.random.default_rng(seed)
    edges = np.argwhere(np.triu(rng.uniform(size=(count, count)) < 0.5, 1))
    rest = rng.normal(size=(count, 3))
    springs = msd.connect(rest, edges, rng.uniform(5, 50, len(edges)), rng.uniform(0.1, 1, count), damping)
    position, velocity = rest + 0.1 * rng.normal(size=rest.shape), rng.normal(size=rest.shape)
    return springs, jnp.asarray(position, jnp.float32), jnp.asarray(velocity, jnp.float32)


def free(springs, position, velocity, steps, dt=DT):
    """Motion without external force."""
    return msd.simulate(springs, position, velocity, jnp.zeros((steps, *position.shape)), dt)


def oscillation(square, steps, dt=DT):
    """x_n of x'' = -square x by Eq. 4 from x = 1 at rest: a cosine of angle theta, cos(theta) = 1 - square dt^2 / 2."""
    theta = np.arccos(1 - square * dt**2 / 2)
    first = 1 - square * dt**2
    return np.cos(theta * np.arange(1, steps + 1)) + (first - np.cos(theta)) / np.sin(theta) * np.sin(
        theta * np.arange(1, steps + 1)
    )


def test_euler_takes_the_velocity_first():
    position, velocity = msd.euler_step(jnp.asarray(1.0), jnp.asarray(2.0), jnp.asarray(10.0), 0.1)
    assert (float(velocity), float(position)) == pytest.approx((3.0, 1.3))


def test_one_spring_is_the_exact_discrete_solution():
    """Two equal masses: their distance swings with w^2 = 2 k / g."""
    springs, rest = chain(2)
    moved = jnp.asarray([[0.02, 0.01, -0.03]])
    position, _ = free(springs, rest + jnp.concatenate([moved, -moved]), jnp.zeros((2, 3)), 100)
    expected = oscillation(2 * 50 / 0.2, 100)[:, None] * np.asarray(moved)
    np.testing.assert_allclose(np.asarray(position)[:, 0] - np.asarray(rest)[0], expected, atol=2e-6)
    np.testing.assert_allclose(np.asarray(position)[:, 1] - np.asarray(rest)[1], -expected, atol=2e-6)


def test_one_spring_has_the_frequency_of_the_continuous_one():
    """After one period it is where it began, to the order of the step."""
    springs, rest = chain(2)
    period, steps = 2 * np.pi / np.sqrt(2 * 50 / 0.2), 2000
    moved = jnp.asarray([[0.02, 0, 0], [-0.02, 0, 0]])
    position, _ = free(springs, rest + moved, jnp.zeros((2, 3)), steps, period / steps)
    np.testing.assert_allclose(position[-1] - rest, moved, atol=1e-4)
    np.testing.assert_allclose(position[steps // 2 - 1] - rest, -moved, atol=1e-4)


@pytest.mark.parametrize("mode", [1, 3, 7])
def test_a_chain_swings_in_its_normal_modes(mode):
    """A free chain has the modes cos(pi m (i + 1/2) / n) of w = 2 sqrt(k / g) sin(pi m / 2 n)."""
    springs, rest = chain(8)
    shape = 0.03 * np.cos(np.pi * mode * (np.arange(8) + 0.5) / 8)[:, None] * np.asarray([[1.0, -2.0, 0.5]])
    square = 4 * 50 / 0.2 * np.sin(np.pi * mode / 16) ** 2
    position, _ = free(springs, rest + shape.astype(np.float32), jnp.zeros((8, 3)), 80)
    expected = oscillation(square, 80)[:, None, None] * shape
    np.testing.assert_allclose(position - rest[None], expected, atol=1e-5)


def test_without_external_force_momentum_is_conserved():
    springs, position, velocity = tangle()
    _, after = free(springs, position, velocity, 200)
    momentum = np.sum(np.asarray(springs.mass)[None, :, None] * np.asarray(after), axis=1)
    np.testing.assert_allclose(momentum, np.repeat(momentum[:1], 200, axis=0), atol=2e-5)


def test_under_a_constant_force_a_free_mass_falls_as_the_sum_of_steps():
    springs, position, velocity = tangle()
    gravity = springs.mass[:, None] * jnp.asarray([[0.0, -9.81, 0.0]])
    still = springs.replace(mask=jnp.zeros_like(springs.mask))
    after, _ = msd.simulate(still, position, velocity, jnp.repeat(gravity[None], 50, axis=0), DT)
    fallen = velocity * (50 * DT) + jnp.asarray([[0.0, -9.81, 0.0]]) * (DT**2 * 50 * 51 / 2)
    np.testing.assert_allclose(after[-1] - position, fallen, atol=2e-5)


def test_force_is_the_slope_of_the_elastic_energy():
    springs, position, _ = tangle()
    slope = jax.grad(lambda x: msd.energy(springs, x, jnp.zeros_like(x))[1])(position)
    force = springs.mass[:, None] * msd.acceleration(springs, position, jnp.zeros_like(position))
    np.testing.assert_allclose(force, -slope, atol=1e-4)


def test_energy_stays_bounded_below_the_limit_and_grows_without_bound_above():
    springs, position, velocity = tangle()
    limit = float(msd.stability_limit(springs))
    energies = jax.jit(jax.vmap(lambda x, v: sum(msd.energy(springs, x, v))))
    start = float(energies(position[None], velocity[None])[0])
    # Far from the limit the energy is kept almost; close to it, it swings, but does not grow.
    for share, factor in ((0.1, 1.1), (0.98, 100.0)):
        assert float(energies(*free(springs, position, velocity, 3000, share * limit)).max()) < factor * start
    assert float(energies(*free(springs, position, velocity, 40, 1.05 * limit))[-1]) > 1e6 * start


def dense_square(springs):
    """The highest squared frequency by the eigenvalues of the mass-weighted stiffness matrix, in float64."""
    mass = np.asarray(springs.mass, np.float64)
    matrix = np.zeros((len(mass), len(mass)))
    for (i, j), k in zip(np.asarray(springs.edges), np.asarray(springs.stiffness, np.float64), strict=True):
        matrix[[i, j], [i, j]] += k
        matrix[i, j] -= k
        matrix[j, i] -= k
    return np.linalg.eigvalsh(matrix / np.sqrt(mass[:, None] * mass[None]))[-1]


@pytest.mark.parametrize("springs", [chain(12)[0], tangle(1)[0], tangle(2, 20)[0]], ids=["chain", "tangle", "large"])
def test_the_stability_limit_is_two_over_the_highest_frequency(springs):
    assert float(msd.stability_limit(springs)) == pytest.approx(2 / np.sqrt(dense_square(springs)), rel=2e-3)


def test_the_stability_limit_with_damping_is_that_of_the_discrete_equation():
    """One spring: the eigenvalues of the step's matrix reach the unit circle there."""
    springs, _ = chain(2, damping=1.5)
    dt = float(msd.stability_limit(springs))
    square, rate = 2 * 50 / 0.2, 1.5 / 0.2
    step = np.asarray([[1 - square * dt**2, dt * (1 - rate * dt)], [-square * dt, 1 - rate * dt]])
    assert np.abs(np.linalg.eigvals(step)).max() == pytest.approx(1, abs=1e-4)
    assert dt < 2 / np.sqrt(square)


def test_free_masses_have_no_limit():
    springs, _ = chain(3, stiffness=0.0)
    assert np.isinf(msd.stability_limit(springs))


def test_a_damped_mass_slows_down_by_the_same_factor_each_step():
    springs, rest = chain(3, stiffness=0.0, damping=1.5)
    _, velocity = free(springs, rest, jnp.ones((3, 3)), 60)
    expected = (1 - 1.5 / 0.2 * DT) ** np.arange(1, 61)
    np.testing.assert_allclose(velocity[:, 1, 0], expected, rtol=1e-5)


def test_a_damped_spring_loses_amplitude_by_the_root_of_that_factor():
    springs, rest = chain(2, damping=0.4)
    moved = jnp.asarray([[0.05, 0, 0], [-0.05, 0, 0]])
    position, _ = free(springs, rest + moved, jnp.zeros((2, 3)), 400)
    factor = np.sqrt(1 - 0.4 / 0.2 * DT)
    scaled = np.asarray(position[:, 0, 0] - rest[0, 0]) / factor ** np.arange(1, 401)
    # What is left is a pure oscillation: x_{n+1} + x_{n-1} = 2 cos(theta) x_n.
    cosine = (1 + factor**2 - 2 * 50 / 0.2 * DT**2) / (2 * factor)
    np.testing.assert_allclose(scaled[2:200] + scaled[:198], 2 * cosine * scaled[1:199], atol=1e-5)
    assert 0.049 < np.abs(scaled[200:]).max() < 0.06


@pytest.fixture(scope="module")
def turn():
    return rotations.to_matrix(rotations.from_axis_angle(jnp.asarray([0.5, -2.0, 1.0])))


def test_a_turned_system_has_the_turned_trajectory(turn):
    springs, position, velocity = tangle(damping=0.3)
    force = jnp.asarray(np.random.default_rng(3).normal(size=(50, *position.shape)), jnp.float32)
    here = msd.simulate(springs, position, velocity, force, DT)
    turns = jnp.repeat(turn[None], 50, axis=0)
    there = msd.simulate(springs, position @ turn.T, velocity @ turn.T, force @ turn.T, DT, turns)
    for a, b in zip(there, here, strict=True):
        np.testing.assert_allclose(a, b @ turn.T, atol=2e-5)


def test_at_rest_a_turned_system_stays_where_it_is_only_with_its_offsets_turned(turn):
    springs, rest = chain(4)
    turned = rest @ turn.T
    there = msd.acceleration(springs, turned, jnp.zeros_like(rest), rotation=turn)
    np.testing.assert_allclose(there, np.zeros((4, 3)), atol=1e-4)
    assert np.abs(msd.acceleration(springs, turned, jnp.zeros_like(rest))).max() > 1
    assert float(msd.energy(springs, turned, jnp.zeros_like(rest), turn)[1]) < 1e-10


def test_turning_roots_alone_can_drive_it():
    springs, rest = chain(4)
    angles = jnp.linspace(0, 1, 30)
    turns = jax.vmap(rotations.yaw_matrix)(angles)
    position, _ = msd.simulate(springs, rest, jnp.zeros_like(rest), None, DT, turns)
    assert np.abs(position[-1] - rest).max() > 0.01


def test_padding_has_no_influence():
    springs, position, velocity = tangle()
    padded = springs.replace(
        **{
            name: jnp.concatenate([getattr(springs, name), getattr(springs, name)[:2]])
            for name in ("edges", "rest", "stiffness")
        },
        mask=jnp.concatenate([springs.mask, jnp.zeros(2, bool)]),
    )
    np.testing.assert_array_equal(*(msd.acceleration(s, position, velocity) for s in (padded, springs)))
    np.testing.assert_allclose(*(msd.stability_limit(s) for s in (padded, springs)), rtol=1e-6)


def test_many_systems_at_once_equal_one_after_the_other():
    springs, position, velocity = tangle()
    stacked = jax.tree.map(lambda a, b: jnp.stack([a, b]), springs, springs.replace(stiffness=2 * springs.stiffness))
    run = jax.jit(jax.vmap(lambda s: free(s, position, velocity, 20)[0]))
    limits = jax.vmap(msd.stability_limit)(stacked)
    assert float(limits[0] / limits[1]) == pytest.approx(np.sqrt(2), rel=1e-4)
    for k, together in enumerate(run(stacked)):
        alone, _ = free(jax.tree.map(lambda x, k=k: x[k], stacked), position, velocity, 20)
        np.testing.assert_allclose(together, alone, atol=1e-5)


def test_gradients_are_those_of_finite_differences():
    springs, position, velocity = tangle(damping=0.3)
    with jax.enable_x64(True):
        doubled, position, velocity = jax.tree.map(
            lambda x: x.astype(jnp.float64) if x.dtype == np.float32 else x, (springs, position, velocity)
        )

        @jax.jit
        def end(stiffness, damping):
            moved, _ = free(doubled.replace(stiffness=stiffness, damping=damping), position, velocity, 20)
            return jnp.sum(moved[-1] ** 2)

        for place, step in ((0, 1e-4), (1, 1e-5)):
            given = [doubled.stiffness, doubled.damping]
            slope = jax.grad(end, argnums=place)(*given)[0]
            ends = []
            for sign in (1, -1):
                moved = list(given)
                moved[place] = moved[place].at[0].add(sign * step)
                ends.append(float(end(*moved)))
            assert float(slope) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-5)


REST = np.asarray([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
EDGES = np.asarray([[0, 1], [1, 2]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"edges": np.asarray([[0, 3]])}, r"edge \[0, 3\] does not join two of 3 nodes"),
        ({"edges": np.asarray([[1, 1]])}, r"edge \[1, 1\]"),
        ({"positions": REST * np.nan}, "finite"),
        ({"stiffness": -1.0}, "stiffness as low as -1.0"),
        ({"mass": 0.0}, "mass as low as 0.0"),
        ({"damping": np.asarray([0.0, np.inf, 0.0])}, "damping .* not finite"),
    ],
)
def test_bad_input_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        msd.connect(**{"positions": REST, "edges": EDGES, "stiffness": 1.0, **changes})


def test_steps_without_number_are_refused():
    springs, rest = chain(3)
    with pytest.raises(ValueError, match="number of steps"):
        msd.simulate(springs, rest, rest, None, DT)
