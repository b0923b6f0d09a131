"""Examples: each runs by itself and prints correct figures; the notebook is the run of its script."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

HERE = Path(__file__).parent.parent
EXAMPLES = sorted((HERE / "examples").glob("*.py"))
NOTEBOOK = HERE / "docs" / "a-winters-day.ipynb"
SCRIPT = HERE / "examples" / "a_winters_day.py"


def run(example: Path, folder: Path) -> str:
    """Run an example in a folder as a user does, and return its output."""
    variables = {**os.environ, "MPLBACKEND": "agg", "PYTHONPATH": str(HERE)}
    ran = subprocess.run([sys.executable, example], cwd=folder, env=variables, capture_output=True, text=True, timeout=600)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def number(pattern: str, said: str) -> float:
    found = re.search(pattern, said)
    assert found, said
    return float(found[1])


def a_garden(said: str) -> None:
    assert number(r"before +mean +([\d.]+) h", said) == pytest.approx(day_length_h("2024-03-21", 59.3), abs=0.02)
    # At noon the sun is 31 degrees high, and a wall of 7 m casts 11.7 m of shadow: over all rows of the garden, 5 to 15 m away.
    assert number(r"after +mean +([\d.]+) h", said) < 10.0 and number(r"after.*least +([\d.]+) h", said) < 6.0


def a_satellite_scene(said: str) -> None:
    assert 0.0 < number(r"([\d.]+)% of the ground in shadow", said) < 2.0
    assert number(r"as seen .*: ([-+\d.]+)", said) > 0.9 and abs(number(r"corrected .*: ([-+\d.]+)", said)) < 0.05


def a_roof_panel(said: str) -> None:
    lost = [float(share) for share in re.findall(r"([\d.]+)% of it behind", said)]
    assert len(lost) == 12 and lost[11] > 5.0 > 0.5 > lost[5], "a ridge in the south east costs winter, not summer"


def a_first_sun(said: str) -> None:
    rows = re.findall(r"(\d\d:\d\d) +(\d\d:\d\d) +([\d.]+) of ([\d.]+) h +relief", said)
    assert len(rows) == 7 and all(first < last and float(direct) < float(up) for first, last, direct, up in rows)


def a_large_raster(said: str) -> None:
    assert 4.0 < number(r"600 x 400 cells, EPSG:32633, mean ([\d.]+) h", said) < day_length_h("2024-12-21", 46.9)


def a_winters_day(said: str) -> None:
    assert 0.0 < number(r"median ([\d.]+) h", said) < number(r"\d: ([\d.]+) h", said) + 4.0


SAYS = {
    "garden": a_garden, "satellite_scene": a_satellite_scene, "roof_panel": a_roof_panel, "first_sun": a_first_sun,
    "large_raster": a_large_raster, "a_winters_day": a_winters_day,
}  # fmt: skip


def day_length_h(date: str, lat_deg: float) -> float:
    """Return the hours for which the centre of the sun's disc, refracted by 34 minutes of arc, is up.

    This is the sunrise equation, with the sun's declination at noon by the Astronomical Almanac's low-precision formula
    (0.01 degrees).
    """
    days = (np.datetime64(f"{date}T12:00") - np.datetime64("2000-01-01T12:00")) / np.timedelta64(1, "D")
    anomaly = np.radians(357.528 + 0.9856003 * days)
    longitude = np.radians(280.460 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2.0 * anomaly))
    declination, lat = np.arcsin(np.sin(np.radians(23.439)) * np.sin(longitude)), np.radians(lat_deg)
    cosine = (np.sin(np.radians(-34.0 / 60.0)) - np.sin(lat) * np.sin(declination)) / (np.cos(lat) * np.cos(declination))
    return float(2.0 * np.degrees(np.arccos(cosine)) / 15.0)


@pytest.mark.long
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_and_prints_correct_figures(example: Path, tmp_path: Path) -> None:
    SAYS[example.stem](run(example, tmp_path))


def test_every_example_is_listed() -> None:
    listed = re.findall(r"\]\((\w+\.py)\)", (HERE / "examples" / "README.md").read_text(encoding="utf-8"))
    assert sorted(listed) == [path.name for path in EXAMPLES]


def test_the_notebook_is_the_run_of_its_script() -> None:
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    of_script = [part.partition("\n") for part in re.split(r"^# %%", SCRIPT.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]]
    assert ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"] == [
        code.strip() for kind, _, code in of_script if kind.strip() == ""
    ]
    assert [cell["cell_type"] for cell in cells] == ["markdown" if "markdown" in kind else "code" for kind, _, _ in of_script]
    for cell in cells:
        shown = "".join(cell["source"])
        outputs = cell.get("outputs", [])
        assert not [output for output in outputs if output["output_type"] == "error"]
        pictures = [output for output in outputs if "image/png" in output.get("data", {})]
        assert len(pictures) == (cell["cell_type"] == "code") * shown.count("plt.show()")
