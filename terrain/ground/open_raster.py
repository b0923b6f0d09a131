"""Open rasters with all their masks applied, and with the nodata value that a level file adds.

A file may declare empty cells in several ways: nodata values, a mask beside the cells (in the file or in a ``.msk``), or an alpha
band. GDAL applies only one of these: a mask if there is one, else nodata, else an alpha band of some types and positions. If a file
declares more than GDAL applies, a virtual raster (VRT) replaces it. In the VRT a cell is nodata if any of these declares it empty.

Small rasters are opened without their overviews. These may average sentinels (values that stand for missing data) into heights.
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

MAX_EXACT_MAXIMA_CELLS = 32_000_000
"""Maximum number of cells of a raster whose maximum heights are read cell by cell, in strips, when it is opened.

Coarse cells of such a raster are computed from its own cells, not from existing overviews of unknown origin.
"""

_VRT_TYPES = {
    "uint8": "Byte", "int8": "Int8", "uint16": "UInt16", "int16": "Int16", "uint32": "UInt32", "int32": "Int32",
    "uint64": "UInt64", "int64": "Int64", "float32": "Float32", "float64": "Float64",
}  # fmt: skip
"""GDAL's names of cell types."""

_AXIS_TAGS = ("positive", "standard_name")
"""Tags of a band that state the direction in which its numbers grow."""

GTIFF_VERTICAL_CRS_OPTIONS = {"GTIFF_REPORT_COMPD_CS": "YES"}
"""GDAL option that includes the vertical CRS of a GeoTIFF 1.0, which GDAL leaves out by default."""


def open_height_raster(source: str, in_memory: MemoryFile | None, nodata: float | None) -> rasterio.DatasetReader:
    """Open a raster of heights: the file ``source``, or the raster in memory ``in_memory`` that replaces it.

    A small raster is opened without its overviews, which may average sentinels into heights. ``nodata`` is a value of cells without
    a height, in addition to the declared one. Raises ``SourceError`` for a ``nodata`` that no cell can have, ``RasterioError`` and
    ``OSError``.
    """
    with (
        rasterio.Env(**GTIFF_VERTICAL_CRS_OPTIONS),
        warnings.catch_warnings(),
    ):  # an Env sends GDAL's messages to the log, not to stderr
        warnings.simplefilter("ignore", NotGeoreferencedWarning)  # the caller raises an error of its own
        dataset = _open(source) if in_memory is None else in_memory.open()
        if nodata is not None and dataset.count and dataset.dtypes[0] in _VRT_TYPES:
            dtype = np.dtype(dataset.dtypes[0])
            if dtype.kind in "iu" and not (float(nodata).is_integer() and np.iinfo(dtype).min <= nodata <= np.iinfo(dtype).max):
                problem = f"{nodata:g} is no value of its type {dtype}"
                raise SourceError(f"{source}: nodata", problem, "Give a value that its cells can have")
            with np.errstate(over="ignore"):
                nodata = float(np.asarray(nodata, np.float64).astype(dtype))  # -3.4028235e+38 itself is not a float32
        return _apply_all_masks(dataset, (1,), nodata)


def open_masked_raster(source: str, bands: Sequence[int] = (1,)) -> rasterio.DatasetReader:
    """Open a raster and mask each cell of its ``bands`` that nodata, a mask or an alpha band declares empty.

    Raises ``SourceError``, ``RasterioError`` and ``OSError``.
    """
    with rasterio.Env(**GTIFF_VERTICAL_CRS_OPTIONS), warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        return _apply_all_masks(open_raster(source), bands, None)


def impossible_nodata(dataset: rasterio.DatasetReader) -> str | None:
    """Return the nodata value of an open raster's first band, as text, if its cell type cannot hold it, else ``None``.

    An example is NaN in a band of integers.
    """
    if np.dtype(dataset.dtypes[0]).kind not in "iu" or dataset.nodatavals[0] is not None:
        return None
    with rasterio.Env(), MemoryFile(ext=".vrt") as in_memory:  # rasterio hides such a value, the text of a VRT does not
        copy(dataset, in_memory.name, driver="VRT")
        band = ElementTree.fromstring(in_memory.read()).find("VRTRasterBand")
    return None if band is None else band.findtext("NoDataValue")


