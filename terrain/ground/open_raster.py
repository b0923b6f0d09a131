"""Rasters as they are opened: without overviews that average sentinels, with the nodata value that a level states, and with all
their masks in force.

A file may say in several ways which cells are empty: nodata values, a mask beside the cells (in the file or in a ``.msk``), an
alpha band. GDAL heeds one of them, a mask before nodata before alpha, and alpha bands only of some types and places. Where a file
says more than GDAL heeds, a virtual raster takes its place, in which the cells that any of them declares empty are nodata.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
import rasterio
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.errors import NotGeoreferencedWarning
from rasterio.io import MemoryFile
from rasterio.shutil import copy

from skugga.terrain.errors import SourceError
from skugga.terrain.level.rasters import open_raster

EXACT_HIGH_CELLS = 32_000_000
"""Largest raster whose highest ground is read cell by cell, in strips, when it is opened, and which is decimated from its
cells and not from overviews that somebody else made."""

_VRT_TYPES = {
    "uint8": "Byte", "int8": "Int8", "uint16": "UInt16", "int16": "Int16", "uint32": "UInt32", "int32": "Int32",
    "uint64": "UInt64", "int64": "Int64", "float32": "Float32", "float64": "Float64",
}  # fmt: skip
"""GDAL's names of types of cells."""

_AXIS_TAGS = ("positive", "standard_name")
"""Of a band: what says which way its numbers grow."""

GTIFF_VERTICAL = {"GTIFF_REPORT_COMPD_CS": "YES"}
"""GDAL leaves out the vertical CRS of a GeoTIFF 1.0, where it is not asked."""


def dataset_of_heights(source: str, held: MemoryFile | None, nodata: float | None) -> rasterio.DatasetReader:
    """Open a raster: the file ``source``, or one in memory that takes its place; a small one without its overviews, which may have
    been made by averaging sentinels into heights. ``nodata`` is a value of cells without a height, besides the declared one.

    Raises ``SourceError`` for a ``nodata`` that no cell can have, ``RasterioError`` and ``OSError``.
    """
    with rasterio.Env(**GTIFF_VERTICAL), warnings.catch_warnings():  # in an Env GDAL's remarks go to the log, not to standard error
        warnings.simplefilter("ignore", NotGeoreferencedWarning)  # refused by the caller with a sentence of its own
        dataset = _open(source) if held is None else held.open()
        if nodata is not None and dataset.count and dataset.dtypes[0] in _VRT_TYPES:
            dtype = np.dtype(dataset.dtypes[0])
            if dtype.kind in "iu" and not (float(nodata).is_integer() and np.iinfo(dtype).min <= nodata <= np.iinfo(dtype).max):
                raise SourceError(f"{source}: nodata", f"{nodata:g}", f"a value that its cells can have, of the type {dtype}")
            with np.errstate(over="ignore"):
                nodata = float(np.asarray(nodata, np.float64).astype(dtype))  # -3.4028235e+38 is none of 32 bits as it stands
        return _with_all_masks(dataset, (1,), nodata)


def dataset_with_masks(source: str, bands: Sequence[int] = (1,)) -> rasterio.DatasetReader:
    """Open a raster whose ``bands``, the first ones, are masked by all that its file says of empty cells.

    Raises ``SourceError``, ``RasterioError`` and ``OSError``.
    """
    with rasterio.Env(**GTIFF_VERTICAL), warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        return _with_all_masks(open_raster(source), bands, None)


def impossible_nodata(dataset: rasterio.DatasetReader) -> str | None:
    """The nodata value that an open raster's first band declares, in words, where no cell of its type can have it, as NaN among
    whole numbers; else ``None``.
    """
    if np.dtype(dataset.dtypes[0]).kind not in "iu" or dataset.nodatavals[0] is not None:
        return None
    with rasterio.Env(), MemoryFile(ext=".vrt") as held:  # rasterio hides such a value, a virtual raster's text does not
        copy(dataset, held.name, driver="VRT")
        band = ElementTree.fromstring(held.read()).find("VRTRasterBand")
    return None if band is None else band.findtext("NoDataValue")


