"""Rasters of heights as they are opened: without overviews that average sentinels, and with a nodata value that a level states."""

from __future__ import annotations

import warnings
from xml.etree import ElementTree

import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning
from rasterio.io import MemoryFile

from terrain.errors import SourceError
from terrain.level.rasters import open_raster

EXACT_HIGH_CELLS = 32_000_000
"""Largest raster whose highest ground is read cell by cell, in strips, when it is opened, and which is decimated from its
cells and not from overviews that somebody else made."""

_VRT_TYPES = {
    "uint8": "Byte", "int8": "Int8", "uint16": "UInt16", "int16": "Int16", "uint32": "UInt32", "int32": "Int32",
    "uint64": "UInt64", "int64": "Int64", "float32": "Float32", "float64": "Float64",
}  # fmt: skip
"""GDAL's names of types of cells."""


def dataset_of_heights(source: str, held: MemoryFile | None, nodata: float | None) -> rasterio.DatasetReader:
    """Open a raster: the file ``source``, or one in memory that takes its place; a small one without its overviews, which may have
    been made by averaging sentinels into heights. ``nodata`` is a value of cells without a height, besides the declared one;
    with it a mask that the file has beside its cells is not looked at.

    Raises ``SourceError`` for a ``nodata`` that no cell can have, ``RasterioError`` and ``OSError``.
    """
    with rasterio.Env(), warnings.catch_warnings():  # in an Env GDAL's remarks go to the log and not to standard error
        warnings.simplefilter("ignore", NotGeoreferencedWarning)  # refused by the caller with a sentence of its own
        dataset = _open(source) if held is None else held.open()
        if nodata is None or not dataset.count or dataset.dtypes[0] not in _VRT_TYPES:
            return dataset
        dtype = np.dtype(dataset.dtypes[0])
        if dtype.kind in "iu" and not (float(nodata).is_integer() and np.iinfo(dtype).min <= nodata <= np.iinfo(dtype).max):
            raise SourceError(f"{source}: nodata", f"{nodata:g}", f"a value that its cells can have, of the type {dtype}")
        with dataset:
            return rasterio.open(_with_nodata(dataset, nodata))


def _open(source: str) -> rasterio.DatasetReader:
    dataset = open_raster(source)
    if dataset.width * dataset.height > EXACT_HIGH_CELLS or not (dataset.count and dataset.overviews(1)):
        return dataset
    dataset.close()
    return open_raster(source, OVERVIEW_LEVEL="NONE")


def _with_nodata(dataset: rasterio.DatasetReader, nodata: float) -> str:
    """A GDAL virtual raster of a raster's first band, in which both its own nodata and a further value are nodata.

    Cells that the source declares empty are left out (``NODATA`` of a complex source), and so have the band's value.
    """
    rows, cols = dataset.shape
    root = ElementTree.Element("VRTDataset", rasterXSize=str(cols), rasterYSize=str(rows))
    if dataset.crs is not None:
        ElementTree.SubElement(root, "SRS").text = dataset.crs.to_wkt()
    if not dataset.transform.is_identity:
        ElementTree.SubElement(root, "GeoTransform").text = ", ".join(f"{value!r}" for value in dataset.transform.to_gdal())
    band = ElementTree.SubElement(root, "VRTRasterBand", dataType=_VRT_TYPES[dataset.dtypes[0]], band="1")
    said = {
        "NoDataValue": repr(float(nodata)), "UnitType": dataset.units[0] or "", "Offset": repr(float(dataset.offsets[0])),
        "Scale": repr(float(dataset.scales[0])),
    }  # fmt: skip
    for tag, text in said.items():
        if text:
            ElementTree.SubElement(band, tag).text = text
    own = dataset.nodatavals[0]
    part = ElementTree.SubElement(band, "SimpleSource" if own is None or own == nodata else "ComplexSource")
    ElementTree.SubElement(part, "SourceFilename", relativeToVRT="0", shared="0").text = dataset.name
    if dataset.width * dataset.height <= EXACT_HIGH_CELLS:
        options = ElementTree.SubElement(part, "OpenOptions")
        ElementTree.SubElement(options, "OOI", key="OVERVIEW_LEVEL").text = "NONE"
    ElementTree.SubElement(part, "SourceBand").text = "1"
    for tag in ("SrcRect", "DstRect"):
        ElementTree.SubElement(part, tag, xOff="0", yOff="0", xSize=str(cols), ySize=str(rows))
    if part.tag == "ComplexSource":
        ElementTree.SubElement(part, "NODATA").text = repr(own)
    return ElementTree.tostring(root, encoding="unicode")
