"""Defects that several algorithms share, written as replacements of attributes."""

from __future__ import annotations

from itertools import count
from typing import Any

import numpy as np

from tests.hard_cases.mutants.mutant import Mutant, set_existing


def _no_snapping() -> None:
    """Place shadow maps off the lattice of their texels."""
    from skugga.shadows.maps import windows as map_windows

    window = map_windows._map_window
    set_existing(map_windows, "_map_window", lambda low, high, texel, border, stable: window(low, high, texel, border, False))


def _float32_world() -> None:
    """Round map coordinates to float32."""
    from skugga.terrain.geo.world import World

    ground = World.points_at_zero_height
    set_existing(
        World, "points_at_zero_height", lambda self, crs, x, y: ground(self, crs, _round_to_float32(x), _round_to_float32(y))
    )


def _round_to_float32(values: Any) -> np.ndarray:
    """Return values as float64 after rounding to float32."""
    return np.asarray(values, np.float32).astype(np.float64)


def _z_pass_always() -> None:
    """Count shadow volumes by z-pass, even with the eye in shadow."""
    from skugga.shadows.volumes import drawing as volume_drawing

    set_existing(volume_drawing, "may_shade_near_plane", lambda low, high, rectangle, light: np.zeros(len(low), bool))


def _constant_bias() -> None:
    """Look up shadow maps without a bias for the slope of the surface."""
    from skugga.shadows.maps import filling

    look_up = filling.look_up

    def without_slope(gl: Any, depth_map: Any, target: Any, buffer: Any, light: Any, settings: Any, *rest: Any) -> None:
        look_up(
            gl, depth_map, target, buffer, light, settings.model_copy(update={"bias": "normal_offset", "bias_scale": 0.0}), *rest
        )

    set_existing(filling, "look_up", without_slope)


def _near_plane() -> None:
    """Use the camera's own perspective, with its near plane almost at the eye, for perspective shadow maps."""
    from skugga.shadows.maps import post_perspective

    matrix, rank = post_perspective.camera_matrix, count()
    set_existing(
        post_perspective, "camera_matrix", lambda camera, tangent, near_m, far_m, slide_m: matrix(camera, tangent, 1e-6, far_m, 0.0)
    )
    # Its texels would lose to those of a uniform map: use it all the same.
    set_existing(post_perspective, "_rms_texel_size", lambda *args: float(next(rank)))


def _flat_earth() -> None:
    """Replace the earth by the tangent plane at the place where distant shadows end."""
    from skugga.terrain.geo import world
    from tests.hard_cases.landscapes import MERIDIAN_DEG, TIP_DEG

    exact = world.geocentric
    origin, up = exact(np.float64(MERIDIAN_DEG), np.float64(TIP_DEG))
    east = world.direction_east(MERIDIAN_DEG)
    metres = np.array([np.cos(np.radians(TIP_DEG)), 1.0]) * world.EARTH_RADIUS_M * np.pi / 180.0

    def geocentric(lon_deg: Any, lat_deg: Any, _: Any = None) -> tuple[np.ndarray, np.ndarray]:
        lon, lat = np.broadcast_arrays(np.asarray(lon_deg, np.float64), np.asarray(lat_deg, np.float64))
        offsets_m = np.stack([lon - MERIDIAN_DEG, lat - TIP_DEG], axis=-1) * metres
        point = origin + offsets_m @ np.stack([east, np.cross(up, east)])
        return point, np.broadcast_to(up, point.shape).copy()

    set_existing(world, "geocentric", geocentric)


def _mirrored_azimuth() -> None:
    """Mirror the sun from east to west."""
    from skugga.terrain import scene

    sun_of = scene.sun_of

    def mirrored(spec: Any, world: Any) -> Any:
        if spec.azimuth is None:
            return sun_of(spec, world)
        return sun_of(spec.model_copy(update={"azimuth": -spec.azimuth % 360.0}), world)

    set_existing(scene, "sun_of", mirrored)


def _one_diagonal() -> None:
    """Cut all quads along the same diagonal."""
    from skugga.terrain.ground import sheet

    set_existing(sheet, "diagonal_cuts", lambda height: np.zeros((height.shape[0] - 1, height.shape[1] - 1), bool))


def _first_facet() -> None:
    """Let a point that several facets share use the first facet, whatever the light."""
    from skugga.shadows import attached_shadow
    from skugga.shadows.truth import truth
    from skugga.terrain.gbuffer.light_facing import FacingNormals

    def facing_normals(buffer: Any, light: Any, with_lifts: bool = False) -> FacingNormals:
        no_pixels = np.zeros(buffer.valid.shape, bool)
        if buffer.surface is None or buffer.triangle is None:
            return FacingNormals(buffer.normal_frame, buffer.crease, buffer.normal_frame, no_pixels, no_pixels)
        row, col, half = np.moveaxis(np.maximum(buffer.triangle, 0), -1, 0)
        normal = np.where(buffer.triangle[..., :1] < 0, buffer.normal_frame, buffer.surface.sheet.normals_frame[row, col, half])
        return FacingNormals(normal, buffer.crease, normal, no_pixels, no_pixels)

    set_existing(attached_shadow, "facing_normals", facing_normals)
    set_existing(truth, "facing_normals", facing_normals)


