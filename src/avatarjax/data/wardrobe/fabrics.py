"""Fabrics by name: how heavy, stiff and airy the sheets are that avatars wear.

Compliance is inverse stiffness (XPBD, Macklin 2016): metres a newton between two vertices. A woven cloth hardly
stretches along its threads, shears easily, and bends more easily the lighter it is; hair is a sheet of strands.
"""

from avatarjax.physics.cloth import Fabric

COTTON = Fabric(density=0.20, stretch=1e-7, shear=2e-4, bend=3e-2)
DENIM = Fabric(density=0.45, stretch=1e-7, shear=5e-5, bend=4e-3)
WOOL = Fabric(density=0.35, stretch=1e-7, shear=1e-4, bend=1e-2)
LEATHER = Fabric(density=0.70, stretch=1e-7, shear=1e-5, bend=1e-3)
SILK = Fabric(density=0.10, stretch=1e-7, shear=5e-4, bend=1e-1, drag=1.2)
HAIR = Fabric(density=0.50, stretch=1e-7, shear=1e-3, bend=5e-3, drag=0.3)
ROPE = Fabric(density=0.60, stretch=1e-7, shear=1e-6, bend=2e-3, drag=0.2)