def _open(source: str) -> rasterio.DatasetReader:
    dataset = open_raster(source)
    if dataset.width * dataset.height > EXACT_HIGH_CELLS or not (dataset.count and dataset.overviews(1)):
        return dataset
    dataset.close()
    return open_raster(source, OVERVIEW_LEVEL="NONE")


def _with_all_masks(dataset: rasterio.DatasetReader, bands: Sequence[int], nodata: float | None) -> rasterio.DatasetReader:
    """A dataset, or a virtual raster in its place, of which ``read`` masks all that is empty; ``nodata`` is a further value."""
    if dataset.count < max(bands) or any(dataset.dtypes[band - 1] not in _VRT_TYPES for band in bands):
        return dataset
    if dataset.gcps[0] or dataset.rpcs is not None:  # refused by who needs a geotransform
        return dataset
    flags = dataset.mask_flag_enums[0]
    alpha = next((number for number, meaning in enumerate(dataset.colorinterp, 1) if meaning == ColorInterp.alpha), None)
    parts: list[_Part] = []
    if alpha is not None and alpha not in bands and MaskFlags.alpha not in flags:
        parts.append(_Part(dataset.name, str(alpha), lut="0:0,1:255"))  # of real numbers, shares of 1
    if MaskFlags.nodata not in flags and any(dataset.nodatavals[band - 1] is not None for band in bands):
        parts.append(_any_mask(dataset, _virtual(dataset, bands, dataset.name), bands))
    if not parts and nodata is None:
        return dataset
    with dataset:
        if not parts and MaskFlags.per_dataset not in flags:
            is_small = dataset.width * dataset.height <= EXACT_HIGH_CELLS
            return rasterio.open(_virtual(dataset, bands, dataset.name, nodata, exact=is_small))
        if nodata is not None:
            parts.append(_any_mask(dataset, _virtual(dataset, bands, dataset.name, nodata), bands))
        if MaskFlags.all_valid not in flags:
            parts.append(_any_mask(dataset, dataset.name, bands))
        return rasterio.open(_virtual(dataset, bands, _masked(dataset, bands, parts), nodata, masked=True))


@dataclass(frozen=True)
class _Part:
    """What a virtual band is made of: a band (a number, or ``mask,1`` for the mask of the first) of a raster, or of a virtual one's
    text. ``exact``: its overviews are not looked at. ``lut`` are values and what they become.
    """

    name: str
    band: str
    exact: bool = True
    lut: str | None = None


def _virtual(
    dataset: rasterio.DatasetReader,
    bands: Sequence[int],
    name: str,
    nodata: float | None = None,
    *,
    masked: bool = False,
    exact: bool = True,
) -> str:
    """A GDAL virtual raster of bands of ``name``, a raster with a dataset's cells, in which what is empty has the nodata value.

    That is ``nodata``, else each band's own, else NaN, for which whole numbers become real ones. ``masked``: the source's mask says
    what is empty, else the bands' values. (GDAL averages without what is empty where a virtual band has nodata, not where it has a
    mask.)
    """
    root = _root(dataset)
    for number in bands:
        own, dtype = dataset.nodatavals[number - 1], dataset.dtypes[number - 1]
        hole = nodata if nodata is not None else own if own is not None else np.nan
        if np.isnan(hole) and np.dtype(dtype).kind != "f":
            dtype = "float32" if np.dtype(dtype).itemsize <= 2 else "float64"
        band = ElementTree.SubElement(root, "VRTRasterBand", dataType=_VRT_TYPES[dtype], band=str(number))
        if tags := {key: value for key, value in dataset.tags(number).items() if key in _AXIS_TAGS}:
            metadata = ElementTree.SubElement(band, "Metadata")
            for key, value in tags.items():
                ElementTree.SubElement(metadata, "MDI", key=key).text = value
        said = {
            "NoDataValue": repr(float(hole)), "UnitType": dataset.units[number - 1] or "",
            "Offset": repr(float(dataset.offsets[number - 1])), "Scale": repr(float(dataset.scales[number - 1])),
        }  # fmt: skip
        for tag, text in said.items():
            if text:
                ElementTree.SubElement(band, tag).text = text
        skips = not masked and own is not None and own != hole
        part = _add_source(band, dataset, _Part(name, str(number), exact), is_complex=masked or skips)
        if masked:
            ElementTree.SubElement(part, "UseMaskBand").text = "true"
        elif skips:
            ElementTree.SubElement(part, "NODATA").text = repr(own)
    return ElementTree.tostring(root, encoding="unicode")


