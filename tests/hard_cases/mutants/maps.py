"""Defects of depth maps, of perspective maps, and of foliage."""

from __future__ import annotations

from collections.abc import Callable

from tests.hard_cases.mutants.mutant import Mutant, cases, constant, edited, edited_shader, wrapped


def edited_receiver(*changes: tuple[str, str]) -> Callable[[], None]:
    """Return a defect of the shader that looks points up in depth maps. The loops on the CPU that do the same work are off.

    Tests compare the loops with the shader, point by point.
    """
    defects = (
        edited_shader("shadows/maps/receiver", *changes),
        wrapped("shadows.maps.lookup:_has_loop", lambda original: lambda depth_map, settings: False),
    )

    def apply() -> None:
        for apply_defect in defects:
            apply_defect()

    return apply


MUTANTS = {
    "sixteen_bits_always": Mutant(
        "maps have 16 bits, whatever the plan says",
        edited("shadows.maps.drawing:draw_map", ("depth_map.depth_bits)", "16)")),
        cases("test_depth", "test_depths_are_right_to_within_a_step", "shadow_map"),
    ),
    "no_half_step": Mutant(
        "depths are compared without regard to their rounding",
        edited_receiver(("uses_offset ? 0.5 * depth_step : 0.0", "0.0")),
        cases("test_depth", "test_depths_are_right_to_within_a_step", "shadow_map")
        + cases("test_depth", "test_sixteen_bits_are_enough_for_mountains", "shadow_map")
        + cases("test_depth", "test_more_bits_are_taken_where_they_are_needed", "shadow_map"),
    ),
    "cascades_overlap": Mutant(
        "a point where cascades part belongs to both",
        edited("shadows.maps.windows:sun_maps", ("(distance_m > near_m)", "(distance_m >= near_m)")),
        cases("test_depth", "test_cascades_part_on_a_pixel", "shadow_map"),
    ),
    "cascades_gap": Mutant(
        "a point where cascades part belongs to neither",
        edited("shadows.maps.windows:sun_maps", ("(distance_m <= far_m)", "(distance_m < far_m)")),
        cases("test_depth", "test_cascades_part_on_a_pixel", "shadow_map"),
    ),
    "thin_leaves_in_maps": Mutant(
        "maps leave out the leaves' half-transparent rims",
        edited("shadows.maps.drawing:draw_map", ('"threshold": ALPHA_THRESHOLD', '"threshold": 0.75')),
        cases("test_foliage", "test_billboards", "shadow_map") + cases("test_foliage", "test_stands", "shadow_map"),
    ),
    "thin_leaves_on_the_plane": Mutant(
        "planar shadows leave out the leaves' half-transparent rims",
        edited("shadows.planar:_draw_casters", ('"threshold": ALPHA_THRESHOLD', '"threshold": 0.75')),
        cases("test_foliage", "test_billboards", "planar"),
    ),
    "trees_turn_to_the_eye": Mutant(
        "trees turn with the camera when their shadows are drawn on a plane",
        edited(
            "shadows.planar:_draw_casters",
            (
                "np.concatenate([instances.yaw_cos_sin,",
                "np.concatenate([np.tile(clip_from_caster[0, :2] / np.linalg.norm(clip_from_caster[0, :2]), (len(instances), 1)),",
            ),
        ),
        cases("test_foliage", "test_camera_round_a_tree", "planar"),
    ),
    "exact_positions": Mutant(
        "float32 positions count as exact, however far away their triangles' corners are",
        constant("shadows.maps.windows:POSITION_ERROR", 0.0),
        cases("test_perspective_maps", "test_huge_triangles", "shadow_map"),
    ),
    "wide_cone": Mutant(
        "a perspective map is uniform already 15 degrees off the view's axis",
        constant("shadows.maps.post_perspective:UNIFORM_MAP_CONE_DEG", 15.0),
        cases("test_perspective_maps", "test_sun_in_the_axis", "perspective_shadow_map"),
    ),
    "sun_never_behind": Mutant(
        "a perspective map takes a sun behind the eye for one before it",
        edited(
            "shadows.maps.post_perspective:light_matrix",
            ("to_light = light[:3] - light[3] * middle", "to_light = light[:3] - abs(light[3]) * middle"),
        ),
        cases("test_perspective_maps", "test_sun_behind_the_viewer", "perspective_shadow_map")
        + cases("test_perspective_maps", "test_fields_of_view", "perspective_shadow_map"),
    ),
    "clipped_casters": Mutant(
        "casters before a map's first depth are clipped",
        edited("terrain.gl.device:Device.depth_pass", ("self.ctx.enable_direct(_DEPTH_CLAMP)", "pass")),
        cases("test_perspective_maps", "test_casters_in_the_plane_of_the_eye", "shadow_map", "perspective_shadow_map")
        + cases("test_perspective_maps", "test_sun_across_the_view", "shadow_map")
        + cases("test_perspective_maps", "test_sun_on_the_rim_of_the_picture", "shadow_map")
        + cases("test_far_shadows", "test_a_beam_outside_of_the_view", "shadow_map"),
    ),
    "far_near_plane": Mutant(
        "a camera sees nothing nearer than half a metre",
        constant("terrain.gbuffer.id_buffer:NEAR_PLANE_M", 0.5),
        cases("test_views", "test_close_to_a_wall", "shadow_map", "planar"),
    ),
    "half_of_the_receivers": Mutant(
        "a perspective map is fitted to the upper half of the picture",
        edited(
            "shadows.maps.perspective_shadow_map:perspective_map",
            (
                "low, high, outermost = _bounds_in_map(best.clip_from_frame, uniform, nearest, position, chosen)",
                "low, high, outermost = _bounds_in_map(\n"
                "    best.clip_from_frame, uniform, nearest, position, chosen[: len(chosen) // 2]\n"
                ")",
            ),
        ),
        cases("test_perspective_maps", "test_sun_on_the_rim_of_the_picture", "perspective_shadow_map")
        + cases("test_perspective_maps", "test_sun_across_the_view", "perspective_shadow_map"),
    ),
    "triangles_before_themselves": Mutant(
        "a map's point lies behind its own triangle by the rounding that it should be before it",
        edited_receiver(("- slack_m;", "+ slack_m;")),
        cases("test_bias", "test_a_footprint_in_the_ground", "shadow_map"),
    ),
    "random_lattice": Mutant(
        "the lattice of a map's texels begins at a random place, another one each time",
        edited(
            "shadows.maps.windows:_map_window", (") - border_texels_xy", ") - border_texels_xy + np.random.default_rng().random(2)")
        ),
        cases("test_repeatable", "test_the_same_again", "shadow_map"),
    ),
    "stale_maps": Mutant(
        "a map of before is used again, wherever it lay",
        edited("shadows.maps.drawing:_map_cache_key", (" tuple(depth_map.uniforms.items()),", "")),
        cases("test_steady", "test_shimmer_of_a_perspective_map", "perspective_shadow_map")
        + cases("test_steady", "test_steady_under_yaw", "shadow_map"),
    ),
}
