"""Record the numba loops that each product compiles, with their argument types, in ``terrain/compiling/signatures.json``.

    python scripts/record_signatures.py                          # all products, some minutes
    python scripts/record_signatures.py "hours of sun" points    # keeps the entries of other products

The script computes each product in its own process, without stored machine code, so that all its loops and their callees are
compiled. The input rasters are projected and geographic, of floats and integers, with and without nodata. Bundled levels cover
trees and buildings.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import date
from pathlib import Path
from typing import Any

from skugga.terrain.compiling.ahead_of_time import MAPS, MAPS_OF_CASTERS, MASKS, PICTURES, POINTS, PRODUCTS, SUN_HOURS, VIEWS

LOW_SUN_TIME = "2024-10-21T16:30:00+00:00"
"""A time for rasters near Greenwich, with the sun low in the west."""


def write_rasters(folder: Path) -> list[Path]:
    """Write three rasters of hills and return their paths.

    They are float32 in UTM with nodata, int16 in degrees, and float32 in an engineering CRS.
    """
    import numpy as np
    import rasterio
    from affine import Affine

    rows, cols = np.mgrid[:360, :300] / 40.0
    heights = 400.0 + 300.0 * np.sin(rows) * np.cos(1.7 * cols) + 40.0 * np.sin(5.0 * cols + 3.0 * rows)
    engineering = 'ENGCRS["site",EDATUM["site"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'
    kinds: list[tuple[str, str, str, float, float, float]] = [
        ("projected", "float32", "EPSG:32631", 500_000.0, 5_000_000.0, 30.0),
        ("geographic", "int16", "EPSG:4326", 3.0, 45.0, 1.0 / 3600.0),
        ("flat", "float32", engineering, 0.0, 0.0, 5.0),
    ]
    paths = []
    for name, dtype, crs, x0, y0, cell in kinds:
        data = heights.astype(dtype)
        if name == "projected":
            data[100:110, 200:230] = -9999
        path = folder / f"{name}.tif"
        with rasterio.open(
            path, "w", driver="GTiff", width=data.shape[1], height=data.shape[0], count=1, dtype=dtype, crs=crs,
            transform=Affine(cell, 0, x0, 0, -cell, y0), nodata=-9999,
        ) as dataset:  # fmt: skip
            dataset.write(data, 1)
        paths.append(path)
    return paths


def _draw_blocks(sources: Sequence[Path], layers: Sequence[str], suns: Sequence[tuple[float, float]] = ()) -> None:
    """Draw one block of tiles of each level for each zoom and layer.

    Colours are drawn at the coarsest, the native and the finest zoom, under the level's sun and ``suns`` (azimuth, altitude). The
    other layers are drawn at the native zoom.
    """
    from skugga.api.http.server.first_blocks import central_block
    from skugga.api.http.state.served_levels import DEFAULT_MATRIX_SET, ServedLevels
    from skugga.api.matrices import MAX_OVERZOOM
    from skugga.api.request import ProductRequest
    from skugga.api.workers.render_worker import run_job
    from skugga.api.workers.warm_up import warm_up
    from skugga.api.workers.worker_state import WorkerState
    from skugga.terrain.level.parts import SunSpec

    state = WorkerState(warm_up())
    for level in ServedLevels(sources).cached_levels():
        zooms = level.zooms.get(DEFAULT_MATRIX_SET)
        if zooms is None:
            continue
        native_zoom = max(zooms.last - MAX_OVERZOOM, zooms.first)
        colors = [(zoom, "color", sun) for zoom in dict.fromkeys((native_zoom, zooms.first, zooms.last)) for sun in (None, *suns)]
        for zoom, layer, sun in [*colors, *((native_zoom, layer, None) for layer in layers)]:
            block = central_block(level, zoom)
            assert block is not None
            spec = None if sun is None else SunSpec(azimuth=sun[0], altitude=sun[1])
            suffix = "npy" if layer == "visibility" else "png"
            request = ProductRequest(product=layer, sun=spec)
            run_job(block.model_copy(update={"format": suffix, "request": request}), state)


def _run_command(*arguments: object) -> None:
    """Run a command of ``skugga`` in this process. ``arguments`` are its words."""
    from skugga.api.cli.main import main

    sys.argv = ["skugga", *map(str, arguments)]
    try:
        main()
    except SystemExit as end:
        assert not end.code, arguments


def _sun_options(raster: Path) -> list[object]:
    """Return a command's options for the sun. A flat world needs angles instead of a time."""
    return ["--azimuth", 237, "--altitude", 12] if raster.stem == "flat" else ["--time", LOW_SUN_TIME]


