"""Three photographs that scikit-image carries, and a distortion of each: (3, 64, 64, 3) in [0, 1], before and after."""

import numpy as np
from skimage import data, filters

# Of the three pairs, by the package lpips 0.1.4 in float64: its own heads, version 0.1, on backbones with our weights.
LPIPS = {
    "alex": [0.06822913, 0.26595989, 0.40494395],
    "vgg": [0.1592388, 0.30377103, 0.45121724],
}


def pairs():
    """Shifted by three pixels, blurred, noisy."""
    corners = {data.astronaut: (60, 190), data.chelsea: (90, 180), data.coffee: (150, 250)}
    before = [read()[r : r + 64, c : c + 64].astype(np.float32) / 255 for read, (r, c) in corners.items()]
    noise = 0.1 * np.random.default_rng(0).standard_normal((64, 64, 3))
    after = [
        np.roll(before[0], 3, axis=1),
        filters.gaussian(before[1], 2.0, channel_axis=-1),
        np.clip(before[2] + noise, 0, 1),
    ]
    return np.stack(before), np.stack(after).astype(np.float32)
