"""Arguments of the library's functions: every value gives a result or one ``SkuggaError``."""

from __future__ import annotations

import datetime
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from affine import Affine
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import skugga
from skugga.api.library import memory

NAN, INF = float("nan"), float("inf")
GROUND = np.zeros((6, 7), np.float32)
TRANSFORM = Affine(30.0, 0.0, 500e3, 0.0, -30.0, 5200e3)
SUN = {"azimuth": 250.0, "altitude": 12.0}

ODD_VALUES = [
    None, "", "x", b"x", 0, -1, 1, 1.5, 1e300, -1e300, 10**400, NAN, INF, True, (), [], (1, 2), (1, 2, 3, 4), "1,2,3,4", {},
    object(), np.array([1.0, 2.0]), np.zeros((2, 2)), np.float32(3), np.int64(-3), np.datetime64("NaT", "s"), pd.NaT,
    "2024-03-21", np.datetime64("2024-03"),
    np.datetime64("2024-03-21T10:00"), datetime.date(2024, 3, 21), datetime.datetime(2024, 3, 21), "2024-03-21T10:00Z",
    Path("nowhere.tif"), slice(0, 2),
]  # fmt: skip

ODD_ARRAYS = [
    5, "abc", [[]], [[1, 2], [3]], [[1, 2], [3, 10**400]], np.zeros(4), np.zeros((1, 5)), np.zeros((0, 5)), np.zeros((2, 2, 2)),
    np.zeros((3, 3), complex), np.full((3, 3), "a"), np.full((3, 3), None), np.full((3, 3), "2020-01-01", "datetime64[D]"),
    np.full((3, 3), NAN), np.full((3, 3), INF), np.full((3, 3), 1e38), np.full((3, 3), 1e300), np.zeros((3, 3), bool),
    np.zeros((3, 3), object), np.ma.masked_all((3, 3)), {"a": 1}, range(3), [[1, 2], [3, 4]],
]  # fmt: skip


