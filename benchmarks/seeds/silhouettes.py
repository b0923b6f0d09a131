"""Replication of the bachelor's report of Copenhagen: shadow volumes with and without silhouettes, z-pass and z-fail.

Z-pass counts volumes in front of the visible surface, z-fail those behind it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from benchmarks.seeds.claims import Claim, Figures, Section
from benchmarks.seeds.times import interleaved_times
from benchmarks.seeds.verdicts import (
    COPENHAGEN_REPORT,
    all_of,
    any_of,
    at_least,
    at_most,
    choose_reason,
    format_by_scene,
    format_max_percent,
    format_percent,
    format_ratio,
    scene_title,
)
from benchmarks.seeds.views import ViewWithTruth, bundled_scene, view_with_truth
from skugga.shadows.passes import PassRecord
from skugga.shadows.volumes.drawing import count_volumes
from skugga.shadows.volumes.edges import Edges, closed_part_mask, find_edges
from skugga.shadows.volumes.layers import layer_batches
from skugga.shadows.volumes.settings import VolumeSettings
from skugga.shadows.volumes.silhouettes import ALL_CODE, FACING_CODE, Silhouette, faces_light, orientations_of, silhouette
from skugga.shadows.volumes.volumes import MAX_VOLUME_LAYERS, Volumes, volumes_of
from skugga.terrain.casters.casting import caster_solids
from skugga.terrain.compiled import compiled
from skugga.terrain.level.level import SUN

LEVELS = ("thesis_street_sun", "thesis_water_tower_sun", "thesis_rocks_sun", "thesis_boxgrid_sun")
SIZE_PX = (640, 512)
REPEATS = 7
SHADOWED_EYE_VIEW = "thesis_boxgrid_sun", "close"
"""A level and its view whose eye is in the shadow."""

MAX_SAME_PICTURE_SHARE = 1e-4
"""Pictures count as the same if at most this share of their pixels differs."""

MAX_WRONG_SHARE = 0.001
"""Maximum wrong share of the cast shadow of a correct method."""

CountingSetting = Literal["auto", "z_fail"]
"""Ways of counting volumes: by z-fail, or by the engine's choice of z-pass and z-fail."""


def measure() -> Figures:
    """Measure the volumes of all levels, and the errors of ways of counting with the eye in shadow."""
    scenes = {level.removeprefix("thesis_").removesuffix("_sun"): _measure_volumes(level) for level in LEVELS}
    return {"scenes": scenes, "inside": _measure_shadowed_eye()}


def _measure_volumes(level: str) -> dict[str, float]:
    """Measure shadow volumes that are built from silhouettes, or from every edge of every triangle.

    Both are counted by z-fail over the same shadow-casting triangles. The engine's own volumes are measured too: by z-fail, by the
    engine's choice of z-pass or z-fail, and by that choice without caps.
    """
    truth_view = view_with_truth(bundled_scene(level), "main", SIZE_PX)
    light = np.array(truth_view.scene.light_position(SUN, truth_view.buffer.frame))
    vertices, triangles = caster_solids(truth_view.scene.objects, truth_view.buffer.frame)
    shared, separate_edges = find_edges(vertices, triangles), edges_without_sharing(triangles)
    facing_rule = np.where(closed_part_mask(shared), np.int8(FACING_CODE), np.int8(ALL_CODE))
    orientations = orientations_of(faces_light(vertices, triangles, light), facing_rule)
    groups = layer_batches(vertices, triangles, shared, orientations, light, MAX_VOLUME_LAYERS)

    def build_volumes(edges: Edges) -> list[Volumes]:
        orientations_of(faces_light(vertices, triangles, light), facing_rule)  # the work for each new sun
        return [extruded_volumes(vertices, silhouette(triangles, edges, group), light) for group in groups]

    silhouettes, polygons, engine_volumes = build_volumes(shared), build_volumes(separate_edges), _engine_volumes(truth_view, light)
    sides = [
        replace(
            volume, faces=volume.faces[: volume.first_cap], caster_of_face=volume.caster_of_face[: volume.first_cap], cap_count=0
        )
        for volume in engine_volumes
    ]
    methods: dict[str, tuple[list[Volumes], CountingSetting]] = {
        "silhouettes": (silhouettes, "z_fail"), "polygons": (polygons, "z_fail"),
        "auto": (engine_volumes, "auto"), "z_fail": (engine_volumes, "z_fail"), "sides": (sides, "auto"),
    }  # fmt: skip
    counts = {name: _count_volumes(truth_view, light, *method) for name, method in methods.items()}
    tasks: dict[str, Callable[[], object]] = {
        "structure": lambda: closed_part_mask(find_edges(vertices, triangles)),
        "build_silhouettes": lambda: build_volumes(shared),
        "build_polygons": lambda: build_volumes(separate_edges),
    }
    tasks |= {f"fill_{name}": lambda method=method: _count_volumes(truth_view, light, *method) for name, method in methods.items()}
    neighbours_by_search(shared.ends[shared.triangle_edges[:1]])  # compiles
    start = time.perf_counter()
    neighbours_by_search(shared.ends[shared.triangle_edges])
    search_ms = 1000.0 * (time.perf_counter() - start)
    valid, first = truth_view.buffer.valid.sum(), counts["auto"][0]
    return {
        **{f"{name}_ms": float(np.median([ms for ms, _ in runs])) for name, runs in interleaved_times(tasks, REPEATS).items()},
        "search_ms": search_ms,
        "triangles": len(triangles), "casting": int((orientations != 0).sum()),
        "sides": sum(volume.first_cap for volume in silhouettes), "sides_polygons": sum(volume.first_cap for volume in polygons),
        **{f"faces_{name}": faces for name, (_, faces) in counts.items()},
        **{f"differs_{name}": float(((dark > 0) != (first > 0)).sum() / valid) for name, (dark, _) in counts.items()},
    }  # fmt: skip


