"""Pictures as a pinhole camera would have seen them, from those of a lens with OpenCV's distortion coefficients."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage


class Undistortion:
    """A resampling of pictures (h, w) onto the pinhole camera of the same intrinsics; what the lens did not see is 0.

    intrinsics (3, 3) with OpenCV's pixel centres, at whole numbers; coefficients (4,) or (5,): k1, k2, p1, p2 and k3
    of Brown's model. Raises ValueError for other numbers of coefficients, or what is not finite.
    """

    def __init__(
        self,
        intrinsics: Float[np.ndarray, "3 3"],
        coefficients: Float[np.ndarray, " c"],
        width: int,
        height: int,
    ):
        if len(coefficients) not in (4, 5) or not np.isfinite(coefficients).all():
            raise ValueError(f"distortion must be 4 or 5 finite coefficients k1 k2 p1 p2 k3, got {coefficients}")
        k1, k2, p1, p2, k3 = (*coefficients, 0.0)[:5]
        u, v = np.meshgrid(np.arange(width), np.arange(height))
        x, y, _ = np.einsum("ij,jhw->ihw", np.linalg.inv(intrinsics), np.stack([u, v, np.ones_like(u)]))
        r = x * x + y * y
        radial = 1 + r * (k1 + r * (k2 + r * k3))
        seen_x = x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x)
        seen_y = y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y
        seen = np.einsum("ij,jhw->ihw", intrinsics, np.stack([seen_x, seen_y, np.ones_like(x)]))
        self._source = seen[[1, 0]].astype(np.float32)

    def image(self, pixels: UInt8[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
        """Bilinear."""
        channels = [ndimage.map_coordinates(c, self._source, np.float32, order=1) for c in np.moveaxis(pixels, -1, 0)]
        return np.round(np.stack(channels, -1)).astype(np.uint8)

    def mask(self, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        """The nearest pixel's."""
        return ndimage.map_coordinates(mask.astype(np.uint8), self._source, order=0) > 0
