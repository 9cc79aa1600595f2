"""Refinement by splatting: a swaying doll is followed, with and without a skeleton, and what is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import splat
from avatarjax.smad import embedded, footage, graph, refine
from avatarjax.smad.refine import RefineConfig
from avatarjax.train import loop, read_metrics
from tests.smad import swaying

CONFIG = RefineConfig(steps=600)
NET = graph.of_gaussians(swaying.doll(), graph.GraphConfig(100, 8))
KEY = jax.random.key(0)


@dataclasses.dataclass
class Case:
    takes: footage.Footage
    cloud: object
    truth: np.ndarray
    folder: object = None
    begin: object = None
    refined: object = None


def case(skeleton, frames=30, bend=0.5):
    film, truth = swaying.take(frames=frames, skeleton=skeleton, bend=bend if skeleton else 0.0)
    return Case(footage.gather([film]), swaying.doll(), truth)


@pytest.fixture(scope="module", params=[False, True], ids=["no skeleton", "skeleton"])
def followed(request, tmp_path_factory):
    found = case(request.param)
    found.folder = tmp_path_factory.mktemp("refine")
    pose = found.takes.pose(0, 0)
    found.begin = refine.start(found.takes, found.cloud, NET, pose, 3)
    found.refined = refine.refine(found.takes, found.cloud, NET, pose, CONFIG, found.folder, KEY)
    return found


def seen(refined):
    """Where the Gaussians are in every frame."""
    return np.stack([refine.at(refined, 0, frame).means for frame in range(refined.warp.takes[0])])


def misses(case, tracks):
    """Mean distances from the true tracks: in space, and at a right angle to the view; metres."""
    error = np.asarray(tracks) - case.truth
    position = np.asarray(case.takes.cameras.position)[:, None]
    view = (case.truth - position) / np.linalg.norm(case.truth - position, axis=-1, keepdims=True)
    across = error - (error * view).sum(-1, keepdims=True) * view
    return [np.linalg.norm(e, axis=-1).mean() for e in (error, across)]


def test_frames_that_were_never_seen_are_drawn_better(followed):
    before, after = (refine.quality(r, followed.takes) for r in (followed.begin, followed.refined))
    assert after.psnr.mean() > before.psnr.mean() + 5 and after.masked_psnr.mean() > before.masked_psnr.mean() + 4
    assert after.ssim.mean() > before.ssim.mean() and after.lpips is None
    np.testing.assert_array_equal(after.frames, np.flatnonzero(followed.takes.held_out))


def test_tracks_come_nearer_to_the_truth(followed):
    """Across the view most of the way; how far things are, one camera does not tell."""
    before, after = (misses(followed, seen(r)) for r in (followed.begin, followed.refined))
    assert after[0] < 0.95 * before[0] and after[1] < 0.6 * before[1]


def test_losses_fall_and_nothing_is_dropped(followed):
    records = read_metrics(followed.folder / "refine.jsonl")
    assert np.mean([r["photometric"] for r in records[-5:]]) < 0.5 * np.mean([r["photometric"] for r in records[:5]])
    assert sum(r["dropped"] for r in records) == 0


def test_sizes_stay_in_their_range(followed):
    scales = np.asarray(followed.refined.gaussians.scales) / 0.035
    low, high = CONFIG.scale_range
    assert scales.min() > 0.999 * low and scales.max() < 1.001 * high
    assert scales.max() > 1.2 * scales.min()


def test_a_frame_rides_on_its_tracks(followed):
    cloud = refine.at(followed.refined, 0, 11)
    warp = followed.refined.warp
    ridden = embedded.carry(warp.binding, followed.refined.gaussians, NET, refine.tracks(followed.refined, 0)[11])
    np.testing.assert_allclose(cloud.means, ridden.means, atol=1e-5)
    assert len(cloud) == len(followed.cloud) and np.abs(cloud.quats - followed.refined.gaussians.quats).max() > 1e-3
    with pytest.raises(ValueError, match="take 0 has no frame 30"):
        refine.at(followed.refined, 0, 30)


def test_a_run_that_was_done_is_reused(followed):
    again = refine.refine(followed.takes, followed.cloud, NET, followed.takes.pose(0, 0), CONFIG, followed.folder, KEY)
    jax.tree.map(np.testing.assert_array_equal, again, followed.refined)


def test_at_the_start_the_cloud_is_as_it_was_given(followed):
    cloud = refine.at(followed.begin, 0, 0)
    np.testing.assert_allclose(cloud.means, followed.cloud.means, atol=1e-4)
    np.testing.assert_allclose(cloud.quats, followed.cloud.quats, atol=1e-3)
    for name in ("log_scales", "logit_opacities", "colors"):
        np.testing.assert_array_equal(getattr(cloud, name), getattr(followed.cloud, name))


FEW = dataclasses.replace(CONFIG, steps=8)


@pytest.fixture(scope="module")
def small():
    return case(skeleton=False, frames=10)


@pytest.fixture(scope="module")
def go(small):
    """Eight steps on the small take or one like it, whose step is compiled once."""
    kept, make = [], refine.make_step

    def once(*args, **settings):
        kept.extend([] if kept else [make(*args, **settings)])
        return kept[0]

    def run(folder, takes=small.takes, chosen=refine._chosen):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(refine, "make_step", once)
            patch.setattr(refine, "_chosen", chosen)
            return refine.refine(takes, small.cloud, NET, takes.pose(0, 0), FEW, folder, KEY)

    return run


def test_frames_of_a_step_follow_from_its_number():
    """Each comes once a round, in the same order every time, and another seed has another order."""
    frames = np.array([0, 1, 3, 4, 5, 6, 8])
    drawn = [refine._chosen(frames, 2, 3, step).tolist() for step in range(14)]
    rounds = np.reshape(drawn, (4, 7))
    for one in rounds:
        assert sorted(one.tolist()) == frames.tolist()
    assert rounds[0].tolist() != rounds[1].tolist()
    assert refine._chosen(frames, 2, 3, 9).tolist() == drawn[9]
    assert [refine._chosen(frames, 2, 4, step).tolist() for step in range(14)] != drawn


@pytest.fixture(scope="module")
def whole(go, tmp_path_factory):
    return go(tmp_path_factory.mktemp("whole"))


def test_an_interrupted_run_goes_on_as_if_it_had_not_been(go, whole, tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "CHECKPOINT_SECONDS", -1.0)
    seen = []

    def interrupted(frames, count, seed, step):
        if step == 5 and step not in seen:
            seen.append(step)
            raise KeyboardInterrupt
        seen.append(step)
        return chosen(frames, count, seed, step)

    chosen = refine._chosen
    with pytest.raises(KeyboardInterrupt):
        go(tmp_path, chosen=interrupted)
    resumed = go(tmp_path, chosen=interrupted)
    assert seen == [0, 1, 2, 3, 4, 5, 5, 6, 7]
    jax.tree.map(np.testing.assert_array_equal, resumed, whole)


def test_held_out_frames_are_never_trained_on(small, go, whole, tmp_path):
    """What they show makes no difference."""
    takes = small.takes
    other = np.where(takes.held_out[:, None, None, None], 255 - takes.rgba, takes.rgba)
    jax.tree.map(np.testing.assert_array_equal, go(tmp_path, dataclasses.replace(takes, rgba=other)), whole)


def test_quality_in_the_mask_is_that_of_its_pixels(small):
    begin = refine.start(small.takes, small.cloud, NET, small.takes.pose(0, 0), 3)
    found, frames = [], np.flatnonzero(small.takes.held_out)
    room = footage.room(small.takes, lambda k: refine._moved(begin, jnp.asarray(k)), frames.tolist(), growth=1)
    for frame in frames:
        camera = jax.tree.map(lambda x, k=frame: jnp.asarray(x[k]), small.takes.cameras)
        drawn = np.clip(refine._drawn(begin, jnp.asarray(frame), camera, room), 0, 1)
        mask = small.takes.rgba[frame, ..., 3] > 127
        error = (np.float64(drawn) - small.takes.rgba[frame, ..., :3] / 255)[mask]
        found.append(-10 * np.log10(np.mean(error**2)))
    np.testing.assert_allclose(refine.quality(begin, small.takes).masked_psnr, found, atol=1e-3)


def test_wrong_input_is_refused(small):
    takes, cloud, pose = small.takes, small.cloud, small.takes.pose(0, 0)
    with pytest.raises(ValueError, match=r"rotations \(3, 3, 3\), poses of the takes \(4, 3, 3\)"):
        refine.start(takes, cloud, NET, pose.replace(rotations=pose.rotations[:3]), 3)
    with pytest.raises(ValueError, match="300 Gaussians must be two or more, and finite"):
        refine.start(takes, cloud.replace(means=cloud.means.at[3].set(jnp.nan)), NET, pose, 3)
    with pytest.raises(ValueError, match="view-dependent"):
        refine.start(takes, cloud.replace(sh=jnp.zeros((300, 3, 3))), NET, pose, 3)
    short = dataclasses.replace(takes, takes=(2,) * 5)
    with pytest.raises(ValueError, match=r"takes of \(2, 2, 2, 2, 2\) frames have none to hold out"):
        refine.quality(refine.start(short, cloud, NET, pose, 3), short)
    for name in ("steps", "knot"):
        with pytest.raises(ValueError, match=f"{name} is 0"):
            RefineConfig(**{name: 0})
    with pytest.raises(ValueError, match="must rise from above 0"):
        RefineConfig(scale_range=(2.0, 1.0))


def test_several_frames_a_step_are_the_mean_of_each(small):
    """The loss of two frames is that of either on average, before one background."""
    takes = small.takes
    begin = refine.start(takes, small.cloud, NET, takes.pose(0, 0), 3)
    room = splat.SplatConfig(capacity=4000, depth=False)

    def loss(*frames):
        chosen = np.array(frames)
        cameras = jax.tree.map(lambda x: jnp.asarray(x[chosen]), takes.cameras)
        edges = jnp.asarray([[0, 1], [5, 9]], jnp.int32)
        spread = jnp.asarray([-9.0, 0.0])
        batch = refine.FrameBatch(
            begin.warp, edges, spread, jnp.asarray(chosen), cameras, jnp.asarray(takes.rgba[chosen])
        )
        return jax.jit(lambda b: refine.loss(CONFIG, room, refine._parameters(begin), KEY, b)[0])(batch)

    np.testing.assert_allclose(loss(1, 6), (loss(1, 1) + loss(6, 6)) / 2, rtol=1e-5)
