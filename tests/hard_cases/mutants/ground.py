"""Defects of the ground, of its casters, of the sun, and of columns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from tests.hard_cases.mutants.mutant import Mutant, cases, edited, wrapped


def _without_patches(occluder_patches: Callable[..., Any]) -> Callable[..., Any]:
    """Return a mutant of ``occluder_patches`` that finds no patches."""
    return lambda scene, buffer: ((), occluder_patches(scene, buffer)[1])


def _with_raised_patches(caster_sheets: Callable[..., Any]) -> Callable[..., Any]:
    """Raise all sheets but a block's own, which is the first."""

    def raised(*args: Any) -> list[Any]:
        own_sheet, *patches = caster_sheets(*args)
        up_m = np.float32([0.0, 0.0, 20.0])
        return [own_sheet, *(replace(patch, position_frame_m=patch.position_frame_m + up_m) for patch in patches)]

    return raised


def _with_raised_rim(heights_with_rim: Callable[..., Any]) -> Callable[..., Any]:
    """Return a mutant of ``heights_with_rim`` whose rim is 10 m higher than all ground."""

    def raised(*args: Any) -> tuple[np.ndarray, ...]:
        height_m, valid, rim = heights_with_rim(*args)
        return np.pad(height_m[1:-1, 1:-1], 1, constant_values=np.float32(np.nanmax(height_m) + 10.0)), valid, rim

    return raised


MUTANTS = {
    "half_a_cell_off": Mutant(
        "heights lie at the corners of cells instead of their centres",
        edited(
            "terrain.ground.elevation:Elevation.cell_of",
            (
                "inverse.d * x + inverse.e * y - 0.5, inverse.a * x + inverse.b * y - 0.5",
                "inverse.d * x + inverse.e * y, inverse.a * x + inverse.b * y",
            ),
        ),
        cases("test_rasters", "test_turned_rasters", "sweep")
        + cases("test_rasters", "test_stretched_and_mirrored_rasters", "sweep")
        + cases("test_rasters", "test_cells_and_grids_of_any_size", "sweep")
        + cases("test_places", "test_true_north", "sweep")
        + cases("test_places", "test_same_scene_in_every_crs", "sweep")
        + cases("test_places", "test_web_mercator", "sweep")
        + cases("test_spikes", "test_a_cliff", "sweep")
        + cases("test_spikes", "test_saw_teeth", "sweep"),
    ),
    "sentinels_are_heights": Mutant(
        "undeclared sentinels count as heights",
        edited(
            "terrain.ground.elevation:Elevation._read_cells",
            ("(height_m >= self._limits[0]) & (height_m <= self._limits[1])", "np.isfinite(height_m)"),
        ),
        cases("test_rasters", "test_holes_cast_nothing", "sweep", "shadow_map")
        + cases("test_rasters", "test_numbers_of_every_kind", "engine"),
    ),
    "holes_are_walls": Mutant(
        "holes cast as if they were filled to 300 m",
        edited(
            "terrain.ground.elevation:Elevation._filled_heights",
            (
                "return padded_values[row0",
                "padded_values[np.isnan(self._read(lod, top, bottom, left, right))] = 300.0\n    return padded_values[row0",
            ),
        ),
        cases("test_rasters", "test_holes_cast_nothing", "sweep") + cases("test_rasters", "test_shadows_cross_holes", "sweep"),
    ),
    "half_the_detail": Mutant(
        "heights are read at half of their detail",
        wrapped(
            "terrain.ground.elevation:Elevation.heights_at",
            lambda heights_at: lambda self, lod, row, col: heights_at(self, lod + 1, row, col),
        ),
        cases("test_spikes", "test_a_needle", "sweep"),
    ),
    "western_longitudes": Mutant(
        "the sun of a time is that of the longitude on the other side of Greenwich",
        edited(
            "terrain.geo.sun:sun_of",
            ("apparent_sun_position(spec.time, world.anchor_lon_deg,", "apparent_sun_position(spec.time, -world.anchor_lon_deg,"),
        ),
        cases("test_places", "test_edges_of_the_map", "sweep") + cases("test_suns", "test_midnight_sun_and_polar_night", "sweep"),
    ),
    "light_from_below": Mutant(
        "a sun below the horizon lights the ground from below",
        edited(
            "shadows.attached_shadow:attached_shadow_mask",
            ("if not scene.sun_is_up or scene.sun is None:", "if scene.sun is None:"),
            (
                "return faces_away(normal,",
                "normal = np.where(np.array(source)[2] <= 0.0, -normal, normal)\n        return faces_away(normal,",
            ),
        ),
        cases("test_suns", "test_suns_at_the_limits", "sweep", "shadow_map")
        + cases("test_suns", "test_midnight_sun_and_polar_night", "sweep", "shadow_map")
        + cases("test_far_shadows", "test_the_sun_crosses_the_horizon", "sweep"),
    ),
    "columns_off_their_middles": Mutant(
        "rays over columns start at the rims of their tops",
        edited(
            "shadows.sweep.columns:column_sweep",
            (
                "row, col = placed.row.ravel()[pixel] + float(window.row0),",
                "row, col = placed.row.ravel()[pixel] + float(window.row0) + 0.5,",
            ),
        ),
        cases("test_columns", "test_a_box_under_eight_suns", "sweep")
        + cases("test_columns", "test_rays_over_cells", "sweep")
        + cases("test_columns", "test_eight_symmetries", "sweep"),
    ),
    "feet_are_metres": Mutant(
        "heights in feet count as metres",
        edited(
            "terrain.ground.elevation:Elevation.__init__",
            ("dataset.scales[0] * self.vertical.metres_per_stored_unit * exaggeration", "dataset.scales[0] * exaggeration"),
        ),
        cases("test_places", "test_same_scene_in_every_crs", "sweep"),
    ),
    "axes_by_the_zenith": Mutant(
        "the light's axes are a cross product with the zenith",
        edited(
            "terrain.geo.light_space:light_space",
            (
                "right = np.array([-np.cos(azimuth), np.sin(azimuth), 0.0])",
                "right = np.cross([0.0, 0.0, 1.0], -direction_enu(sun.azimuth_deg, sun.altitude_deg))\n"
                "    right = right / max(np.linalg.norm(right), 1e-9)",
            ),
        ),
        cases("test_world_scale", "test_suns_along_the_axes", "shadow_map", "sweep"),
    ),
    "no_neighbours": Mutant(
        "ground beyond a block casts nothing into it",
        wrapped("terrain.casters.reach:_occluder_patches", _without_patches),
        cases("test_tiles", "test_tiles_join", "sweep") + cases("test_sweep_azimuths", "test_every_azimuth", "sweep"),
    ),
    "raised_neighbours": Mutant(
        "ground beyond a block casts as if it were 20 m higher",
        wrapped("terrain.casters.casting:caster_sheets", _with_raised_patches),
        cases("test_sweep_azimuths", "test_seams_throw_nothing", "shadow_map"),
    ),
    "raised_rim": Mutant(
        "the outermost nodes of a block's ground are 10 m higher than its highest",
        wrapped("terrain.ground.elevation:Elevation.heights_with_rim", _with_raised_rim),
        cases("test_rasters", "test_smallest_rasters", "sweep"),
    ),
}
