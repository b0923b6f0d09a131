"""The objects on a level's ground: trees, meshes and lamps. They are read on first use and are the same under every sun."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from pyproj import CRS

from skugga.terrain.cache import MIB, cached
from skugga.terrain.geo.world import World
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.geolocate import Geolocator
from skugga.terrain.level.level import CasterKind, LoadedLevel
from skugga.terrain.lights import AnimatedLamp, animated_lamp
from skugga.terrain.meshes.solids import Solids
from skugga.terrain.trees.trees import Trees

if TYPE_CHECKING:
    from skugga.terrain.ground.draped_lines import DrapedLines
    from skugga.terrain.ground.land_cover import LandCover
    from skugga.terrain.meshes.assemble import Placement
    from skugga.terrain.meshes.facades import Facades
    from skugga.terrain.meshes.surface import Surface
    from skugga.terrain.trees.forest import Planting

MIN_EDGE_NORMAL_DISTANCE = 0.8
"""Minimum distance of the unit normals of two faces at a sharp edge: 47 degrees. Below it the surface counts as smooth."""


@dataclass(frozen=True, eq=False)
class SceneObjects:
    """Trees, meshes and lamps of a level. The meshes have their positions at a second of the level's clock.

    Properties raise ``LevelError`` or ``SourceError``.
    """

    loaded: LoadedLevel
    world: World
    elevation: Elevation
    clock_seconds: float = 0.0

    def close(self) -> None:
        """Release the trees and meshes that were read."""
        for name, attribute in vars(type(self)).items():
            if isinstance(attribute, cached_property):
                self.__dict__.pop(name, None)

    def at_second(self, seconds: float) -> SceneObjects:
        """Return the objects at another second of the level's clock, or these objects where no mesh moves.

        Both share the properties that do not depend on the clock, so that no file is read twice.
        """
        if seconds == self.clock_seconds or not any(mesh.moves for mesh in self.loaded.level.meshes):
            return self
        other = replace(self, clock_seconds=seconds)
        shared = ("lines", "land_cover", "planting", "placement", "facades", "solid_creases", "animated_lamps")
        other.__dict__.update({name: getattr(self, name) for name in shared})
        return other

    @cached_property
    def lines(self) -> DrapedLines | None:
        """The level's roads and rivers on its ground, or ``None``."""
        if not (self.loaded.level.roads or self.loaded.level.rivers):
            return None
        from skugga.terrain.ground.line_sources import read_lines

        return read_lines(self.loaded, self.world, self.elevation)

    @cached_property
    def land_cover(self) -> LandCover | None:
        """The level's land cover, with the floor of its woods, or ``None``."""
        if not (self.loaded.level.land_cover or self.loaded.level.forest):
            return None
        from skugga.terrain.ground.land_cover_sources import read_land_cover

        return read_land_cover(self.loaded, self.world, self.elevation)

    @cached_property
    def planting(self) -> Planting | None:
        """The level's forest on its ground, or ``None``."""
        if not self.loaded.level.forest:
            return None
        # Imported here, since its libraries take half a second to load, and only levels with trees need them.
        from skugga.terrain.trees.forest import plant_trees

        return plant_trees(self.loaded, self.world, self.elevation)

    @property
    def trees(self) -> Trees | None:
        """The trees, or ``None``."""
        return None if self.planting is None else self.planting.trees

    @property
    def notes(self) -> tuple[str, ...]:
        """Statements on what was read from the files of lines, land cover, trees and footprints."""
        parts = (self.lines, self.land_cover, self.placement, self.planting)
        return tuple(note for part in parts if part is not None for note in part.notes)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Statements on probable mistakes in the files of lines, land cover, trees and footprints."""
        parts = (self.lines, self.land_cover, self.placement, self.planting)
        return tuple(text for part in parts if part is not None for text in part.warnings)

    @cached_property
    def placement(self) -> Placement | None:
        """The placement of all meshes, independent of the clock, or ``None``."""
        if not self.loaded.level.meshes:
            return None
        from skugga.terrain.meshes.assemble import place_meshes

        return place_meshes(self.loaded, self.world, self.elevation)

    @cached_property
    def animated_lamps(self) -> dict[str, AnimatedLamp]:
        """The level's lamps by name, each with its positions at all times of the clock."""
        key_path, geolocator = f"{self.loaded.path}: lights", Geolocator(self.world, self.elevation)
        return {
            name: animated_lamp(name, spec, geolocator, f"{key_path}.{name}") for name, spec in self.loaded.level.lights.items()
        }

    @cached_property
    def solids(self) -> Solids | None:
        """The meshes, or ``None``."""
        if self.placement is None:
            return None
        from skugga.terrain.meshes.assemble import solids

        placed = solids(self.placement, self.clock_seconds)
        return placed if len(placed.triangles) else None

    @property
    def surface(self) -> Surface | None:
        """Textures and materials of the meshes' triangles, or ``None`` if each triangle has one colour."""
        return None if self.placement is None else self.placement.surface

    @cached_property
    def facades(self) -> Facades | None:
        """The façades of the level's buildings, or ``None``. Buildings do not move."""
        if self.placement is None or self.solids is None:
            return None
        from skugga.terrain.meshes.facades import facades

        return facades(self.placement, self.solids)

    @cached_property
    def solid_creases(self) -> np.ndarray:
        """How far the smooth surface round each triangle of the meshes bends upwards, float32 (n,).

        The measure is that of ``skugga.terrain.meshes.facets.creases``. Sharp edges (``MIN_EDGE_NORMAL_DISTANCE``) do not count. It
        is the same at every second of the clock, since bodies are rigid and share no vertices.
        """
        if self.solids is None:
            return np.zeros(0, np.float32)
        from skugga.terrain.meshes.facets import creases, face_normals, node_faces

        vertices, triangles = self.solids.vertices_earth_m, self.solids.triangles
        normals, adjacency = face_normals(vertices, triangles), node_faces(len(vertices), triangles)
        return creases(vertices, normals, triangles, adjacency, MIN_EDGE_NORMAL_DISTANCE, np.ones(len(triangles), np.bool_))

    @cached_property
    def tree_base_heights_m(self) -> np.ndarray:
        """Heights (n,) of the trees' feet in metres."""
        return self.trees_in_crs(self.elevation.crs)[:, 2]

    def solids_in_crs(self, crs: CRS) -> np.ndarray:
        """Return x, y in a CRS and height in metres (n, 3) of the meshes' vertices."""
        assert self.solids is not None
        return _map_positions(self.world, self.solids.vertices_earth_m, crs)

    def trees_in_crs(self, crs: CRS) -> np.ndarray:
        """Return x, y in a CRS and height in metres (n, 3) of the trees' feet."""
        assert self.trees is not None
        return _map_positions(self.world, self.trees.base_earth_m, crs)

    @cached_property
    def caster_kinds(self) -> tuple[CasterKind, ...]:
        """The kinds of shadow casters in the level. The ground is always one."""
        caster_kinds: list[CasterKind] = ["relief"]
        if self.solids is not None:
            caster_kinds.append("meshes")
        if self.trees is not None:
            caster_kinds.append("forest")
        return tuple(caster_kinds)

    @cached_property
    def crown_area_share(self) -> float:
        """Area of all crowns as a share of the ground's. Larger than the covered share where crowns overlap."""
        if self.trees is None:
            return 0.0
        ground_m2 = self.elevation.rows * self.elevation.cols * self.elevation.cell_size_m(self.world.metres_per_unit) ** 2
        return float(np.pi / 4.0 * np.sum(np.square(self.trees.crown_diameter_m, dtype=np.float64)) / ground_m2)

    @cached_property
    def tallest_object_m(self) -> float:
        """Largest height of any object above its ground in metres; 0 on bare ground."""
        tree_m = 0.0 if self.trees is None else float(self.trees.height_m.max())
        if self.solids is None:
            return tree_m
        solid_positions = self.solids_in_crs(self.elevation.crs)
        above = solid_positions[:, 2] - self.elevation.filled_ground_m(solid_positions[:, 0], solid_positions[:, 1])
        return max(tree_m, float(np.nanmax(above, initial=0.0)))


@cached("scene", 512 * MIB)
def _map_positions(world: World, points_earth_m: np.ndarray, crs: CRS) -> np.ndarray:
    """Return x, y in a CRS and height in metres (n, 3) of earth-fixed points (n, 3)."""
    return np.stack(world.map_position(crs, points_earth_m), axis=-1)
