"""A thing with a known shape that turns before a still camera: its video, drawn by casting a ray for every pixel."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from avatarjax import cameras
from avatarjax.data.recording import MonocularVideo, Poses, solid

CENTRE = np.array([0.3, 1.0, -0.2])  # Of the body's frame, in the world.
RED, BLUE = np.array([220, 40, 30]), np.array([20, 60, 210])


def ellipsoid(origins, directions, radii=(0.35, 0.6, 0.2)):
    """Distance (n,) along each ray to where it enters the ellipsoid about the origin, infinite where it does not."""
    o, d = origins / np.array(radii), directions / np.array(radii)
    a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - 1
    root = b * b - a * c
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)


def box(origins, directions, half=(0.3, 0.5, 0.25)):
    """The same for a box about the origin."""
    with np.errstate(divide="ignore"):
        a, b = (-np.array(half) - origins) / directions, (np.array(half) - origins) / directions
    near, far = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
    return np.where(near < far, near, np.inf)


def video(shape=ellipsoid, frames=24, size=64, sway=0.0, empty=False):
    """A full turn; the thing is red where its own x is positive and blue elsewhere. `sway` moves it to and fro along
    its own x by so many metres, which its poses do not tell."""
    camera = cameras.look_at((0.5, 1.4, 3.0), CENTRE, width=size, height=size, fov_y=0.6)
    v, u = np.mgrid[:size, :size] + 0.5
    pixels = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3)
    view = np.asarray(camera.world_to_camera, np.float64)
    directions = pixels @ np.linalg.inv(np.asarray(camera.intrinsics, np.float64)).T @ view[:3, :3]
    position = -view[:3, :3].T @ view[:3, 3]
    angles = 2 * np.pi * np.arange(frames) / frames
    images, masks, turns, places = [], [], [], []
    for k, angle in enumerate(angles):
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        place = CENTRE + np.array([0.05 * np.sin(angle), 0, 0])
        shift = sway * np.sin(2 * np.pi * k / 7) * np.array([1.0, 0, 0])
        origins, own = (position - place) @ turn - shift, directions @ turn
        distance = shape(np.broadcast_to(origins, own.shape), own)
        hit = np.isfinite(distance) & (not empty)
        x = (origins + np.where(hit, distance, 0)[:, None] * own)[:, :1]
        images.append(np.where(hit[:, None], np.where(x > 0, RED, BLUE), 230).reshape(size, size, 3).astype(np.uint8))
        masks.append(hit.reshape(size, size))
        turns.append(turn)
        places.append(place)
    poses = Poses(
        np.tile(np.eye(3, dtype=np.float32), (frames, 1, 1, 1)), np.float32(turns), np.float32(places), ("root",), (-1,)
    )
    return MonocularVideo(
        Path("."), solid(np.stack(masks)), camera, poses, 30.0, lambda: iter(images), _loaded=np.stack(images)
    )


def moving_camera(film):
    """The same video with a camera for each frame."""
    frames = len(film)
    tile = lambda x: jnp.broadcast_to(x, (frames, *x.shape))  # noqa: E731
    camera = film.camera.replace(
        world_to_camera=tile(film.camera.world_to_camera), intrinsics=tile(film.camera.intrinsics)
    )
    return MonocularVideo(film.folder, film.mattes, camera, film.poses, film.fps, film.decode, _loaded=film.images())