def _engine_volumes(truth_view: ViewWithTruth, light: np.ndarray) -> list[Volumes]:
    """Return the shadow volumes that the engine builds for a view's meshes. ``light`` is ``Scene.light_position``."""
    return volumes_of(truth_view.buffer, truth_view.scene, light, ("meshes",), truth_view.casters, PassRecord(""))


def _count_volumes(
    truth_view: ViewWithTruth, light: np.ndarray, volumes: list[Volumes], counting: CountingSetting
) -> tuple[np.ndarray, int]:
    """Return the number of volumes that contain each point facing the sun (rows, cols), and the number of drawn faces.

    ``light`` is ``Scene.light_position``.
    """
    record = PassRecord("")
    receivers = truth_view.receivers
    return count_volumes(
        truth_view.buffer, truth_view.scene, light, volumes, VolumeSettings(counting=counting), receivers, False, record
    ), record.triangles


def edges_without_sharing(triangles: np.ndarray) -> Edges:
    """Return the edges of triangles (m, 3), indices of vertices, as if no two triangles shared an edge.

    The silhouette of such a mesh includes all edges of each triangle.
    """
    start, end = triangles, np.roll(triangles, -1, axis=1)
    ends = np.stack([np.minimum(start, end), np.maximum(start, end)], axis=-1).reshape(-1, 2)
    directions = np.where(start < end, np.int8(1), np.int8(-1))
    return Edges(ends.astype(np.int32), np.arange(triangles.size, dtype=np.int32).reshape(-1, 3), directions)


def extruded_volumes(vertices: np.ndarray, outline: Silhouette, light: np.ndarray) -> Volumes:
    """Return the sun's shadow volume of a silhouette, as one caster.

    ``vertices`` (n, 3) are in metres. ``light`` is ``Scene.light_position``, whose first three values point to the sun. The volume
    consists of the caps, and of a triangle from each silhouette edge to the point at infinity.
    """
    count = len(vertices)
    a, b = np.repeat(outline.edges, outline.multiplicity, axis=0).T
    sides = np.column_stack([b, a, np.full(len(a), count)])
    points = np.vstack([np.column_stack([vertices, np.ones(count)]), np.append(-light[:3], 0.0)])
    cap_vertices = vertices[outline.caps.ravel()]
    faces = np.concatenate([sides, outline.caps]).astype(np.int32)
    low, high = cap_vertices.min(axis=0)[None], cap_vertices.max(axis=0)[None]
    return Volumes(
        points.astype(np.float32), faces, np.zeros(len(faces), np.int32), low, high, outline.edges, len(sides), len(outline.caps)
    )


@compiled
def neighbours_by_search(ends):
    """Return the neighbouring triangle at each edge of triangles, int (m, 3), by exhaustive comparison; -1 for none.

    ``ends`` (m, 3, 2) are the vertices at the ends of the edges.
    """
    count = len(ends)
    out = np.full((count, 3), -1, np.int32)
    for t in range(count):
        for k in range(3):
            a, b = ends[t, k, 0], ends[t, k, 1]
            for other in range(t + 1, count):
                for j in range(3):
                    if ends[other, j, 0] == a and ends[other, j, 1] == b:
                        out[t, k], out[other, j] = other, t
    return out


