"""A raster as LEVEL, with canopy, buildings, nodata and units given as options instead of in a level file."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import rasterio
from PIL import Image

from skugga.api.catalogue import bundled_levels
from skugga.api.http.server import server
from skugga.api.http.state.served_levels import ServedLevels
from skugga.api.products.mask import MASK_NO_SURFACE, MASK_SHADOW
from skugga.api.settings import Settings
from skugga.api.workers.piped_process import SpawnedWorker
from skugga.terrain.errors import InputError
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.scene import build_scene
from tests.rasters import write_geotiff

WEST, NORTH, CELL = 500e3, 5200e3, 2.0
SUN = ("--azimuth", "180", "--altitude", "30")


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Return a folder with flat ground at 100 m, a canopy raster with a tree of 20 m, a house of 10 m, and a level file."""
    write_geotiff(tmp_path / "dem.tif", np.full((80, 80), 100.0, np.float32), "EPSG:32633", WEST, NORTH, CELL)
    canopy = np.zeros((80, 80), np.float32)
    canopy[58:63, 18:23] = [[9, 12, 14, 12, 9]] * 5
    canopy[60, 20] = 20.0
    write_geotiff(tmp_path / "canopy.tif", canopy, "EPSG:32633", WEST, NORTH, CELL)
    x, y = WEST + 110.0, NORTH - 110.0
    ring = [[x, y], [x + 20, y], [x + 20, y + 20], [x, y + 20], [x, y]]
    house = {
        "type": "FeatureCollection",
        "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32633"}},
        "features": [{"type": "Feature", "properties": {"height_m": 10}, "geometry": {"type": "Polygon", "coordinates": [ring]}}],
    }
    (tmp_path / "houses.geojson").write_text(json.dumps(house), encoding="utf-8")
    (tmp_path / "level.yaml").write_text(
        "version: 1\ntitle: dem\nterrain: {source: dem.tif, nodata: 7}\nforest: [{source: canopy.tif}]\n"
        "meshes: [{source: houses.geojson}]\n",
        encoding="utf-8",
    )
    return tmp_path


def full_level_source(site: Path) -> LevelSource:
    """Return a level source with all files of ``site``: heights, canopy and buildings."""
    return LevelSource(path=site / "dem.tif", canopy=site / "canopy.tif", buildings=site / "houses.geojson", nodata=7.0)


def test_options_and_a_level_file_make_the_same_level(site):
    options, file = (build_scene(load_level(source)) for source in (full_level_source(site), site / "level.yaml"))
    assert options.objects.caster_kinds == file.objects.caster_kinds == ("relief", "meshes", "forest")
    assert set(options.loaded.sources) == set(file.loaded.sources)
    assert options.loaded.level.terrain == file.loaded.level.terrain and options.loaded.level.title == file.loaded.level.title


def test_canopy_and_buildings_cast_shadows(gl, run, site):
    options = {"--canopy": site / "canopy.tif", "--buildings": site / "houses.geojson"}
    shaded = {}
    for names in ((), ("--canopy",), ("--buildings",), ("--canopy", "--buildings")):
        raster_options = [word for name in names for word in (name, str(options[name]))]
        path = site / "mask.png"
        output_options = ("--layer", "mask", "--size", "160x160", "--algorithm", "shadow_map", "-o", str(path))
        assert run("render", str(site / "dem.tif"), *raster_options, *SUN, *output_options) == (0, "", "")
        shaded[names] = int((np.asarray(Image.open(path)) == MASK_SHADOW).sum())
    assert shaded[()] == 0
    # The house: 20 m wide, 10 m / tan 30 degrees = 17.3 m of shadow, in pixels of 1 m.
    assert shaded[("--buildings",)] == pytest.approx(20 * 10 / np.tan(np.radians(30)), rel=0.08)
    assert 50 < shaded[("--canopy",)] < 700
    assert shaded[("--canopy", "--buildings")] == pytest.approx(shaded[("--canopy",)] + shaded[("--buildings",)], abs=5)


