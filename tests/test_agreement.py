"""Interfaces agree on which points of a raster are lit. Every allowed difference is listed in ``ALLOWED`` with its reason.

A few cases run with the quick tests; all of them by ``make test-thorough ARGS=tests/test_agreement.py``.

Rays decide (``skugga.shadows.truth``). Tiles, maps and WMS have identical pixels, and so have ``shade`` and the accessor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import rioxarray

import skugga
from skugga.api.http.server.app import create_app
from skugga.api.settings import Settings
from skugga.shadows.truth.truth import Truth
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene
from tests.agreement import (
    CELLS,
    DATA_GROUNDS,
    MADE_GROUNDS,
    MERCATOR,
    SUNS,
    Ground,
    chosen_pixels,
    filled_heights,
    lit_at_points,
    lit_mask,
    make_ground,
    served_pictures,
    sun_time,
    traced,
)
from tests.api.conftest import Client, running
from tests.conftest import SHARED_DATA

POINTS = 300
QUICK = [("hills", "winter")]
GROUNDS = (*MADE_GROUNDS, *DATA_GROUNDS)


def cases(suns: Iterable[str], quick: Sequence[tuple[str, str]] = ()) -> list[Any]:
    """Return the cases of all grounds under some suns, of which those that are not ``quick`` are thorough."""
    thorough_cases = [(ground, sun) for sun in suns for ground in GROUNDS if (ground, sun) not in quick]
    return [*quick, *(pytest.param(*case, marks=pytest.mark.thorough) for case in thorough_cases)]


ALL_SUNS = cases(SUNS, QUICK)
TWO_SUNS = cases(["winter", "low morning"])


class Allowance(NamedTuple):
    """Largest share that may differ of the pixels on edges of shadows, and of the others."""

    edge: float
    elsewhere: float


ALLOWED = {
    # Reasons come from the definitions. Limits are the largest shares of all cases, rounded up: they bound growth, no more.
    # A sweep interpolates between eight lines of sight a column. So it errs where a shadow's edge is nearer than a part of a cell,
    # and at 1 node in 10,000 elsewhere (docs/python.md). Tiles and rasters have other lines, since their blocks begin elsewhere.
    # Walls one cell wide are the worst: 85 of 4322 pixels on edges, and 74 of 3681 towers under a sun of 3 degrees.
    "sweep": Allowance(0.025, 2e-4),
    # The same at both ends and in the middle of the minute of hours of sun.
    "hours": Allowance(0.03, 2e-4),
    # Clearances err more where the sun passes a diagonal of the grid: 42 of 10,420 cells of a city whose truth is steady lose the
    # sun for a part of the minute, while masks at its ends and middle are right.
    "hours along a diagonal": Allowance(0.03, 5e-3),
    # ``skugga.horizon`` interpolates the angle between its lines, and a thin caster's angle may jump there: at 28 of 32,399 cells
    # of a city of 1 m.
    "horizon": Allowance(0.03, 1e-3),
    # A report's ray starts on the ground, that of truth by up to a millimetre a kilometre above it (docs/accuracy.md).
    "point": Allowance(0.02, 0.0),
    # Between cells' centres, truth takes the smooth normal for attached shadow (docs/accuracy.md). Bare ground in maps and reports
    # of points have the triangles' normals (docs/how-it-works.md). ``check_between_cells`` counts attached shadow by itself.
    # It also moves points from triangles that face away up to the smooth ground, so that cast shadow at their rims differs.
    "sweep between cells": Allowance(0.02, 5e-4),
    # A report's ground is the triangles between cells, and a map's is bilinear at its pixels (docs/how-it-works.md): they lie
    # metres apart on cliffs, up to 8 of 430 points off edges.
    "point between cells": Allowance(0.15, 3e-2),
}

ALLOWED_ACCESSOR_PIXELS = 3
"""Largest number of pixels in which the accessor differs from the file: it finds the cells' size from rounded coordinates."""

ALLOWED_ATTACHED_SHARE = 0.02
"""Largest share of pixels between cells that differ in attached shadow, by smooth normals and by those of triangles."""


def check(name: str, allowed: str, lit: np.ndarray, truth: Truth, at: np.ndarray | None = None) -> None:
    """Check lit pixels against truth, by an allowance. ``at`` masks pixels."""
    compared = truth.valid if at is None else truth.valid & at
    differs, limit = (lit != truth.lit) & compared, ALLOWED[allowed]
    edges, inner = int((compared & ~truth.decidable).sum()), int((compared & truth.decidable).sum())
    on_edge, elsewhere = int((differs & ~truth.decidable).sum()), int((differs & truth.decidable).sum())
    found = f"{name}: {on_edge} of {edges} on edges, {elsewhere} of {inner} elsewhere"
    print(found)
    # One pixel is always allowed where a share is: it may be more than the share of few pixels.
    assert on_edge <= max(limit.edge * edges, 1.0) and elsewhere <= max(limit.elsewhere * inner, limit.elsewhere > 0.0), found


