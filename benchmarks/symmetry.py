"""Symmetry of shadows: whether mirrored or rotated ground, under a sun mirrored or rotated alike, has the same shadow, mirrored.

    python -m benchmarks.symmetry FOLDER [--algorithms sweep truth shadow_map shadow_volume] [--crop 256] [--between-nodes]
                                         [--markdown FILE]

The middles of rasters below FOLDER (``CELL_M_BY_RASTER``) become levels in a flat world. The side of their cells is a power of two
of metres. With one pixel per cell, pixels then lie exactly on nodes. Each level is drawn in all eight symmetries of a square. The
figure is the largest share of pixels whose class (shadow or lit) differs from that of the original ground.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rasterio

from skugga.selector.planner.planner import make_plan
from skugga.shadows.render import render_frame
from skugga.shadows.truth.truth import ALL_CASTER_KINDS, lit_mask, ray_scene
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import MapView, blocks_of
from skugga.terrain.level.level import SUN, load_level
from skugga.terrain.scene import Scene, build_scene

SYMMETRIES = [
    (flips_east_west, flips_north_south, is_transposed)
    for is_transposed in (False, True)
    for flips_north_south in (False, True)
    for flips_east_west in (False, True)
]
"""The eight symmetries of a square, each as three flags: mirror from east to west, mirror from north to south, and swap rows and
columns."""

SUNS = ((90.0, 45.0), (113.0, 30.0), (202.0, 10.0))
"""Azimuth and altitude, degrees."""

CELL_M_BY_RASTER = {
    "mountain/bigtujunga_30m_utm11.tif": 32.0, "urban/goteborg_1m/DSM.tif": 1.0, "forest/quebec_DSM.tif": 1.0,
}  # fmt: skip
"""Side of a cell in the flat world, metres, by raster below the folder."""

SITE_CRS = 'ENGCRS["site",EDATUM["site"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'
"""An engineering CRS in metres. The world of a level with this CRS is flat."""

Symmetry = tuple[bool, bool, bool]
"""A symmetry of a square, one of ``SYMMETRIES``."""


def transform_grid(values: np.ndarray, symmetry: Symmetry) -> np.ndarray:
    """Mirror and transpose values (n, m) of a grid by a symmetry."""
    flips_east_west, flips_north_south, is_transposed = symmetry
    values = values.T if is_transposed else values
    return values[:: -1 if flips_north_south else 1, :: -1 if flips_east_west else 1]


def invert_grid(values: np.ndarray, symmetry: Symmetry) -> np.ndarray:
    """Invert ``transform_grid`` for values of a grid."""
    flips_east_west, flips_north_south, is_transposed = symmetry
    values = values[:: -1 if flips_north_south else 1, :: -1 if flips_east_west else 1]
    return values.T if is_transposed else values


def transform_azimuth(azimuth_deg: float, symmetry: Symmetry) -> float:
    """Transform a sun's azimuth, degrees, like ``transform_grid`` transforms the ground."""
    flips_east_west, flips_north_south, is_transposed = symmetry
    if is_transposed:
        azimuth_deg = 270.0 - azimuth_deg
    if flips_north_south:
        azimuth_deg = 180.0 - azimuth_deg
    return (-azimuth_deg if flips_east_west else azimuth_deg) % 360.0


