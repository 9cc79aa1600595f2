"""Learning from pictures: a doll's sway, which its poses tell, is found without tracks; the held out is not seen."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.smad import config as configs
from avatarjax.smad import (
    driving,
    dynamics,
    embedded,
    footage,
    fusion,
    graph,
    skeletal,
    train_dynamics,
    train_pictures,
)
from avatarjax.smad.avatar import Avatar
from avatarjax.smad.config import PicturesConfig
from avatarjax.smad.fusion import FusionConfig
from avatarjax.smad.train_dynamics import Take
from avatarjax.train import Run, StageConfig, read_metrics
from tests.smad import swaying

BASE = dynamics.sized(configs.preset("ci"), len(swaying.JOINTS))
CONFIG = dataclasses.replace(
    BASE,
    deformer=dataclasses.replace(BASE.deformer, hidden=16, message=8, decoder=(16, 8), pose_width=16),
    # No drape of the true tracks: pictures alone are to tell.
    dynamics=dataclasses.replace(BASE.dynamics, components=0),
    pictures=PicturesConfig(StageConfig(250, 2, 1e-2), StageConfig(40, 2, 3e-3), frames=3, drawn=2),
)
FRAMES, PERIOD = 30, 10.0


@pytest.fixture(scope="module")
def doll():
    """A take in which bones bend as often as the doll sways, an avatar that is skinned, and the true tracks."""
    video, _ = swaying.take(frames=FRAMES, bend=0.1, period=PERIOD)
    takes, cloud = footage.gather([video]), swaying.doll()
    net = graph.of_gaussians(cloud, graph.GraphConfig(60, 6))
    poses = driving.recorded(video.poses)
    skin = skeletal.bind(takes.rig, takes.pose(0, 0), net.positions)
    each = [jax.tree.map(lambda x, k=k: x[k], poses) for k in range(FRAMES)]
    tracks = [swaying.sway(skeletal.pose_points(skin, p), float(k), period=PERIOD) for k, p in enumerate(each)]
    system = train_dynamics.fit_system(CONFIG, net, skin, [Take(poses, jnp.stack(tracks))])
    params = dynamics.init(CONFIG, system, jax.random.key(0))
    return takes, Avatar(cloud, embedded.bind(cloud, net), system, params, CONFIG), Take(poses, jnp.stack(tracks))


@pytest.fixture(scope="module")
def draped(doll, tmp_path_factory):
    takes, avatar, _ = doll
    run = Run(tmp_path_factory.mktemp("drape"), 0, "doll")
    return train_pictures.train_drape(avatar, takes, run), run.folder


def test_the_error_of_pictures_falls_and_nothing_is_dropped(draped):
    records = read_metrics(draped[1] / "drape.jsonl")
    errors = [record["photometric"] for record in records]
    assert np.mean(errors[-6:]) < 0.7 * np.mean(errors[:3])
    assert sum(record["dropped"] for record in records) == 0


def test_nodes_come_nearer_to_where_they_truly_are(doll, draped):
    _, avatar, take = doll
    recorded = train_dynamics.record(CONFIG, avatar.system, [take])

    @jax.jit
    def miss(params, frame):
        window = train_dynamics.window_at(CONFIG, recorded, frame)
        away = dynamics.settled(CONFIG, params, avatar.system, window) - recorded.offsets[frame]
        return jnp.mean(jnp.linalg.norm(away, axis=-1))

    before, after = (np.mean([miss(p, jnp.asarray(k)) for k in range(30)]) for p in (avatar.params, draped[0].params))
    assert after < 0.7 * before


def test_rollouts_begin_calm_and_are_learned_from(doll, draped, tmp_path):
    takes, avatar, take = doll
    recorded = train_dynamics.record(CONFIG, avatar.system, [take])
    state = train_dynamics.calm_at(CONFIG, draped[0].params, avatar.system, recorded, jnp.asarray(20))
    np.testing.assert_array_equal(state.offset, state.equilibrium[0])
    still = (state.equilibrium[0] - state.equilibrium[1]) / CONFIG.dt
    np.testing.assert_allclose(state.velocities[:, 0], still, atol=1e-5)
    swinging = train_pictures.train_swing(avatar, takes, Run(tmp_path, 0, "doll"))
    errors = [record["photometric"] for record in read_metrics(tmp_path / "swing.jsonl")]
    assert np.mean(errors[-5:]) < 0.95 * np.mean(errors[:5])
    assert float(jnp.abs(swinging.params["inertia"]).max()) > 0


def test_colours_are_fused_from_frames_of_the_first_take(doll, tmp_path):
    """Gaussians of one grey, which what the frames show makes the doll's own again."""
    takes, avatar, _ = doll
    grey = avatar.replace(gaussians=avatar.gaussians.replace(colors=jnp.full_like(avatar.gaussians.colors, 0.5)))
    config = FusionConfig(views=4, width=2, stage=StageConfig(30, 2, 1e-2))
    learned, fused = train_pictures.train_fusion(grey, takes, config, Run(tmp_path, 0, "doll"))
    assert fused is not None
    params, views = fused
    towards = fusion.direction(jax.tree.map(lambda x: jnp.asarray(x[0]), takes.cameras))
    seen = np.asarray(views.seen).any(axis=0)
    found = fusion.fuse(config, params, views, learned.gaussians, towards).colors
    before, after = (
        np.abs(np.asarray(x - avatar.gaussians.colors))[seen].mean() for x in (grey.gaussians.colors, found)
    )
    assert seen.mean() > 0.2 and after < 0.8 * before
    assert learned.system is grey.system and learned.params is grey.params


@pytest.mark.parametrize("train", [train_pictures.train_drape, train_pictures.train_swing])
def test_frames_that_are_held_out_make_no_difference(doll, tmp_path, train):
    takes, avatar, _ = doll
    stage = StageConfig(2, 2, 1e-2)
    short = dataclasses.replace(CONFIG.pictures, drape_stage=stage, swing_stage=stage)
    avatar = avatar.replace(config=dataclasses.replace(CONFIG, pictures=short))
    other = np.where(takes.held_out[:, None, None, None], 255 - takes.rgba, takes.rgba)
    found = [
        train(avatar, shown, Run(tmp_path / str(k), 0, "doll")).params
        for k, shown in enumerate((takes, dataclasses.replace(takes, rgba=other)))
    ]
    jax.tree.map(np.testing.assert_array_equal, *found)


def test_without_an_equilibrium_there_is_no_drape(doll, tmp_path):
    takes, avatar, _ = doll
    avatar = avatar.replace(config=dataclasses.replace(CONFIG, equilibrium=False))
    with pytest.raises(ValueError, match="equilibrium is False"):
        train_pictures.train_drape(avatar, takes, Run(tmp_path, 0, "doll"))
