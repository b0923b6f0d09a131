"""Defects of lamps that shine all round, and of the extent of lights."""

from __future__ import annotations

from tests.hard_cases.mutants.mutant import Mutant, cases, edited, edited_shader


def _wide_sun() -> None:
    edited("shadows.area_light:sun_disc_directions", ("np.tan(np.radians(radius_deg))", "1.5 * np.tan(np.radians(radius_deg))"))()
    edited_shader("shadows/maps/sun_disc.frag", ("vec2(ahead_m * disc_tangent)", "vec2(1.5 * ahead_m * disc_tangent)"))()


MUTANTS = {
    "narrow_faces": Mutant(
        "the six maps of a lamp that shines all round end before their seams",
        edited("shadows.maps.windows:lamp_map", ("half = 1.0 if", "half = 0.95 if")),
        cases("test_omni_lamps", "test_a_lamp_that_shines_all_round", "shadow_map"),
    ),
    "short_volumes_of_lamps": Mutant(
        "volumes under a lamp end behind their casters, after a third of the way from the lamp",
        edited(
            "shadows.volumes.volumes:_build_volumes",
            (
                "far = np.column_stack([points - light[:3], np.zeros(count)])",
                "far = np.column_stack([points + (points - light[:3]) / 3.0, np.ones(count)])",
            ),
        ),
        cases("test_omni_lamps", "test_a_lamp_that_shines_all_round", "shadow_volume", "hybrid"),
    ),
    "parallel_rays_of_lamps": Mutant(
        "on a plane a lamp's rays are parallel",
        edited("shadows.planar:_make_projection", ("position_frame_m - origin, 1.0)", "position_frame_m - origin, 0.0)")),
        cases("test_omni_lamps", "test_a_lamp_that_shines_all_round", "planar"),
    ),
    "wide_sun": Mutant(
        "the sun's disc is half as wide again",
        _wide_sun,
        cases("test_penumbrae", "test_half_shadow_of_the_sun", "shadow_map", "perspective_shadow_map", "shadow_volume", "sweep")
        + cases("test_penumbrae", "test_half_shadow_of_an_edge_aslant", "shadow_map", "shadow_volume", "sweep"),
    ),
    "wide_lamp": Mutant(
        "the ball of a lamp is half as wide again",
        edited("shadows.area_light:point_light_scenes", ("lamp.radius_m * ball_points", "1.5 * lamp.radius_m * ball_points")),
        cases("test_penumbrae", "test_half_shadow_of_a_lamp", "shadow_map", "perspective_shadow_map", "shadow_volume"),
    ),
}