def check_between_cells(name: str, allowed: str, lit: np.ndarray, truth: Truth, at: np.ndarray | None = None) -> None:
    """Check lit pixels between cells' centres against truth. Truth's attached shadow counts by itself."""
    compared = truth.valid if at is None else truth.valid & at
    attached = (lit != truth.lit) & truth.attached_shadow_mask & compared
    print(f"{name}: {attached.sum()} of {compared.sum()} in attached shadow")
    assert attached.sum() <= max(ALLOWED_ATTACHED_SHARE * compared.sum(), 1.0), (name, attached.sum())
    check(name, allowed, lit, truth, compared & ~truth.attached_shadow_mask)


def is_along_diagonal(scenes: list[Scene]) -> bool:
    """Return whether the sun of any scene stands within half a degree of a diagonal of the grid."""
    return any(abs(scene.sun.azimuth_deg % 90.0 - 45.0) < 0.5 for scene in scenes if scene.sun is not None)


def check_points(check_mask: Callable[..., None], allowed: str, scene: Scene, view: MapView, truth: Truth) -> np.ndarray:
    """Check reports of ``POINTS`` pixels' centres against truth. Return whether they are lit, and -1 elsewhere, (rows, cols)."""
    row, col = chosen_pixels(view.rows, POINTS)
    row, col = row[truth.valid[row, col]], col[truth.valid[row, col]]
    lit = np.full(truth.lit.shape, -1)
    lit[row, col] = lit_at_points(scene, view, row, col)
    check_mask("points", allowed, lit == 1, truth, lit >= 0)
    return lit


@pytest.fixture(scope="module")
def ground_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Ground]:
    """Return ``ground_of(name)``, which writes a ground once."""
    folder, grounds = tmp_path_factory.mktemp("grounds"), {}

    def ground(name: str) -> Ground:
        if name not in grounds:
            grounds[name] = make_ground(folder, name, SHARED_DATA)
        return grounds[name]

    return ground


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Client, dict[str, Ground]]]:
    """Run a service over all grounds whose data are there."""
    folder, grounds = tmp_path_factory.mktemp("served"), {}
    for name in GROUNDS:
        if name in MADE_GROUNDS or (SHARED_DATA / DATA_GROUNDS[name][0]).is_file():
            grounds[name] = make_ground(folder, name, SHARED_DATA)
    levels: list[Path] = [ground.path.with_suffix(".yaml") for ground in grounds.values()]
    with running(create_app(Settings(workers=1), levels)) as client:
        yield client, grounds


