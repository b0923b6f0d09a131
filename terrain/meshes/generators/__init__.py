"""Generated meshes: test scenes for shadows, each a list of closed bodies in metres east, north and up.

Five scenes follow the descriptions, not the models, of J. Sindholt, *A comparison of Shadow Algorithms* (DTU 2005, section 7), with
its numbers of triangles. ``tetrahedra`` and ``wood_hill`` belong to a landscape typical of the GIS of that time.
"""

from __future__ import annotations

from collections.abc import Callable

from skugga.terrain.meshes.body import Body
from skugga.terrain.meshes.generators.boxgrid import boxgrid
from skugga.terrain.meshes.generators.landmarks import tetrahedra, wood_hill
from skugga.terrain.meshes.generators.rocks import rocks
from skugga.terrain.meshes.generators.room import room
from skugga.terrain.meshes.generators.street import street
from skugga.terrain.meshes.generators.water_tower import water_tower

GENERATORS: dict[str, Callable[[], list[Body]]] = {
    "boxgrid": boxgrid,
    "rocks": rocks,
    "street": street,
    "room": room,
    "water_tower": water_tower,
    "tetrahedra": tetrahedra,
    "wood_hill": wood_hill,
}
"""Name of a scene -> function that returns its bodies, the same at every call. Heights are above the ground."""
