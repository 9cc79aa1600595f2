"""What of a body can be seen."""

import numpy as np

from avatarjax.data.wardrobe.skin import in_view
from tests.data.wardrobe.shapes import ball


def test_a_ball_inside_a_ball_is_not_seen():
    points, faces = ball()
    vertices = np.concatenate([points, 0.5 * points]).astype(np.float32)
    both = np.concatenate([faces, faces + len(points)]).astype(np.int32)
    seen = in_view(vertices, both, np.concatenate([points, points]).astype(np.float32))
    assert seen[: len(points)].all()
    # The holes at the poles let in a few rays.
    assert seen[len(points) :].mean() < 0.1
