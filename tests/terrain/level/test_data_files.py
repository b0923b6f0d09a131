"""Data files and their links: only regular files are opened, and remote sources need permission."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

from skugga.api.http.state.served_levels import ServedLevels
from skugga.terrain.errors import LevelError, SourceError
from skugga.terrain.geo.vectors import read_features
from skugga.terrain.geo.world import LONGITUDE_LATITUDE
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.imagery import Imagery
from skugga.terrain.level.data_files import check_file, check_geodata, special_file_kind
from skugga.terrain.level.linked_files import linked_files
from skugga.terrain.level.rasters import is_raster
from skugga.terrain.meshes.models import read_model
from skugga.terrain.trees.canopy import Canopy
from tests.rasters import write_geotiff

UTM = "EPSG:32633"
READERS = {
    "raster": Elevation, "imagery": Imagery, "canopy": Canopy, "vector": lambda source: read_features(source, LONGITUDE_LATITUDE),
    "model": read_model,
}  # fmt: skip


def vrt_text(source: str, band: str = "", inside: str = "", relative: int = 1) -> str:
    """Return the text of a virtual raster over the file ``source``.

    ``band`` are attributes of its band, and ``inside`` is text before the band's source. ``relative`` is 1 for a relative path.
    """
    return (
        f'<VRTDataset rasterXSize="8" rasterYSize="6"><SRS>{UTM}</SRS><GeoTransform>500000, 10, 0, 5200000, 0, -10</GeoTransform>'
        f'<VRTRasterBand dataType="Float32" band="1" {band}>{inside}<SimpleSource>'
        f'<SourceFilename relativeToVRT="{relative}">{source}'
        "</SourceFilename><SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"
    )


@pytest.fixture
def folder(tmp_path):
    """A folder with a raster, a virtual raster over it, and one over that."""
    write_geotiff(tmp_path / "dem.tif", np.arange(48, dtype=np.float32).reshape(6, 8), UTM, 500e3, 5200e3, 10.0)
    (tmp_path / "good.vrt").write_text(vrt_text("dem.tif"))
    (tmp_path / "twice.vrt").write_text(vrt_text(str(tmp_path / "good.vrt"), relative=0))
    return tmp_path


@pytest.mark.parametrize("kind", ["a pipe", "a device", "a folder"])
@pytest.mark.parametrize("reader", READERS)
def test_special_files_are_rejected_before_they_are_opened(tmp_path, kind, reader):
    path = tmp_path / ("mill.obj" if reader == "model" else "data")
    if kind == "a pipe":
        os.mkfifo(path)
    elif kind == "a device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    with pytest.raises(SourceError) as caught:
        READERS[reader](str(path))
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    assert kind == "a folder" or kind in str(caught.value)
    assert special_file_kind(path) == kind and not is_raster(path)


def test_regular_and_missing_files_are_not_special(folder):
    assert special_file_kind(folder / "dem.tif") is None
    assert special_file_kind(folder / "absent") is None
    assert special_file_kind("a\0b") is None


def test_model_may_not_refer_to_a_device(tmp_path):
    (tmp_path / "mill.obj").write_text("mtllib mill.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "mill.mtl").write_text("newmtl wall\nmap_Kd wall.png\n")
    (tmp_path / "wall.png").symlink_to("/dev/zero")
    with pytest.raises(SourceError, match=r"refers to /dev/zero, a device"):
        read_model(str(tmp_path / "mill.obj"))


def test_virtual_rasters_of_files_are_read(folder):
    for name in ("good.vrt", "twice.vrt"):
        elevation = Elevation(str(folder / name))
        assert (elevation.rows, elevation.cols, elevation.overview.max_heights_m.max()) == (6, 8, 47.0)
        elevation.close()
    assert linked_files(str(folder / "twice.vrt")) == (str(folder / "good.vrt"), str(folder / "dem.tif"))


@pytest.mark.parametrize(
    ("text", "expected_text"),
    [
        (vrt_text("/etc/passwd", 'subClass="VRTRawRasterBand"'), "raw bytes"),
        (
            vrt_text("dem.tif", 'subClass="VRTDerivedRasterBand"', "<PixelFunctionLanguage> Python </PixelFunctionLanguage>"),
            "Python",
        ),
        (vrt_text("/dev/zero", relative=0), "/dev/zero, a device"),
        (vrt_text("&lt;VRTDataset/&gt;"), "contains another virtual file as text"),
    ],
    ids=["raw", "python", "device", "inside"],
)
def test_unsafe_virtual_rasters_are_rejected(folder, text, expected_text):
    (folder / "bad.vrt").write_text(text)
    (folder / "of_bad.vrt").write_text(vrt_text("bad.vrt"))
    for name in ("bad.vrt", "of_bad.vrt"):
        with pytest.raises(SourceError, match=expected_text):
            Elevation(str(folder / name))
        with pytest.raises(SourceError, match=expected_text):
            check_geodata(str(folder / name))


def test_linked_files_ends_on_a_cycle(folder):
    (folder / "a.vrt").write_text(vrt_text("b.vrt"))
    (folder / "b.vrt").write_text(vrt_text("a.vrt"))
    assert linked_files(str(folder / "a.vrt")) == (str(folder / "b.vrt"),)
    check_file(str(folder / "a.vrt"))


REMOTE_URL = "http://elsewhere.example/data"
CRS_LINK = {"type": "link", "properties": {"href": REMOTE_URL}}
REMOTE_FILES = {
    "a.vrt": vrt_text(f"/vsicurl/{REMOTE_URL}", relative=0),
    "b.vrt": vrt_text(f"{REMOTE_URL}.tif", relative=1),
    "c.vrt": vrt_text("wms.xml"),
    "wms.xml": f"<GDAL_WMS><Service name='TMS'><ServerUrl>{REMOTE_URL}</ServerUrl></Service></GDAL_WMS>",
    "ogr.vrt": (
        f"<OGRVRTDataSource><OGRVRTLayer name='x'><SrcDataSource>{REMOTE_URL}</SrcDataSource></OGRVRTLayer></OGRVRTDataSource>"
    ),
    "wfs.xml": f"<?xml version='1.0'?><!-- a -->\n<OGRWFSDataSource><URL>{REMOTE_URL}</URL></OGRWFSDataSource>",
    "crs.geojson": json.dumps({"type": "FeatureCollection", "crs": CRS_LINK, "features": []}),
    "deep.json": json.dumps({"features": [{"geometry": {"type": "Point", "crs": {**CRS_LINK, "type": "Link"}}}]}),
    "escaped.json": json.dumps({"crs": CRS_LINK}).replace("link", "\\u006cink").replace("crs", "cr\\u0073"),
    "run.gdalg.json": json.dumps({"type": "gdal_streamed_alg", "command_line": f"gdal vector pipeline ! read {REMOTE_URL}"}),
    "model.gltf": json.dumps({"images": [{"uri": REMOTE_URL}]}),
}


@pytest.mark.parametrize("name", REMOTE_FILES)
def test_linked_files_finds_addresses_in_any_format(folder, name):
    for file_name, text in REMOTE_FILES.items():
        (folder / file_name).write_text(text)
    assert any(REMOTE_URL in link for link in linked_files(str(folder / name)))


@pytest.mark.parametrize("name", REMOTE_FILES)
def test_service_rejects_levels_with_remote_sources(folder, name):
    for file_name, text in REMOTE_FILES.items():
        (folder / file_name).write_text(text)
    for keys in ({"terrain": {"source": name}}, {"terrain": {"source": "dem.tif"}, "meshes": [{"source": name, "height": 3}]}):
        (folder / "level.yaml").write_text(json.dumps({"version": 1, **keys}))
        with pytest.raises(LevelError, match="elsewhere.*SKUGGA_REMOTE_SOURCES"):
            ServedLevels([folder / "level.yaml"])


def test_service_serves_virtual_rasters_of_files(folder):
    served_levels = ServedLevels([folder / "twice.vrt"])
    assert [level.name for level in served_levels.cached_levels()] == ["twice"]


@pytest.mark.parametrize(
    "text",
    [
        json.dumps({"type": "FeatureCollection", "features": [{"properties": {"link": REMOTE_URL, "type": "link"}}]}),
        json.dumps({"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::3857"}}, "link": "ä"}),
        f"<kml xmlns='http://www.opengis.net/kml/2.2'><Document><description>{REMOTE_URL}</description></Document></kml>",
    ],
)
def test_addresses_in_plain_data_are_no_links(tmp_path, text):
    path = tmp_path / ("a.kml" if text.startswith("<") else "a.geojson")
    path.write_text(text)
    assert linked_files(str(path)) == ()


READ_ALL_SCRIPT = """
import sys, rasterio, pyogrio, warnings
from skugga.terrain.level.gdal_guard import forbid_remote_reads
address, guarded, *files = sys.argv[1:]
if guarded == "yes":
    forbid_remote_reads()
