"""Small sheets of cloth with nothing around them, for the tests of the physics."""

import jax
import jax.numpy as jnp
import numpy as np

from avatarjax.physics import xpbd
from avatarjax.physics.cloth import Cloth, Fabric, sew
from avatarjax.physics.contacts import Capsules, Surface

ANYWHERE = 100.0  # metres: a reach that holds nothing back


def grid(rows, columns, spacing=0.05):
    """Vertices (n, 3) of a level sheet, rows along +z and columns along +x, triangles (f, 3) that face up, and uvs."""
    row, column = np.mgrid[:rows, :columns]
    vertices = np.stack([column, 0 * row, row], axis=-1).reshape(-1, 3) * spacing
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, below, across = corner + 1, corner + columns, corner + columns + 1
    faces = np.concatenate([np.stack([corner, below, right], 1), np.stack([right, below, across], 1)])
    uvs = np.stack([column / columns, row / rows], axis=-1).reshape(-1, 2)[faces]
    return vertices.astype(np.float32), faces.astype(np.int32), uvs.astype(np.float32)


def sewn(vertices, faces, uvs, pinned, fabrics=(Fabric(),), fabric_of=None, reach=ANYWHERE, braces=(), distance=1.0):
    """A cloth whose vertices `pinned` are sewn on."""
    reaches = np.full(len(vertices), reach, np.float32)
    reaches[pinned] = 0
    return sew(
        vertices,
        faces,
        uvs,
        np.zeros(len(faces), np.int32) if fabric_of is None else fabric_of,
        fabrics,
        reaches,
        np.asarray(braces, np.int32).reshape(-1, 2),
        np.full(len(vertices), distance, np.float32),
    )


def hanging(rows=12, columns=12, spacing=0.05, height=2.0, **options) -> Cloth:
    """A sheet in the plane z = 0 whose first row is sewn on, `height` metres over the ground."""
    vertices, faces, uvs = grid(rows, columns, spacing)
    upright = np.stack([vertices[:, 0], height - vertices[:, 2], 0 * vertices[:, 0]], axis=1)
    return jax.tree.map(jnp.asarray, sewn(upright, faces, uvs, np.arange(columns), **options))


def loose(rows=8, columns=8, spacing=0.05, height=2.0, **options) -> Cloth:
    """A level sheet that is sewn on nowhere, `height` metres over the ground."""
    vertices, faces, uvs = grid(rows, columns, spacing)
    vertices = vertices + np.array([0, height, 0], np.float32)
    cloth = sewn(vertices, faces, uvs, [0], **options)
    mass = np.bincount(faces.ravel(), minlength=len(vertices)) / 3 * spacing**2 / 2 * Fabric().density
    cloth = cloth.replace(
        inverse_masses=(1 / mass).astype(np.float32),
        tether_length=np.full(len(vertices), ANYWHERE, np.float32),
        reach=np.full(len(vertices), ANYWHERE, np.float32),
    )
    return jax.tree.map(jnp.asarray, cloth)


def at_rest(cloth, velocity=(0.0, 0.0, 0.0)) -> xpbd.ClothState:
    """The pattern, all of it with one velocity."""
    return xpbd.ClothState(cloth.rest, jnp.broadcast_to(jnp.asarray(velocity, jnp.float32), cloth.rest.shape))


def nothing() -> tuple[Surface, Capsules]:
    """No solid within reach."""
    below = jnp.array([[[0.0, -50.0, 0.0]]])
    return Surface(below, jnp.array([[[0.0, 1.0, 0.0]]])), Capsules(
        jnp.zeros((0, 3)), jnp.zeros((0, 3)), jnp.zeros((0,))
    )


def still(cloth, frames, surface=None, capsules=None) -> xpbd.Drive:
    """Drives of `frames` + 1 frames in which nothing moves."""
    none = nothing()
    drive = xpbd.Drive(cloth.rest, surface or none[0], capsules or none[1])
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (frames + 1, *x.shape)), drive)


simulate = jax.jit(xpbd.simulate, static_argnames="config")
