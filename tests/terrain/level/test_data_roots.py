"""Data roots: a level reads only files below its roots, whatever links lead elsewhere."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rasterio

from skugga.api.http.state.served_levels import ServedLevels
from skugga.terrain.errors import LevelError
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource
from tests.rasters import write_geotiff

VRT = """<VRTDataset rasterXSize="64" rasterYSize="64"><SRS>EPSG:32633</SRS>
<GeoTransform>500000, 30, 0, 5000000, 0, -30</GeoTransform><VRTRasterBand dataType="Float32" band="1"><SimpleSource>
<SourceFilename relativeToVRT="{relative}">{name}</SourceFilename><SourceBand>1</SourceBand>
</SimpleSource></VRTRasterBand></VRTDataset>"""

HEADER = """DatasetHeader Begin
 Version="6.0"
 DataFile="{name}"
 DataSetType=ERStorage
 DataType=Raster
 ByteOrder=LSBFirst
 RasterInfo Begin
  CellType=Unsigned8BitInteger
  NrOfLines=16
  NrOfCellsPerLine=16
  NrOfBands=1
 RasterInfo End
DatasetHeader End
"""


def raster(path: Path, cells: int = 64) -> Path:
    return write_geotiff(path, np.full((cells, cells), 7.0, np.float32), "EPSG:32633", 500_000, 5_000_000, 30 * 64 / cells)


def level_of(path: Path, source: str, **keys) -> Path:
    path.write_text(json.dumps({"version": 1, "terrain": {"source": source}, **keys}), encoding="utf-8")
    return path


@pytest.fixture
def inside(tmp_path: Path) -> Path:
    """Create a folder of levels that contains a raster, next to ``outside/secret.tif``."""
    for name in ("inside", "outside"):
        (tmp_path / name).mkdir()
    raster(tmp_path / "outside" / "secret.tif")
    raster(tmp_path / "inside" / "dem.tif")
    return tmp_path / "inside"


def secret(inside: Path) -> Path:
    return inside.parent / "outside" / "secret.tif"


def by_path(inside: Path) -> None:
    level_of(inside / "level.yaml", "../outside/secret.tif")


def by_whole_path(inside: Path) -> None:
    level_of(inside / "level.yaml", str(secret(inside)))


def by_link(inside: Path) -> None:
    (inside / "linked.tif").symlink_to(secret(inside))
    level_of(inside / "level.yaml", "linked.tif")


def by_linked_folder(inside: Path) -> None:
    (inside / "folder").symlink_to(secret(inside).parent)
    level_of(inside / "level.yaml", "folder/secret.tif")


def by_linked_level(inside: Path) -> None:
    level_of(inside.parent / "outside" / "level.yaml", "secret.tif")
    (inside / "level.yaml").symlink_to(inside.parent / "outside" / "level.yaml")


def by_linked_overview(inside: Path) -> None:
    (inside / "dem.tif.ovr").symlink_to(secret(inside))
    level_of(inside / "level.yaml", "dem.tif")


def by_imagery(inside: Path) -> None:
    level_of(inside / "level.yaml", "dem.tif", terrain={"source": "dem.tif", "imagery": str(secret(inside))})


def by_a_virtual_raster(inside: Path) -> None:
    (inside / "parts.vrt").write_text(VRT.format(relative=1, name="../outside/secret.tif"), encoding="utf-8")
    level_of(inside / "level.yaml", "parts.vrt")


def by_the_working_folder(inside: Path) -> None:
    """Use a path relative to the working folder of the service."""
    (inside / "parts.vrt").write_text(VRT.format(relative=0, name=os.path.relpath(secret(inside))), encoding="utf-8")
    level_of(inside / "level.yaml", "parts.vrt")


def by_a_part_of_a_file(inside: Path) -> None:
    (inside / "parts.vrt").write_text(VRT.format(relative=0, name=f"GTIFF_DIR:1:{secret(inside)}"), encoding="utf-8")
    level_of(inside / "level.yaml", "parts.vrt")


def by_metadata(inside: Path) -> None:
    """Use an overview file that the metadata of the raster refers to."""
    small = raster(inside.parent / "outside" / "small.tif", 32)
    with rasterio.open(inside / "dem.tif", "r+") as dataset:
        dataset.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=str(small))
    level_of(inside / "level.yaml", "dem.tif")


def by_a_header(inside: Path) -> None:
    """Read the bytes of any file as heights."""
    (inside / "raw.ers").write_text(HEADER.format(name="../outside/secret.tif"), encoding="utf-8")
    level_of(inside / "level.yaml", "raw.ers")


def by_a_query(inside: Path) -> None:
    query = f"SELECT * FROM '{inside.parent / 'outside' / 'houses.shp'}'.houses"
    source = f"<SrcDataSource relativeToVRT='1'>own.geojson</SrcDataSource><SrcSQL>{query}</SrcSQL>"
    layer = f"<OGRVRTDataSource><OGRVRTLayer name='x'>{source}</OGRVRTLayer></OGRVRTDataSource>"
    (inside / "houses.vrt").write_text(layer, encoding="utf-8")
    level_of(inside / "level.yaml", "dem.tif", meshes=[{"source": "houses.vrt", "height": 3}])


def by_an_archive(inside: Path) -> None:
    level_of(inside / "level.yaml", f"/vsizip/{inside.parent / 'outside' / 'all.zip'}/dem.tif")


def by_an_address(inside: Path) -> None:
    level_of(inside / "level.yaml", f"file://{secret(inside)}")


def by_an_address_of_another(inside: Path) -> None:
    level_of(inside / "level.yaml", f"/vsicurl/file://{secret(inside)}")


WAYS = (
    by_path, by_whole_path, by_link, by_linked_folder, by_linked_level, by_linked_overview, by_imagery, by_a_virtual_raster,
    by_the_working_folder, by_a_part_of_a_file, by_metadata, by_a_header, by_a_query, by_an_archive, by_an_address,
    by_an_address_of_another,
)  # fmt: skip


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("lead_out", WAYS, ids=lambda way: way.__name__)
def test_no_level_of_a_folder_leads_out_of_it(inside: Path, lead_out: Callable[[Path], None], caplog: pytest.LogCaptureFixture):
    """Links out of the folder fail even with remote sources allowed. The other levels are served."""
    lead_out(inside)
    level_of(inside / "right.yaml", "dem.tif" if lead_out not in (by_linked_overview, by_metadata) else "other.tif")
    raster(inside / "other.tif")
    assert ServedLevels([], remote_sources=True, folder=inside).names() == ["right"]
    (record,) = (record for record in caplog.records if record.levelname == "ERROR")
    said = record.getMessage()
    assert "level.yaml" in said and "\n" not in said
    assert "lies outside the folders of levels and data" in said or "does not exist" in said


@pytest.mark.parametrize("lead_out", [by_path, by_link, by_linked_level, by_linked_overview], ids=lambda way: way.__name__)
def test_worker_checks_data_roots_too(inside: Path, lead_out: Callable[[Path], None]):
    """A worker reads the level itself, and the level may have changed."""
    lead_out(inside)
    with pytest.raises(LevelError, match="lies outside the folders of levels"):
        load_level(LevelSource(path=inside / "level.yaml", roots=(inside,)))


@pytest.mark.parametrize("lead_out", [by_path, by_link, by_linked_folder, by_a_virtual_raster, by_metadata])
def test_data_roots_allow_other_folders(inside: Path, lead_out: Callable[[Path], None]):
    lead_out(inside)
    level = ServedLevels([inside / "level.yaml"], data_roots=[inside.parent / "outside"]).get("level")
    assert level.key.roots is not None and inside.parent / "outside" in level.key.roots


def test_files_below_the_level_folder_are_allowed(inside: Path):
    """Subfolders, links within the folder, and a named level that is itself a link are allowed."""
    (inside / "data").mkdir()
    raster(inside / "data" / "far.tif")
    (inside / "near.tif").symlink_to(inside / "data" / "far.tif")
    (inside / "parts.vrt").write_text(VRT.format(relative=1, name="data/far.tif"), encoding="utf-8")
    for name in ("data/far.tif", "near.tif", "parts.vrt", str(inside / "dem.tif")):
        assert ServedLevels([level_of(inside / "level.yaml", name)]).names() == ["level"]
    named = inside.parent / "named.yaml"
    named.symlink_to(inside / "level.yaml")
    assert ServedLevels([named]).names() == ["named"]
    assert ServedLevels([secret(inside)]).names() == ["secret"]


def test_without_roots_any_file_is_read(inside: Path):
    by_path(inside)
    assert load_level(inside / "level.yaml").name == "level"


def test_data_root_error_names_target_and_remedy(inside: Path):
    by_link(inside)
    level_of(inside / "level.yaml", str(inside / "linked.tif"))
    with pytest.raises(LevelError) as caught:
        ServedLevels([inside / "level.yaml"])
    assert f"linked.tif, which resolves to {secret(inside)}" in str(caught.value)
    assert f"Move it into one of {inside}, or add its folder to SKUGGA_DATA_ROOTS" in str(caught.value)
