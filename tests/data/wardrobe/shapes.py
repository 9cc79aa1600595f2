"""Shapes that tests dress."""

import numpy as np

from avatarjax.data.wardrobe.garments import grid_faces


def ball(rows=30, columns=60):
    """Points, which are also the normals, and faces of a ball of radius 1."""
    polar, angles = np.meshgrid(np.linspace(0.01, np.pi - 0.01, rows), np.arange(columns) * 2 * np.pi / columns)
    polar, angles = polar.T, angles.T
    n = np.stack([np.sin(polar) * np.sin(angles), np.cos(polar), np.sin(polar) * np.cos(angles)], axis=-1)
    return n.reshape(-1, 3), grid_faces(rows, columns, closed=True)[0]
