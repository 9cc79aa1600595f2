import av
import numpy as np
import pytest

from avatarjax.io import video


def decoded(path):
    with av.open(str(path)) as container:
        # The rate is read here: a stream does not outlive its container.
        rate = container.streams.video[0].average_rate
        return np.stack([f.to_ndarray(format="rgb24") for f in container.decode(video=0)]), rate


@pytest.fixture(scope="module")
def frames():
    """Smooth pictures that change with time."""
    y, x, t = np.mgrid[0:32, 0:48, 0:7]
    return np.stack([4 * x + 8 * t, 6 * y + 4 * t, 200 - 3 * x], -1).clip(0, 255).astype(np.uint8).transpose(2, 0, 1, 3)


def test_every_frame_is_there_in_size_and_colour(frames, tmp_path):
    video.write_video(tmp_path / "a.mp4", frames)
    got, rate = decoded(tmp_path / "a.mp4")
    assert got.shape == frames.shape
    assert np.abs(got.astype(float) - frames).mean() < 6
    assert rate == 30


def test_frames_come_in_order_from_any_iterable(frames, tmp_path):
    video.write_video(tmp_path / "a.mp4", iter(frames))
    red = decoded(tmp_path / "a.mp4")[0][..., 0].mean((1, 2))
    assert (np.diff(red) > 2).all()


def test_the_rate_is_kept(frames, tmp_path):
    video.write_video(tmp_path / "a.mp4", frames, fps=12)
    assert decoded(tmp_path / "a.mp4")[1] == 12


@pytest.mark.parametrize("height, width", [(31, 48), (32, 47), (31, 47)])
def test_odd_sides_are_padded_to_even(frames, tmp_path, height, width):
    video.write_video(tmp_path / "a.mp4", frames[:, :height, :width])
    got = decoded(tmp_path / "a.mp4")[0]
    assert got.shape == frames.shape
    assert np.abs(got[:, :height, :width].astype(float) - frames[:, :height, :width]).mean() < 6


def test_no_frames_are_refused_and_an_older_file_stays(tmp_path):
    (tmp_path / "a.mp4").write_text("older")
    with pytest.raises(ValueError, match=r"a\.mp4: a video needs at least one frame"):
        video.write_video(tmp_path / "a.mp4", [])
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("a.mp4", "older")]


def test_frames_of_other_sizes_are_refused_and_nothing_is_left(frames, tmp_path):
    with pytest.raises(ValueError, match=r"shape \(30, 48, 3\) follows frames of shape \(32, 48, 3\)"):
        video.write_video(tmp_path / "a.mp4", [frames[0], frames[1][:30]])
    assert not list(tmp_path.iterdir())
