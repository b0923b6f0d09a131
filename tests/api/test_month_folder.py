"""Finished months of irradiation: a stopped run continues with them, and other requests do not take them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import skugga
from skugga.shadows.irradiation.direct import DirectLight
from tests.rasters import write_geotiff


@pytest.fixture
def level(tmp_path: Path):
    """Level of a hill in a plain."""
    row, col = np.mgrid[:40, :40]
    heights = (200.0 * np.exp(-((row - 20.0) ** 2 + (col - 20.0) ** 2) / 60.0)).astype(np.float32)
    with skugga.open_level(write_geotiff(tmp_path / "hill.tif", heights, "EPSG:32632", 500e3, 5200e3, 30.0)) as opened:
        yield opened


def test_a_stopped_run_continues_with_its_months(level, tmp_path, monkeypatch):
    options = {"date": "2023-01-30", "to": "2023-03-02", "per": "month", "step_min": 60.0, "checkpoint": tmp_path / "months"}
    whole = level.irradiation(**{**options, "checkpoint": None})
    computed: list[int] = []
    direct = DirectLight.irradiation

    def stop_in_march(self, suns, lights, numbers, on_sun):
        computed.append(len(numbers))
        if len(computed) == 3:
            raise KeyboardInterrupt
        return direct(self, suns, lights, numbers, on_sun)

    monkeypatch.setattr(DirectLight, "irradiation", stop_in_march)
    with pytest.raises(KeyboardInterrupt):
        level.irradiation(**options)
    assert len(list((tmp_path / "months").iterdir())) == 2
    continued = level.irradiation(**options)
    assert len(computed) == 4, "January and February are there, March is computed"
    np.testing.assert_array_equal(continued, whole)


def test_other_requests_do_not_take_the_months(level, tmp_path):
    options = {"date": "2023-06-21", "part": "beam", "step_min": 60.0, "checkpoint": tmp_path / "months"}
    ground = level.irradiation(**options)
    level_planes = level.irradiation(**options, plane="level")
    assert len(list((tmp_path / "months").iterdir())) == 2
    assert np.abs(ground - level_planes).max() > 0.1
    np.testing.assert_array_equal(level.irradiation(**options), ground)