warnings.simplefilter("ignore")
for name in files:
    for read in (lambda: rasterio.open(name).read(1), lambda: pyogrio.raw.read(name)):
        try:
            read()
        except Exception as error:
            pass
print(rasterio.open("dem.tif").read(1).sum(), rasterio.open("twice.vrt").read(1).sum())
"""


def test_gdal_guard_does_not_warn_about_missing_drivers():
    """Wheels of pyogrio have no PostgreSQL driver to skip."""
    code = "from skugga.terrain.level.gdal_guard import forbid_remote_reads as f; f(); import rasterio, pyogrio"
    environment = {name: value for name, value in os.environ.items() if name != "CPL_LOG"}
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False,
        env={**environment, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert (process.returncode, process.stderr) == (0, "")


@pytest.mark.parametrize("guarded", ["yes", "no"])
def test_gdal_guard_stops_all_requests_of_gdal(folder, guarded):
    requested_paths = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):  # noqa: N802
            requested_paths.append(self.path)
            self.send_error(404)

        do_HEAD = do_GET  # noqa: N815

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        address = f"http://127.0.0.1:{server.server_port}"
        files = [name for name in REMOTE_FILES if name != "model.gltf"]
        for name in files:
            (folder / name).write_text(REMOTE_FILES[name].replace(REMOTE_URL, f"{address}/{name}"))
        files += [f"{address}/plain.tif", f"/vsicurl/{address}/plain.geojson"]
        environment = {name: value for name, value in os.environ.items() if "proxy" not in name.lower()}
        process = subprocess.run(
            [sys.executable, "-c", READ_ALL_SCRIPT, address, guarded, *files],
            cwd=folder, capture_output=True, text=True, timeout=120,
            env={**environment, "PYTHONPATH": os.pathsep.join(sys.path)},
        )  # fmt: skip
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
    assert process.returncode == 0, process.stderr
    assert process.stdout.split() == [str(float(sum(range(48))))] * 2
    requested_files = {path.split("/")[1].split("?")[0] for path in requested_paths}
    if guarded == "yes":
        assert not requested_paths
    else:  # without the guard GDAL sends requests; otherwise the test could not fail
        assert {"a.vrt", "crs.geojson", "plain.tif"} <= requested_files, requested_files
