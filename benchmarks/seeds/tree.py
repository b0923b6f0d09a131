"""J. Sindholt, A comparison of Shadow Algorithms (DTU 2005), replication of figure 57: a tree whose meshes are not closed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np
import trimesh

from benchmarks.seeds.claims import Claim, Figures, Section
from benchmarks.seeds.pictures import CaptionedPicture, CropBox, draw_crop, write_sheet
from benchmarks.seeds.thin import MAX_WRONG_SHARE
from benchmarks.seeds.verdicts import HYBRID, PSM, SM, SV, THESIS, at_least, at_most, choose_reason, format_percent
from benchmarks.seeds.views import LevelDocument, Variant, draw_variant, view_with_truth, write_and_build_scene
from skugga.shadows.truth.metrics import MAX_INTERIOR_SHARE
from skugga.shadows.volumes import volumes
from skugga.shadows.volumes.edges import Edges, signed_side_counts
from skugga.shadows.volumes.silhouettes import Silhouette, silhouette

SIZE_PX = (960, 768)
MAP_SIZE = 1024
"""Texels a side of the shadow maps."""
FULL_CROP: CropBox = (0, 0, *SIZE_PX)
BARK_RGBA, LEAF_RGBA = (96, 74, 54, 255), (78, 118, 52, 255)


@contextmanager
def assume_closed_meshes() -> Iterator[None]:
    """Build shadow volumes as if all meshes were closed, while the context manager is active.

    Then only triangles that face the light form volumes, with sides at silhouette edges between exactly two triangles.
    """

    def between_two(triangles: np.ndarray, edges: Edges, orientations: np.ndarray) -> Silhouette:
        facing = np.maximum(orientations, 0)
        outline = silhouette(triangles, edges, facing)
        meeting = np.bincount(edges.triangle_edges[edges.triangle_edges >= 0], minlength=len(edges.ends))
        is_shared = meeting[np.flatnonzero(signed_side_counts(edges, facing))] == 2
        return Silhouette(outline.edges[is_shared], outline.multiplicity[is_shared], outline.caps)

    with patch.object(volumes, "silhouette", between_two):
        yield


def open_tree_mesh(seed: int = 7) -> trimesh.Trimesh:
    """Return a tree mesh in metres: open tubes that intersect, and leaves of two crossed rectangles each.

    No part is closed, leaves face all directions, and half of the leaves have the opposite winding.
    """
    rng = np.random.default_rng(seed)
    trunk = np.array([[0, 0, 0], [0.1, 0.05, 2.2], [-0.05, 0.1, 4.4], [0.1, 0, 7.6]])
    parts, leaves_at = [_open_tube(trunk, [0.34, 0.25, 0.17, 0.04])], []
    for number in range(12):
        height, azimuth_rad = 2.0 + 0.42 * number, 2.4 * number
        branch_direction = np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.0])
        start, length = np.array([0, 0, height]), 3.3 - 0.2 * number
        ends = start + length * (np.array([[0.0], [0.5], [1.0]]) * branch_direction + np.array([[0.0], [0.16], [0.42]]) * [0, 0, 1])
        parts.append(_open_tube(ends, [0.11, 0.07, 0.02]))
        for share in (0.45, 0.7, 0.9):
            position = start + share * (ends[2] - start)
            tip = position + 0.35 * length * _unit(rng.normal(size=3) + 0.6 * branch_direction)
            parts.append(_open_tube(np.array([position, tip]), [0.035, 0.012]))
            leaves_at.append(position + np.linspace(0.1, 1.1, 10)[:, None] * (tip - position))
    colors = [BARK_RGBA] * sum(len(faces) for _, faces in parts)
    for position in np.concatenate(leaves_at):
        position = position + rng.normal(scale=0.14, size=3)
        axis = _unit(rng.normal(size=3))
        side_axis = _unit(np.cross(axis, rng.normal(size=3)))
        for leaf_axis in (side_axis, np.cross(axis, side_axis)):
            corners = position + 0.16 * np.array([-axis - leaf_axis, axis - leaf_axis, axis + leaf_axis, leaf_axis - axis])
            faces = np.array([[0, 1, 2], [0, 2, 3]])
            parts.append((corners, faces if rng.random() < 0.5 else faces[:, ::-1]))
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts[:-1])])
    faces = np.concatenate([triangles + start for (_, triangles), start in zip(parts, first, strict=True)])
    colors += [LEAF_RGBA] * (len(faces) - len(colors))
    return trimesh.Trimesh(np.concatenate([vertices for vertices, _ in parts]), faces, face_colors=colors, process=False)


def _open_tube(path_m: np.ndarray, radii_m: list[float], sides: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) in metres and triangles (m, 3) of a tube along a path (k, 3), without ends.

    ``radii_m`` are the k radii at the path's points. ``sides`` is the number of sides of the cross-section.
    """
    tube_axis = _unit(path_m[-1] - path_m[0])
    normal = _unit(np.cross(tube_axis, np.eye(3)[np.argmin(np.abs(tube_axis))]))
    angle_rad = 2.0 * np.pi * np.arange(sides) / sides
    circle = np.cos(angle_rad)[:, None] * normal + np.sin(angle_rad)[:, None] * np.cross(tube_axis, normal)
    vertices = (path_m[:, None] + np.array(radii_m)[:, None, None] * circle).reshape(-1, 3)
    k = np.arange(sides)
    ring = np.concatenate([
        np.stack([k, (k + 1) % sides, k + sides], axis=1), np.stack([(k + 1) % sides, (k + 1) % sides + sides, k + sides], axis=1)
    ])  # fmt: skip
    return vertices, np.concatenate([ring + sides * part for part in range(len(path_m) - 1)])