def _open(source: str) -> rasterio.DatasetReader:
    """Open a raster file. One with at most ``MAX_EXACT_MAXIMA_CELLS`` cells is opened without its overviews."""
    dataset = open_raster(source)
    if dataset.width * dataset.height > MAX_EXACT_MAXIMA_CELLS or not (dataset.count and dataset.overviews(1)):
        return dataset
    dataset.close()
    return open_raster(source, OVERVIEW_LEVEL="NONE")


def _apply_all_masks(dataset: rasterio.DatasetReader, bands: Sequence[int], nodata: float | None) -> rasterio.DatasetReader:
    """Return a dataset whose ``read`` masks all empty cells: the given one, or a VRT.

    ``nodata`` is a value of empty cells in addition to the one that the file declares.
    """
    if dataset.count < max(bands) or any(dataset.dtypes[band - 1] not in _VRT_TYPES for band in bands):
        return dataset
    if dataset.gcps[0] or dataset.rpcs is not None:  # callers that need a geotransform raise an error
        return dataset
    flags = dataset.mask_flag_enums[0]
    alpha = next((number for number, meaning in enumerate(dataset.colorinterp, 1) if meaning == ColorInterp.alpha), None)
    parts: list[_VrtSource] = []
    if alpha is not None and alpha not in bands and MaskFlags.alpha not in flags:
        parts.append(_VrtSource(dataset.name, str(alpha), lut="0:0,1:255"))  # the lookup table interpolates real values
    if MaskFlags.nodata not in flags and any(dataset.nodatavals[band - 1] is not None for band in bands):
        parts.append(_union_mask(dataset, _vrt_of_values(dataset, bands, dataset.name), bands))
    if not parts and nodata is None:
        return dataset
    with dataset:
        if not parts and MaskFlags.per_dataset not in flags:
            is_small = dataset.width * dataset.height <= MAX_EXACT_MAXIMA_CELLS
            return rasterio.open(_vrt_of_values(dataset, bands, dataset.name, nodata, ignores_overviews=is_small))
        if nodata is not None:
            parts.append(_union_mask(dataset, _vrt_of_values(dataset, bands, dataset.name, nodata), bands))
        if MaskFlags.all_valid not in flags:
            parts.append(_union_mask(dataset, dataset.name, bands))
        return rasterio.open(_vrt_of_values(dataset, bands, _vrt_with_mask(dataset, bands, parts), nodata, masked=True))


@dataclass(frozen=True)
class _VrtSource:
    """A source of a band of a VRT.

    Attributes
    ----------
    name
        The raster's file name, or the text of a VRT.
    band
        A band number, or ``mask,1`` for the mask of the first band.
    ignores_overviews
        Whether the raster's overviews are ignored.
    lut
        Lookup table: values and their replacements.
    """

    name: str
    band: str
    ignores_overviews: bool = True
    lut: str | None = None


def _vrt_of_values(
    dataset: rasterio.DatasetReader,
    bands: Sequence[int],
    name: str,
    nodata: float | None = None,
    *,
    masked: bool = False,
    ignores_overviews: bool = True,
) -> str:
    """Return the text of a VRT of some bands of the raster ``name``, in which empty cells have the nodata value.

    The raster ``name`` has the same cells as ``dataset``. The nodata value is ``nodata``, or else each band's own, or else NaN, for
    which integers become floats. If ``masked``, the raster's mask defines the empty cells, otherwise the bands' values do. (GDAL's
    averages leave out empty cells if a VRT band has nodata, but not if it has a mask.)
    """
    root = _vrt_root(dataset)
    for number in bands:
        own_nodata, dtype = dataset.nodatavals[number - 1], dataset.dtypes[number - 1]
        hole = nodata if nodata is not None else own_nodata if own_nodata is not None else np.nan
        if np.isnan(hole) and np.dtype(dtype).kind != "f":
            dtype = "float32" if np.dtype(dtype).itemsize <= 2 else "float64"
        band = ElementTree.SubElement(root, "VRTRasterBand", dataType=_VRT_TYPES[dtype], band=str(number))
        if tags := {key: value for key, value in dataset.tags(number).items() if key in _AXIS_TAGS}:
            metadata = ElementTree.SubElement(band, "Metadata")
            for key, value in tags.items():
                ElementTree.SubElement(metadata, "MDI", key=key).text = value
        elements = {
            "NoDataValue": repr(float(hole)), "UnitType": dataset.units[number - 1] or "",
            "Offset": repr(float(dataset.offsets[number - 1])), "Scale": repr(float(dataset.scales[number - 1])),
        }  # fmt: skip
        for tag, text in elements.items():
            if text:
                ElementTree.SubElement(band, tag).text = text
        skips = not masked and own_nodata is not None and own_nodata != hole
        part = _add_source(band, dataset, _VrtSource(name, str(number), ignores_overviews), is_complex=masked or skips)
        if masked:
            ElementTree.SubElement(part, "UseMaskBand").text = "true"
        elif skips:
            ElementTree.SubElement(part, "NODATA").text = repr(own_nodata)
    return ElementTree.tostring(root, encoding="unicode")


