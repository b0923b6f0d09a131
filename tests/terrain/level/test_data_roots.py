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

ERS_HEADER = """DatasetHeader Begin
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


def write_raster(path: Path, cells: int = 64) -> Path:
    """Write a raster of equal heights with ``cells`` cells a side, and return its path."""
    return write_geotiff(path, np.full((cells, cells), 7.0, np.float32), "EPSG:32633", 500_000, 5_000_000, 30 * 64 / cells)


def write_level(path: Path, source: str, **keys) -> Path:
    """Write a level over the raster ``source``, and return its path."""
    path.write_text(json.dumps({"version": 1, "terrain": {"source": source}, **keys}), encoding="utf-8")
    return path


@pytest.fixture
def level_folder(tmp_path: Path) -> Path:
    """Create a folder of levels that contains a raster, next to ``outside/secret_raster.tif``."""
    for name in ("inside", "outside"):
        (tmp_path / name).mkdir()
    write_raster(tmp_path / "outside" / "secret.tif")
    write_raster(tmp_path / "inside" / "dem.tif")
    return tmp_path / "inside"


def secret_raster(level_folder: Path) -> Path:
    """Return the path of a raster outside the level's folder."""
    return level_folder.parent / "outside" / "secret.tif"


def escape_by_path(level_folder: Path) -> None:
    """Write a level whose raster is outside, by a relative path."""
    write_level(level_folder / "level.yaml", "../outside/secret.tif")


def escape_by_absolute_path(level_folder: Path) -> None:
    """Write a level whose raster is outside, by an absolute path."""
    write_level(level_folder / "level.yaml", str(secret_raster(level_folder)))


def escape_by_link(level_folder: Path) -> None:
    """Write a level whose raster is a symbolic link to a file outside."""
    (level_folder / "linked.tif").symlink_to(secret_raster(level_folder))
    write_level(level_folder / "level.yaml", "linked.tif")


def escape_by_linked_folder(level_folder: Path) -> None:
    """Write a level whose raster lies in a symbolic link to a folder outside."""
    (level_folder / "folder").symlink_to(secret_raster(level_folder).parent)
    write_level(level_folder / "level.yaml", "folder/secret.tif")


def escape_by_linked_level(level_folder: Path) -> None:
    """Write a level that is a symbolic link to a file outside."""
    write_level(level_folder.parent / "outside" / "level.yaml", "secret.tif")
    (level_folder / "level.yaml").symlink_to(level_folder.parent / "outside" / "level.yaml")


def escape_by_linked_overview(level_folder: Path) -> None:
    """Write a level whose raster has overviews outside."""
    (level_folder / "dem.tif.ovr").symlink_to(secret_raster(level_folder))
    write_level(level_folder / "level.yaml", "dem.tif")


def escape_by_imagery(level_folder: Path) -> None:
    """Write a level whose imagery is outside."""
    write_level(level_folder / "level.yaml", "dem.tif", terrain={"source": "dem.tif", "imagery": str(secret_raster(level_folder))})


def escape_by_virtual_raster(level_folder: Path) -> None:
    """Write a level whose virtual raster has a source outside."""
    (level_folder / "parts.vrt").write_text(VRT.format(relative=1, name="../outside/secret.tif"), encoding="utf-8")
    write_level(level_folder / "level.yaml", "parts.vrt")


def escape_by_working_folder(level_folder: Path) -> None:
    """Use a path relative to the working folder of the service."""
    (level_folder / "parts.vrt").write_text(
        VRT.format(relative=0, name=os.path.relpath(secret_raster(level_folder))), encoding="utf-8"
    )
    write_level(level_folder / "level.yaml", "parts.vrt")


def escape_by_part_of_a_file(level_folder: Path) -> None:
    """Write a level whose virtual raster has a directory of a TIFF file outside as a source."""
    (level_folder / "parts.vrt").write_text(
        VRT.format(relative=0, name=f"GTIFF_DIR:1:{secret_raster(level_folder)}"), encoding="utf-8"
    )
    write_level(level_folder / "level.yaml", "parts.vrt")


def escape_by_metadata(level_folder: Path) -> None:
    """Use an overview file that the metadata of the raster refers to."""
    small_raster = write_raster(level_folder.parent / "outside" / "small.tif", 32)
    with rasterio.open(level_folder / "dem.tif", "r+") as dataset:
        dataset.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=str(small_raster))
    write_level(level_folder / "level.yaml", "dem.tif")


def escape_by_header(level_folder: Path) -> None:
    """Read the bytes of any file as heights."""
    (level_folder / "raw.ers").write_text(ERS_HEADER.format(name="../outside/secret.tif"), encoding="utf-8")
    write_level(level_folder / "level.yaml", "raw.ers")


def escape_by_query(level_folder: Path) -> None:
    """Write a level whose virtual vector file queries a file outside."""
    query = f"SELECT * FROM '{level_folder.parent / 'outside' / 'houses.shp'}'.houses"
    source = f"<SrcDataSource relativeToVRT='1'>own.geojson</SrcDataSource><SrcSQL>{query}</SrcSQL>"
    layer = f"<OGRVRTDataSource><OGRVRTLayer name='x'>{source}</OGRVRTLayer></OGRVRTDataSource>"
    (level_folder / "houses.vrt").write_text(layer, encoding="utf-8")
    write_level(level_folder / "level.yaml", "dem.tif", meshes=[{"source": "houses.vrt", "height": 3}])


