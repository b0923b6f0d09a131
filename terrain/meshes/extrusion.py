"""Extrude footprints to closed blocks on the earth, under flat or sloped roofs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from skugga.terrain.geo.world import World
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.level.parts import MeshSpec, RoofForm
from skugga.terrain.meshes.block_triangles import block_triangles, roof_triangles
from skugga.terrain.meshes.body import Body, Footprint, PlacedBody, srgb_albedo
from skugga.terrain.meshes.materials import hash_bits, wall_and_roof_albedo
from skugga.terrain.meshes.skeleton_roofs import MAX_SKELETON_CORNERS, MAX_SKELETON_WORK
from skugga.terrain.meshes.sloped_blocks import sloped_block


@dataclass(frozen=True, eq=False)
class Blocks:
    """Blocks (extruded footprints), one row per polygon.

    Attributes
    ----------
    polygons
        Outlines in the terrain's CRS.
    color_key
        Centroid (n, 2) of the feature that the polygon belongs to. The colours derive from it.
    roof_m, base_m
        Heights (n,) of roof and floor above the elevation's datum, metres.
    height_m
        Height (n,) of the roof above the floor, or above the mean ground if the block stands on it, metres.
    """

    polygons: np.ndarray
    color_key: np.ndarray
    roof_m: np.ndarray
    base_m: np.ndarray
    height_m: np.ndarray


@dataclass(frozen=True, eq=False)
class Extrusion:
    """Extruded blocks, and warnings about roofs and eaves that could not be built."""

    bodies: list[PlacedBody]
    warnings: tuple[str, ...] = ()


def extrude(blocks: Blocks, world: World, elevation: Elevation, spec: MeshSpec) -> Extrusion:
    """Return the blocks as placed bodies, with the colour, the form of roofs and the eaves of a level's mesh.

    Outlines are in the CRS of the ground ``elevation``. Without a colour, a block's albedo derives from its ``color_key``.
    """
    albedo = None if spec.color is None else srgb_albedo(spec.color)
    rings, polygon = shapely.get_rings(blocks.polygons, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    is_corner = np.append(ring[1:] == ring[:-1], False)  # the last point of a ring repeats the first
    xy, ring, crs = xy[is_corner], ring[is_corner], elevation.crs
    terrain_m = elevation.filled_ground_m(xy[:, 0], xy[:, 1])
    ground, up = world.points_at_zero_height(crs, xy[:, 0], xy[:, 1])
    ring_ends = np.cumsum(np.bincount(ring, minlength=len(rings)))
    start, first_ring, placed = 0, 0, []
    flat_count, narrow_count, skeleton_work = 0, 0, 0
    for i, (roof_m, base_m) in enumerate(zip(blocks.roof_m, blocks.base_m, strict=True)):
        last_ring = int(np.searchsorted(polygon, i, side="right"))
        ends = ring_ends[first_ring:last_ring]
        corner_slice = slice(start, int(ends[-1]))
        origin = ground[start] + base_m * up[start]
        floor = ground[corner_slice] + base_m * up[corner_slice]
        # A rectangle needs no skeleton, and a flat roof none either.
        corner_count = 0 if spec.roof == "auto" or corner_slice.stop - start <= 4 else corner_slice.stop - start
        skeleton_work += corner_count**2
        form: RoofForm = spec.roof if skeleton_work <= MAX_SKELETON_WORK or not corner_count else "flat"
        sloped, lacks_roof, lacks_eaves = sloped_block(
            floor, up[start], ends - start, blocks.height_m[i], form, spec.eaves_m if form == spec.roof else 0.0
        )
        lacks_roof = lacks_roof or form != spec.roof
        flat_count, narrow_count = flat_count + lacks_roof, narrow_count + lacks_eaves
        if sloped is None:
            roof = roof_triangles(xy[corner_slice] - xy[start], ends - start)
            triangles, is_roof = block_triangles(roof, ends - start)
            crease_deg = None
            order, wall_drop_m = np.arange(corner_slice.start, corner_slice.stop), 0.0
            vertices = np.concatenate([ground[corner_slice] + height * up[corner_slice] for height in (roof_m, base_m)]) - origin
        else:
            order, wall_drop_m = start + sloped.order, sloped.wall_drop_m
            point, point_up = world.points_at_zero_height(crs, *(sloped.point_weights @ xy[order]).T)
            vertices = np.concatenate([
                ground[order] + (roof_m - wall_drop_m) * up[order], ground[order] + base_m * up[order],
                point + (roof_m - sloped.point_drops_m)[:, None] * point_up,
            ]) - origin  # fmt: skip
            triangles, is_roof, crease_deg = sloped.triangles, sloped.is_roof, sloped.crease_deg
        bits, ground_floor_m = hash_bits(blocks.color_key[i], crs), roof_m - blocks.height_m[i]
        wall_albedo, roof_albedo = wall_and_roof_albedo(bits) if albedo is None else (albedo, albedo)
        body = Body(vertices, triangles, np.where(is_roof[:, None], roof_albedo, wall_albedo), crease_deg=crease_deg)
        footprint = Footprint(
            bits, float(ground_floor_m - base_m), float(blocks.height_m[i] - wall_drop_m),
            (terrain_m[order] - ground_floor_m).astype(np.float32),
        )  # fmt: skip
        placed.append(PlacedBody(body, origin, np.eye(3), footprint=footprint))
        start, first_ring = corner_slice.stop, last_ring
    return Extrusion(placed, _roof_warnings(flat_count, narrow_count))


def _roof_warnings(flat_count: int, narrow_count: int) -> tuple[str, ...]:
    """Return warnings about the numbers of buildings that lack a sloped roof, or eaves."""
    warnings = []
    if flat_count:
        problem = (
            f"outlines of more than {MAX_SKELETON_CORNERS} corners, that touch themselves, or whose skeleton was not found; all "
            f"outlines beyond {MAX_SKELETON_WORK:,} squared corners of a file"
        )
        warnings.append(f"footprints with flat roofs in place of sloped ones: {flat_count} ({problem}). Simplify or split them")
    if narrow_count:
        problem = "walls too low, corners too sharp, or courtyards and niches too narrow"
        warnings.append(f"footprints without eaves: {narrow_count} ({problem}). Use smaller eaves_m")
    return tuple(warnings)
