"""Adjacent tiles join, in whichever frames they are drawn, and zooming in moves no shadow."""

from __future__ import annotations

import numpy as np
from morecantile import tms as matrix_sets

from skugga.shadows.truth.metrics import edge_distances, edge_metric_coverage
from skugga.terrain.gbuffer.view_geometry import view_frame
from skugga.terrain.geo.grid import MapView, tile_grid
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.hard_cases.cases import RenderedView, Trial, hard_case
from tests.render import block_at

TILE_ALIGNED_ALGORITHMS = ("shadow_volume", "hybrid", "sweep")
LON, LAT, ZOOM = -84.27, 36.2933, 12


@hard_case(
    "G5",
    "Neighbouring tiles join, and zooming in moves no shadow",
    "real mountains: tiles of one frame, tiles of two frames, and zoom 12 against 13",
    {"same frame": 0.0, "across frames": 1e-4, "edge_p95_px": 3.0},
)
def test_tiles_join(trial: Trial) -> dict[str, float]:
    """Half of a tile is drawn a second time with its neighbour.

    Volumes, which are drawn in the tile's own camera, and lines, which run through its middle, are compared at decidable pixels. A
    tile's pixels are exactly the ground's nodes, where edges of volumes begin and which lines graze: rounding decides on which side
    of its own edge a node lies. The same holds for nodes on edges as the sun sees them.
    """
    px = 320 if trial.thorough else 160
    altitudes = (20.0, 4.0) if trial.thorough else (10.0,)
    mountains = build_scene(load_level("configs/jacksboro.yaml"))
    same_frame, across_frames, edges = 0.0, 0.0, []
    for altitude in altitudes:
        scene = mountains.with_sun(SunSpec(azimuth=237.0, altitude=altitude))
        tile = block_at(LON, LAT, ZOOM).part(313, 200, px, px)
        neighbour = tile.part(0, px // 2, px, px)
        assert view_frame(scene, tile) is view_frame(scene, neighbour)
        same_frame = max(same_frame, _differing_share(trial, scene, tile, neighbour))
        last = _easternmost_tile(scene, tile)
        across_frames = max(across_frames, _differing_share(trial, scene, last, last.part(0, px // 2, px, px)))
        edges.append(_zoom_edges_px(trial, scene, tile.part(0, 0, px // 2, px // 2)))
    return {
        "same frame": same_frame,
        "across frames": across_frames,
        "edge_p95_px": float(np.quantile(np.concatenate(edges), 0.95)),
    }


def _differing_share(trial: Trial, scene: Scene, tile: MapView, neighbour: MapView) -> float:
    """Return the share of the pixels whose class differs in the strip that two tiles have in common."""
    first, second = trial.render_view(scene, tile), trial.render_view(scene, neighbour)
    strip = tile.cols // 2
    left, right = first.dark[:, -strip:], second.dark[:, :strip]
    assert 0.005 < left[first.buffer.valid[:, -strip:]].mean() < 0.99, "light and shadow"
    differ = left != right
    if trial.algorithm in TILE_ALIGNED_ALGORITHMS:
        differ &= first.truth.decidable[:, -strip:] & second.truth.decidable[:, :strip] & ~_on_edges(first)[:, -strip:]
    return float(differ.mean())


def _on_edges(rendered: RenderedView) -> np.ndarray:
    """Return which pixels of a tile, at nodes, see the sun by some of their facets only: silhouette edges begin there."""
    surface, view = rendered.buffer.surface, rendered.view
    assert surface is not None and isinstance(view, MapView) and rendered.scene.sun is not None
    faces = (surface.sheet.normals_frame @ rendered.scene.sun.in_frame(rendered.buffer.frame)) > 0.0
    any_facing, all_facing = (np.stack([which[..., down : down + faces.shape[0] - 1, right : right + faces.shape[1] - 1]
        for which in (reduce(axis=-1),) for down in (0, 1) for right in (0, 1)]) for reduce in (faces.any, faces.all))  # fmt: skip
    mixed = any_facing.any(axis=0) & ~all_facing.all(axis=0)
    row, col = int(view.row0) - surface.row0 - 1, int(view.col0) - surface.col0 - 1
    return mixed[row : row + view.rows, col : col + view.cols]


def _easternmost_tile(scene: Scene, tile: MapView) -> MapView:
    """Return the easternmost tile of its frame: half a tile further another frame begins."""
    half = tile.cols // 2
    frame = view_frame(scene, tile)
    while view_frame(scene, tile.part(0, half, tile.rows, tile.cols)) is frame:
        tile = tile.part(0, half, tile.rows, tile.cols)
    return tile


def _zoom_edges_px(trial: Trial, scene: Scene, tile: MapView) -> np.ndarray:
    """Return distances between shadow edges in a tile and in its four children of the next zoom, in the tile's pixels."""
    grid = tile_grid(matrix_sets.get("WebMercatorQuad"), ZOOM + 1)
    finer = MapView(grid, 2.0 * tile.row0, 2.0 * tile.col0, 1.0, 1.0, 2 * tile.rows, 2 * tile.cols)
    coarse_picture, fine_picture = trial.render_view(scene, tile), trial.render_view(scene, finer)
    doubled = np.repeat(np.repeat(coarse_picture.dark, 2, axis=0), 2, axis=1)
    distances = edge_distances(fine_picture.dark, doubled, fine_picture.buffer.valid) / 2.0
    trial.record_coverage("edge_p95_px", edge_metric_coverage(doubled, fine_picture.truth))
    assert distances.size > 100, "edges"
    return distances
