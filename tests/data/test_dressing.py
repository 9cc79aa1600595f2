"""The cowgirl's clothes on a run: what is skinned, what is simulated, and how well that is measured."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.data import avatars, cloth_quality, dressing, skinning
from avatarjax.data.body import Rig
from avatarjax.data.motion import clips
from avatarjax.data.wardrobe.assembly import AvatarMesh
from avatarjax.physics.cloth import Fabric
from avatarjax.physics.xpbd import XPBDConfig

CONFIG = XPBDConfig(substeps=16)
FRAMES = 65
SPEED = 3.0  # metres a second


@pytest.fixture(scope="module")
def cowgirl():
    return avatars.build("cowgirl")


@pytest.fixture(scope="module")
def transforms(cowgirl):
    """A run straight ahead (65, j, 3, 4)."""
    run = clips.ground_clip(cowgirl.rig, clips.load_clip("run", cowgirl.rig))
    time = np.arange(FRAMES)
    frame = time % len(run.quats)
    forward = jnp.asarray(time[:, None] * np.array([0, 0, SPEED / 30]), jnp.float32)
    kinematics = jax.jit(jax.vmap(skinning.forward_kinematics, in_axes=(None, 0, 0)))
    return np.asarray(kinematics(cowgirl.rig, run.quats[frame], run.hips[frame] + forward))


@pytest.fixture(scope="module")
def frames(cowgirl, transforms):
    return dressing.simulate(cowgirl, transforms, CONFIG)


@pytest.fixture(scope="module")
def skinned(cowgirl, transforms):
    """All vertices by linear blend skinning, in float64."""
    homogeneous = np.concatenate([cowgirl.vertices, np.ones((len(cowgirl.vertices), 1))], axis=1)
    bones = np.einsum("vj,fjak->fvak", cowgirl.weights.astype(np.float64), transforms[::16])
    return np.einsum("fvak,vk->fva", bones, homogeneous)


@pytest.fixture(scope="module")
def own(cowgirl):
    """The vertices of the parts that are simulated."""
    return np.asarray(dressing.outfit(cowgirl).own)


def test_what_is_not_simulated_is_linear_blend_skinning(frames, skinned, own):
    others = np.setdiff1d(np.arange(frames.shape[1]), own)
    np.testing.assert_allclose(frames[::16][:, others], skinned[:, others], atol=1e-5)


def test_sewn_vertices_are_linear_blend_skinning_and_loose_ones_are_not(cowgirl, frames, skinned, own):
    away = np.linalg.norm(frames[::16] - skinned, axis=-1)
    sewn = own[cowgirl.reach[own] == 0]
    np.testing.assert_allclose(away[:, sewn], 0, atol=1e-5)
    assert np.median(away[-1, cowgirl.reach > 0.1]) > 0.01


def test_no_vertex_leaves_its_reach(cowgirl, frames, skinned):
    away = np.linalg.norm(frames[::16] - skinned, axis=-1)
    # Collisions have the last word: a body that pushes may take a vertex out of it.
    assert (away <= cowgirl.reach[None] + 0.002).mean() > 0.998


@pytest.mark.parametrize("count", [2, 31, 33])
def test_frames_do_not_depend_on_how_many_follow(cowgirl, transforms, frames, count):
    """Chunks are 30 frames long, whatever the motion's length is; two frames say how fast it begins."""
    np.testing.assert_array_equal(dressing.simulate(cowgirl, transforms[:count], CONFIG), frames[:count])


def test_progress_adds_up_to_all_frames(cowgirl, transforms):
    done = []
    dressing.simulate(cowgirl, transforms[:40], CONFIG, progress=done.append)
    assert done == [1, 30, 9]


def test_the_motion_begins_without_a_jump(frames, skinned, own, cowgirl, transforms):
    """The clothes' way from the first frame to the second is as long as in the rest of the run, and not against it."""
    way = np.diff(frames[:, own], axis=0)
    length = np.linalg.norm(way, axis=-1)
    assert np.quantile(length[0], 0.99) <= np.quantile(length[5:], 0.999)
    assert (way[0, :, 2] > 0).mean() > 0.9  # the velocity with which they were put on is the run's


def test_clothes_at_rest_stay_at_rest(cowgirl, own):
    """After two seconds of standing they move by less than half a millimetre a frame."""
    still = np.broadcast_to(np.asarray(avatars.standing_pose(cowgirl.rig)), (65, len(cowgirl.rig.names), 3, 4))
    stood = dressing.simulate(cowgirl, still, CONFIG)
    np.testing.assert_array_equal(dressing.settle(cowgirl, still[0], CONFIG), stood[-1])
    moved = np.linalg.norm(np.diff(stood[-5:, own], axis=0), axis=-1)
    assert moved.mean() < 5e-4 and np.quantile(moved, 0.99) < 2.5e-3


