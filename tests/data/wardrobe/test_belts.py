"""Rope ends are sewn to the cloth they hang on."""

import numpy as np

from avatarjax.data.wardrobe import (
    belts,
    skirts,
)


def test_a_rope_end_is_one_more_strip_of_the_cloth_it_hangs_on(woman):
    rig, skin = woman
    skirt = skirts.long_skirt(rig, skin.vertices[np.abs(skin.vertices[:, 0]) < 0.2], top=0.95, bottom=0.1)
    path = np.stack([np.full(20, 0.03), np.linspace(0.95, 0.55, 20), np.linspace(0.2, 0.3, 20)], axis=1)
    tied = belts.hang_rope(skirt, path)
    assert tied.braces is not None and tied.reach is not None
    assert len(tied.vertices) == len(skirt.vertices) + 20 * 6
    rope = np.arange(len(skirt.vertices), len(tied.vertices))
    assert set(rope) <= set(np.unique(tied.braces))
    assert tied.reach[rope].min() == 0 and tied.reach[rope].max() > 0.4
    np.testing.assert_allclose(tied.weights.sum(1), 1, atol=1e-5)
