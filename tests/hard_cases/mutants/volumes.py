"""Defects of shadow volumes, of the stencil, and of the hybrid."""

from __future__ import annotations

from tests.hard_cases.mutants.mutant import Mutant, cases, constant, edited

MUTANTS = {
    "saturating_stencil": Mutant(
        "the stencil stops at 0 and at its largest number instead of wrapping",
        edited("terrain.gl.stencil:Stencil.count_pass", ("GL.GL_INCR_WRAP, GL.GL_DECR_WRAP", "GL.GL_INCR, GL.GL_DECR")),
        cases("test_volumes", "test_stacks_of_volumes", "shadow_volume")
        + cases("test_volumes", "test_near_plane_touches_a_shadow_volume", "shadow_volume")
        + cases("test_volumes", "test_caster_without_end", "shadow_volume", "hybrid"),
    ),
    "unlimited_layers": Mutant(
        "all volumes are counted at once, however many overlap",
        constant("shadows.volumes.volumes:MAX_VOLUME_LAYERS", 10**6),
        cases("test_volumes", "test_stacks_of_volumes", "shadow_volume"),
    ),
    "finite_volumes": Mutant(
        "volumes end 30 m behind their casters",
        edited(
            "shadows.volumes.volumes:_build_volumes",
            ("far = np.append(-light[:3], 0.0)[None]", "far = np.append(points.mean(axis=0) - 30.0 * light[:3], 1.0)[None]"),
        ),
        cases("test_volumes", "test_caster_without_end", "shadow_volume", "hybrid")
        + cases("test_far_shadows", "test_a_beam_outside_of_the_view", "shadow_volume")
        + cases("test_properties", "test_random_situations", "shadow_volume"),
    ),
    "one_side_per_edge": Mutant(
        "an edge has one side, however many casters end there",
        edited("shadows.volumes.volumes:_build_volumes", ("np.repeat(edges, outline.multiplicity, axis=0)", "edges")),
        cases("test_bodies", "test_bodies_that_are_none", "shadow_volume"),
    ),
    "all_bodies_closed": Mutant(
        "only faces towards the light cast, also those of open bodies",
        edited("shadows.volumes.volumes:_mesh_structure", ("FACING_CODE, ALL_CODE)", "FACING_CODE, FACING_CODE)")),
        cases("test_bodies", "test_bodies_that_are_none", "shadow_volume"),
    ),
    "coarse_welding": Mutant(
        "vertices within a centimetre count as one",
        edited(
            "shadows.volumes.edges:find_edges",
            (
                "_welded_vertices(np.asarray(vertices, np.float32).reshape(-1, 3))",
                "np.unique(np.round(np.asarray(vertices).reshape(-1, 3), 2), axis=0, return_inverse=True)[1].reshape(-1)",
            ),
        ),
        cases("test_bodies", "test_edge_on_to_the_sun", "shadow_volume") + cases("test_bodies", "test_slivers", "shadow_volume"),
    ),
    "map_without_silhouettes": Mutant(
        "the hybrid's map decides also in texels that a silhouette crosses",
        edited(
            "shadows.hybrid.conservative_map:conservative_map",
            ("certain_depths(cols, rows, corners, edges)", "certain_depths(cols, rows, corners, edges[:0])"),
        ),
        cases("test_wires", "test_wires", "hybrid"),
    ),
    "map_without_casters": Mutant(
        "the hybrid's map lacks the casters, and lights what they shade",
        edited(
            "shadows.hybrid.conservative_map:conservative_map",
            ("certain_depths(cols, rows, corners, edges)", "certain_depths(cols, rows, corners[:0], edges[:0])"),
        ),
        cases("test_wires", "test_wires", "hybrid"),
    ),
    "volumes_of_nothing": Mutant(
        "volumes are counted even if there are none",
        edited(
            "shadows.volumes.drawing:count_volumes",
            ("if not any(len(volume_set.faces) for volume_set in volumes):", "if False:"),
        ),
        cases("test_nothing", "test_nothing_and_single_points", "shadow_volume"),
    ),
    "faces_towards_the_eye": Mutant(
        "faces of volumes are moved towards the eye, not away from it",
        edited(
            "terrain.gl.stencil:Stencil.count_pass",
            ("-SLOPE_OFFSET_STEPS / 256.0, -offset_steps", "SLOPE_OFFSET_STEPS / 256.0, offset_steps"),
        ),
        cases("test_bias", "test_a_footprint_in_the_ground", "shadow_volume"),
    ),
    "shifted_maps": Mutant(
        "volumes over a map are drawn up to 0.3 pixels off, depending on the map's place",
        edited(
            "terrain.casters.clip_space:map_clip",
            (
                "points, pixel = _map_samples(world, frame, view, low, high)",
                "points, pixel = _map_samples(world, frame, view, low, high)\n    pixel = pixel + 0.3 * np.sin(view.centre[0])",
            ),
        ),
        cases("test_steady", "test_whole_pixel_shifts_without_texels", "shadow_volume"),
    ),
}