def test_where_in_the_world_the_figure_runs_does_not_matter(cowgirl, transforms, frames, own):
    """In the first frames: folds multiply the rounding of coordinates by ten every few frames, on some processors to a
    millimetre after six, where the cloth moves by centimetres in each."""
    s, c = np.sin(0.7), np.cos(0.7)
    turn, shift = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]], np.float32), np.array([1.5, 0, -2.0], np.float32)
    place = transforms[:3, ..., 3] @ turn.T + shift
    elsewhere = np.concatenate([turn @ transforms[:3, ..., :3], place[..., None]], axis=-1)
    back = (dressing.simulate(cowgirl, elsewhere, CONFIG) - shift) @ turn
    away = np.linalg.norm(back - frames[:3], axis=-1)[:, own]
    assert away.mean() < 1e-3 and np.quantile(away, 0.99) < 1e-2


def test_clothes_stay_out_of_the_body_and_keep_their_size(cowgirl, frames):
    """What the datasets promise: 99.9 % of the vertices and triangles less than 5 mm inside, over all frames."""
    depth = cloth_quality.penetration(cowgirl, frames[:60])
    assert depth.shape[1] == (cowgirl.reach > 0).sum() + cloth_quality.simulated_faces(cowgirl).sum()
    assert (depth < 0.005).mean() > 0.999
    assert np.median(cloth_quality.strain(cowgirl, frames[:60])) < 0.03


class TestQuality:
    @pytest.fixture
    def table(self):
        """A level solid sheet of 20 cm and a cloth of 10 cm in the same plane, all of whose vertices are loose."""

        def sheet(count, size, middle):
            row, column = np.mgrid[:count, :count] / (count - 1) * size - size / 2 + middle
            corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
            right, below, across = corner + 1, corner + count, corner + count + 1
            faces = np.concatenate([np.stack([corner, below, right], 1), np.stack([right, below, across], 1)])
            return np.stack([column, 0 * row, row], axis=-1).reshape(-1, 3).astype(np.float32), faces.astype(np.int32)

        (top, top_faces), (cloth, cloth_faces) = sheet(41, 0.2, 0.0), sheet(11, 0.1, 0.0)
        count = len(top) + len(cloth)
        ends = np.array([[0, 0, 0], [0, 1, 0]], np.float32)
        rig = Rig(ends[:1], ends[1:], np.zeros((2, 1, 3), np.float32), ("Hips",), (-1,))
        faces = np.concatenate([top_faces, cloth_faces + len(top)])
        return AvatarMesh(
            name="table",
            vertices=np.concatenate([top, cloth]),
            faces=faces,
            uvs=np.zeros((len(faces), 3, 2), np.float32),
            texture=np.zeros((2, 2, 3), np.uint8),
            parts=np.r_[np.zeros(len(top_faces), np.int32), np.ones(len(cloth_faces), np.int32)],
            part_names=("top", "cloth"),
            weights=np.ones((count, 1), np.float32),
            reach=np.r_[np.zeros(len(top)), np.ones(len(cloth))].astype(np.float32),
            braces=np.zeros((0, 2), np.int32),
            fabrics=(Fabric(), Fabric()),
            solid=(True, False),
            rig=rig,
        )

    @staticmethod
    def moved(table, change):
        """The table with its cloth's vertices changed, as one frame."""
        vertices = table.vertices.copy()
        cloth = table.reach > 0
        vertices[cloth] = change(vertices[cloth])
        return vertices[None]

    @pytest.mark.parametrize("height, depth", [(-0.004, 0.004), (0.0, 0.0), (0.01, 0.0)])
    def test_depth_is_the_height_below_the_surface(self, table, height, depth):
        frame = self.moved(table, lambda x: x + np.array([0, height, 0], np.float32))
        found = cloth_quality.penetration(table, frame)
        assert found.shape == (1, 121 + 200)
        np.testing.assert_allclose(found, depth, atol=1e-7)

    def test_what_hangs_beside_the_solid_is_not_inside(self, table):
        """Half of the cloth is over the table's edge: what is more than 3 cm beyond it does not count."""
        frame = self.moved(table, lambda x: x + np.array([0.105, -0.004, 0], np.float32))
        beyond = frame[0][table.reach > 0][:, 0] - 0.1
        depth = cloth_quality.penetration(table, frame)[0, :121]
        np.testing.assert_allclose(depth, np.where(beyond < 0.03, 0.004, 0), atol=1e-7)

    def test_a_cloth_that_is_solid_is_not_inside_itself(self, table):
        both = dataclasses.replace(table, solid=(True, True))
        frame = self.moved(table, lambda x: x + np.array([0, 0.01, 0], np.float32))
        assert not cloth_quality.penetration(both, frame).any()

    def test_strain_is_the_change_of_length(self, table):
        """A tenth longer along x: so are its edges along x, those along z are not, diagonals are by Pythagoras."""
        frame = self.moved(table, lambda x: x * np.array([1.1, 1, 1], np.float32))
        found = np.sort(cloth_quality.strain(table, frame)[0])
        assert found.shape == (2 * 110 + 100,)
        wanted = np.repeat([0, np.sqrt((1.21 + 1) / 2) - 1, 0.1], [110, 100, 110])
        np.testing.assert_allclose(found, wanted, atol=2e-5)

    def test_the_rest_pose_is_not_strained(self, table):
        assert not cloth_quality.strain(table, table.vertices[None]).any()
