"""Invalid input at the public interfaces: level files through the command line, queries through a real server.

Invalid input gives one line (one problem document) that names the file, key or parameter. Unusual but valid input gives a picture
of valid numbers. Nothing gives a traceback. Nothing takes ten seconds, a limit against hanging, not a measure of speed.
"""

from __future__ import annotations

import io
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from affine import Affine
from PIL import Image

from skugga.api.cli import main as cli
from skugga.api.http.server.app import create_app
from skugga.api.products.mask import MASK_LIT, MASK_NO_SURFACE, MASK_SHADOW
from skugga.api.settings import Settings
from skugga.terrain.errors import printable
from tests.api.conftest import CORNER, ZOOM, Client, running, write_level
from tests.rasters import ENGINEERING, write_geotiff

UTM = "EPSG:32633"

TIMEOUT_S = 10.0

NAN, INF = float("nan"), float("inf")

FLAT = {"flat": {"size": [200, 200], "cells": [20, 20]}}

PLACE = [15.002, 45.152]
"""Longitude and latitude on ``ok.tif``."""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of valid and invalid rasters, meshes and vectors."""
    folder = tmp_path_factory.mktemp("front_door")
    (folder / "folder").mkdir()
    heights = np.full((40, 40), 100, np.float32)
    heights[10:14, 10:14] = 130.0
    utm = (UTM, 500_000, 5_000_000, 10)
    write_geotiff(folder / "ok.tif", heights, *utm)
    write_geotiff(folder / "site.tif", heights, ENGINEERING, 0, 400, 10)
    write_geotiff(folder / "nothing.tif", heights * NAN, *utm)
    write_geotiff(folder / "high.tif", heights * np.float32(1e30), ENGINEERING, 0, 400, 10)
    write_geotiff(folder / "geocentric.tif", heights, "EPSG:4978", 0, 400, 10)
    write_geotiff(folder / "far.tif", heights, UTM, 5e9, 5e9, 10)
    write_geotiff(folder / "beyond_pole.tif", heights, "EPSG:4326", 10, 200, 1)
    write_geotiff(folder / "vast.tif", heights, UTM, 0, 0, 1e300)
    write_geotiff(folder / "tiny.tif", heights, UTM, 5e5, 5e6, 1e-12)
    write_geotiff(folder / "no_cell.tif", heights, UTM, 0, 0, 1, transform=Affine(NAN, 0, 0, 0, -10, 0))
    write_geotiff(folder / "rgb.tif", np.full((3, 40, 40), 90, np.uint8), *utm)
    write_geotiff(folder / "rgb_site.tif", np.full((3, 40, 40), 90, np.uint8), ENGINEERING, 0, 400, 10)
    with pytest.warns(match="geotransform"):
        write_geotiff(folder / "nowhere.tif", heights, UTM, 0, 0, 1, transform=Affine.identity())
    valid_content = (folder / "ok.tif").read_bytes()
    for name, content in (
        ("cut.tif", valid_content[: len(valid_content) // 2]),
        ("head.tif", valid_content[:100]),
        ("text.tif", b"hello"),
        ("empty.tif", b""),
    ):
        (folder / name).write_bytes(content)
    box = trimesh.creation.box((5, 5, 5))
    for name, vertices, faces in (
        ("ok", box.vertices, box.faces), ("nan", np.where(np.arange(24).reshape(8, 3) == 4, NAN, box.vertices), box.faces),
        ("inf", np.where(np.arange(24).reshape(8, 3) == 4, INF, box.vertices), box.faces), ("huge", box.vertices * 1e30, box.faces),
        ("tiny", box.vertices * 1e-30, box.faces), ("points", box.vertices, []), ("index", box.vertices, [[0, 1, 99]]),
        ("sheet", box.vertices * (1, 1, 0), box.faces), ("none", [], []),
    ):  # fmt: skip
        lines = ["v {} {} {}".format(*vertex) for vertex in vertices] + [
            "f {} {} {}".format(*(np.array(face) + 1)) for face in faces
        ]
        (folder / f"{name}.obj").write_text("\n".join(lines))
    (folder / "text.glb").write_text("x")
    ring = [[15.0005, 45.1525], [15.004, 45.1525], [15.004, 45.154], [15.0005, 45.154], [15.0005, 45.1525]]
    for name, rings in (
        ("square", [ring]), ("bow", [[ring[0], ring[2], ring[1], ring[3], ring[0]]]),
        ("sea", [[[100, 0], [101, 0], [101, 1], [100, 0]]]), ("beyond", [[[15, 45], [16, 1e300], [15, 46], [15, 45]]]),
        ("round", [[[15, 45], [1e9, 45], [15, 46], [15, 45]]]), ("missing", None),
    ):  # fmt: skip
        geometry = None if rings is None else {"type": "Polygon", "coordinates": rings}
        feature = {"type": "Feature", "properties": {"h": 10, "word": "tall", "low": -5, "tall": 1e12}, "geometry": geometry}
        (folder / f"{name}.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    (folder / "broken.geojson").write_text("{")
    return folder


def ground(name: str, **keys: Any) -> dict[str, Any]:
    """Return the keys of a level whose terrain is the file ``name``."""
    return {"terrain": {"source": name, **keys}}


def perspective_level(*position: float, **keys: Any) -> dict[str, Any]:
    """Return the keys of a level with a view from an eye to ``PLACE``."""
    return {"views": {"map": {"kind": "perspective", "eye": position, "target": [*PLACE, 0], "size": [40, 30], **keys}}}


def mesh_level(name: str, **keys: Any) -> dict[str, Any]:
    """Return the keys of a flat level with the mesh of the file ``name``."""
    return {"terrain": FLAT, "meshes": [{"source": name, "at": [0, 0], **keys}]}


def lamp(*position: float, **keys: Any) -> dict[str, Any]:
    """Return the keys of a flat level with a lamp at a position."""
    return {"terrain": FLAT, "lights": {"lamp": {"kind": "omni", "position": position, **keys}}}


def trees(name: str, **keys: Any) -> dict[str, Any]:
    """Return the keys of trees from the file ``name``."""
    return {"forest": [{"source": name, **keys}]}


def houses(name: str, height: Any) -> dict[str, Any]:
    """Return the keys of houses from the footprints of the file ``name``."""
    return {"meshes": [{"source": name, "height": height}]}


INVALID_LEVELS: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "half a raster": (ground("cut.tif"), ("cut.tif", "undamaged")),
    "the head of a raster": (ground("head.tif"), ("head.tif", "GDAL reads")),
    "an empty raster": (ground("empty.tif"), ("empty.tif", "GDAL reads")),
    "a raster of text": (ground("text.tif"), ("text.tif", "GDAL reads")),
    "a folder as raster": (ground("folder"), ("folder", "GDAL reads")),
    "no such raster": (ground("absent.tif"), ("absent.tif", "No such file")),
    "a name with NUL": (ground("a\0b"), ("terrain.source", "NUL")),
    "no name": (ground(""), ("terrain.source", "at least 1")),
    "no heights": (ground("nothing.tif"), ("nothing.tif", "no height")),
    "heights of 1e32 m": (ground("high.tif"), ("high.tif", "no height")),
    "a geocentric raster": (ground("geocentric.tif"), ("geocentric.tif", "WGS 84", "projected")),
    "a raster off the earth": (ground("far.tif"), ("far.tif", "UTM")),
    "a raster beyond the pole": (ground("beyond_pole.tif"), ("beyond_pole.tif", "160 to 200", "-90 to 90")),
    "cells of 1e300 m": (ground("vast.tif"), ("vast.tif", "UTM")),
    "cells of 1e-12 m": (ground("tiny.tif"), ("bounds",)),
    "cells that are no number": (ground("no_cell.tif"), ("no_cell.tif",)),
    "a raster that lies nowhere": (ground("nowhere.tif"), ("nowhere.tif", "geotransform")),
    "bounds swapped": (ground("ok.tif", bounds=[15.1, 45.1, 15.0, 45.2]), ("terrain.bounds", "15.1", "west < east")),
    "bounds elsewhere": (ground("ok.tif", bounds=[100, 0, 101, 1]), ("terrain.bounds", "100", "on the raster")),
    "three bounds": (ground("ok.tif", bounds=[1, 2, 3]), ("terrain.bounds", "[1, 2, 3]", "4 items")),
    "degrees in a flat world": (ground("site.tif", bounds=[0, 0, 1, 1]), ("terrain.bounds", "engineering")),
    "heights times 0": (ground("ok.tif", exaggeration=0), ("terrain.exaggeration", "0", "greater than 0")),
    "furlongs": (ground("ok.tif", units="furlong"), ("terrain.units", "furlong", "us-ft")),
    "imagery of text": (ground("ok.tif", imagery="text.tif"), ("text.tif", "RGB")),
    "imagery of one band": (ground("ok.tif", imagery="ok.tif"), ("ok.tif", "1 bands", "red, green and blue")),
    "imagery of another world": (ground("ok.tif", imagery="rgb_site.tif"), ("rgb_site.tif", "site", "transformed")),
    "imagery of the earth in a flat world": (ground("site.tif", imagery="rgb.tif"), ("rgb.tif", "UTM", "transformed")),
    "ground of no size": ({"terrain": {"flat": {"size": [0, 5], "cells": [1, 1]}}}, ("terrain.flat.size.0", "greater than 0")),
    "ground of 1e9 cells": ({"terrain": {"flat": {"size": [9, 5], "cells": [10**9, 1]}}}, ("terrain.flat.cells.0", "8192")),
    "ground of 1e14 cells": (
        {"terrain": {"generate": {"kind": "ridges", "size": [1e7, 1e7], "cell": 1, "relief": 1}}}, ("terrain.generate", "8192")),
    "cells of NaN metres": (
        {"terrain": {"generate": {"kind": "ridges", "size": [9, 9], "cell": NAN, "relief": 1}}},
        ("terrain.generate.cell", "nan", "finite")),
    "a list of terrain": ({"terrain": []}, ("terrain", "mapping")),
    "another version": ({"version": 2}, ("version", "'2'", "1")),
    "version NaN": ({"version": NAN}, ("version", "nan", "1")),
    "sun at noon": ({"sun": "noon"}, ("sun", "noon", "none")),
    "sun of a number": ({"sun": {"time": 1234567890}}, ("sun.time", "1234567890", "ISO 8601")),
    "sun at a leap second": ({"sun": {"time": "2016-12-31T23:59:60Z"}}, ("sun.time", ":60Z", "ISO 8601")),
    "sun at 1e300 degrees": ({"sun": {"azimuth": 1e300, "altitude": 10}}, ("sun.azimuth", "1e+300", "720")),
    "sun in the west": ({"sun": {"azimuth": "west", "altitude": 10}}, ("sun.azimuth", "west", "number")),
    "a time in a flat world": ({**ground("site.tif"), "sun": {"time": "2024-06-21T12:00:00Z"}}, ("time", "engineering")),
    "a lamp off the ground": ({"lights": {"lamp": {"kind": "omni", "position": [100, 0, 50]}}}, ("lights.lamp.position", "data")),
    "a lamp at 1e300 m": (lamp(0, 0, 1e300), ("lights.lamp.position.2", "1e+300")),
    "a lamp of half the sky": (lamp(0, 0, 9, kind="spot", target=[0, 0, 0], cutoff=90), ("lights.lamp.cutoff", "90", "85")),
    "a mesh with NaN": (mesh_level("nan.obj"), ("nan.obj", "finite")),
    "a mesh with infinity": (mesh_level("inf.obj"), ("inf.obj", "finite")),
    "a mesh of nothing": (mesh_level("none.obj"), ("none.obj", "no triangle")),
    "a mesh of points": (mesh_level("points.obj"), ("points.obj", "no triangle")),
    "a mesh with a wrong index": (mesh_level("index.obj"), ("index.obj", "99")),
    "a mesh of text": (mesh_level("text.glb"), ("text.glb", "cannot be read")),
    "no such mesh": (mesh_level("absent.obj"), ("absent.obj", "no such file")),
    "a mesh off the ground": (mesh_level("ok.obj", at=[1e6, 0]), ("meshes.0.at", "1000000", "terrain")),
    "a mesh at 1e300 m": (mesh_level("ok.obj", at=[[0, 0], [1e300, 0]]), ("meshes.0.at.1.0", "1e+300")),
    "a mesh that whirls": (mesh_level("ok.obj", motion={"spin": 1e300}), ("meshes.0.motion.spin", "1e+300")),
    "the end of time": ({"seconds": INF}, ("seconds", "inf", "finite")),
    "houses in the sea": (houses("sea.geojson", "h"), ("sea.geojson", "100, 0")),
    "houses of text": (houses("square.geojson", "word"), ("square.geojson", "word = tall", "numbers")),
    "houses without heights": (houses("square.geojson", "storeys"), ("square.geojson", "storeys", "word")),
    "houses below the ground": (houses("square.geojson", "low"), ("square.geojson", "low")),
    "houses to the moon": (houses("square.geojson", "tall"), ("square.geojson", "1e+12", "1000")),
    "houses at latitude 1e300": (houses("beyond.geojson", "h"), ("beyond.geojson", "1e+300", "coordinates")),
    "houses round the earth": (houses("round.geojson", "h"), ("round.geojson", "1000000000", "coordinates")),
    "houses of nothing": (houses("missing.geojson", "h"), ("missing.geojson", "geometry")),
    "houses of half a file": (houses("broken.geojson", "h"), ("broken.geojson", "GDAL reads")),
    "a forest in the sea": (trees("sea.geojson", density=9), ("forest.0.source", "on the terrain")),
    "a forest at latitude 1e300": (trees("beyond.geojson", density=9), ("beyond.geojson", "1e+300")),
    "a forest without density": (trees("square.geojson"), ("forest.0.density", "trees per hectare")),
    "a canopy of text": (trees("text.tif"), ("text.tif", "GDAL reads")),
    "half a canopy": (trees("cut.tif"), ("cut.tif", "undamaged")),
    "a canopy of another world": (trees("site.tif"), ("site.tif", "transformed")),
    "a canopy of nothing": (trees("nothing.tif"), ("nothing.tif", "no height")),
    "a view of no size": ({"views": {"map": {"kind": "map", "size": [0, 9]}}}, ("views.map.size.0", "greater than or equal to 1")),
    "a view of 1e9 pixels": ({"views": {"map": {"kind": "map", "size": [10**9, 9]}}}, ("views.map.size.0", "16384")),
    "a view turned round": ({"views": {"map": {"kind": "map", "bounds": [5, 5, 1, 1]}}}, ("views.map.bounds", "west < east")),
    "a view in no CRS": ({"views": {"map": {"kind": "map", "crs": "hello"}}}, ("crs", "hello", "PROJ")),
    "a geocentric view": ({"views": {"map": {"kind": "map", "crs": "EPSG:4978"}}}, ("crs", "EPSG:4978", "projected")),
    "a view of half a turn": (perspective_level(*PLACE, 10, fov=180), ("views.map.fov", "180", "179")),
    "an eye in its target": (perspective_level(*PLACE, 0), ("views.map", "other than")),
    "an eye off the ground": (perspective_level(15.002, 45.1, 10), ("views.map.eye", "45.1", "data")),
    "an eye at 1e300 m": (perspective_level(*PLACE, 1e300), ("views.map.eye.2", "1e+300")),
    "a magic algorithm": ({"shadows": {"algorithm": "magic"}}, ("shadows.algorithm", "magic", "shadow_map")),
    "maps of no texel": ({"shadows": {"map_size": 0}}, ("shadows.map_size", "'0'", "64")),
    "an error of NaN": ({"shadows": {"max_error": NAN}}, ("shadows.max_error", "nan", "finite")),
    ("a sweep of "
        "meshes"): ({**mesh_level("ok.obj"), "shadows": {"algorithm": "sweep"}}, ("shadows.algorithm", "sweep", "shadow_map")),
    "an unknown key": ({"forrest": []}, ("forrest", "unknown key", "forest")),
}  # fmt: skip
"""Invalid levels -> keys of a level over ``ok.tif``, and words that its error line must have."""

UNUSUAL_LEVELS: dict[str, dict[str, Any]] = {
    "hardly any heights": ground("ok.tif", exaggeration=1e-300),
    "detail of 1e300 m": ground("ok.tif", resolution=1e300),
    "detail of 1e-300 m": ground("ok.tif", resolution=1e-300),
    "no sun": {"sun": "none"},
    "a sun below the ground": {"sun": {"azimuth": 0, "altitude": -90}},
    "a lamp in the ground": lamp(0, 0, -50),
    "a lamp on the ground": {**lamp(0, 0, 0), "sun": "none"},
    "a lamp at 1e9 m": {**lamp(0, 0, 1e9), "sun": "none"},
    "a mesh of 1e30 m": mesh_level("huge.obj"),
    "a mesh of 1e-30 m": mesh_level("tiny.obj"),
    "a mesh without height": mesh_level("sheet.obj"),
    "a mesh times 1e6": mesh_level("ok.obj", scale=1e6),
    "200 meshes": mesh_level("ok.obj", at=[[i % 20, i // 20] for i in range(200)]),
    "houses that cross themselves": houses("bow.geojson", "h"),
    "a view of somewhere else": {"views": {"map": {"kind": "map", "bounds": [1e6, 1e6, 1e6 + 100, 1e6 + 100]}}},
    "a view in a CRS of the antipodes": {"views": {"map": {"kind": "map", "crs": "EPSG:2193"}}},
    "an eye in the ground": perspective_level(*PLACE, -500),
    "an eye at 1e9 m": perspective_level(*PLACE, 1e9),
}
"""Unusual but valid levels."""


@pytest.fixture(scope="module")
def compiled(files: Path) -> None:
    """Compile every loop that these levels run: a first run on a machine compiles for half a minute, and does not hang."""
    for keys in (
        ground("ok.tif"),
        perspective_level(*PLACE, 300),
        mesh_level("ok.obj"),
        houses("square.geojson", 10),
        lamp(0, 0, 50),
    ):
        level = {"version": 1, **ground("ok.tif"), "sun": {"azimuth": 200, "altitude": 20}, **keys}
        (files / "first.yaml").write_text(json.dumps(level), encoding="utf-8")
        with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as ended:
            size = () if "views" in keys else ("--size", "40x30")
            patch.setattr(sys, "argv", ["skugga", "render", str(files / "first.yaml"), *size, "-o", str(files / "first.npy"),
                                        "--layer", "visibility"])  # fmt: skip
            cli.main()
        assert ended.value.code == 0, keys


@pytest.fixture
def render(files, compiled, monkeypatch, capfd) -> Callable[..., tuple[int, str]]:
    """``render(keys, *arguments)`` draws a level over ``ok.tif``. It returns the exit status and standard error, with GDAL's
    messages.
    """

    def call(keys: dict[str, Any], *arguments: str) -> tuple[int, str]:
        level = {"version": 1, **ground("ok.tif"), "sun": {"azimuth": 200, "altitude": 20}, **keys}
        text = json.dumps(level).replace("NaN", ".nan").replace("Infinity", ".inf")
        (files / "level.yaml").write_text(text, encoding="utf-8")
        monkeypatch.setattr(sys, "argv", ["skugga", "render", str(files / "level.yaml"), *arguments])
        start = time.perf_counter()
        with pytest.raises(SystemExit) as ended:
            cli.main()
        assert time.perf_counter() - start < TIMEOUT_S
        return int(ended.value.code), capfd.readouterr().err

    return call


@pytest.mark.parametrize("what", INVALID_LEVELS)
def test_hostile_levels_are_one_line(gl, render, tmp_path, what):
    keys, words = INVALID_LEVELS[what]
    size_options = () if "views" in keys else ("--size", "32x32")
    status, message = render(keys, *size_options, "-o", str(tmp_path / "out.png"))
    assert status == 2, message
    assert message.count("\n") == 1 and "Traceback" not in message and "internal" not in message
    for word in words:
        assert word in message
    assert not (tmp_path / "out.png").exists()


@pytest.mark.parametrize("what", UNUSUAL_LEVELS)
def test_odd_levels_are_pictures_of_numbers(gl, render, tmp_path, what):
    keys = UNUSUAL_LEVELS[what]
    target = tmp_path / "out.npy"
    status, message = render(keys, "--size", "40x30", "--layer", "visibility", "-o", str(target))
    assert (status, message) == (0, "")
    visibility = np.load(target)
    assert visibility.shape == (30, 40)
    valid_visibility = visibility[~np.isnan(visibility)]
    assert ((valid_visibility >= 0.0) & (valid_visibility <= 1.0)).all()
    assert valid_visibility.size or what in ("a view of somewhere else", "an eye in the ground", "an eye at 1e9 m")


X, Y = CORNER

TILE = f"levels/hills/tiles/WebMercatorQuad/{ZOOM}/{X}/{Y}.png"

SNAPSHOT = "levels/hills/snapshot.png"

WRONG_QUERIES = {
    TILE: (
        ("azimuth=1e400&altitude=1", "azimuth"), ("azimuth=-inf&altitude=1", "azimuth"), ("azimuth=1e300&altitude=1", "azimuth"),
        ("azimuth=1&altitude=nan", "altitude"), ("azimuth=&altitude=", "azimuth"), ("time=", "time"), ("time=%00", "time"),
        ("time=0001-01-01T00:00:00Z", "time"), ("time=9999-12-31T23:59:59-14:00", "time"), ("time=2016-12-31T23:59:60Z", "time"),
        (f"time={'9' * 5000}", "time"), ("map_size=1e9", "map_size"), ("map_size=-64", "map_size"),
        (f"map_size={'9' * 30}", "map_size"),
        ("map_size=%C2%B2", "map_size"), ("depth_bits=24.0", "depth_bits"), ("filter=", "filter"), ("filter=suns", "filter"),
        ("algorithm=", "algorithm"), ("algorithm=%00", "algorithm"), (f"algorithm={'a' * 5000}", "algorithm"),
        ("algorithm=relief%3D", "algorithm"), ("algorithm=%3D", "algorithm"), ("algorithm=,", "algorithm"),
        ("algorithm=planar", "algorithm"), ("algorithm=truth", "algorithm"), ("layer=", "layer"), ("bias=", "bias"),
        ("stencil=three", "stencil"), ("%00=1", "\0"), ("crs=EPSG:0", "crs"), ("bounds=5,5,1,1", "bounds"),
    ),
    SNAPSHOT: (
        ("size=0x0", "size"), ("size=1000000000x1", "size"), ("size=-1x5", "size"), ("size=1e9x1", "size"), ("size=5", "size"),
        ("size=nanxnan", "size"), ("size=%C2%B2x%C2%B2", "size"), ("size=16384x1", "size"), ("view=", "view"), ("view=%00", "view"),
        ("view=nowhere", "view"), (f"view={'v' * 200}", "view"), ("seconds=nan", "seconds"), ("seconds=inf", "seconds"),
        ("seconds=1e300", "seconds"), ("light=", "light"), ("light=lamp", "light"), ("size=9x9&altitude=5", "azimuth"),
        ("size=9x9&algorithm=perspective_shadow_map", "algorithm"),
    ),
}  # fmt: skip
"""Address -> queries, and the parameter at fault."""

WRONG_TILES = (
    (ZOOM, 10**9, 0, "x"), (ZOOM, 99999999999999999999999, 0, "x"), (-1, 0, 0, "z"), (10**9, 0, 0, "z"), (ZOOM, -X, Y, "x"),
    (ZOOM, "1e3", 0, "x"), ("nan", 0, 0, "z"), (ZOOM, X, "%C2%B2", "y"), (ZOOM, X, "0x10", "y"), (ZOOM, X, 1e9, "y"),
)  # fmt: skip


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    """A real server with one render process that has drawn a picture."""
    level = write_level(tmp_path_factory.mktemp("served"), "hills")
    with running(create_app(Settings(workers=1), [level])) as client:
        assert client.get(f"{SNAPSHOT}?size=16x16").status_code == 200
        client.timeout = TIMEOUT_S
        yield client


@pytest.mark.parametrize("address", WRONG_QUERIES)
def test_hostile_queries_name_the_parameter(server: Client, address: str):
    for query, parameter in WRONG_QUERIES[address]:
        answer = server.get(f"{address}?{query}")
        assert answer.status_code == 422, (query[:80], answer.status_code, answer.text[:300])
        problem = answer.json()
        assert answer.headers["content-type"] == "application/problem+json"
        assert problem["parameter"] == parameter and printable(parameter) in problem["detail"], (query[:80], problem)
        assert "Traceback" not in problem["detail"] and len(problem["detail"]) < 1000


@pytest.mark.parametrize("z, x, y, parameter", WRONG_TILES)
def test_tiles_out_of_range_are_not_there(server: Client, z, x, y, parameter):
    answer = server.get(f"levels/hills/tiles/WebMercatorQuad/{z}/{x}/{y}.png")
    assert answer.status_code in (404, 422)
    assert answer.json()["parameter"] == parameter and answer.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize(
    "query",
    ["azimuth=0&altitude=-90", "azimuth=0&altitude=0", "azimuth=-360&altitude=90", "azimuth=720&altitude=1e-300",
     "time=1678-01-01T00:00:00%2B14:00", "time=2261-12-31T23:59:59-12:00", "azimuth=9&altitude=9&map_size=8192", "seconds=1e9"],
)  # fmt: skip
def test_odd_queries_are_pictures(server: Client, query: str):
    for size, layer in (("24x16", "mask"), ("9x7", "color")):
        answer = server.get(f"{SNAPSHOT}?size={size}&layer={layer}&{query}")
        assert answer.status_code == 200, answer.text[:300]
        with Image.open(io.BytesIO(answer.content)) as image:
            picture = np.asarray(image if layer == "mask" else image.convert("RGBA"))
        assert picture.shape[:2] == tuple(int(n) for n in size.split("x"))[::-1]
        if layer == "mask":
            assert set(np.unique(picture)) <= {MASK_SHADOW, MASK_NO_SURFACE, MASK_LIT}
        else:
            assert set(np.unique(picture[..., 3])) <= {0, 255} and (picture[1:-1, 1:-1, 3] == 255).all()


@pytest.mark.parametrize("body", [b"{", b"[]", b"{}", b"\xff", b'{"view":' * 2000, b"NaN", b'{"scene":1e400}', b" ", b""])
def test_hostile_scene_descriptors_are_refused(server: Client, body: bytes):
    answer = server.post("plan", content=body, headers={"content-type": "application/json"})
    assert 400 <= answer.status_code < 500
    assert answer.headers["content-type"] == "application/problem+json"