def test_shade_select_and_validate_accept_the_options(gl, run, site):
    raster, object_options = (
        str(site / "dem.tif"),
        ("--canopy", str(site / "canopy.tif"), "--buildings", str(site / "houses.geojson")),
    )
    assert run("shade", raster, *object_options, *SUN, "-o", str(site / "mask.tif")) == (0, "", "")
    with rasterio.open(site / "mask.tif") as dataset:
        assert (dataset.read(1) == MASK_SHADOW).sum() > 60
    status, out, _ = run("validate", raster, *object_options)
    assert status == 0 and " trees, " in out and "1 meshes of" in out
    status, out, _ = run("select", raster, *object_options, "--policy", "rules", "--json")
    assert status == 0 and set(json.loads(out)["algorithm"]["sun"]) == {"relief", "meshes", "forest"}


def test_validate_reports_trees_and_footprints(run, site):
    raster, object_options = (
        str(site / "dem.tif"),
        ("--canopy", str(site / "canopy.tif"), "--buildings", str(site / "houses.geojson")),
    )
    status, out, _ = run("validate", raster, *object_options)
    assert status == 0 and "note: " in out and "warning" not in out
    assert "houses.geojson: heights: 1 of 1 footprints from the attribute 'height_m'" in out
    tree_note = re.search(r"note: .*canopy.tif: (\d+) trees planted; left out: of its cells 99.6 % lower than 0.5 m\n", out)
    assert tree_note is not None and f"note: {tree_note[1]} trees, " in out


def test_every_command_warns_of_a_canopy_without_trees(gl, run, site):
    """Each command warns in one line and goes on."""
    write_geotiff(site / "canopy.tif", np.zeros((80, 80), np.float32), "EPSG:32633", WEST, NORTH, CELL)
    raster, canopy = str(site / "dem.tif"), str(site / "canopy.tif")
    warning = f"{canopy}: no tree is planted: of its cells 100 % lower than 0.5 m\n"
    size, date = ("--size", "40x40"), ("--date", "2024-03-21", "--step", "1h")
    for command, options in (("render", (*SUN, *size)), ("shade", SUN), ("sunhours", date)):
        status, _, err = run(command, raster, "--canopy", canopy, *options, "-o", str(site / f"{command}.tif"))
        assert (status, err) == (0, f"skugga: warning: {warning}"), command
    assert f"note: warning: {warning}" in run("validate", raster, "--canopy", canopy)[1]


def test_the_service_and_its_workers_accept_the_options(site):
    levels = ServedLevels([full_level_source(site)])
    level = levels.reload_if_changed("dem")
    assert level.loaded.level.forest and level.summary()["warnings"] == []
    assert build_scene(load_level(level.key)).objects.caster_kinds == ("relief", "meshes", "forest")
    other = ServedLevels([LevelSource(path=site / "dem.tif")]).reload_if_changed("dem")
    assert other.version != level.version


def test_a_collar_of_zeros_is_reported_and_nodata_fixes_it(gl, run, site, caplog):
    row, col = np.mgrid[:90, :120].astype(np.float32)
    heights = 600 + 90 * np.sin(col / 9) * np.cos(row / 13)
    heights[:, :30] = 0.0
    raster = str(write_geotiff(site / "cut.tif", heights, "EPSG:32633", WEST, NORTH, 30.0))
    for command in (("render", raster, "--layer", "mask", "--size", "120x90"), ("shade", raster)):
        out = str(site / f"{command[0]}.tif")
        status, _, err = run(*command, *SUN, "-o", out)
        assert status == 0 and err.startswith("skugga: warning: ") and err.count("\n") == 1 and "--nodata 0" in err
        assert run(*command, "--nodata", "0", *SUN, "-o", out) == (0, "", "")
        with rasterio.open(out) as dataset:
            mask = dataset.read(1)[3:-3, :-3]  # a picture's outermost pixels may be half outside
            assert (mask[:, :30] == MASK_NO_SURFACE).all() and (mask[:, 31:] != MASK_NO_SURFACE).all()
    assert "warning" in run("validate", raster)[1] and "warning" not in run("validate", raster, "--nodata", "0")[1]
    (warned,) = ServedLevels([Path(raster)]).reload_if_changed("cut").summary()["warnings"]
    assert "nodata: 0" in warned and "cut.tif" not in warned and warned in caplog.text