def _measure_shadowed_eye() -> dict[str, float]:
    """Measure ``wrong_cast`` with the eye in shadow, for z-pass, z-fail and the engine's choice between them."""
    level, name = SHADOWED_EYE_VIEW
    truth_view = view_with_truth(bundled_scene(level), name, SIZE_PX)
    light = np.array(truth_view.scene.light_position(SUN, truth_view.buffer.frame))
    engine_volumes = _engine_volumes(truth_view, light)
    beyond_m = 1e6 * light[:3]  # bounds far down the rays shade nothing before the eye: z-pass counts everything
    z_pass_volumes = [
        replace(volume, caster_low_m=volume.caster_low_m - beyond_m, caster_high_m=volume.caster_high_m - beyond_m)
        for volume in engine_volumes
    ]
    methods: dict[str, tuple[list[Volumes], CountingSetting]] = {
        "z_pass": (z_pass_volumes, "auto"),
        "z_fail": (engine_volumes, "z_fail"),
        "auto": (engine_volumes, "auto"),
    }
    wrong_shares = {}
    for key, method in methods.items():
        layers, _ = _count_volumes(truth_view, light, *method)
        wrong_shares[key] = truth_view.errors(truth_view.with_attached_shadow((layers == 0).astype(np.float32)))["wrong_cast"]
    return wrong_shares


