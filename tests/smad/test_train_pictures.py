"""Learning the dynamics from pictures: a doll's sway is found without its tracks, and what is held out is not seen."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.smad import config as configs
from avatarjax.smad import driving, dynamics, embedded, footage, graph, train_dynamics, train_pictures
from avatarjax.smad.avatar import Avatar
from avatarjax.smad.config import DynamicsConfig
from avatarjax.smad.train_dynamics import Take
from avatarjax.train import Run, StageConfig, read_metrics
from tests.smad import swaying

BASE = dynamics.sized(configs.preset("ci"), len(swaying.JOINTS))
CONFIG = dataclasses.replace(
    BASE,
    deformer=dataclasses.replace(BASE.deformer, hidden=16, message=8, decoder=(16, 8), pose_width=16),
    # The tracks count for nothing: what is learned comes from pictures.
    dynamics=DynamicsConfig(
        frames=3, noise=0.0, target=0.0, tracks=0.0, pictures=2, picture_stage=StageConfig(200, 4, 5e-3)
    ),
)
FRAMES = 30


@pytest.fixture(scope="module")
def doll():
    """A take, an avatar that springs back to rest at once, and the true tracks, from which rollouts start."""
    video, _ = swaying.take(frames=FRAMES, skeleton=False)
    takes, cloud = footage.gather([video]), swaying.doll()
    net = graph.of_gaussians(cloud, graph.GraphConfig(60, 6))
    poses = driving.recorded(video.poses)
    tracks = [Take(poses, jnp.stack([swaying.sway(net.positions, float(k)) for k in range(FRAMES)]))]
    system = train_dynamics.fit_scaling(CONFIG, net, None, tracks)
    params = dynamics.init(CONFIG, system, jax.random.key(0))
    return takes, Avatar(cloud, embedded.bind(cloud, net), system, params, CONFIG), tracks


@pytest.fixture(scope="module")
def trained(doll, tmp_path_factory):
    takes, avatar, tracks = doll
    run = Run(tmp_path_factory.mktemp("pictures"), 0, "doll")
    return train_pictures.train(avatar, takes, tracks, run), run.folder


def test_the_error_of_pictures_falls_and_nothing_is_dropped(trained):
    records = read_metrics(trained[1] / "dynamics_pictures.jsonl")
    errors = [record["photometric"] for record in records]
    assert np.mean(errors[-6:]) < 0.85 * np.mean(errors[:6])
    assert sum(record["dropped"] for record in records) == 0


def test_nodes_come_nearer_to_where_they_truly_are(doll, trained):
    """Three frames after any frame of the take."""
    _, avatar, tracks = doll
    recorded = train_dynamics.record(CONFIG, avatar.system, tracks)

    @jax.jit
    def miss(params, start):
        states, _ = train_dynamics.roll(CONFIG, params, avatar.system, recorded, start, 3, jax.random.key(0))
        return jnp.mean(jnp.linalg.norm(states.offset[-1] - recorded.offsets[start + 3], axis=-1))

    before, after = (
        np.mean([miss(p, jnp.asarray(k)) for k in range(2, 27)]) for p in (avatar.params, trained[0].params)
    )
    assert after < 0.75 * before


def test_frames_that_are_held_out_make_no_difference(doll, tmp_path):
    takes, avatar, tracks = doll
    short = dataclasses.replace(CONFIG.dynamics, picture_stage=StageConfig(2, 2, 1e-2))
    avatar = avatar.replace(config=dataclasses.replace(CONFIG, dynamics=short))
    other = np.where(takes.held_out[:, None, None, None], 255 - takes.rgba, takes.rgba)
    found = [
        train_pictures.train(avatar, shown, tracks, Run(tmp_path / str(k), 0, "doll")).params
        for k, shown in enumerate((takes, dataclasses.replace(takes, rgba=other)))
    ]
    jax.tree.map(np.testing.assert_array_equal, *found)


def test_tracks_of_other_frames_are_refused(doll, tmp_path):
    takes, avatar, tracks = doll
    fewer = [jax.tree.map(lambda x: x[:20], tracks[0])]
    with pytest.raises(ValueError, match=r"tracks of \[20\] frames for takes of \(30,\)"):
        train_pictures.train(avatar, takes, fewer, Run(tmp_path, 0, "doll"))
