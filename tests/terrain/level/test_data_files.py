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


def vrt(source: str, band: str = "", inside: str = "", relative: int = 1) -> str:
    return (
        f'<VRTDataset rasterXSize="8" rasterYSize="6"><SRS>{UTM}</SRS><GeoTransform>500000, 10, 0, 5200000, 0, -10</GeoTransform>'
        f'<VRTRasterBand dataType="Float32" band="1" {band}>{inside}<SimpleSource>'
        f'<SourceFilename relativeToVRT="{relative}">{source}'
        "</SourceFilename><SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"
    )


@pytest.fixture
def folder(tmp_path):
    write_geotiff(tmp_path / "dem.tif", np.arange(48, dtype=np.float32).reshape(6, 8), UTM, 500e3, 5200e3, 10.0)
    (tmp_path / "good.vrt").write_text(vrt("dem.tif"))
    (tmp_path / "twice.vrt").write_text(vrt(str(tmp_path / "good.vrt"), relative=0))
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
        assert (elevation.rows, elevation.cols, elevation.overview.high_m.max()) == (6, 8, 47.0)
        elevation.close()
    assert linked_files(str(folder / "twice.vrt")) == (str(folder / "good.vrt"), str(folder / "dem.tif"))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (vrt("/etc/passwd", 'subClass="VRTRawRasterBand"'), "raw bytes"),
        (vrt("dem.tif", 'subClass="VRTDerivedRasterBand"', "<PixelFunctionLanguage> Python </PixelFunctionLanguage>"), "Python"),
        (vrt("/dev/zero", relative=0), "/dev/zero, a device"),
        (vrt("&lt;VRTDataset/&gt;"), "contains another virtual file as text"),
    ],
    ids=["raw", "python", "device", "inside"],
)
def test_unsafe_virtual_rasters_are_rejected(folder, text, said):
    (folder / "bad.vrt").write_text(text)
    (folder / "of_bad.vrt").write_text(vrt("bad.vrt"))
    for name in ("bad.vrt", "of_bad.vrt"):
        with pytest.raises(SourceError, match=said):
            Elevation(str(folder / name))
        with pytest.raises(SourceError, match=said):
            check_geodata(str(folder / name))


def test_linked_files_ends_on_a_cycle(folder):
    (folder / "a.vrt").write_text(vrt("b.vrt"))
    (folder / "b.vrt").write_text(vrt("a.vrt"))
    assert linked_files(str(folder / "a.vrt")) == (str(folder / "b.vrt"),)
    check_file(str(folder / "a.vrt"))


ADDRESS = "http://elsewhere.example/data"
CRS_LINK = {"type": "link", "properties": {"href": ADDRESS}}
REMOTE = {
    "a.vrt": vrt(f"/vsicurl/{ADDRESS}", relative=0),
    "b.vrt": vrt(f"{ADDRESS}.tif", relative=1),
    "c.vrt": vrt("wms.xml"),
    "wms.xml": f"<GDAL_WMS><Service name='TMS'><ServerUrl>{ADDRESS}</ServerUrl></Service></GDAL_WMS>",
    "ogr.vrt": f"<OGRVRTDataSource><OGRVRTLayer name='x'><SrcDataSource>{ADDRESS}</SrcDataSource></OGRVRTLayer></OGRVRTDataSource>",
    "wfs.xml": f"<?xml version='1.0'?><!-- a -->\n<OGRWFSDataSource><URL>{ADDRESS}</URL></OGRWFSDataSource>",
    "crs.geojson": json.dumps({"type": "FeatureCollection", "crs": CRS_LINK, "features": []}),
    "deep.json": json.dumps({"features": [{"geometry": {"type": "Point", "crs": {**CRS_LINK, "type": "Link"}}}]}),
    "escaped.json": json.dumps({"crs": CRS_LINK}).replace("link", "\\u006cink").replace("crs", "cr\\u0073"),
    "run.gdalg.json": json.dumps({"type": "gdal_streamed_alg", "command_line": f"gdal vector pipeline ! read {ADDRESS}"}),
    "model.gltf": json.dumps({"images": [{"uri": ADDRESS}]}),
}


@pytest.mark.parametrize("name", REMOTE)
def test_linked_files_finds_addresses_in_any_format(folder, name):
    for each, text in REMOTE.items():
        (folder / each).write_text(text)
    assert any(ADDRESS in link for link in linked_files(str(folder / name)))


@pytest.mark.parametrize("name", REMOTE)
def test_service_rejects_levels_with_remote_sources(folder, name):
    for each, text in REMOTE.items():
        (folder / each).write_text(text)
    for keys in ({"terrain": {"source": name}}, {"terrain": {"source": "dem.tif"}, "meshes": [{"source": name, "height": 3}]}):
        (folder / "level.yaml").write_text(json.dumps({"version": 1, **keys}))
        with pytest.raises(LevelError, match="elsewhere.*SKUGGA_REMOTE_SOURCES"):
            ServedLevels([folder / "level.yaml"])


def test_service_serves_virtual_rasters_of_files(folder):
    served = ServedLevels([folder / "twice.vrt"])
    assert [level.name for level in served.known()] == ["twice"]


@pytest.mark.parametrize(
    "text",
    [
        json.dumps({"type": "FeatureCollection", "features": [{"properties": {"link": ADDRESS, "type": "link"}}]}),
        json.dumps({"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::3857"}}, "link": "ä"}),
        f"<kml xmlns='http://www.opengis.net/kml/2.2'><Document><description>{ADDRESS}</description></Document></kml>",
    ],
)
def test_addresses_in_plain_data_are_no_links(tmp_path, text):
    path = tmp_path / ("a.kml" if text.startswith("<") else "a.geojson")
    path.write_text(text)
    assert linked_files(str(path)) == ()


READ_ALL = """
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
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False,
        env={**environment, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("guarded", ["yes", "no"])
def test_gdal_guard_stops_all_requests_of_gdal(folder, guarded):
    asked = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):  # noqa: N802
            asked.append(self.path)
            self.send_error(404)

        do_HEAD = do_GET  # noqa: N815

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        address = f"http://127.0.0.1:{server.server_port}"
        files = [name for name in REMOTE if name != "model.gltf"]
        for name in files:
            (folder / name).write_text(REMOTE[name].replace(ADDRESS, f"{address}/{name}"))
        files += [f"{address}/plain.tif", f"/vsicurl/{address}/plain.geojson"]
        environment = {name: value for name, value in os.environ.items() if "proxy" not in name.lower()}
        done = subprocess.run(
            [sys.executable, "-c", READ_ALL, address, guarded, *files], cwd=folder, capture_output=True, text=True, timeout=120,
            env={**environment, "PYTHONPATH": os.pathsep.join(sys.path)},
        )  # fmt: skip
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [str(float(sum(range(48))))] * 2
    found = {path.split("/")[1].split("?")[0] for path in asked}
    if guarded == "yes":
        assert not asked
    else:  # without the guard GDAL sends requests; otherwise the test could not fail
        assert {"a.vrt", "crs.geojson", "plain.tif"} <= found, found
