"""A monocular video: what of it remains when only some of its frames are kept."""

import numpy as np
import pytest

from tests.smad import turning

CHOSEN = np.array([5, 0, 3])


@pytest.mark.parametrize("moves", [False, True], ids=["one camera", "a camera for each frame"])
def test_some_frames_of_a_video_are_those_of_the_whole(moves):
    whole = turning.video(frames=6, size=16)
    whole = turning.moving_camera(whole) if moves else whole
    some = whole.only(CHOSEN)
    assert len(some) == len(some.poses) == 3
    np.testing.assert_array_equal(some.images(), whole.images()[CHOSEN])
    np.testing.assert_array_equal(list(some.frames()), whole.images()[CHOSEN])
    np.testing.assert_array_equal(some.masks, whole.masks[CHOSEN])
    for k, frame in enumerate(CHOSEN.tolist()):
        np.testing.assert_array_equal(some.poses.root_rotation[k], whole.poses.root_rotation[frame])
        np.testing.assert_array_equal(some.camera_at(k).world_to_camera, whole.camera_at(frame).world_to_camera)
    assert some.poses.parents == whole.poses.parents
