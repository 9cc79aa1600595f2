"""Cloth against closed forms, symmetries, and a plain float64 implementation of one step."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sheets import ANYWHERE, at_rest, grid, hanging, loose, nothing, sewn, simulate, still

from avatarjax.physics import xpbd
from avatarjax.physics.cloth import Fabric
from avatarjax.physics.contacts import Capsules, Surface
from avatarjax.physics.xpbd import Drive, XPBDConfig

# Nothing but gravity and the threads; few steps, since these sheets are coarse.
BARE = XPBDConfig(substeps=8, refreshes=1, damping=0.0, distance=0.0)
WEIGHTLESS = dataclasses.replace(BARE, gravity=(0.0, 0.0, 0.0))
FRAMES = 10


def without_air(cloth):
    return cloth.replace(drag=jnp.zeros_like(cloth.drag))


def strain(cloth, positions):
    """Mean relative change of length of the stiff pairs."""
    stiff = (cloth.compliances < 1e-6) & (cloth.pairs[..., 0] < cloth.count)
    p, q = (positions[np.asarray(cloth.pairs[stiff][:, k])] for k in range(2))
    return float(np.abs(np.linalg.norm(p - q, axis=1) / cloth.lengths[stiff] - 1).mean())


def energy(cloth, state):
    """Kinetic and potential energy of the loose vertices, joules."""
    free = np.asarray(cloth.inverse_masses) > 0
    mass = 1 / np.asarray(cloth.inverse_masses, np.float64)[free]
    x, v = (np.asarray(a, np.float64)[free] for a in (state.positions, state.velocities))
    return (mass * ((v**2).sum(1) / 2 + 9.81 * x[:, 1])).sum()


class TestClosedForms:
    def test_loose_cloth_falls_in_a_parabola(self):
        """That of steps that first change the velocity: g T^2 / 2 (1 + 1 / steps), sideways at its own speed."""
        cloth = without_air(loose())
        _, positions = simulate(cloth, at_rest(cloth, (0.5, 1.0, -0.2)), still(cloth, FRAMES), BARE)
        time = np.arange(1, FRAMES + 1) / 30
        fallen = -9.81 * time**2 / 2 * (1 + 1 / (BARE.substeps * np.arange(1, FRAMES + 1)))
        way = time[:, None] * np.array([0.5, 1.0, -0.2]) + fallen[:, None] * np.array([0, 1, 0])
        np.testing.assert_allclose(
            positions - cloth.rest[None], np.broadcast_to(way[:, None], positions.shape), atol=2e-4
        )

    def test_a_sheet_falls_no_faster_than_its_terminal_velocity(self):
        """Where the drag of a plate is the weight: sqrt(g / drag)."""
        cloth = loose(4, 4, height=12.0)
        state, _ = simulate(cloth, at_rest(cloth), still(cloth, 75), BARE)
        np.testing.assert_allclose(-state.velocities[:, 1], np.sqrt(9.81 / cloth.drag), rtol=0.01)

    def test_damping_takes_its_share_of_the_speed_each_second(self):
        cloth = without_air(loose())
        config = dataclasses.replace(WEIGHTLESS, damping=0.4)
        state, _ = simulate(cloth, at_rest(cloth, (1.0, 0, 0)), still(cloth, 30), config)
        np.testing.assert_allclose(state.velocities[:, 0], 0.6, rtol=2e-3)

    def test_a_pendulum_has_its_period(self):
        """A triangle that swings about its sewn-on edge: 2 pi sqrt(l / g), 1 + a^2 / 16 times that at amplitude a."""
        length, amplitude = 0.4, 0.2
        corners = np.array([[-0.2, 1, 0], [0.2, 1, 0], [0, 1 - length, 0]])
        corners[2] += length * np.array([0, 1 - np.cos(amplitude), np.sin(amplitude)])
        vertices = corners.astype(np.float32)
        uvs = np.array([[[0, 0], [1, 0], [0.5, 1]]], np.float32)
        cloth = jax.tree.map(jnp.asarray, without_air(sewn(vertices, np.array([[0, 1, 2]]), uvs, [0, 1])))
        config = dataclasses.replace(BARE, substeps=32)
        _, positions = simulate(cloth, at_rest(cloth), still(cloth, 120), config)
        aside = np.r_[vertices[2, 2], positions[:, 2, 2]]
        back = np.flatnonzero((aside[:-1] < 0) & (aside[1:] >= 0))
        crossings = back - aside[back] / (aside[back + 1] - aside[back])
        period = 2 * np.pi * np.sqrt(length / 9.81) * (1 + amplitude**2 / 16)
        np.testing.assert_allclose(np.diff(crossings) / 30, period, rtol=0.01)


class TestRest:
    def test_a_sheet_without_weight_stays_as_it_is(self):
        cloth = hanging()
        _, positions = simulate(cloth, at_rest(cloth), still(cloth, FRAMES), WEIGHTLESS)
        np.testing.assert_allclose(positions, np.broadcast_to(cloth.rest, positions.shape), atol=2e-6)

    def test_sewn_vertices_are_at_their_targets(self):
        cloth = hanging()
        drives = still(cloth, FRAMES)
        targets = drives.targets + 0.02 * jnp.sin(jnp.arange(FRAMES + 1.0))[:, None, None]
        _, positions = simulate(cloth, at_rest(cloth), drives.replace(targets=targets), BARE)
        np.testing.assert_allclose(positions[:, :12], targets[1:, :12], atol=3e-7)

    def test_smaller_steps_stretch_a_hanging_sheet_less(self):
        cloth = hanging(8, 8)
        found = []
        for steps in (4, 32):
            config = dataclasses.replace(BARE, substeps=steps, damping=0.9)
            _, positions = simulate(cloth, at_rest(cloth), still(cloth, 20), config)
            found.append(strain(cloth, np.asarray(positions[-1])))
        assert found[1] < 1e-3 < found[0]

    def test_no_vertex_gets_further_than_its_reach(self):
        cloth = hanging(reach=0.03)
        _, positions = simulate(cloth, at_rest(cloth, (0, 0, 5.0)), still(cloth, FRAMES), BARE)
        away = np.linalg.norm(positions - cloth.rest[None], axis=-1)
        assert 0.029 < away.max() < 0.03 + 1e-6

    def test_swinging_cloth_gains_no_energy(self):
        """Let go level, it swings down; energy is that of the first frame or less from then on."""
        vertices, faces, uvs = grid(8, 8)
        level = vertices + np.array([0, 2, 0], np.float32)
        cloth = without_air(jax.tree.map(jnp.asarray, sewn(level, faces, uvs, np.arange(8))))
        state, drives = at_rest(cloth), still(cloth, 5)
        energies = [energy(cloth, state)]
        for _ in range(8):
            state, _ = simulate(cloth, state, drives, BARE)
            energies.append(energy(cloth, state))
        assert max(np.diff(energies)) < 1e-3 * abs(energies[0])


class TestAir:
    def test_wind_blows_cloth_downwind(self):
        cloth = hanging()
        for wind in ((0.0, 0.0, 4.0), (0.0, 0.0, -4.0)):
            config = dataclasses.replace(BARE, wind=wind)
            _, positions = simulate(cloth, at_rest(cloth), still(cloth, FRAMES), config)
            assert 0.05 < np.sign(wind[2]) * float(positions[-1, -1, 2]) < 11 * 0.05 * 1.02  # a tether's length

    def test_cloth_that_moves_with_the_wind_feels_none(self):
        cloth = loose()
        config = dataclasses.replace(WEIGHTLESS, wind=(1.0, 0.0, 0.5))
        state, _ = simulate(cloth, at_rest(cloth, (1.0, 0.0, 0.5)), still(cloth, FRAMES), config)
        np.testing.assert_allclose(state.velocities - jnp.array([[1.0, 0, 0.5]]), 0, atol=2e-3)

    @pytest.mark.parametrize("factor", [1.0, 1e3, 1e6])
    def test_drag_slows_and_never_reverses(self, factor):
        cloth = loose()
        cloth = cloth.replace(drag=cloth.drag * factor)
        velocity = jnp.array([0.3, 2.0, -0.4])
        state, _ = simulate(cloth, at_rest(cloth, velocity), still(cloth, 1), WEIGHTLESS)
        share = state.velocities / velocity[None]
        assert (share > -1e-3).all() and (share[:, 1] < 0.97).all() and (share <= 1 + 1e-3).all()


class TestContact:
    @staticmethod
    def sphere(centre, radius, count=800):
        """Points spread evenly over a sphere."""
        k = np.arange(count) + 0.5
        height, angle = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
        around = np.sqrt(1 - height**2)
        normals = np.stack([around * np.cos(angle), height, around * np.sin(angle)], axis=1).astype(np.float32)
        return Surface(jnp.asarray(centre + radius * normals)[None], jnp.asarray(normals)[None])

    def test_a_sheet_dropped_on_a_sphere_stays_outside(self):
        """By 2 mm, vertices in every frame; and it does lie there."""
        cloth = loose(14, 14, 0.04, height=1.0)
        centre = np.array([0.27, 0.72, 0.25], np.float32)
        config = dataclasses.replace(BARE, substeps=16, refreshes=2)
        _, positions = simulate(cloth, at_rest(cloth), still(cloth, 30, self.sphere(centre, 0.2)), config)
        away = np.linalg.norm(np.asarray(positions) - centre, axis=-1)
        assert away.min() > 0.2 - 0.002
        assert (away[-1] < 0.22).sum() > 10 and positions[-1, :, 1].min() < 0.75

    def test_nothing_goes_under_the_ground(self):
        cloth = loose(height=0.1)
        _, positions = simulate(cloth, at_rest(cloth, (0, -3.0, 0)), still(cloth, FRAMES), BARE)
        np.testing.assert_allclose(positions[..., 1].min(), float(cloth.clearance[0]), atol=1e-6)

    def test_a_capsule_carries_cloth(self):
        cloth = loose(8, 8, height=0.6)
        bar = Capsules(jnp.array([[-1.0, 0.5, 0.175]]), jnp.array([[1.0, 0.5, 0.175]]), jnp.array([0.05]))
        _, positions = simulate(cloth, at_rest(cloth), still(cloth, 15, capsules=bar), BARE)
        away = np.linalg.norm(np.asarray(positions)[..., 1:] - np.array([0.5, 0.175]), axis=-1)
        assert away.min() > 0.05 - 1e-5 and (away[-1] < 0.06).any()

    def test_a_folded_sheet_keeps_off_itself(self):
        """Two halves that fly at each other stay about `distance` apart: the distance is that of vertices."""
        vertices, faces, uvs = grid(6, 16, 0.03)
        pattern = jax.tree.map(
            jnp.asarray, sewn(vertices + np.array([0, 1, 0], np.float32), faces, uvs, np.arange(0, 96, 16))
        )
        pattern = pattern.replace(tether_length=jnp.full(96, ANYWHERE))
        column = np.tile(np.arange(16), 6)
        folded = np.where(column < 8, column, 15 - column) * 0.03
        height = 1 + np.where(column < 8, 0, 0.03)
        x = jnp.asarray(np.stack([folded, height, vertices[:, 2]], axis=1), jnp.float32)
        speed = jnp.zeros_like(x).at[:, 1].set(jnp.where(jnp.asarray(column) < 8, 0.0, -0.5))
        gaps = {}
        for distance in (0.0, 0.02):
            config = dataclasses.replace(WEIGHTLESS, distance=distance)
            _, positions = simulate(pattern, xpbd.ClothState(x, speed), still(pattern, 3), config)
            last = np.asarray(positions[-1])
            gaps[distance] = np.linalg.norm(last[column < 6][:, None] - last[column > 9][None], axis=-1).min()
        assert gaps[0.0] < 0.012 and gaps[0.02] > 0.018


class TestFunction:
    def test_the_same_inputs_give_the_same_bits(self):
        cloth = hanging()
        runs = [simulate(cloth, at_rest(cloth), still(cloth, FRAMES), XPBDConfig(substeps=8))[1] for _ in range(2)]
        np.testing.assert_array_equal(*runs)

    def test_frames_are_repeated_steps(self):
        cloth = hanging()
        drives = still(cloth, 3)
        drives = drives.replace(targets=drives.targets + 0.01 * jnp.arange(4.0)[:, None, None])
        end, positions = simulate(cloth, at_rest(cloth), drives, BARE)
        state, step = at_rest(cloth), jax.jit(xpbd.step, static_argnames="config")
        for k in range(3):
            before, after = (jax.tree.map(lambda x, n=n: x[n], drives) for n in (k, k + 1))
            state = step(cloth, state, before, after, BARE)
            np.testing.assert_allclose(state.positions, positions[k], atol=1e-6)
        np.testing.assert_allclose(state.velocities, end.velocities, atol=1e-3)

    def test_a_batch_is_its_members(self):
        cloth = hanging()
        drives = still(cloth, 2)
        states = [at_rest(cloth, v) for v in ((0, 0, 1.0), (0.5, 0, -1.0))]
        batch = jax.tree.map(lambda *x: jnp.stack(x), *states)
        found = jax.jit(jax.vmap(lambda s: xpbd.simulate(cloth, s, drives, BARE)[1]))(batch)
        for k, state in enumerate(states):
            np.testing.assert_allclose(found[k], simulate(cloth, state, drives, BARE)[1], atol=2e-6)

    def test_a_step_has_a_finite_gradient_that_is_the_difference(self):
        """Of where the lowest corner gets to, by the speed with which it sets out."""
        cloth = hanging(5, 5)
        start, end = (jax.tree.map(lambda x, k=k: x[k], still(cloth, 1)) for k in range(2))

        @jax.jit
        def corner(velocities):
            return xpbd.step(cloth, xpbd.ClothState(cloth.rest, velocities), start, end, BARE).positions[-1, 2]

        velocities = jnp.zeros_like(cloth.rest).at[:, 2].set(0.5)
        gradient = jax.grad(corner)(velocities)
        assert np.isfinite(gradient).all()
        direction = jnp.zeros_like(velocities).at[-5:, 2].set(1.0)
        difference = (corner(velocities + 0.05 * direction) - corner(velocities - 0.05 * direction)) / 0.1
        assert float((gradient * direction).sum()) == pytest.approx(float(difference), rel=0.02)

    @pytest.mark.parametrize("change", [{"substeps": 0}, {"refreshes": 0}, {"substeps": 8, "refreshes": 3}])
    def test_steps_that_cannot_be_cut_are_refused(self, change):
        with pytest.raises(ValueError, match="cannot be cut into"):
            XPBDConfig(**change)


def everything(seed=0):
    """Two sheets that hang over each other with all there is: wind, surfaces and a capsule that move, folds."""
    rng = np.random.default_rng(seed)
    vertices, faces, uvs = grid(5, 6, 0.05)
    outer = vertices[:, [0, 2, 1]] * np.array([1, -1, 1]) + np.array([0, 1, 0.012])
    inner = outer - np.array([0, 0, 0.012])
    fabric_of = np.r_[np.zeros(len(faces), np.int32), np.ones(len(faces), np.int32)]
    cloth = sewn(
        np.concatenate([inner, outer]).astype(np.float32),
        np.concatenate([faces, faces + 30]),
        np.concatenate([uvs, uvs]),
        [*range(6), *range(30, 36)],
        fabrics=(Fabric(), Fabric(density=0.1, stretch=1e-5, friction=0.4)),
        fabric_of=fabric_of,
        reach=0.06,
    )
    assert len(cloth.covering[1]) == 30
    x = cloth.rest + 0.02 * rng.normal(size=cloth.rest.shape)
    state = xpbd.ClothState(*(a.astype(np.float32) for a in (x, rng.normal(size=x.shape))))

    def drive():
        normals = rng.normal(size=(2, 40, 3)) * [0.2, 0.2, 1]
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        points = rng.uniform([0, 0.75, -0.02], [0.25, 1, 0], (2, 40, 3))
        ends = rng.uniform([0, 0.8, -0.02], [0.25, 1, 0.02], (2, 1, 3))
        targets = cloth.rest + 0.003 * rng.normal(size=x.shape)
        arrays = [a.astype(np.float32) for a in (targets, points, normals, ends[0], ends[1])]
        return Drive(arrays[0], Surface(*arrays[1:3]), Capsules(*arrays[3:], np.array([0.02], np.float32)))

    start = drive()
    end = jax.tree.map(lambda a, b: a + np.float32(0.02) * (b - a), start, drive())
    return cloth, state, start, end


def plain_step(cloth, state, start, end, config):
    """One step a frame in float64, a vertex and a constraint at a time."""
    cloth, state, start, end = jax.tree.map(
        lambda x: x.astype(np.float64) if x.dtype == np.float32 else x, (cloth, state, start, end)
    )
    n, dt = cloth.count, 1 / config.fps
    before, velocities = state.positions, state.velocities
    sewn_on = cloth.inverse_masses == 0
    carried = (end.targets - start.targets) / dt

    normals = np.zeros((n, 3))
    for face in cloth.faces:
        a, b, c = before[face]
        normals[face] += np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    bounds = np.cumsum([0, *cloth.pieces])
    neighbour, inner = np.zeros(n, int), np.arange(n)
    for low, high in itertools.pairwise(bounds.tolist()):
        for k in range(low, high):
            far = [m for m in range(low, high) if np.linalg.norm(cloth.rest[m] - cloth.rest[k]) > config.distance]
            neighbour[k] = min(far, key=lambda m, k=k: np.linalg.norm(before[m] - before[k]))
    for low, own in zip(bounds[:-1], cloth.covering, strict=True):
        for k in own:
            inner[k] = np.linalg.norm(before[:low] - before[k], axis=1).argmin()

    x = np.empty((n, 3))
    for k in range(n):
        v = velocities[k] + np.array(config.gravity) * dt - np.array(config.wind)
        across = v @ normals[k]
        flat = v - across * normals[k]
        flat = flat / (1 + 0.1 * cloth.drag[k] * dt * np.linalg.norm(flat))
        across = across / (1 + cloth.drag[k] * dt * abs(across))
        v = (flat + across * normals[k] + np.array(config.wind)) * (1 - config.damping) ** dt
        x[k] = end.targets[k] if sewn_on[k] else before[k] + dt * v

    for pairs, lengths, compliances in zip(cloth.pairs, cloth.lengths, cloth.compliances, strict=True):
        for (p, q), length, compliance in zip(pairs, lengths, compliances, strict=True):
            if p < n:
                offset = x[p] - x[q]
                now = np.linalg.norm(offset)
                w, u = cloth.inverse_masses[p], cloth.inverse_masses[q]
                impulse = (length - now) / (w + u + compliance / dt**2) * offset / now
                x[p] += w * impulse
                x[q] -= u * impulse

    def tie(x, anchors, lengths):
        away = np.linalg.norm(x - anchors, axis=1)
        return np.where((away > lengths)[:, None], anchors + (x - anchors) * (lengths / (away + 1e-30))[:, None], x)

    x = tie(x, x[cloth.tether], cloth.tether_length)
    old = x.copy()
    for k, m in enumerate(neighbour):
        away = np.linalg.norm(old[k] - old[m])
        if away < config.distance:
            share = 0 if sewn_on[k] else 1 if sewn_on[m] else 0.5
            x[k] += share * (config.distance / away - 1) * (old[k] - old[m])
    old = x.copy()
    for k, m in enumerate(inner):
        offset = old[k] - old[m]
        height = offset @ normals[m]
        if m != k and offset @ offset - height**2 < 0.03**2 and -0.03 < height < config.distance:
            x[k] += (config.distance - height) * normals[m]
    x = tie(x, end.targets, cloth.reach)

    for a, b, radius in zip(end.capsules.begin, end.capsules.end, end.capsules.radii, strict=True):
        for k in range(n):
            foot = a + np.clip((x[k] - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1) * (b - a)
            away = np.linalg.norm(x[k] - foot)
            if away < radius:
                x[k] = foot + (x[k] - foot) * radius / away
    for group in range(len(start.surface.points)):
        for k in range(n):
            m = np.linalg.norm(start.surface.points[group] - before[k], axis=1).argmin()
            point, normal = end.surface.points[group][m], end.surface.normals[group][m]
            normal = normal / np.linalg.norm(normal)
            offset = x[k] - point
            height = offset @ normal
            depth = cloth.clearance[k] - height
            if offset @ offset - height**2 < 0.05**2 and height > -0.10 and depth > 0:
                slip = x[k] - before[k] - (point - start.surface.points[group][m])
                slip = slip - (slip @ normal) * normal
                x[k] += depth * normal - min(1, cloth.friction[k] * depth / np.linalg.norm(slip)) * slip
    x[:, 1] = np.maximum(x[:, 1], cloth.clearance)
    x[sewn_on] = end.targets[sewn_on]
    against = (x - before) / dt - carried
    speed = np.linalg.norm(against, axis=1, keepdims=True)
    return x, carried + against * np.minimum(1, config.top_speed / speed)


@pytest.mark.parametrize("seed", range(3))
def test_one_step_is_the_plain_implementation(seed):
    config = XPBDConfig(fps=240.0, substeps=1, refreshes=1, wind=(0.5, 0.1, -1.0), top_speed=4.0)
    cloth, state, start, end = everything(seed)
    positions, velocities = plain_step(cloth, state, start, end, config)
    found = jax.jit(xpbd.step, static_argnames="config")(*jax.tree.map(jnp.asarray, (cloth, state, start, end)), config)
    assert (np.linalg.norm(velocities, axis=1) > 3).any()  # some reach the top speed
    np.testing.assert_allclose(found.positions, positions, atol=1e-5)
    np.testing.assert_allclose(found.velocities, velocities, atol=1e-5 * 240)


class TestSymmetry:
    """Where the world lies and which way it faces does not matter. A tenth of a second: folds multiply rounding."""

    @staticmethod
    def run(turn=np.eye(3), shift=(0, 0, 0)):
        config = XPBDConfig(substeps=16, wind=tuple((turn @ np.array([2.0, 0, 1.0])).tolist()))
        cloth, state, start, end = everything()
        shift = np.asarray(shift, np.float64)

        def points(x):
            return jnp.asarray(x @ turn.T + shift, jnp.float32)

        def vectors(x):
            return jnp.asarray(x @ turn.T, jnp.float32)

        def moved(drive):
            capsules = drive.capsules.replace(begin=points(drive.capsules.begin), end=points(drive.capsules.end))
            surface = Surface(points(drive.surface.points), vectors(drive.surface.normals))
            return Drive(points(drive.targets), surface, capsules)

        cloth = jax.tree.map(jnp.asarray, cloth).replace(rest=points(cloth.rest))
        drives = jax.tree.map(lambda a, b: jnp.stack([a, b, a, b]), moved(start), moved(end))
        state = xpbd.ClothState(points(state.positions), vectors(state.velocities))
        _, positions = simulate(cloth, state, drives, config)
        return (np.asarray(positions, np.float64) - shift) @ turn

    def test_turning_the_world_about_the_vertical_turns_the_cloth(self):
        s, c = np.sin(0.7), np.cos(0.7)
        turned = self.run(turn=np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]))
        np.testing.assert_allclose(turned, self.run(), atol=1e-4)

    def test_moving_the_world_moves_the_cloth(self):
        np.testing.assert_allclose(self.run(shift=(1.5, 0.5, -2.0)), self.run(), atol=1e-4)


def test_normals_are_those_of_a_sphere():
    rng = np.random.default_rng(0)
    from scipy.spatial import ConvexHull

    points = rng.normal(size=(400, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    hull = ConvexHull(points)
    flat = np.cross(*(points[hull.simplices[:, k]] - points[hull.simplices[:, 0]] for k in (1, 2)))
    outward = (flat * points[hull.simplices].mean(1)).sum(1) > 0
    faces = np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1])
    normals = xpbd.vertex_normals(jnp.asarray(points, jnp.float32), jnp.asarray(faces))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    assert ((np.asarray(normals) * points).sum(1) > 0.97).all()


def test_nothing_is_within_reach():
    """What the other tests rely on."""
    surface, capsules = nothing()
    assert surface.points[..., 1].max() < -10 and len(capsules.radii) == 0