def compute_maps(rasters: Sequence[Path], folder: Path) -> None:
    """Draw blocks of ``rasters`` that have only relief, from several directions of the sun. ``folder`` is not used.

    A render process also draws the shadow of a wall when it starts, and times a device that is not calibrated.
    """
    from skugga.api.device_calibration import calibration
    from skugga.api.workers.warm_up import warm_up

    warm_up(needs_opengl=True)
    calibration()
    _draw_blocks(rasters, ["shadow"], suns=[(350.0, 35.0), (80.0, 5.0)])  # along columns and rows


def compute_maps_of_casters(rasters: Sequence[Path], folder: Path) -> None:
    """Draw blocks of bundled levels with trees and meshes. The parameters are not used."""
    from skugga.api.catalogue import find_level

    _draw_blocks([find_level("jacksboro_wooded"), find_level("jacksboro_alpine")], ["shadow"])


def compute_pictures(rasters: Sequence[Path], folder: Path) -> None:
    """Draw masks and heights of tiles, a picture and all layers of each raster. Files are written into ``folder``."""
    _draw_blocks(rasters, ["mask", "visibility", "terrain-rgb"])
    for raster in rasters:
        for sky in ("even", "clear"):
            _run_command("render", raster, *_sun_options(raster), "--sky", sky, "--size", "600x600", "-o", folder / "out.png")
        _run_command("render", raster, *_sun_options(raster), "--style", "swiss", "--size", "30x30", "-o", folder / "out.png")
        for layer in ("visibility", "shadow", "color", "cosi"):
            _run_command("shade", raster, "--layer", layer, *_sun_options(raster), "-o", folder / "out.tif")


def compute_views(rasters: Sequence[Path], folder: Path) -> None:
    """Draw all perspective views of the bundled levels, and the street by each algorithm that a plan may choose on another device.

    The parameters are not used.
    """
    from skugga.api.catalogue import bundled_levels
    from skugga.api.cli.snapshot import snapshot
    from skugga.api.request import ProductRequest
    from skugga.terrain.level.level import load_level

    for path in bundled_levels():
        for name, view in load_level(path).level.views.items():
            if view.kind == "perspective":
                snapshot(path, name, ProductRequest(), {}, (480, 384))
    (street,) = (path for path in bundled_levels() if path.stem == "thesis_street")
    for algorithm in ("shadow_map", "perspective_shadow_map", "shadow_volume", "hybrid"):
        snapshot(street, "main", ProductRequest(), {"algorithm": algorithm}, (480, 384))


def compute_masks(rasters: Sequence[Path], folder: Path) -> None:
    """Compute a mask of each raster, as a file in ``folder``."""
    for raster in rasters:
        _run_command("shade", raster, *_sun_options(raster), "-o", folder / "out.tif")


def compute_sun_hours(rasters: Sequence[Path], folder: Path) -> None:
    """Compute sun hours of the first two rasters, and times of their first sun and longest spell, as files and as tiles."""
    from skugga.api.http.server.first_blocks import central_blocks
    from skugga.api.http.state.served_levels import ServedLevels
    from skugga.api.products.sun_hours import SunHoursOptions
    from skugga.api.request import ProductRequest
    from skugga.api.workers.jobs import BlockJob
    from skugga.api.workers.render_worker import run_job
    from skugga.api.workers.worker_state import WorkerState

    for raster in rasters[:2]:
        for quantity in ("hours", "first", "longest"):
            _run_command("sunhours", raster, "--date", "2024-12-21", "--quantity", quantity, "-o", folder / "out.tif")
    state = WorkerState("")
    for block in central_blocks(ServedLevels(rasters[:2])):
        place = block.model_dump(include={"matrix_set", "zoom", "block_x", "block_y"})
        options = SunHoursOptions(**SunHoursOptions.UNSERVED, date=date(2024, 3, 20))
        run_job(BlockJob(level=block.level, **place, request=ProductRequest(product="sunhours", options=options)), state)