def _unit(vector: np.ndarray) -> np.ndarray:
    """Return a vector (3,) scaled to length 1."""
    return vector / np.linalg.norm(vector)


LIGHTS: dict[str, LevelDocument] = {
    "spot": {"sun": "none", "lights": {"lamp": {"kind": "spot", "position": [-14, -9, 19], "target": [0, 0, 4], "cutoff": 24}}},
    "sun": {"sun": {"azimuth": 237, "altitude": 42}},
}
"""Keys of the level for each light, by name."""
ASSUMED_CLOSED = "volumes as of closed meshes"
VARIANTS = {
    SM: Variant({"algorithm": "shadow_map", "map_size": MAP_SIZE, "cascades": 1, "filter": 1}),
    PSM: Variant({"algorithm": "perspective_shadow_map", "map_size": MAP_SIZE, "filter": 1}),
    ASSUMED_CLOSED: Variant({"algorithm": "shadow_volume"}, assume_closed_meshes),
    SV: Variant({"algorithm": "shadow_volume"}),
    HYBRID: Variant({"algorithm": "hybrid"}),
}
"""Compared algorithms, by the name in the table."""


def measure() -> Figures:
    """Measure an open tree under a spot light and the sun: by all four algorithms, and by volumes that assume closed meshes."""
    rows, pictures, tree = [], [], open_tree_mesh()
    triangle_counts = np.unique(np.sort(tree.edges, axis=1), axis=0, return_counts=True)[1]
    floor = {"version": 1, "terrain": {"flat": {"size": [50, 50], "cells": [100, 100]}}, "meshes": [{"source": "tree.ply"}]}
    view_spec = {"kind": "perspective", "eye": [8.5, -18.5, 8.5], "target": [2.2, 0.8, 3.3], "fov": 29, "size": list(SIZE_PX)}
    with TemporaryDirectory() as name:
        folder = Path(name)
        tree.export(folder / "tree.ply")
        for light, light_keys in LIGHTS.items():
            truth_view = view_with_truth(
                write_and_build_scene({**floor, **light_keys, "views": {"main": view_spec}}, folder), "main", SIZE_PX
            )
            for algorithm, variant in VARIANTS.items():
                figures = draw_variant(truth_view, variant).figures
                rows.append({"light": light, "algorithm": algorithm, **figures})
                if light == "sun" and algorithm != PSM:
                    caption = f"{algorithm}: {format_percent(figures['wrong_cast'])} wrong"
                    pictures.append(CaptionedPicture(draw_crop(truth_view, variant, FULL_CROP, downscale_factor=2), caption))
    write_sheet("seeds-tree.webp", pictures, 2)
    return {
        "rows": rows,
        "triangles": len(tree.faces),
        "open_edges": int((triangle_counts == 1).sum()),
        "edges": len(triangle_counts),
    }


def make_section(figures: Figures) -> Section:
    """Format the claims on meshes that are not closed, and the table of errors."""
    row_by_key = {(row["light"], row["algorithm"]): row for row in figures["rows"]}

    def worst(algorithm: str, metric: str) -> float:
        return max(row_by_key[light, algorithm][metric] for light in LIGHTS)

    worst_interior = max(worst(SM, "interior"), worst(PSM, "interior"))
    worst_shares = {name: worst(name, "wrong_cast") for name in (SV, HYBRID, ASSUMED_CLOSED)}
    maps_are_right, volumes_fail = (
        at_most(worst_interior, MAX_INTERIOR_SHARE),
        at_least(max(worst_shares[SV], worst_shares[HYBRID]), MAX_WRONG_SHARE),
    )
    claims = [
        Claim(
            f"{THESIS}, figure 57",
            "shadow maps and perspective ones do not care how the geometry is made",
            f"at most {format_percent(worst_interior)} of the picture is wrong away from shadow edges (held if at most "
            f"{format_percent(MAX_INTERIOR_SHARE)})",
            maps_are_right,
            choose_reason(
                maps_are_right,
                "a depth map draws triangles one by one and knows no edges between them",
                "twigs and leaves are thinner than texels: whole ones are lost, which has nothing to do with open meshes",
            ),
        ),
        Claim(
            f"{THESIS}, figure 57",
            "shadow volumes and the hybrid need closed meshes, and fail on the tree",
            f"wrong at most in {format_percent(worst_shares[SV])} (volumes) and {format_percent(worst_shares[HYBRID])} (hybrid) "
            "of the cast "
            f"shadow (held if over {format_percent(MAX_WRONG_SHARE)} of either); volumes that are made as of closed meshes in "
            f"{format_percent(worst_shares[ASSUMED_CLOSED])}",
            volumes_fail,
            choose_reason(
                volumes_fail,
                "sides of open edges are counted wrongly",
                "a side counts as often as triangles meet at its edge without cancelling, once at an open one, and of open "
                "bodies all triangles cast: taking both away brings the failure back",
            ),
        ),
    ]
    keys = ("wrong_cast", "false_shadow", "missed_shadow", "interior")
    table = [
        {"light": row["light"], "algorithm": row["algorithm"]} | {key: format_percent(row[key]) for key in keys}
        for row in figures["rows"]
    ]
    return Section(
        "An open tree (figure 57)",
        f"A tree of {figures['triangles']} triangles: open tubes that run into one another, and leaves of two crossed rectangles, "
        f"oriented at random. {figures['open_edges']} of its {figures['edges']} edges have only one triangle. {SIZE_PX[0]} x "
        f"{SIZE_PX[1]} pixels, maps of {MAP_SIZE}, one tap.",
        [("Errors by algorithm", table)],
        claims,
        [("seeds-tree.webp", "A map, volumes that take the tree for closed, volumes, and the hybrid, under the sun")],
    )