def test_heights_without_a_unit_on_a_grid_in_feet_warn(gl, run, site):
    """A step of 10 without a unit casts the shadow of 10 m. With ``--units ft`` it casts that of 3.048 m."""
    heights = np.full((20, 120), 100.0, np.float32)
    heights[:, :40] += 10.0
    raster = str(write_geotiff(site / "feet.tif", heights, "EPSG:2994", 636_000.0, 848_000.0, 3.0))
    shadow_m = {}
    for unit_options in ((), ("--units", "m"), ("--units", "ft")):
        status, _, err = run("shade", raster, "--azimuth", "271", "--altitude", "20", *unit_options, "-o", str(site / "mask.tif"))
        assert status == 0 and ("x and y are in feet" in err and "--units ft" in err) is (unit_options == ())
        with rasterio.open(site / "mask.tif") as dataset:
            shadow_m[unit_options[-1:]] = float((dataset.read(1)[5:-5] == MASK_SHADOW).sum(axis=1).mean()) * 3.0 * 0.3048
    assert shadow_m[()] == shadow_m["m",] == pytest.approx(10.0 / np.tan(np.radians(20.0)), rel=0.06)
    assert shadow_m["ft",] == pytest.approx(3.048 / np.tan(np.radians(20.0)), rel=0.12)
    assert "warning" in run("validate", raster)[1] and "warning" not in run("validate", raster, "--units", "us-ft")[1]
    assert run("init", raster, "--units", "ft", "-o", str(site / "feet.yaml"))[::2] == (0, "")
    assert "\n  units: ft\n" in (site / "feet.yaml").read_text()
    status, _, err = run("shade", raster, "--units", "yards", "-o", str(site / "mask.tif"))
    assert status == 2 and "--units: 'yards' is not allowed. Allowed: m, ft, us-ft" in err


def test_validate_reports_the_unit_and_direction_of_heights(run, site):
    """The rasters hold a plain 100 m deep with a mount 20 m deep. The messages name the source of unit and direction, and
    the remedy for an unknown unit.
    """
    depths = np.full((40, 40), 100.0, np.float32)
    depths[15:25, 15:25] = 20.0
    named = str(write_geotiff(site / "named.tif", depths, "EPSG:32633+5715", WEST, NORTH, CELL))
    plain = str(write_geotiff(site / "plain.tif", depths, "EPSG:32633", WEST, NORTH, CELL))
    fathoms = str(write_geotiff(site / "fathoms.tif", depths / np.float32(1.8288), "EPSG:32633", WEST, NORTH, CELL))
    with rasterio.open(fathoms, "r+") as dataset:
        dataset.units = ("fathoms",)
    depth_raster = str(write_geotiff(site / "odd.tif", depths, "EPSG:32633", WEST, NORTH, CELL))
    with rasterio.open(depth_raster, "r+") as dataset:
        dataset.units = ("furlong",)
    for arguments, heights, message in (
        ((named,), "-100 to -20 m", "heights in m (by its band), positive down (by its CRS 'MSL depth')"),
        ((named, "--positive", "up"), "20 to 100 m", "heights in m (by its band), positive up (by terrain.positive)"),
        ((plain,), "20 to 100 m", "heights in m (no unit is stated), positive up (no direction is stated); if that is wrong"),
        ((plain, "--positive", "down"), "-100 to -20 m", "positive down (by terrain.positive)"),
        ((plain, "--units", "dm"), "2 to 10 m", "heights in dm (by terrain.units), positive up"),
        ((fathoms, "--positive", "down"), "-100 to -20 m", "heights in fathom (by its band), positive down"),
    ):
        status, out, err = run("validate", *arguments)
        assert (status, err) == (0, "") and f"heights {heights}," in out and message in out, arguments
    status, _, err = run("validate", depth_raster)
    assert status == 2 and "unit furlong of its band" in err and "us-ft, dm" in err and err.count("\n") == 1
    assert run("validate", depth_raster, "--units", "fathom")[0] == 0
    assert run("init", plain, "--positive", "down", "-o", str(site / "depths.yaml"))[::2] == (0, "")
    assert "\n  positive: down\n" in (site / "depths.yaml").read_text()