def compute_points(rasters: Sequence[Path], folder: Path) -> None:
    """Compute reports of points on the rasters and on a bundled level with trees. ``folder`` is not used."""
    from skugga.api.catalogue import find_level
    from skugga.api.point.report import point_report
    from skugga.api.point.values import PointQuery
    from skugga.terrain.level.level import load_level
    from skugga.terrain.scene import build_scene

    for source in [*rasters, find_level("jacksboro_wooded")]:
        with_trees = source.stem == "jacksboro_wooded"
        scene = build_scene(load_level(source))
        flat = scene.world.is_flat
        lon, lat = (750.0, -900.0) if flat else (scene.world.anchor_lon_deg, scene.world.anchor_lat_deg)
        point_report(scene, PointQuery(lon=lon, lat=lat, date=None if flat else date(2024, 3, 20)))
        if not flat and not with_trees:
            point_report(scene, PointQuery(lon=lon, lat=lat, date=date(2024, 3, 20), height=2.0))
        scene.close()


PRODUCERS: dict[str, Callable[[Sequence[Path], Path], None]] = {
    MAPS: compute_maps, MAPS_OF_CASTERS: compute_maps_of_casters, PICTURES: compute_pictures, MASKS: compute_masks,
    SUN_HOURS: compute_sun_hours, POINTS: compute_points, VIEWS: compute_views,
}  # fmt: skip
"""Functions that compute a product from the paths of rasters and a folder for files, by the product's name."""


def record_loops(product: str) -> list[tuple[str, Any]]:
    """Compute a product in this process, and return the loops that it compiled with their encoded argument types.

    ``product`` is a key of ``PRODUCERS``. The process must have no stored machine code.
    """
    from skugga.terrain.compiling.hooks import compile_lazily
    from skugga.terrain.compiling.loop_cache import compile_recorders
    from skugga.terrain.compiling.signatures import decode_type, encode_type

    recorded_loops: list[tuple[str, Any]] = []

    def record_loop(loop: Any, args: tuple[Any, ...]) -> None:
        function = loop.py_func
        if "<" in function.__qualname__:  # a closure, which no module can look up
            return
        encoded = [encode_type(arg) for arg in args]
        assert tuple(map(decode_type, encoded)) == args, (function, args)
        recorded_loops.append((f"{function.__module__}:{function.__qualname__}", encoded))

    compile_recorders.append(record_loop)
    compile_lazily()
    with tempfile.TemporaryDirectory() as folder:
        PRODUCERS[product](write_rasters(Path(folder)), Path(folder))
    return recorded_loops


def main(products: Sequence[str]) -> None:
    """Record the loops of products, two at a time, and write the signatures."""
    from skugga.terrain.compiling.signatures import SIGNATURES_FILE, recorded_signatures

    def recorded(product: str) -> list[tuple[str, Any]]:
        with tempfile.TemporaryDirectory() as store:
            numba_options = {
                "NUMBA_OPT": "1",
                "NUMBA_LOOP_VECTORIZE": "0",
                "NUMBA_SLP_VECTORIZE": "0",
            }  # the machine code is discarded
            environment = {**os.environ, "NUMBA_CACHE_DIR": store, "XDG_CACHE_HOME": f"{store}/cache", **numba_options}
            command = [sys.executable, __file__, "--one", product, f"{store}/found.json"]
            subprocess.run(command, env=environment, check=True)
            return [tuple(item) for item in json.loads(Path(store, "found.json").read_text(encoding="utf-8"))]

    products_by_loop: dict[tuple[str, str], set[str]] = {}
    for item in recorded_signatures():
        if other_products := set(item.products) - set(products):
            products_by_loop[item.loop, item.args] = other_products
    with ThreadPoolExecutor(2) as pool:
        for product, loops in zip(products, pool.map(recorded, products), strict=True):
            print(f"{product}: {len(loops)} loops")
            for loop, args in loops:
                products_by_loop.setdefault((loop, json.dumps(args)), set()).add(product)
    rows = [
        json.dumps({"loop": loop, "args": json.loads(args), "products": [item for item in PRODUCTS if item in loop_products]})
        for (loop, args), loop_products in sorted(products_by_loop.items())
    ]
    SIGNATURES_FILE.write_text("[\n" + ",\n".join(rows) + "\n]\n", encoding="utf-8")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        Path(sys.argv[3]).write_text(json.dumps(record_loops(sys.argv[2])), encoding="utf-8")
    else:
        main(sys.argv[1:] or PRODUCTS)
