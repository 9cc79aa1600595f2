from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Fabric:
    """A sheet: density (kg a square metre), compliances (metres a newton) of edges along the threads (stretch), across
    them (shear) and of opposite corners of neighbouring triangles (bend); drag: how strongly air holds it, relative to
    a flat plate; friction on skin and clothes (Coulomb)."""

    density: float = 0.2
    stretch: float = 1e-7
    shear: float = 1e-4
    bend: float = 1e-2
    drag: float = 0.6
    friction: float = 0.3