@pytest.mark.parametrize(("name", "sun"), ALL_SUNS)
def test_rasters_points_and_hours_agree_at_cell_centres(ground_of, name, sun):
    ground = ground_of(name)
    with skugga.open_level(ground.path) as level:
        moment = sun_time(level, sun)
        moments = [moment, moment + timedelta(seconds=30), moment + timedelta(minutes=1)]
        scenes = [level._scene.with_sun(SunSpec(time=time)) for time in moments]
        truths = [traced(scene, level._own_raster.view) for scene in scenes]
        truth = truths[0]
        mask = level.shade("mask", time=moment.isoformat())
        assert np.array_equal(mask == 128, ~truth.valid) and np.array_equal(truth.valid, np.isfinite(ground.height_m))
        check("shade", "sweep", lit_mask(mask), truth)

        heights = rioxarray.open_rasterio(ground.path, masked=True).squeeze()
        in_shadow = heights.skugga.shadow(time=moment.isoformat()).to_numpy()
        assert (in_shadow != (mask == 0)).sum() <= ALLOWED_ACCESSOR_PIXELS, "the accessor"

        view = level._own_raster.view
        lit = check_points(check, "point", scenes[0], view, truth)
        row, col = np.nonzero(lit >= 0)
        for n in range(0, len(row), len(row) // 4):  # the whole report has the moment of its part
            x, y = float(view.grid.x(view.col0 + col[n])), float(view.grid.y(view.row0 + row[n]))
            assert level.point(x, y, crs=MERCATOR, time=moment.isoformat()).now.lit == (lit[row[n], col[n]] == 1)

        window = f"{moments[0]:%H:%M}-{moments[-1]:%H:%M}"
        minutes = 60.0 * level.sun_hours(f"{moment:%Y-%m-%d}", window=window, clock="utc")
        steady_lit, steady_dark = (np.all([t.lit == value for t in truths], axis=0) for value in (True, False))
        steady = replace(truth, decidable=np.all([t.decidable for t in truths], axis=0))
        allowed = "hours along a diagonal" if is_along_diagonal(scenes) else "hours"
        check("hours of steady sun", allowed, minutes > 0.999, steady, steady_lit)
        check("hours of steady shade", allowed, minutes > 0.001, steady, steady_dark)


@pytest.mark.parametrize(("name", "sun"), TWO_SUNS)
def test_tiles_maps_and_wms_agree_at_cell_centres(served, name, sun):
    client, grounds = served
    if name not in grounds:
        pytest.skip(f"no sample raster of {name}")
    ground = grounds[name]
    with skugga.open_level(ground.path) as level:
        moment = sun_time(level, sun)
        view = ground.view(0)
        pictures = served_pictures(client, ground, 0, moment)
        pictures["render"] = level.render(
            "map", "mask", bounds=view.bounds, crs=MERCATOR, size=(CELLS, CELLS), time=moment.isoformat()
        )
        for other, mask in pictures.items():
            assert np.array_equal(mask, pictures["tiles"]), other
        check("tiles", "sweep", lit_mask(pictures["tiles"]), traced(level._scene.with_sun(SunSpec(time=moment)), view))


@pytest.mark.parametrize(("name", "sun"), TWO_SUNS)
def test_interfaces_agree_between_cell_centres(served, name, sun):
    """Pixels of the next zoom lie a quarter of a cell off the centres, and beyond the outermost ones."""
    client, grounds = served
    if name not in grounds:
        pytest.skip(f"no sample raster of {name}")
    ground = grounds[name]
    with skugga.open_level(ground.path) as level:
        moment, view = sun_time(level, sun), ground.view(1)
        scene = level._scene.with_sun(SunSpec(time=moment))
        truth = traced(scene, view)
        pictures = served_pictures(client, ground, 1, moment)
        pictures["render"] = level.render(
            "map", "mask", bounds=view.bounds, crs=MERCATOR, size=(view.cols, view.rows), time=moment.isoformat()
        )
        for other, mask in pictures.items():
            assert np.array_equal(mask, pictures["tiles"]), other
        assert np.array_equal(pictures["tiles"] == 128, ~truth.valid)
        check_between_cells("tiles", "sweep between cells", lit_mask(pictures["tiles"]), truth)
        quarter = view.grid.step / 4.0  # inside of the outermost cells, so that rounding adds no cell
        west, south, east, north = view.bounds
        inside = west + quarter, south + quarter, east - quarter, north - quarter
        mask = level.shade("mask", bounds=inside, crs=MERCATOR, resolution=view.grid.step, time=moment.isoformat())
        check_between_cells("shade", "sweep between cells", lit_mask(mask), truth)
        check_points(check_between_cells, "point between cells", scene, view, truth)


@pytest.mark.parametrize(("name", "sun"), ALL_SUNS)
def test_arrays_agree_with_a_level_in_a_flat_world(ground_of, name, sun):
    ground = ground_of(name)
    azimuth, altitude = 67.0 + 226.0 * list(SUNS).index(sun) / 5.0, SUNS[sun][2]
    with skugga.open_level(ground.flat_path) as level:
        spec, view = SunSpec(azimuth=azimuth, altitude=altitude), level._own_raster.view
        scene = level._scene.with_sun(spec)
        truth = traced(scene, view)
        # A raster's holes are filled for casting shadows, those of an array are not: the array gets the raster's heights in them.
        heights = filled_heights(scene, view)
        assert np.array_equal(heights[truth.valid], ground.height_m[truth.valid])
        arguments = heights, ground.cell_m, azimuth, altitude
        sunlit = skugga.sunlit(*arguments)
        assert np.array_equal(skugga.shadow(*arguments), ~sunlit)
        check("sunlit", "sweep", sunlit, truth)
        check("horizon", "horizon", skugga.horizon(*arguments[:3], lines=8) < altitude, truth)
        check("shade", "sweep", lit_mask(level.shade("mask", azimuth=azimuth, altitude=altitude)), truth)
        mask = level.render("map", "mask", bounds=view.bounds, size=(CELLS, CELLS), azimuth=azimuth, altitude=altitude)
        check("map", "sweep", lit_mask(mask), truth)
        check_points(check, "point", scene, view, truth)
