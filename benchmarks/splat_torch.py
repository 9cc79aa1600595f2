"""Gaussian splatting in plain PyTorch, for benchmarks/splat.py: what one writes without a kernel of one's own.

It takes `pip install torch` (2.13.0 was measured). Same model and constants as `avatarjax.splat`. Projection, depth
sort and binning are vectorised; compositing is a loop over the tiles that any Gaussian touches, in chunks of their
lists until the tile is opaque; gradients are autograd's.
"""

from __future__ import annotations

import math

import numpy as np
import torch  # pyright: ignore[reportMissingImports]

from avatarjax import Camera, Gaussians

ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN = 1 / 255, 0.99, 1e-4
NEAR, EPS2D = 0.01, 0.3
# The fastest that were measured on two CPU cores.
TILE = 8
CHUNK = 256


class Renderer:
    """A cloud of n Gaussians and a square camera as tensors."""

    def __init__(self, cloud: Gaussians, camera: Camera) -> None:
        fields = (cloud.means, cloud.log_scales, cloud.quats, cloud.logit_opacities, cloud.colors)
        self._trained = [torch.tensor(np.asarray(x), requires_grad=True) for x in fields]
        self._camera = [torch.tensor(np.asarray(x)) for x in (camera.world_to_camera, camera.intrinsics)]
        self._size = camera.width

    @torch.no_grad()
    def image(self) -> torch.Tensor:
        """Image (h, w, 3) over black."""
        return render(*self._trained, *self._camera, self._size)[0]

    def gradient(self, weights: np.ndarray) -> tuple[torch.Tensor, ...]:
        """Gradient of sum(image * weights) + sum(alpha) by the five arrays of the cloud; weights (h, w, 3)."""
        image, alpha = render(*self._trained, *self._camera, self._size)
        return torch.autograd.grad((image * torch.from_numpy(weights)).sum() + alpha.sum(), self._trained)


def render(
    means: torch.Tensor,
    log_scales: torch.Tensor,
    quats: torch.Tensor,
    logit_opacities: torch.Tensor,
    colors: torch.Tensor,
    world_to_camera: torch.Tensor,
    intrinsics: torch.Tensor,
    size: int,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Image (size, size, 3) over black and alpha (size, size) of n Gaussians, whose arrays are those of `Gaussians`."""
    log_opacities = torch.nn.functional.logsigmoid(logit_opacities)
    centers, covariances, depths = _project(means, log_scales, quats, world_to_camera, intrinsics, size)
    xx, xy, yy = covariances
    determinant = xx * yy - xy * xy
    conics = torch.stack([-0.5 * yy, xy, -0.5 * xx], dim=1) / determinant[:, None]
    rows = torch.cat([centers, conics, log_opacities[:, None], colors], dim=1)
    with torch.no_grad():
        reach = torch.where(depths > NEAR, 2 * (log_opacities - math.log(ALPHA_MIN)), 0).clamp(min=0)
        extents = (reach[:, None] * torch.stack([xx, yy], dim=1)).sqrt()
        ids, tiles, lengths = _bin(centers, extents, depths, -(-size // TILE))
    # One gather and one split: an index operation for each tile would cost a gradient of all n rows for each tile.
    lists = torch.split(rows[ids], lengths)
    y, x = torch.meshgrid(torch.arange(TILE) + 0.5, torch.arange(TILE) + 0.5, indexing="ij")
    pixels = torch.stack([x.reshape(-1), y.reshape(-1)])
    across = -(-size // TILE)
    blank = torch.zeros(4, TILE * TILE)
    blocks = [blank] * across**2
    for tile, entries in zip(tiles, lists, strict=True):
        corner = torch.tensor([tile % across * TILE, tile // across * TILE], dtype=torch.float32)
        blocks[tile] = _composite(entries, pixels + corner[:, None])
    image = torch.stack(blocks).reshape(across, across, 4, TILE, TILE).permute(0, 3, 1, 4, 2)
    image = image.reshape(across * TILE, across * TILE, 4)[:size, :size]
    return image[..., :3], image[..., 3]


def _project(
    means: torch.Tensor,
    log_scales: torch.Tensor,
    quats: torch.Tensor,
    world_to_camera: torch.Tensor,
    intrinsics: torch.Tensor,
    size: int,
) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]:
    """Centres (n, 2) in pixels, xx, xy and yy (n,) of the covariances in square pixels, depths (n,) in metres."""
    rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
    focal, principal = intrinsics.diagonal()[:2], intrinsics[:2, 2]
    points = means @ rotation.T + translation
    depths = points[:, 2]
    z = torch.where(depths > NEAR, depths, 1)[:, None]
    slopes = points[:, :2] / z
    margin = 0.15 * size / focal
    bounded = torch.minimum(torch.maximum(slopes, -principal / focal - margin), (size - principal) / focal + margin)
    jacobian = torch.cat([torch.diag_embed(focal / z), (-focal * bounded / z)[..., None]], dim=-1)
    on_image = jacobian @ rotation @ (_matrices(quats) * log_scales.exp()[:, None, :])
    x, y = on_image.unbind(dim=1)
    covariances = (x * x).sum(dim=1) + EPS2D, (x * y).sum(dim=1), (y * y).sum(dim=1) + EPS2D
    return focal * slopes + principal, covariances, depths


def _matrices(quats: torch.Tensor) -> torch.Tensor:
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(dim=1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=1),
    ]
    return torch.stack(rows, dim=1)


def _bin(
    centers: torch.Tensor, extents: torch.Tensor, depths: torch.Tensor, across: int
) -> tuple[torch.Tensor, list[int], list[int]]:
    """Gaussians by tile and near to far in each, the tiles with any, and how many each has."""
    first = torch.ceil((centers - extents + 0.5) / TILE - 1).clamp(0, across).long()
    stop = (torch.floor((centers + extents - 0.5) / TILE) + 1).clamp(0, across).long()
    sides = (stop - first).clamp(min=0)
    counts = torch.where(extents[:, 0] > 0, sides[:, 0] * sides[:, 1], 0)
    order = torch.argsort(depths, stable=True)
    ids = torch.repeat_interleave(order, counts[order])
    starts = torch.cumsum(counts[order], dim=0) - counts[order]
    within = torch.arange(len(ids)) - torch.repeat_interleave(starts, counts[order])
    column, row = within % sides[ids, 0], within // sides[ids, 0]
    tiles = (first[ids, 1] + row) * across + first[ids, 0] + column
    tiles, order = torch.sort(tiles, stable=True)
    present, lengths = torch.unique_consecutive(tiles, return_counts=True)
    return ids[order], present.tolist(), lengths.tolist()


def _composite(entries: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    """Colours and alpha (4, p) of a tile: entries (m, 9) near to far, pixels (2, p)."""
    through = torch.ones(1, pixels.shape[1])
    color = torch.zeros(3, pixels.shape[1])
    for chunk in torch.split(entries, CHUNK):
        x, y, xx, xy, yy, log_opacity = chunk[:, :6, None].unbind(dim=1)
        dx, dy = pixels[0] - x, pixels[1] - y
        alphas = torch.exp(log_opacity + (xx * dx + xy * dy) * dx + yy * dy * dy)
        alphas = torch.where(alphas >= ALPHA_MIN, alphas.clamp(max=ALPHA_MAX), 0)
        behind = through * torch.cumprod(1 - alphas, dim=0)
        weights = alphas * torch.cat([through, behind[:-1]])
        color = color + chunk[:, 6:].T @ weights
        through = behind[-1:]
        if through.detach().max() < TRANSMITTANCE_MIN:
            break
    return torch.cat([color, 1 - through])
