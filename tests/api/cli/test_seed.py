"""``skugga seed`` as a command: its messages, errors in one line, and its own render processes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.api.seed.pmtiles_checker import check_archive
from tests.api.seed.runs import rough_ground, write_ground

QUICK_OPTIONS = "--zooms", "12-13", "--layer", "shadow", "--azimuth", "225", "--altitude", "12"


@pytest.fixture
def raster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """File of a raster of rough ground, in the working folder."""
    monkeypatch.chdir(tmp_path)
    return write_ground(tmp_path / "dem.tif", rough_ground(120))


def test_seed_writes_an_archive_of_a_raster(run, raster, tmp_path):
    status, out, _ = run("seed", "dem.tif", *QUICK_OPTIONS, "-o", "a.pmtiles", "--dry-run", "--json")
    dry_run = json.loads(out)
    assert status == 0 and dry_run["total"]["tasks"] >= 2 and {row["why"] for row in dry_run["rows"]} == {"not drawn yet"}
    status, out, err = run("seed", "dem.tif", *QUICK_OPTIONS, "-o", "a.pmtiles", "--workers", "1")
    lines = [line for line in err.splitlines() if line.startswith("[")]
    assert (status, out) == (0, "Wrote a.pmtiles.\n") and len(lines) == dry_run["total"]["tasks"]
    assert all(" s, " in line and "worker's peak" in line for line in lines)
    check_archive(tmp_path / "a.pmtiles")
    log = [json.loads(line) for line in (tmp_path / "a.pmtiles.seed" / "log.jsonl").read_text(encoding="utf-8").splitlines()]
    assert [entry["done"] for entry in log[:-1]] == list(range(1, len(lines) + 1))
    assert all(0 < entry["encode_s"] < entry["seconds"] and entry["peak_bytes"] > 10**8 for entry in log[:-1])
    status, out, err = run("seed", "dem.tif", *QUICK_OPTIONS, "-o", "a.pmtiles")
    assert status == 0 and out.startswith("Nothing to do: all ") and err == ""
    status, out, _ = run("seed", "dem.tif", *QUICK_OPTIONS, "-o", "a.pmtiles", "--dry-run")
    assert out.startswith("0 tasks would run") and f"Done: {len(lines)}, failed: 0." in out


def test_the_forecast_names_the_sun_and_its_time(run, raster):
    time, options = "2024-12-21T12:00:00+01:00", ("--zooms", "13", "--layer", "shadow", "-o", "a.pmtiles", "--dry-run")
    status, out, _ = run("seed", "dem.tif", *options, "--time", time)
    assert status == 0 and f" {time} " in out and "%" not in out and " 0 ms" not in out, out
    assert "azimuth 225, altitude 12" in run("seed", "dem.tif", *options, "--azimuth", "225", "--altitude", "12", "--work", "b")[1]


@pytest.mark.parametrize(
    ("options", "expected_texts"),
    [
        (("-o", "nowhere/a.pmtiles"), ("nowhere", "folder not found")),
        (("-o", "dem.tif"), ("--output", "dem.tif", ".pmtiles")),
        (("-o", "a.pmtiles", "--zooms", "13-12"), ("--zooms", "13-12", "the lower one first")),
        (("-o", "a.pmtiles", "--zooms", "x"), ("--zooms", "8-13")),
        (("-o", "a.pmtiles", "--zooms", "3-23"), ("--zooms", "3-23", "zooms 0 to 1")),
        (("-o", "a.pmtiles", "--layer", "depth"), ("--layer", "depth", "terrarium")),
        (("-o", "a.pmtiles", "--layer", "visibility"), ("--layer", "visibility")),
        (("-o", "a.pmtiles", "--layer", "mask", "--format", "jpg"), ("--format", "jpg", "png")),
        (("-o", "a.pmtiles", "--format", "tif"), ("--format", "tif", "png, webp, jpg")),
        (("-o", "a.pmtiles", "--times", "2024-03-21T08:00Z,2024-03-21T09:00Z"), ("{time}",)),
        (("-o", "a.pmtiles", "--time", "2024-03-21T08:00"), ("time", "offset")),
        (("-o", "a.pmtiles", "--algorithm", "truth"), ("--algorithm", "truth")),
        (("-o", "a.pmtiles", "--scheduler", "tcp://127.0.0.1:1", "--workers", "2"), ("--workers", "--scheduler")),
        (("-o", "a.pmtiles", "--shards", "nope://bucket"), ("--shards", "nope://bucket")),
        (("-o", "full"), ("--output", "full", "tiles.json")),
        (("-o", "dem.tif/a.pmtiles"), ("dem.tif",)),
    ],
)  # fmt: skip
def test_wrong_input_is_one_line(run, raster, tmp_path, options, expected_texts):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("kept", encoding="utf-8")
    status, out, err = run("seed", "dem.tif", *options)
    assert status in (1, 2) and out == "" and err.count("\n") == 1, err
    for text in expected_texts:
        assert text in err
    assert not list(tmp_path.glob("a.pmtiles")) and (tmp_path / "full" / "mine.txt").read_text(encoding="utf-8") == "kept"


def test_an_unwritable_folder_is_one_line(run, raster, tmp_path):
    (tmp_path / "shards").write_text("a file", encoding="utf-8")
    status, _, err = run("seed", "dem.tif", *QUICK_OPTIONS, "-o", "a.pmtiles", "--shards", "shards")
    assert status == 1 and "shards" in err and err.count("\n") == 1
    (tmp_path / "work").write_text("a file", encoding="utf-8")
    status, _, err = run("seed", "dem.tif", *QUICK_OPTIONS, "-o", "a.pmtiles", "--work", "work")
    assert status == 1 and "work" in err and err.count("\n") == 1
    assert not (tmp_path / "a.pmtiles").exists()


def test_a_day_of_archives_has_one_table(run, raster, tmp_path):
    day = ("--from", "2024-03-21T09:00:00+01:00", "--to", "2024-03-21T11:00:00+01:00", "--step", "2h")
    status, out, _ = run("seed", "dem.tif", "--zooms", "12", "--layer", "mask", *day, "-o", "m_{time}.pmtiles", "--json")
    assert status == 0 and len(json.loads(out)["written"]) == 2
    names = sorted(path.name for path in tmp_path.glob("m_*"))
    assert names == ["m_20240321T080000Z.pmtiles", "m_20240321T100000Z.pmtiles", "m_times.pmtiles.seed"]


def test_a_full_disk_is_reported_and_keeps_the_archive(run, raster, tmp_path, monkeypatch):
    (tmp_path / "a.pmtiles").write_bytes(before := b"an earlier archive")

    def fail_on_full_disk(*_: object) -> None:
        raise OSError(28, "No space left on device", str(tmp_path / "a.pmtiles"))

    monkeypatch.setattr("skugga.api.seed.publishing.write_archive", fail_on_full_disk)
    status, _, err = run("seed", "dem.tif", *QUICK_OPTIONS, "-o", "a.pmtiles", "--workers", "1")
    assert status == 1 and "a.pmtiles: No space left on device" in err
    assert (tmp_path / "a.pmtiles").read_bytes() == before
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    status, _, err = run("seed", "dem.tif", *QUICK_OPTIONS, "-o", "a.pmtiles")
    assert (status, err) == (0, "") and (tmp_path / "a.pmtiles").read_bytes() != before, (
        "the archive is published from the stored tiles"
    )
