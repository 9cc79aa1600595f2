"""The shipped motion: loops that close, feet on the ground, refusals."""

import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.data import body as bodies
from avatarjax.data.motion import clips, retargeting


@pytest.fixture(scope="module")
def rig():
    return bodies.shape(bodies.load_body(), {"caucasian-female-young": 1.0})[1]


def test_every_clip_holds_unit_rotations_of_the_whole_rig(rig):
    for name in clips.clip_names():
        clip = clips.load_clip(name, rig)
        assert clip.quats.shape[1:] == (len(rig.names), 4) and len(clip.hips) == len(clip.quats) > 10
        np.testing.assert_allclose(jnp.linalg.norm(clip.quats, axis=-1), 1, atol=1e-5)


@pytest.mark.parametrize("name", ["idle", "run", "walk"])
def test_a_loop_closes_as_smoothly_as_it_runs(rig, name):
    quats = np.asarray(clips.load_clip(name, rig).quats)
    inside = np.abs(np.diff(quats, axis=0)).max()
    assert np.minimum(np.abs(quats[0] - quats[-1]), np.abs(quats[0] + quats[-1])).max() < 1.2 * inside


def test_sampling_at_whole_frames_gives_the_frames(rig):
    clip = clips.load_clip("run", rig)
    quats, hips = clips.sample(clip, jnp.float32((5 + 0.0001) / len(clip.quats) + 3))
    np.testing.assert_allclose(np.abs((quats * clip.quats[5]).sum(-1)), 1, atol=1e-4)
    np.testing.assert_allclose(hips, clip.hips[5], atol=1e-3)


def test_a_taller_figure_runs_faster(rig):
    _, tall = bodies.shape(bodies.load_body(), {"caucasian-male-young": 1.0})
    small, large = (float(clips.load_clips(r).run_speed) for r in (rig, tall))
    assert 2 < small < large < 6


def test_an_unknown_clip_is_refused(rig):
    with pytest.raises(ValueError, match="moonwalk"):
        clips.load_clip("moonwalk", rig)


def test_a_file_that_is_not_gltf_is_refused(tmp_path):
    (tmp_path / "x.glb").write_bytes(b"nothing of the kind")
    with pytest.raises(ValueError, match="glTF"):
        retargeting.bone_orientations(tmp_path / "x.glb")