def _any_mask(dataset: rasterio.DatasetReader, name: str, bands: Sequence[int]) -> _Part:
    """A mask of a raster with a dataset's cells that is 0 where the masks of all its bands are."""
    if len(bands) == 1:
        return _Part(name, f"mask,{bands[0]}")
    root = _root(dataset)
    _add_derived(root, dataset, "max", [_Part(name, f"mask,{number}") for number in bands])
    return _Part(ElementTree.tostring(root, encoding="unicode"), "1")


def _masked(dataset: rasterio.DatasetReader, bands: Sequence[int], masks: Sequence[_Part]) -> str:
    """A GDAL virtual raster of a raster's bands as they are, whose mask is 0 where any of some masks is."""
    root = _root(dataset)
    for number in bands:
        band = ElementTree.SubElement(root, "VRTRasterBand", dataType=_VRT_TYPES[dataset.dtypes[number - 1]], band=str(number))
        _add_source(band, dataset, _Part(dataset.name, str(number)))
    _add_derived(ElementTree.SubElement(root, "MaskBand"), dataset, "min", masks)
    return ElementTree.tostring(root, encoding="unicode")


def _root(dataset: rasterio.DatasetReader) -> ElementTree.Element:
    rows, cols = dataset.shape
    root = ElementTree.Element("VRTDataset", rasterXSize=str(cols), rasterYSize=str(rows))
    if dataset.crs is not None:
        ElementTree.SubElement(root, "SRS").text = dataset.crs.to_wkt()
    if not dataset.transform.is_identity:
        ElementTree.SubElement(root, "GeoTransform").text = ", ".join(f"{value!r}" for value in dataset.transform.to_gdal())
    return root


def _add_derived(root: ElementTree.Element, dataset: rasterio.DatasetReader, function: str, parts: Sequence[_Part]) -> None:
    """Add a band of bytes: another one, or made from some by a function of GDAL's."""
    band = ElementTree.SubElement(root, "VRTRasterBand", dataType="Byte")
    if len(parts) > 1:
        band.set("subClass", "VRTDerivedRasterBand")
        ElementTree.SubElement(band, "PixelFunctionType").text = function
    for part in parts:
        _add_source(band, dataset, part)


def _add_source(
    band: ElementTree.Element, dataset: rasterio.DatasetReader, part: _Part, is_complex: bool = False
) -> ElementTree.Element:
    """Add a source of a virtual band that covers all of it."""
    rows, cols = dataset.shape
    source = ElementTree.SubElement(band, "ComplexSource" if is_complex or part.lut else "SimpleSource")
    ElementTree.SubElement(source, "SourceFilename", relativeToVRT="0", shared="0").text = part.name
    if part.exact:
        options = ElementTree.SubElement(source, "OpenOptions")
        ElementTree.SubElement(options, "OOI", key="OVERVIEW_LEVEL").text = "NONE"
    ElementTree.SubElement(source, "SourceBand").text = part.band
    for tag in ("SrcRect", "DstRect"):
        ElementTree.SubElement(source, tag, xOff="0", yOff="0", xSize=str(cols), ySize=str(rows))
    if part.lut:
        ElementTree.SubElement(source, "LUT").text = part.lut
    return source
