"""Contacts against brute force and plain loops in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.physics import contacts
from avatarjax.physics.contacts import Capsules, Surface, columns


def cloud(rng, count, size=1.0):
    return (size * rng.normal(size=(count, 3))).astype(np.float32)


def squares(queries, points):
    """Squared distances (n, m) in float64."""
    return ((queries[:, None].astype(np.float64) - points[None]) ** 2).sum(-1)


def rows(x):
    return np.stack([np.asarray(c) for c in x], axis=-1)


class TestNearest:
    @pytest.mark.parametrize("count", [1, 2, 15, 16, 17, 31, 32, 33, 100, 513])
    @pytest.mark.parametrize("asked", [37, 300])
    def test_no_point_is_nearer(self, asked, count):
        """But for what the index in the lowest bits costs."""
        rng = np.random.default_rng(count)
        queries, points = cloud(rng, asked), cloud(rng, count)
        found = np.asarray(contacts.nearest(jnp.asarray(queries), jnp.asarray(points)))
        distances = squares(queries, points)
        bits = max(1, (-(-count // 16) * 16 - 1).bit_length())
        assert found.min() >= 0 and found.max() < count
        assert (distances[np.arange(asked), found] <= distances.min(1) * (1 + 2.0 ** (bits - 22))).all()

    def test_it_is_the_very_point_where_points_are_well_apart(self):
        rng = np.random.default_rng(0)
        points = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), -1).reshape(-1, 3).astype(np.float32)
        order = rng.permutation(len(points))
        queries = points[order] + rng.uniform(-0.3, 0.3, points.shape).astype(np.float32)
        np.testing.assert_array_equal(contacts.nearest(jnp.asarray(queries), jnp.asarray(points)), order)

    def test_blocks_that_lie_apart_are_told_apart(self):
        """Queries along a line, as in a mesh, and points on another: most blocks are never looked at."""
        along = np.linspace(0, 10, 1000, dtype=np.float32)
        queries, points = (np.stack([x, 0 * x, 0 * x], axis=1) for x in (along, along[::3] + 0.004))
        found = np.asarray(contacts.nearest(jnp.asarray(queries), jnp.asarray(points)))
        distances = squares(queries, points)
        np.testing.assert_allclose(distances[np.arange(1000), found], distances.min(1), rtol=1e-3)

    def test_many_at_once_are_the_same(self):
        rng = np.random.default_rng(0)
        queries, points = (jnp.asarray(rng.normal(size=(3, n, 3)), jnp.float32) for n in (200, 90))
        found = jax.vmap(contacts.nearest)(queries, points)
        for k in range(3):
            np.testing.assert_array_equal(found[k], contacts.nearest(queries[k], points[k]))

    def test_an_accelerator_finds_the_same(self, monkeypatch):
        """There all blocks search at once."""
        rng = np.random.default_rng(1)
        queries, points = jnp.asarray(cloud(rng, 300)), jnp.asarray(cloud(rng, 90))
        here = contacts.nearest(queries, points, queries, points, 0.5)
        monkeypatch.setattr(jax.lax, "platform_dependent", lambda *inputs, cpu, default: default(*inputs))
        np.testing.assert_array_equal(contacts.nearest(queries, points, queries, points, 0.5), here)

    def test_the_first_of_equal_points_wins(self):
        points = jnp.tile(jnp.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]), (25, 1))
        found = contacts.nearest(jnp.array([[0.9, 2.0, 3.0], [0.1, 0.0, 0.0]]), points)
        np.testing.assert_array_equal(found, [0, 1])

    @pytest.mark.parametrize("count", [5, 48, 70])
    def test_points_that_are_near_in_the_pattern_do_not_count(self, count):
        rng = np.random.default_rng(count)
        points, rest = cloud(rng, count), cloud(rng, count)
        apart = 1.2
        found = np.asarray(contacts.nearest(*(jnp.asarray(a) for a in (points, points, rest, rest)), apart))
        distances = np.where(squares(rest, rest) > apart**2, squares(points, points), np.inf)
        some = np.isfinite(distances).any(1)
        assert some.sum() > count / 2
        assert (distances[np.arange(count), found] <= distances.min(1) * (1 + 2.0**-14))[some].all()

    @pytest.mark.parametrize("count", [7, 16, 30])
    def test_it_is_the_first_where_none_counts(self, count):
        rng = np.random.default_rng(count)
        points, rest = jnp.asarray(cloud(rng, count)), jnp.asarray(cloud(rng, count, 0.1)) + 5.0
        assert not np.asarray(contacts.nearest(points, points, rest, rest, 2.0)).any()


def plane_case(seed, groups=3, count=40):
    """Vertices about random planes that move, some deep, some out of reach."""
    rng = np.random.default_rng(seed)
    points, normals = 0.03 * rng.normal(size=(groups, count, 3)), rng.normal(size=(groups, count, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    x, moved = 0.03 * rng.normal(size=(count, 3)), 0.002 * rng.normal(size=(groups, count, 3))
    previous = x + 0.005 * rng.normal(size=(count, 3))
    clearance, friction = rng.uniform(0.001, 0.006, count), rng.uniform(0, 0.6, count)
    return [a.astype(np.float32) for a in (x, previous, points, normals, moved, clearance, friction)]


def push_out(x, previous, points, normals, moved, clearance, friction):
    vectors = (columns(jnp.asarray(a)) for a in (x, previous, points, normals, moved))
    return rows(contacts.push_out(*vectors, jnp.asarray(clearance), jnp.asarray(friction)))


def plain_push_out(x, previous, points, normals, moved, clearance, friction):
    """What `push_out` says, a vertex and a plane at a time."""
    x = x.astype(np.float64)
    for point, normal, carried in zip(*(a.astype(np.float64) for a in (points, normals, moved)), strict=True):
        for k in range(len(x)):
            offset = x[k] - point[k]
            height = offset @ normal[k]
            if offset @ offset - height**2 >= 0.05**2 or height <= -0.10 or height >= clearance[k]:
                continue
            depth = clearance[k] - height
            slip = x[k] - previous[k] - carried[k]
            slip = slip - (slip @ normal[k]) * normal[k]
            x[k] += depth * normal[k] - slip * min(1, friction[k] * depth / np.linalg.norm(slip))
    return x


class TestPushOut:
    @pytest.mark.parametrize("seed", range(4))
    def test_it_is_the_plain_loop(self, seed):
        case = plane_case(seed)
        wanted = plain_push_out(*case)
        assert (np.abs(wanted - case[0]).max(1) > 1e-4).mean() > 0.3  # the case is about something
        np.testing.assert_allclose(push_out(*case), wanted, atol=2e-6)

    def test_vertices_end_clear_of_the_surface(self):
        x, previous, points, normals, moved, clearance, friction = plane_case(7, groups=1, count=100)
        after = push_out(x, previous, points, normals, moved, clearance, friction)
        height = ((after - points[0]) * normals[0]).sum(1)
        before = x - points[0]
        above = (before * normals[0]).sum(1)
        held = ((before**2).sum(1) - above**2 < 0.05**2) & (above > -0.10)
        assert held.sum() > 20
        assert (height[held] >= clearance[held] - 1e-6).all()

    def test_a_vertex_outside_or_out_of_reach_stays_to_the_bit(self):
        up, zero = jnp.array([[[0.0, 1.0, 0.0]] * 3]), jnp.zeros((1, 3, 3))
        x = jnp.array([[0.0, 0.01, 0.0], [0.06, -0.01, 0.0], [0.0, -0.2, 0.0]])  # above, aside, below the limb
        after = push_out(x, x - 0.01, zero, up, zero, np.full(3, 0.005, np.float32), np.full(3, 0.5, np.float32))
        np.testing.assert_array_equal(after, x)

    @staticmethod
    def slide(slip, depth, friction, carried):
        """Where a vertex ends that went `slip` metres along x and `depth` into a level floor that moves along x."""
        floor, up = np.zeros((1, 1, 3), np.float32), np.array([[[0, 1, 0]]], np.float32)
        x = np.array([[slip, -depth, 0]], np.float32)
        moved = np.array([[[carried, 0, 0]]], np.float32)
        amounts = np.zeros(1, np.float32), np.array([friction], np.float32)
        return push_out(x, np.zeros((1, 3), np.float32), floor, up, moved, *amounts)[0]

    @pytest.mark.parametrize("carried", [0.0, 0.003, -0.002])
    def test_within_the_cone_a_vertex_goes_with_the_surface(self, carried):
        np.testing.assert_allclose(self.slide(0.001, 0.02, 0.4, carried), [carried, 0, 0], atol=1e-7)

    @pytest.mark.parametrize("carried", [0.0, 0.003, -0.002])
    def test_beyond_the_cone_friction_takes_its_share_of_the_depth(self, carried):
        """A slip of 20 mm against the floor, less 0.4 of the 5 mm that it was pressed in."""
        after = self.slide(0.02 + carried, 0.005, 0.4, carried)
        np.testing.assert_allclose(after, [carried + 0.02 - 0.4 * 0.005, 0, 0], atol=1e-7)

    def test_without_friction_it_only_rises(self):
        np.testing.assert_allclose(self.slide(0.02, 0.005, 0.0, 0.01), [0.02, 0, 0], atol=1e-8)

    def test_planes_are_those_of_the_nearest_points(self):
        rng = np.random.default_rng(3)
        surface = Surface(jnp.asarray(rng.normal(size=(2, 20, 3)), jnp.float32), jnp.asarray(cloud(rng, 40))[None])
        surface = surface.replace(normals=surface.normals.reshape(2, 20, 3))
        x = jnp.asarray(cloud(rng, 11))
        planes = contacts.find_planes(x, surface)
        points, normals = (rows(c) for c in contacts.take_planes(surface, planes))
        for group in range(2):
            near = squares(np.asarray(x), np.asarray(surface.points[group])).argmin(1)
            np.testing.assert_array_equal(points[group], surface.points[group][near])
            np.testing.assert_array_equal(normals[group], surface.normals[group][near])


def to_segment(x, begin, end):
    """Distances (n,) from a segment."""
    axis = end - begin
    share = np.clip((x - begin) @ axis / (axis @ axis + 1e-12), 0, 1)
    return np.linalg.norm(x - begin - share[:, None] * axis, axis=1)


class TestCapsules:
    @pytest.mark.parametrize("end", [[0.3, 0.2, -0.1], [0.0, 0.0, 0.0]], ids=["capsule", "sphere"])
    def test_points_inside_end_on_the_surface_and_others_stay(self, end):
        rng = np.random.default_rng(1)
        begin, end, radius = np.zeros(3, np.float32), np.array(end, np.float32), 0.1
        x = cloud(rng, 300, 0.12)
        capsule = Capsules(jnp.asarray(begin)[None], jnp.asarray(end)[None], jnp.array([radius]))
        after = rows(contacts.push_out_of_capsules(columns(jnp.asarray(x)), capsule))
        inside = to_segment(x, begin, end) < radius
        assert 30 < inside.sum() < 270
        np.testing.assert_allclose(to_segment(after[inside], begin, end), radius, atol=1e-6)
        np.testing.assert_array_equal(after[~inside], x[~inside])

    def test_points_leave_a_sphere_along_its_radius(self):
        x = np.array([[0.03, 0.04, 0.0]], np.float32)
        sphere = Capsules(jnp.zeros((1, 3)), jnp.zeros((1, 3)), jnp.array([0.1]))
        after = rows(contacts.push_out_of_capsules(columns(jnp.asarray(x)), sphere))
        np.testing.assert_allclose(after, 2 * x, rtol=1e-5)


class TestSheets:
    def test_neighbours_are_the_nearest_of_the_own_piece_that_are_apart_in_the_pattern(self):
        rng = np.random.default_rng(5)
        x, rest, pieces, apart = cloud(rng, 50), cloud(rng, 50), (20, 30), 0.8
        found = np.asarray(contacts.find_neighbours(jnp.asarray(x), jnp.asarray(rest), pieces, apart))
        piece = np.repeat([0, 1], pieces)
        excluded = (squares(rest, rest) <= apart**2) | (piece[:, None] != piece)
        np.testing.assert_array_equal(found, np.where(excluded, np.inf, squares(x, x)).argmin(1))

    def test_inner_vertices_are_the_nearest_of_earlier_pieces(self):
        rng = np.random.default_rng(6)
        x = cloud(rng, 30)
        covering = tuple(jnp.asarray(c, jnp.int32) for c in ([], [11, 14], [20, 25, 29]))
        found = np.asarray(contacts.find_inner(jnp.asarray(x), (10, 10, 10), covering))
        wanted = np.arange(30)
        for vertices, start in (([11, 14], 10), ([20, 25, 29], 20)):
            wanted[vertices] = squares(x[vertices], x[:start]).argmin(1)
        np.testing.assert_array_equal(found, wanted)

    @staticmethod
    def separate(gap, free, distance=0.01, rest_gap=0.5):
        """Two vertices `gap` apart, each other's neighbours, before and after."""
        x = np.array([[0, 1, 0], [gap * 0.6, 1 + gap * 0.8, 0]], np.float32)
        rest = np.array([[0, 0, 0], [rest_gap, 0, 0]], np.float32)
        neighbours, free = jnp.array([1, 0], jnp.int32), jnp.asarray(free, jnp.float32)
        x, rest = jnp.asarray(x), columns(jnp.asarray(rest))
        return np.asarray(x), rows(contacts.separate(columns(x), neighbours, rest, free, distance))

    def test_two_that_touch_go_half_the_way_each(self):
        before, after = self.separate(0.004, [1, 1])
        assert np.linalg.norm(after[1] - after[0]) == pytest.approx(0.01, abs=1e-6)
        np.testing.assert_allclose(after.sum(0), before.sum(0), atol=1e-6)  # and so momentum is kept

    def test_the_other_goes_all_the_way_where_one_is_sewn_on(self):
        before, after = self.separate(0.004, [0, 1])
        np.testing.assert_array_equal(after[0], before[0])
        assert np.linalg.norm(after[1] - after[0]) == pytest.approx(0.01, abs=1e-6)

    @pytest.mark.parametrize("gap, rest_gap", [(0.02, 0.5), (0.004, 0.005)])
    def test_those_that_are_apart_or_belong_together_stay(self, gap, rest_gap):
        before, after = self.separate(gap, [1, 1], rest_gap=rest_gap)
        np.testing.assert_array_equal(after, before)

    def test_an_outer_sheet_is_kept_a_gap_above_the_inner_one(self):
        """Vertices over vertex 0: inside, above, and below but aside of its edge; it and the unrelated ones stay."""
        x = jnp.array([[0, 1, 0], [0.01, 0.995, 0], [0, 1.05, 0], [0.04, 0.99, 0], [0, 0.999, 0]], jnp.float32)
        inner = jnp.array([0, 0, 0, 0, 4], jnp.int32)
        normals = columns(jnp.tile(jnp.array([[0.0, 1.0, 0.0]]), (5, 1)))
        after = rows(contacts.keep_outside(columns(x), inner, normals, 0.01))
        wanted = np.asarray(x).copy()
        wanted[1, 1] = 1.01
        np.testing.assert_allclose(after, wanted, atol=1e-6)


def test_contacts_have_finite_gradients_where_vertices_coincide():
    """At no distance a direction is not defined, and must not become a NaN."""
    x = jnp.zeros((2, 3))
    neighbours, free = jnp.array([1, 0], jnp.int32), jnp.ones(2)
    rest = columns(jnp.array([[0.0, 0, 0], [1.0, 0, 0]]))
    capsule = Capsules(jnp.zeros((1, 3)), jnp.zeros((1, 3)), jnp.ones(1))

    def total(x):
        apart = contacts.separate(columns(x), neighbours, rest, free, 0.01)
        return sum(c.sum() for c in contacts.push_out_of_capsules(apart, capsule))

    assert np.isfinite(jax.grad(total)(x)).all()