def read_heights(path: Path, crop: int) -> np.ndarray:
    """Return the middle of a raster's heights, with an even number of rows and of columns, at most ``crop``."""
    with rasterio.open(path) as dataset:
        rows, cols = (min(crop, size) // 2 * 2 for size in dataset.shape)
        row, col = (dataset.height - rows) // 2, (dataset.width - cols) // 2
        return dataset.read(1, window=((row, row + rows), (col, col + cols))).astype(np.float32)


def flat_world_scene(heights: np.ndarray, cell_m: float, sun: tuple[float, float], folder: Path) -> Scene:
    """Return the scene of heights (rows, cols) in a flat world, whose origin is their south-west corner.

    ``sun`` is azimuth and altitude in degrees. The level file is written into ``folder``.
    """
    rows, cols = heights.shape
    transform = rasterio.transform.from_origin(0.0, rows * cell_m, cell_m, cell_m)
    with rasterio.open(
        folder / "site.tif",
        "w",
        driver="GTiff",
        height=rows,
        width=cols,
        count=1,
        dtype="float32",
        crs=SITE_CRS,
        transform=transform,
    ) as dataset:
        dataset.write(heights, 1)
    level = {
        "version": 1,
        "terrain": {"source": "site.tif"},
        "sun": {"azimuth": sun[0], "altitude": sun[1]},
        "effects": {"cast_shadows": "on"},
    }
    (folder / "site.yaml").write_text(json.dumps(level), encoding="utf-8")  # JSON is YAML
    return build_scene(load_level(folder / "site.yaml"))


def shadow_mask(scene: Scene, algorithm: str, size: tuple[int, int]) -> np.ndarray:
    """Return the mask of pixels in shadow (rows, cols) in a map of the whole scene.

    ``algorithm`` is the name of an algorithm, or ``truth`` for traced rays. ``size`` is (columns, rows).
    """
    view = scene.view(bounds=scene.elevation.bounds, size=size)
    assert isinstance(view, MapView)
    if algorithm != "truth":
        plan = make_plan(describe(scene, view), scene.loaded.level, {"algorithm": algorithm, "map_size": 4096})
        return np.nan_to_num(render_frame(scene, view, plan).visibility, nan=1.0) < 0.5
    out = np.zeros((view.rows, view.cols), bool)
    for part, row, col in blocks_of(view):
        buffer = geometry_buffer(scene, part)
        shadow = buffer.valid & ~lit_mask(
            buffer, scene, SUN, ray_scene(buffer, scene, find_casters(scene, buffer), ALL_CASTER_KINDS)
        )
        top, left = max(row, 0), max(col, 0)
        bottom, right = min(row + part.rows, view.rows), min(col + part.cols, view.cols)
        out[top:bottom, left:right] = shadow[top - row : bottom - row, left - col : right - col]
    return out


def max_differing_share(heights: np.ndarray, cell_m: float, sun: tuple[float, float], algorithm: str, between_nodes: bool) -> float:
    """Return the largest share of pixels in which one of the eight pictures, transformed back, differs from the first.

    ``heights`` is (rows, cols) in metres, ``sun`` azimuth and altitude in degrees. With ``between_nodes`` pixels lie between nodes.
    """
    pictures = []
    for symmetry in SYMMETRIES:
        ground = np.ascontiguousarray(transform_grid(heights, symmetry))
        rows, cols = (length * 3 // 2 if between_nodes else length for length in ground.shape)
        with tempfile.TemporaryDirectory() as folder:
            scene = flat_world_scene(ground, cell_m, (transform_azimuth(sun[0], symmetry), sun[1]), Path(folder))
            pictures.append(invert_grid(shadow_mask(scene, algorithm, (cols, rows)), symmetry))
            scene.close()
    return max(float((other != pictures[0]).mean()) for other in pictures[1:])


def format_report(folder: Path, algorithms: list[str], crop: int, between_nodes: bool) -> Iterator[str]:
    """Yield lines of Markdown: a row for each raster and algorithm, in per cent of the pixels.

    ``folder`` has the rasters, and ``crop`` limits their sides in cells. With ``between_nodes`` pixels lie between nodes.
    """
    yield "| raster | algorithm | " + " | ".join(f"{azimuth:g} / {altitude:g}" for azimuth, altitude in SUNS) + " |"
    yield "| --- | --- |" + " ---: |" * len(SUNS)
    for name, cell_m in CELL_M_BY_RASTER.items():
        heights = read_heights(folder / name, crop)
        for algorithm in algorithms:
            shares = [100.0 * max_differing_share(heights, cell_m, sun, algorithm, between_nodes) for sun in SUNS]
            yield f"| {name} | {algorithm} | " + " | ".join(f"{share:.4f}" for share in shares) + " |"


def main() -> None:
    """Measure all rasters and algorithms, and print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--algorithms", nargs="+", default=["sweep", "truth", "shadow_map", "shadow_volume"])
    parser.add_argument("--crop", type=int, default=256)
    parser.add_argument("--between-nodes", action="store_true", help="draw 1.5 pixels per cell, so that pixels lie between nodes")
    parser.add_argument("--markdown", type=Path)
    args = parser.parse_args()
    lines = []
    for line in format_report(args.folder, args.algorithms, args.crop, args.between_nodes):
        print(line, flush=True)
        lines.append(line)
    if args.markdown:
        args.markdown.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