def _union_mask(dataset: rasterio.DatasetReader, name: str, bands: Sequence[int]) -> _VrtSource:
    """Return a VRT source for the mask of the raster ``name``: 0 where the masks of all ``bands`` are 0.

    The raster has the same cells as ``dataset``.
    """
    if len(bands) == 1:
        return _VrtSource(name, f"mask,{bands[0]}")
    root = _vrt_root(dataset)
    _add_derived(root, dataset, "max", [_VrtSource(name, f"mask,{number}") for number in bands])
    return _VrtSource(ElementTree.tostring(root, encoding="unicode"), "1")


def _vrt_with_mask(dataset: rasterio.DatasetReader, bands: Sequence[int], masks: Sequence[_VrtSource]) -> str:
    """Return the text of a VRT of a raster's unchanged bands, whose mask is 0 where any of ``masks`` is 0."""
    root = _vrt_root(dataset)
    for number in bands:
        band = ElementTree.SubElement(root, "VRTRasterBand", dataType=_VRT_TYPES[dataset.dtypes[number - 1]], band=str(number))
        _add_source(band, dataset, _VrtSource(dataset.name, str(number)))
    _add_derived(ElementTree.SubElement(root, "MaskBand"), dataset, "min", masks)
    return ElementTree.tostring(root, encoding="unicode")


def _vrt_root(dataset: rasterio.DatasetReader) -> ElementTree.Element:
    """Return the root element of a VRT with the size, the CRS and the geotransform of a dataset, without bands."""
    rows, cols = dataset.shape
    root = ElementTree.Element("VRTDataset", rasterXSize=str(cols), rasterYSize=str(rows))
    if dataset.crs is not None:
        ElementTree.SubElement(root, "SRS").text = dataset.crs.to_wkt()
    if not dataset.transform.is_identity:
        ElementTree.SubElement(root, "GeoTransform").text = ", ".join(f"{value!r}" for value in dataset.transform.to_gdal())
    return root


def _add_derived(root: ElementTree.Element, dataset: rasterio.DatasetReader, function: str, parts: Sequence[_VrtSource]) -> None:
    """Add a band of bytes to a VRT: a copy of the only part, or a GDAL pixel function (``max``, ``min``) of several parts."""
    band = ElementTree.SubElement(root, "VRTRasterBand", dataType="Byte")
    if len(parts) > 1:
        band.set("subClass", "VRTDerivedRasterBand")
        ElementTree.SubElement(band, "PixelFunctionType").text = function
    for part in parts:
        _add_source(band, dataset, part)


def _add_source(
    band: ElementTree.Element, dataset: rasterio.DatasetReader, part: _VrtSource, is_complex: bool = False
) -> ElementTree.Element:
    """Add a source that covers all of a VRT band, and return its element."""
    rows, cols = dataset.shape
    source = ElementTree.SubElement(band, "ComplexSource" if is_complex or part.lut else "SimpleSource")
    ElementTree.SubElement(source, "SourceFilename", relativeToVRT="0", shared="0").text = part.name
    if part.ignores_overviews:
        options = ElementTree.SubElement(source, "OpenOptions")
        ElementTree.SubElement(options, "OOI", key="OVERVIEW_LEVEL").text = "NONE"
    ElementTree.SubElement(source, "SourceBand").text = part.band
    for tag in ("SrcRect", "DstRect"):
        ElementTree.SubElement(source, tag, xOff="0", yOff="0", xSize=str(cols), ySize=str(rows))
    if part.lut:
        ElementTree.SubElement(source, "LUT").text = part.lut
    return source