def escape_by_archive(level_folder: Path) -> None:
    """Write a level whose raster lies in an archive outside."""
    write_level(level_folder / "level.yaml", f"/vsizip/{level_folder.parent / 'outside' / 'all.zip'}/dem.tif")


def escape_by_url(level_folder: Path) -> None:
    """Write a level whose raster is a ``file`` URL."""
    write_level(level_folder / "level.yaml", f"file://{secret_raster(level_folder)}")


def escape_by_url_of_another(level_folder: Path) -> None:
    """Write a level whose raster is a ``file`` URL that GDAL would read by curl."""
    write_level(level_folder / "level.yaml", f"/vsicurl/file://{secret_raster(level_folder)}")


ESCAPES = (
    escape_by_path, escape_by_absolute_path, escape_by_link, escape_by_linked_folder,
    escape_by_linked_level, escape_by_linked_overview, escape_by_imagery, escape_by_virtual_raster,
    escape_by_working_folder, escape_by_part_of_a_file, escape_by_metadata,
    escape_by_header, escape_by_query, escape_by_archive, escape_by_url,
    escape_by_url_of_another,
)  # fmt: skip

ESCAPE_REASONS = (
    "lies outside the folders of levels and data",
    "does not exist",
    "Path traversal detected",  # GDAL 3.12 and newer
)
"""Reasons why a level is left out, of which its message has one."""


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("escape", ESCAPES, ids=lambda escape: escape.__name__)
def test_no_level_of_a_folder_leads_out_of_it(level_folder: Path, escape: Callable[[Path], None], caplog: pytest.LogCaptureFixture):
    """Links out of the folder fail even with remote sources allowed. The other levels are served."""
    escape(level_folder)
    write_level(
        level_folder / "right.yaml", "dem.tif" if escape not in (escape_by_linked_overview, escape_by_metadata) else "other.tif"
    )
    write_raster(level_folder / "other.tif")
    assert ServedLevels([], remote_sources=True, folder=level_folder).names() == ["right"]
    (record,) = (record for record in caplog.records if record.levelname == "ERROR")
    message = record.getMessage()
    assert "level.yaml" in message and "\n" not in message
    assert any(reason in message for reason in ESCAPE_REASONS)


@pytest.mark.parametrize(
    "escape",
    [escape_by_path, escape_by_link, escape_by_linked_level, escape_by_linked_overview],
    ids=lambda escape: escape.__name__,
)
def test_worker_checks_data_roots_too(level_folder: Path, escape: Callable[[Path], None]):
    """A worker reads the level itself, and the level may have changed."""
    escape(level_folder)
    with pytest.raises(LevelError, match="lies outside the folders of levels"):
        load_level(LevelSource(path=level_folder / "level.yaml", roots=(level_folder,)))


@pytest.mark.parametrize(
    "escape", [escape_by_path, escape_by_link, escape_by_linked_folder, escape_by_virtual_raster, escape_by_metadata]
)
def test_data_roots_allow_other_folders(level_folder: Path, escape: Callable[[Path], None]):
    escape(level_folder)
    level = ServedLevels([level_folder / "level.yaml"], data_roots=[level_folder.parent / "outside"]).reload_if_changed("level")
    assert level.key.roots is not None and level_folder.parent / "outside" in level.key.roots


def test_files_below_the_level_folder_are_allowed(level_folder: Path):
    """Subfolders, links within the folder, and a named level that is itself a link are allowed."""
    (level_folder / "data").mkdir()
    write_raster(level_folder / "data" / "far.tif")
    (level_folder / "near.tif").symlink_to(level_folder / "data" / "far.tif")
    (level_folder / "parts.vrt").write_text(VRT.format(relative=1, name="data/far.tif"), encoding="utf-8")
    for name in ("data/far.tif", "near.tif", "parts.vrt", str(level_folder / "dem.tif")):
        assert ServedLevels([write_level(level_folder / "level.yaml", name)]).names() == ["level"]
    linked_level = level_folder.parent / "named.yaml"
    linked_level.symlink_to(level_folder / "level.yaml")
    assert ServedLevels([linked_level]).names() == ["named"]
    assert ServedLevels([secret_raster(level_folder)]).names() == ["secret"]


def test_without_roots_any_file_is_read(level_folder: Path):
    escape_by_path(level_folder)
    assert load_level(level_folder / "level.yaml").name == "level"


def test_data_root_error_names_target_and_remedy(level_folder: Path):
    escape_by_link(level_folder)
    write_level(level_folder / "level.yaml", str(level_folder / "linked.tif"))
    with pytest.raises(LevelError) as caught:
        ServedLevels([level_folder / "level.yaml"])
    assert f"linked.tif, which resolves to {secret_raster(level_folder)}" in str(caught.value)
    assert f"Move it into one of {level_folder}, or add its folder to SKUGGA_DATA_ROOTS" in str(caught.value)
