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

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
NOTEBOOK = ROOT / "docs" / "a-winters-day.ipynb"
SCRIPT = ROOT / "examples" / "a_winters_day.py"


def run_example(example: Path, folder: Path) -> str:
    """Run an example in a folder as a user does, and return its output."""
    variables = {**os.environ, "MPLBACKEND": "agg", "PYTHONPATH": str(ROOT)}
    process = subprocess.run([sys.executable, example], cwd=folder, env=variables, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    return process.stdout


def captured_number(pattern: str, output: str) -> float:
    """Return the number that the group of a pattern matches in a text."""
    match = re.search(pattern, output)
    assert match, output
    return float(match[1])


def check_garden(output: str) -> None:
    """Check the hours of sun that the example prints."""
    assert captured_number(r"before +mean +([\d.]+) h", output) == pytest.approx(day_length_h("2024-03-21", 59.3), abs=0.02)
    # At noon the sun is 31 degrees high, and a wall of 7 m casts 11.7 m of shadow: over all rows of the garden, 5 to 15 m away.
    assert captured_number(r"after +mean +([\d.]+) h", output) < 10.0 and captured_number(r"after.*least +([\d.]+) h", output) < 6.0


def check_satellite_scene(output: str) -> None:
    """Check the share of shadow and the correlations that the example prints."""
    assert 0.0 < captured_number(r"([\d.]+)% of the ground in shadow", output) < 2.0
    assert (
        captured_number(r"as seen .*: ([-+\d.]+)", output) > 0.9
        and abs(captured_number(r"corrected .*: ([-+\d.]+)", output)) < 0.05
    )


def check_roof_panel(output: str) -> None:
    """Check the monthly losses that the example prints."""
    lost_percent = [float(share) for share in re.findall(r"([\d.]+)% of it behind", output)]
    assert len(lost_percent) == 12 and lost_percent[11] > 5.0 > 0.5 > lost_percent[5], (
        "a ridge in the south east costs winter, not summer"
    )


def check_first_sun(output: str) -> None:
    """Check the times of first and last sun that the example prints."""
    rows = re.findall(r"(\d\d:\d\d) +(\d\d:\d\d) +([\d.]+) of ([\d.]+) h +relief", output)
    assert len(rows) == 7 and all(first < last and float(direct) < float(up) for first, last, direct, up in rows)


def check_large_raster(output: str) -> None:
    """Check the mean hours of sun that the example prints."""
    assert 4.0 < captured_number(r"600 x 400 cells, EPSG:32633, mean ([\d.]+) h", output) < day_length_h("2024-12-21", 46.9)


def check_winters_day(output: str) -> None:
    """Check the hours of sun that the example prints."""
    assert 0.0 < captured_number(r"median ([\d.]+) h", output) < captured_number(r"\d: ([\d.]+) h", output) + 4.0


def check_sky_view(output: str) -> None:
    """Check the figures of the kinds that the example prints."""
    mean = {kind: float(value) for kind, value in re.findall(r"^(\w+) +[\d.]+ +([\d.]+) +[\d.]+ +\d+ m$", output, re.MULTILINE)}
    assert len(mean) == 5 and 0.5 < mean["solid_angle"] < mean["cosine"] < 1.0, "cos2 h is more than 1 - sin h"
    assert 60.0 < mean["openness"] < 90.0 and 60.0 < mean["negative_openness"] < 90.0


def check_many_suns(output: str) -> None:
    """Check the shares of sun and of agreement that the example prints."""
    shares = re.findall(r"([\d.]+)% in the sun, ([\d.]+)% as by", output)
    assert len(shares) == 5 and all(float(agreement) > 98.0 for _, agreement in shares)
    assert float(shares[0][0]) < float(shares[2][0]), "a low sun reaches less ground than one at noon"


def check_garden_year(output: str) -> None:
    """Check the months that the example prints: the house south of the garden costs winter, not summer."""
    months = [[float(value) for value in row] for row in re.findall(r"open +([\d.]+) +with .* +([\d.]+) kWh/m2, +(\d+)%", output)]
    assert len(months) == 12 and months[11][2] > 60.0 > 20.0 > months[5][2]
    assert 1200.0 < sum(before for before, _, _ in months) < 1500.0, "a clear year at 59 degrees north"


def check_roof_and_tree(output: str) -> None:
    """Check that received and lost light add up, and that trees take more in winter than in summer."""
    rows = [
        [float(value) for value in row]
        for row in re.findall(r"([\d.]+) of +([\d.]+), .*ridge +([-\d.]+), .*houses +([-\d.]+), .*trees +([-\d.]+)", output)
    ]
    assert len(rows) == 13 and all(total + sum(lost) == pytest.approx(open_sky, abs=0.25) for total, open_sky, *lost in rows)
    assert rows[1][4] > 5.0 * rows[5][4] and 2000.0 < rows[12][1] < 2800.0


def check_vineyard(output: str) -> None:
    """Check that slopes to the south receive most, and those to the north least."""
    light = {name: float(value) for name, value in re.findall(r"facing (\w+) +(\d+) kWh", output)}
    assert light["north"] < light["west"] < light["south"] and light["north"] < light["east"] < light["south"]


def check_glacier_melt(output: str) -> None:
    """Check the light and the ice that the example prints: a kWh melts 12 kg of ice."""
    rows = [(float(light), float(ice)) for light, ice in re.findall(r"(\d+) kWh/m2, up to +([\d.]+) m of ice", output)]
    assert len(rows) == 3 and rows[1][0] < rows[0][0] < rows[2][0]
    assert rows[0][1] == pytest.approx(0.65 * rows[0][0] * 3.6e6 / 334e3 / 900.0, abs=0.1)


OUTPUT_CHECKS = {
    "garden": check_garden, "satellite_scene": check_satellite_scene, "roof_panel": check_roof_panel, "first_sun": check_first_sun,
    "large_raster": check_large_raster, "sky_view": check_sky_view, "many_suns": check_many_suns,
    "garden_year": check_garden_year, "vineyard": check_vineyard, "roof_and_tree": check_roof_and_tree,
    "glacier_melt": check_glacier_melt,
    "a_winters_day": check_winters_day,
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
    OUTPUT_CHECKS[example.stem](run_example(example, tmp_path))


def test_every_example_is_listed() -> None:
    listed = re.findall(r"\]\((\w+\.py)\)", (ROOT / "examples" / "README.md").read_text(encoding="utf-8"))
    assert sorted(listed) == [path.name for path in EXAMPLES]


def test_the_notebook_is_the_run_of_its_script() -> None:
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    script_cells = [part.partition("\n") for part in re.split(r"^# %%", SCRIPT.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]]
    assert ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"] == [
        code.strip() for kind, _, code in script_cells if kind.strip() == ""
    ]
    assert [cell["cell_type"] for cell in cells] == ["markdown" if "markdown" in kind else "code" for kind, _, _ in script_cells]
    for cell in cells:
        source = "".join(cell["source"])
        outputs = cell.get("outputs", [])
        assert not [output for output in outputs if output["output_type"] == "error"]
        pictures = [output for output in outputs if "image/png" in output.get("data", {})]
        assert len(pictures) == (cell["cell_type"] == "code") * source.count("plt.show()")