def _facets_at_the_terminator() -> None:
    """Decide by flat facets whether ground faces the light."""
    from skugga.terrain.gbuffer import light_facing

    set_existing(light_facing, "_write_smooth_normals", lambda *_: None)


def _chords_shade_the_bulge() -> None:
    """Trace shadows from the facets instead of the smooth ground."""
    from skugga.shadows import visibility

    set_existing(visibility, "move_to_smooth_ground", lambda buffer, light: buffer)


def _own_points() -> None:
    """Sample coarse pixels at one point."""
    from skugga.shadows import render

    set_existing(render, "supersampling", lambda scene, view, plan: None)


MUTANTS = {
    "own_points": Mutant(
        "pixels of coarse maps go by their own points", _own_points,
        (("test_zooms", "test_share_of_shadow", "sweep"), ("test_zooms", "test_share_of_shadow", "shadow_map")),
    ),
    "one_diagonal": Mutant(
        "quads are cut from south-west to north-east, all of them", _one_diagonal,
        (("test_every_side", "test_eight_symmetries", "shadow_volume"), ("test_every_side", "test_eight_symmetries", "truth")),
    ),
    "first_facet": Mutant(
        "a point that several facets share goes by one of them, whatever the light", _first_facet,
        (("test_every_side", "test_eight_symmetries", "sweep"), ("test_every_side", "test_a_box_under_eight_suns", "sweep"),
         ("test_every_side", "test_a_box_under_eight_suns", "truth")),
    ),
    "facets_at_the_terminator": Mutant(
        "between nodes the ground is turned away where its facets are", _facets_at_the_terminator,
        (("test_every_side", "test_no_teeth_at_the_terminator", "sweep"),
         ("test_every_side", "test_no_teeth_at_the_terminator", "shadow_volume"),
         ("test_every_side", "test_no_teeth_in_maps", "sweep")),
    ),
    "chords_shade_the_bulge": Mutant(
        "where the smooth ground faces the light the light is looked for from the facets all the same", _chords_shade_the_bulge,
        (("test_every_side", "test_no_teeth_at_the_terminator", "hybrid"), ("test_every_side", "test_no_teeth_in_maps", "sweep")),
    ),
    "no_snapping": Mutant(
        "maps follow what is looked at, off the lattice of their texels", _no_snapping,
        tuple(
            ("test_steady", test, "shadow_map")
            for test in ("test_whole_pixel_shifts", "test_a_full_turn", "test_steady_under_pan", "test_steady_under_yaw",
                         "test_steady_under_zoom")
        ),
    ),
    "float32_world": Mutant(
        "map coordinates are float32", _float32_world,
        (("test_world_scale", "test_a_site_may_lie_anywhere", "shadow_map"),
         ("test_world_scale", "test_a_site_may_lie_at_odd_digits", "shadow_map"),
         ("test_world_scale", "test_a_site_may_lie_anywhere", "shadow_volume")),
    ),
    "z_pass_always": Mutant(
        "faces before the point are counted, wherever the eye is", _z_pass_always,
        (("test_volumes", "test_eye_in_a_volume", "shadow_volume"), ("test_volumes", "test_eye_in_a_volume", "hybrid")),
    ),
    "constant_bias": Mutant(
        "points are held against a map as they are, whatever the slope", _constant_bias,
        (("test_bias", "test_tilted_planes_are_lit", "shadow_map"), ("test_bias", "test_level_ground_is_lit", "shadow_map"),
         ("test_bias", "test_less_bias_shows_acne", "shadow_map"),
         ("test_perspective_maps", "test_from_a_pebble_to_a_mountain", "shadow_map"),
         ("test_perspective_maps", "test_from_a_pebble_to_a_mountain", "perspective_shadow_map"),
         ("test_perspective_maps", "test_grazing_and_upright_suns", "shadow_map"),
         ("test_perspective_maps", "test_grazing_and_upright_suns", "perspective_shadow_map"),
         ("test_perspective_maps", "test_sun_across_the_view", "perspective_shadow_map"),
         ("test_views", "test_sizes_and_angles", "shadow_map"), ("test_views", "test_places_of_the_eye", "shadow_map"),
         ("test_properties", "test_random_situations", "shadow_map"),
         ("test_properties", "test_random_situations", "perspective_shadow_map")),
    ),
    "near_plane": Mutant(
        "a perspective map's near plane lies a thousandth of a millimetre before the eye, and no texels are compared", _near_plane,
        (("test_properties", "test_found_situations", "perspective_shadow_map"),),
    ),
    "flat_earth": Mutant(
        "the globe is a plane", _flat_earth,
        (("test_far_shadows", "test_a_peak_shades_what_lies_far_away", "sweep"),
         ("test_far_shadows", "test_curvature_shortens_long_shadows", "shadow_map"),
         ("test_rasters", "test_grids_of_the_earth", "shadow_map"),
         ("test_far_shadows", "test_curvature_shortens_long_shadows", "sweep")),
    ),
    "mirrored_azimuth": Mutant(
        "azimuths count counter-clockwise", _mirrored_azimuth,
        (("test_places", "test_true_north", "shadow_map"), ("test_places", "test_true_north", "sweep"),
         ("test_bias", "test_a_cube_touches_its_shadow", "shadow_map")),
    ),
}  # fmt: skip