@pytest.mark.parametrize(
    ("arguments", "expected_texts"),
    [
        (("validate", "level.yaml", "--positive", "down"), ("positive", "level.yaml", "terrain: {positive: down}")),
        (("validate", "dem.tif", "--positive", "below"), ("--positive", "below", "up (heights) or down (depths)")),
        (("validate", "level.yaml", "--canopy", "canopy.tif"), ("canopy", "level.yaml", "forest: [{source: FILE}]")),
        (("validate", "level.yaml", "--buildings", "houses.geojson"), ("buildings", "level.yaml", "meshes: [{source: FILE}]")),
        (("validate", "level.yaml", "--nodata", "0"), ("nodata", "level.yaml", "terrain: {nodata: VALUE}")),
        (("validate", "dem.tif", "--canopy", "nowhere.tif"), ("canopy", "nowhere.tif", "an existing file")),
        (("validate", "dem.tif", "--buildings", "nowhere.shp"), ("buildings", "nowhere.shp", "an existing file")),
        (("validate", "dem.tif", "--buildings", "canopy.tif"), ("canopy.tif",)),
        (("validate", "dem.tif", "--canopy", "level.yaml"), ("level.yaml",)),
        (("validate", "dem.tif", "--nodata", "many"), ("--nodata",)),
        (("serve", "--nodata", "0"), ("--nodata", "exactly one LEVEL")),
        (("serve", "dem.tif", "canopy.tif", "--canopy", "canopy.tif"), ("--canopy", "exactly one LEVEL")),
    ],
)
def test_wrong_options_are_one_line(run, site, monkeypatch, arguments, expected_texts):
    monkeypatch.chdir(site)
    status, out, err = run(*arguments)
    assert (status, out) == (2, "") and err.count("\n") == 1
    for text in expected_texts:
        assert text in err


def test_a_level_file_refuses_raster_options(site):
    with pytest.raises(InputError, match=r"applies to rasters only, and .*level.yaml is a level file"):
        load_level(LevelSource(path=site / "level.yaml", nodata=0.0))


@pytest.fixture
def serve_calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Path | None, list[str]]]:
    """Return a list that collects the folder and level names of each call of the server."""
    calls: list[tuple[Path | None, list[str]]] = []

    def record_call(
        settings: Settings, levels: list[LevelSource], archives: list[Path], spawned_worker: SpawnedWorker | None
    ) -> None:
        assert not archives
        calls.append((settings.levels, [level.path.stem for level in levels]))

    monkeypatch.setattr(server, "serve", record_call)
    monkeypatch.setattr("skugga.api.cli.commands.serve.forbid_remote_reads", lambda: None)
    return calls


def test_levels_come_from_the_command_or_the_setting(run, serve_calls, site: Path, monkeypatch: pytest.MonkeyPatch):
    level = str(site / "dem.tif")
    for arguments in (("--levels", str(site)), (level,), (level, "--levels", str(site)), ()):
        assert run("serve", *arguments) == (0, "", "")
    monkeypatch.setenv("SKUGGA_LEVELS", str(site))
    assert run("serve") == (0, "", "")
    bundled = [path.stem for path in bundled_levels()]
    assert serve_calls == [(site, []), (None, ["dem"]), (site, ["dem"]), (None, bundled), (site, [])]