def make_section(figures: Figures) -> Section:
    """Format the claims on silhouettes and on ways of counting, and the table of figures."""
    scenes, shadowed_eye_errors = figures["scenes"], figures["inside"]
    rows = scenes.values()

    def format_for_scenes(value_of: Callable[[dict[str, float]], float]) -> str:
        return format_by_scene({name: value_of(row) for name, row in scenes.items()})

    def polygons_ms(row: dict[str, float]) -> float:
        return row["build_polygons_ms"] + row["fill_polygons_ms"]

    def relative_cost(row: dict[str, float], structure: str) -> float:
        return (row[f"{structure}_ms"] + row["build_silhouettes_ms"] + row["fill_silhouettes_ms"]) / polygons_ms(row)

    differing_polygons, differing_sides = (max(row[f"differs_{name}"] for row in rows) for name in ("polygons", "sides"))
    fewer_volumes = all_of(
        [*(at_most(row["sides"], row["sides_polygons"]) for row in rows), at_most(differing_polygons, MAX_SAME_PICTURE_SHARE)]
    )
    search_is_slower = any_of(at_least(relative_cost(row, "search"), 1.0) for row in rows)
    edge_table_is_faster = all_of(at_most(relative_cost(row, "structure"), 1.0) for row in rows)
    fewer_faces = all_of(at_most(row["faces_sides"], row["faces_z_fail"]) for row in rows)
    z_pass_is_faster = all_of(at_most(row["fill_sides_ms"], row["fill_z_fail_ms"]) for row in rows)
    only_z_fail_is_right = all_of(
        (at_most(shadowed_eye_errors["z_fail"], MAX_WRONG_SHARE), at_least(shadowed_eye_errors["z_pass"], MAX_WRONG_SHARE))
    )
    claims = [
        Claim(
            COPENHAGEN_REPORT,
            "silhouettes need fewer volumes than one for each polygon (11 instead of 24), for the same shadow",
            "sides that are drawn, as a share of those without: "
            f"{format_for_scenes(lambda row: row['sides'] / row['sides_polygons'])}; of "
            f"the pixels {format_max_percent(differing_polygons)} differ (held if fewer everywhere, and at most "
            f"{format_percent(MAX_SAME_PICTURE_SHARE)} differ)",
            fewer_volumes,
            choose_reason(
                fewer_volumes,
                "the two sides at an edge between two casting triangles cancel; only those are left whose neighbour faces away",
                "casters share too few edges",
            ),
        ),
        Claim(
            COPENHAGEN_REPORT,
            "made badly, silhouettes make volumes slower than none: there by finding neighbours through comparing all edges",
            "time with silhouettes over time without, when every side is held against every other: "
            f"{format_for_scenes(lambda row: relative_cost(row, 'search'))} (held if over 1 anywhere)",
            search_is_slower,
            choose_reason(
                search_is_slower,
                "the search grows with the square of the triangles "
                f"({format_by_scene({n: row['triangles'] for n, row in scenes.items()}, str)}); what it saves "
                "grows with their number",
                "at so few triangles the search is cheaper than the filling that it saves",
            ),
        ),
        Claim(
            COPENHAGEN_REPORT,
            "a better structure of edges would make them much faster",
            "time over that without silhouettes, the edge table made anew each time: "
            f"{format_for_scenes(lambda row: relative_cost(row, 'structure'))} (held if under 1 everywhere)",
            edge_table_is_faster,
            choose_reason(
                edge_table_is_faster,
                "a hash of vertex pairs finds all edges in one pass over the triangles ("
                f"{format_for_scenes(lambda row: row['search_ms'] / row['structure_ms'])} times as fast as the search), and what "
                "is filled "
                "shrinks with the sides. The table does not depend on the light, so it is made once for a mesh",
                "making the table costs more than the sides that it saves, where a mesh is drawn once alone",
            ),
        ),
        Claim(
            COPENHAGEN_REPORT,
            "z-pass draws fewer faces than z-fail, since it needs no caps",
            f"faces without caps over those of z-fail: {format_for_scenes(lambda row: row['faces_sides'] / row['faces_z_fail'])} "
            "(held if "
            f"under 1 everywhere); of the pixels {format_max_percent(differing_sides)} differ without caps",
            fewer_faces,
            (
                "a cap lies on a surface that is drawn, and is never before what is seen. "
                if differing_sides <= MAX_SAME_PICTURE_SHARE
                else ""
            )
            + "The engine draws caps for z-pass too, and leaves out faces wholly on the side of the points that does not count "
            "either way, so that which way draws more of them is up to the view: by default "
            f"{format_for_scenes(lambda row: row['faces_auto'] / row['faces_z_fail'])} of z-fail's",
        ),
        Claim(
            COPENHAGEN_REPORT,
            "z-pass is faster than z-fail",
            "time of filling, z-pass without caps over z-fail: "
            f"{format_for_scenes(lambda row: row['fill_sides_ms'] / row['fill_z_fail_ms'])} "
            "(held if under 1 everywhere); by default "
            f"{format_for_scenes(lambda row: row['fill_auto_ms'] / row['fill_z_fail_ms'])}",
            z_pass_is_faster,
            choose_reason(
                z_pass_is_faster,
                "fewer faces pass over fewer pixels",
                "faces are not what filling takes: either way the same stencil is cleared, given depths and read, and faces "
                "cover very different shares of the picture",
                "in some scenes the two are within the noise of one another: the same stencil is cleared, given depths and read",
            ),
        ),
        Claim(
            COPENHAGEN_REPORT,
            "z-pass is wrong with the eye in a volume; z-fail is right",
            f"wrong of the cast shadow with the eye in the shadow: z-pass {format_percent(shadowed_eye_errors['z_pass'])}, z-fail "
            f"{format_percent(shadowed_eye_errors['z_fail'])}, caster by caster {format_percent(shadowed_eye_errors['auto'])} "
            "(held if z-fail gets at most "
            f"{format_percent(MAX_WRONG_SHARE)} wrong and z-pass more)",
            only_z_fail_is_right,
            choose_reason(
                only_z_fail_is_right,
                "z-pass counts from the eye and starts at 0, though the eye is in volumes already; z-fail starts at infinity, "
                "where there are none. By default each caster whose volume may reach the near plane is counted by z-fail, the "
                "others by z-pass",
                "no volume holds the eye in this view",
            ),
        ),
    ]
    table = [
        {
            "scene": scene_title(name),
            "triangles": str(row["triangles"]),
            "casting": str(row["casting"]),
            "sides (polygons)": f"{row['sides']} ({row['sides_polygons']})",
            "search": format_ratio(row["search_ms"] / polygons_ms(row)),
            "edge table": format_ratio(row["structure_ms"] / polygons_ms(row)),
            "build": format_ratio(row["build_silhouettes_ms"] / polygons_ms(row)),
            "fill": format_ratio(row["fill_silhouettes_ms"] / polygons_ms(row)),
            "table, build and fill": format_ratio(relative_cost(row, "structure")),
        }
        for name, row in scenes.items()
    ]
    return Section(
        "Silhouettes, z-pass and z-fail",
        f"Main views of the thesis's scenes under the sun, {SIZE_PX[0]} x {SIZE_PX[1]}. Volumes of the same triangles (those of "
        "closed "
        "bodies that face the sun) are built twice by the same code: once with the edges that neighbours share, once with every "
        "side of a triangle as an edge of its own, one volume per triangle. Both are counted by z-fail, as in the report. Times "
        f"are ratios to building and filling one volume per polygon, taken in turns, medians of {REPEATS} (the search is timed "
        "once).",
        [("Silhouettes against one volume a polygon", table)],
        claims,
    )