def check_answers_or_refuses(call: Callable[[], Any]) -> None:
    """Call a function; fail on any warning and on any error but ``SkuggaError``."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            call()
        except skugga.SkuggaError as error:
            assert 0 < len(str(error)) < 1000 and "\n" not in str(error) and "/vsimem" not in str(error)


@pytest.fixture(scope="module")
def level() -> Iterator[skugga.OpenLevel]:
    """An open level of the heights ``GROUND``."""
    with skugga.open_heights(GROUND, TRANSFORM, "EPSG:32633") as open_level:
        yield open_level


ARRAY_FUNCTIONS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "shadow": (skugga.shadow, dict(height_m=GROUND, cell_m=30.0, azimuth_deg=250.0, altitude_deg=12.0, lines=8, cores=1)),
    "sunlit": (skugga.sunlit, dict(height_m=GROUND, cell_m=30.0, azimuth_deg=250.0, altitude_deg=12.0, lines=8, cores=1)),
    "horizon": (skugga.horizon, dict(height_m=GROUND, cell_m=30.0, azimuth_deg=250.0, lines=4, cores=1)),
    "sun_hours": (
        skugga.sun_hours,
        dict(height_m=GROUND, cell_m=30.0, date="2024-03-21", lat_deg=46.0, lon_deg=7.0, step_min=60.0, window="10:00-12:00"),
    ),
    "open_heights": (
        lambda **arguments: skugga.open_heights(**arguments).close(), dict(height_m=GROUND, transform=TRANSFORM, crs="EPSG:32633"),
    ),
    "open_level": (
        lambda **arguments: skugga.open_level(**arguments).close(),
        dict(source="jacksboro", canopy=None, buildings=None, nodata=None, units=None),
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "parameter"),
    [(name, argument) for name, (_, valid_arguments) in ARRAY_FUNCTIONS.items() for argument in valid_arguments],
)
def test_functions_answer_or_refuse_odd_values(name, parameter):
    function, valid_arguments = ARRAY_FUNCTIONS[name]
    for value in [*ODD_VALUES, *(ODD_ARRAYS if parameter == "height_m" else ())]:
        check_answers_or_refuses(lambda value=value: function(**{**valid_arguments, parameter: value}))


LEVEL_METHODS: dict[str, dict[str, Any]] = {
    "shade": {
        "layer": "mask", "time": None, "azimuth": 250.0, "altitude": 12.0, "bounds": None, "crs": None, "resolution": None,
        "like": None, "cells": None, "algorithm": None, "map_size": None, "max_error": None, "times": None,
    },
    "sun_hours": {
        "date": "2024-03-21", "to": None, "every_days": 1, "window": "10:00-12:00", "clock": "solar", "quantity": "hours",
        "step_min": 60.0, "threshold_h": 2.0, "least_altitude": 0.0, "height": 0.0, "bounds": None, "crs": None, "resolution": None,
        "like": None, "cells": None,
    },
    "sky_view": {
        "kind": "cosine", "azimuths": 8, "transmissivity": 0.0, "bounds": None, "crs": None, "resolution": None, "like": None,
        "cells": None,
    },
    "horizons": {"azimuths": 8, "bounds": None, "crs": None, "resolution": None, "like": None, "cells": None},
    "point": {
        "lon": 500100.0, "lat": 5199900.0, "crs": "EPSG:32633", "time": None, "date": "2024-03-21", "clock": None, "height": 0.0,
        "year": None,
    },
    "point_irradiation": {
        "lon": 500100.0, "lat": 5199900.0, "crs": "EPSG:32633", "year": None, "date": "2024-03-21", "to": None, "plane": None,
        "tilt": 35.0, "azimuth": 180.0, "albedo": 0.2, "linke": None, "clock": "solar", "step_min": 60.0, "height": 0.0,
    },
    "horizon": {"lon": 500100.0, "lat": 5199900.0, "crs": "EPSG:32633", "height": 0.0},
    "point_horizons": {"points": [[500100.0, 5199900.0]], "azimuths": 8, "height": 0.0, "crs": "EPSG:32633"},
    "film": {
        "view": "map", "start": "2024-03-21T10:00Z", "end": "2024-03-21T12:00Z", "step": "1h", "path": None, "fps": 25.0,
        "size": (8, 8), "bounds": None, "crs": None, "seconds": None, "style": None, "slope_exaggeration": None,
    },
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "parameter"), [(name, argument) for name, valid_arguments in LEVEL_METHODS.items() for argument in valid_arguments]
)
def test_levels_answer_or_refuse_odd_values(level, name, parameter):
    for value in ODD_VALUES:
        check_answers_or_refuses(lambda value=value: getattr(level, name)(**{**LEVEL_METHODS[name], parameter: value}))


@pytest.mark.parametrize(
    "parameter",
    ["view", "layer", "time", "azimuth", "altitude", "size", "bounds", "crs", "seconds", "style", "slope_exaggeration", "ramp"],
)
def test_render_answers_or_refuses_odd_values(gl, level, parameter):
    for value in ODD_VALUES:
        check_answers_or_refuses(lambda value=value: level.render(**{**SUN, "size": (8, 8), parameter: value}))


FLOATS = st.sampled_from([np.float32, np.float64, np.float16])
INTEGERS = st.sampled_from([np.int16, np.uint8, np.int64, np.bool_])


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow])
@given(
    heights=st.one_of(
        arrays.arrays(FLOATS, arrays.array_shapes(min_dims=0, max_dims=3, max_side=5)),
        arrays.arrays(INTEGERS, arrays.array_shapes(min_dims=2, max_dims=2, max_side=5)),
    ),
    cell=st.one_of(st.floats(), st.tuples(st.floats(), st.floats()), st.floats(0.1, 1000.0)),
    azimuth=st.one_of(st.floats(), st.floats(0.0, 360.0)),
    altitude=st.one_of(st.floats(), st.floats(-90.0, 90.0)),
)
def test_any_numbers_give_shadows_of_the_array_s_shape(heights, cell, azimuth, altitude):
    def shaded() -> None:
        in_shadow = skugga.shadow(heights, cell, azimuth, altitude)
        assert in_shadow.shape == heights.shape and in_shadow.dtype == np.bool_
        with np.errstate(invalid="ignore"):
            assert not in_shadow[~(np.abs(heights.astype(np.float64)) <= 1.01e6)].any()

    check_answers_or_refuses(shaded)


@pytest.mark.parametrize(
    ("call", "expected_texts"),
    [
        (lambda level: level.shade("mask", times="2024-03-21T10:00Z"), ("times: unknown parameter", "time,", "algorithm")),
        (lambda level: skugga.shadow(GROUND, 0.0, 250.0, 12.0), ("cell_m: '0.0'", "0.000001 to 1,000,000 metres")),
        (lambda level: skugga.shadow(GROUND, 1e-300, 250.0, 12.0), ("cell_m: '1e-300'", "0.000001 to 1,000,000 metres")),
        (lambda level: skugga.shadow(GROUND, 1e300, 250.0, 12.0), ("cell_m: '1e+300'", "0.000001 to 1,000,000 metres")),
        (lambda level: skugga.shadow(GROUND, (TRANSFORM.e, TRANSFORM.a), 250.0, 12.0), (("cell_m: "
            "'(-30.0, 30.0)'"), "abs(transform.e)")),
        (lambda level: skugga.shadow(GROUND, 30.0, 250.0, 95.0), ("altitude_deg: '95.0'", "90")),
        (lambda level: skugga.shadow(GROUND, 30.0, 250.0, NAN), ("altitude_deg: 'nan'", "finite")),
        (lambda level: skugga.shadow(GROUND, 30.0, 250.0, 12.0, lines=10**6), ("lines", "64")),
        (lambda level: skugga.shadow(GROUND[0], 30.0, 250.0, 12.0), ("height_m", "(7,)", "1 x 1")),
        (lambda level: skugga.shadow(GROUND[:0], 30.0, 250.0, 12.0), ("height_m", "(0, 7)", "1 x 1")),
        (lambda level: skugga.horizon(GROUND[:1], 30.0, 250.0), ("height_m", "(1, 7)", "2 x 2")),
        (lambda level: skugga.open_heights(np.full((3, 3), NAN), TRANSFORM, "EPSG:32633"), ("the array", "no height")),
        (lambda level: level.shade(cells=np.s_[6:, :], **SUN), ("cells", "6 rows and 7 columns")),
        (lambda level: level.shade(cells=np.s_[:2, :2], crs=3857, **SUN), ("crs", "cannot be combined with cells")),
        (lambda level: level.shade(resolution=1e-9, **SUN), ("resolution: '1e-09'", "2^40")),
        (lambda level: level.sun_hours("2024-03-21", step_min=0), ("step_min: '0'", "0.5")),
        (lambda level: level.point(15.0, 46.95, year=5), ("year: '5'", "1800")),
        (lambda level: skugga.open_level("a" * 5000), ("LEVEL", "aaa")),
    ],
)  # fmt: skip
def test_messages_name_parameter_and_allowed_values(level, call, expected_texts):
    with pytest.raises(skugga.SkuggaError) as error:
        call(level)
    for text in expected_texts:
        assert text in str(error.value)


@pytest.mark.parametrize(
    "time", [np.datetime64("2024"), np.datetime64("2024-06"), np.datetime64("2024-06-21", "W"), np.datetime64("2024-06-21"), pd.NaT]
)
def test_a_time_without_a_time_of_day_is_refused(level, time):
    with pytest.raises(skugga.SkuggaError, match="^time: .*offset"):
        level.shade(time=time)


def test_datetime64_of_any_unit_of_time_is_utc(level):
    expected_mask = level.shade(time="2024-06-21T18:00Z")
    for unit in ("h", "m", "s", "ms", "us", "ns"):
        np.testing.assert_array_equal(level.shade(time=np.datetime64("2024-06-21T18", unit)), expected_mask)


@pytest.mark.parametrize(
    "date", [np.datetime64("2024"), np.datetime64("2024-06"), np.datetime64("2024-06-21", "W"), np.datetime64("NaT", "D"), pd.NaT]
)
def test_a_date_without_a_day_is_refused(level, date):
    for call in (lambda: skugga.sun_hours(GROUND, 30.0, date, 46.0), lambda: level.sun_hours(date)):
        with pytest.raises(skugga.SkuggaError, match="^date: .*2024-03-21"):
            call()


@pytest.mark.parametrize(
    "date", [np.datetime64("2024-06-21"), np.datetime64("2024-06-21T10"), pd.Timestamp("2024-06-21T10"), datetime.date(2024, 6, 21)]
)
def test_a_date_of_any_type_is_its_day(level, date):
    options = {"step_min": 60.0, "window": "10:00-12:00"}
    np.testing.assert_array_equal(level.sun_hours(date, **options), level.sun_hours("2024-06-21", **options))


def test_an_array_that_is_no_grid_is_a_value_error():
    with pytest.raises(ValueError, match=r"\(4,\)"):
        skugga.shadow(np.zeros(4), 30.0, 0.0, 10.0)


def test_an_unknown_argument_is_a_type_error():
    with pytest.raises(TypeError, match="'dark'"):
        skugga.shadow(GROUND, 30.0, 250.0, 12.0, dark=True)


def test_a_closed_level_is_an_error():
    level = skugga.open_heights(GROUND, TRANSFORM, "EPSG:32633")
    level.close()
    level.close()
    with pytest.raises(skugga.SkuggaError, match="closed"):
        level.shade(**SUN)


def test_arrays_too_large_for_memory_are_refused_at_once():
    """The array would have a petabyte. numpy allocates memory for it only when it is written to."""
    huge = np.broadcast_to(np.float32(0.0), (10**7, 10**7))
    for call in (
        lambda: skugga.shadow(huge, 30.0, 250.0, 12.0),
        lambda: skugga.sunlit(huge, 30.0, 250.0, 12.0),
        lambda: skugga.horizon(huge, 30.0, 250.0),
        lambda: skugga.sun_hours(huge, 30.0, "2024-03-21", 46.0),
        lambda: skugga.open_heights(huge, TRANSFORM, "EPSG:32633"),
    ):
        with pytest.raises(skugga.SkuggaError, match=r"height_m: 10000000 x 10000000 cells take .* GB .*skugga shade.*dask"):
            call()


def test_a_raster_too_large_for_an_array_is_refused(level):
    for call in (lambda: level.shade(resolution=0.0005, **SUN), lambda: level.sun_hours("2024-03-21", resolution=0.0005)):
        with pytest.raises(skugga.SkuggaError, match=r"resolution: .* GB .*np\.s_.*skugga shade"):
            call()


def test_free_memory_respects_system_and_container(tmp_path, monkeypatch):
    """Free memory is the minimum of both. Pages of files that the kernel may drop count as free."""
    (tmp_path / "meminfo").write_text("MemTotal: 64 kB\nMemAvailable: 32 kB\n")
    monkeypatch.setattr(memory, "MEMINFO_PATH", tmp_path / "meminfo")
    monkeypatch.setattr(memory, "CGROUP_FILES", [(tmp_path, "memory.max", "memory.current", "inactive_file")])
    assert memory.free_bytes() == 32 * 1024
    for name, text in (("memory.max", "20000"), ("memory.current", "15000"), ("memory.stat", "anon 9000\ninactive_file 4000\n")):
        (tmp_path / name).write_text(text)
    assert memory.free_bytes() == 20000 - (15000 - 4000)
    (tmp_path / "memory.max").write_text("max")
    assert memory.free_bytes() == 32 * 1024


def test_a_slice_of_cells_equals_part_of_the_whole():
    row, col = np.mgrid[:90, :120]
    hills = 300.0 * np.sin(col / 9) * np.cos(row / 13)
    with skugga.open_heights(hills, TRANSFORM, "EPSG:32633") as level:
        part = np.s_[20:70, 30:]
        np.testing.assert_array_equal(level.shade(cells=part, **SUN), level.shade(**SUN)[part])
        hours = level.sun_hours("2024-12-21", step_min=60.0)
        np.testing.assert_array_equal(level.sun_hours("2024-12-21", step_min=60.0, cells=part), hours[part])
        for crs in (level.crs, 32633, "EPSG:32633", level.crs.to_wkt()):
            np.testing.assert_array_equal(level.shade(crs=crs, **SUN), level.shade(**SUN))


def test_lists_are_accepted_as_heights_and_cell_sizes():
    wall = np.zeros((5, 30), np.float32)
    wall[:, 10] = 60.0
    in_shadow = skugga.shadow(wall, 30.0, 270.0, 26.0)
    assert in_shadow[2].sum() > 3
    for heights in (wall.tolist(), wall.astype(int), np.asfortranarray(wall)):
        np.testing.assert_array_equal(skugga.shadow(heights, [30, 30], 270, 26), in_shadow)
