"""Which further files and addresses a data file leads to: a virtual raster to its parts, a model to its materials and pictures,
the description of a web service to that, GeoJSON to a CRS that it links to.

Only what a file's own text says is looked at; the files themselves need not be there.
"""

from __future__ import annotations

import json
import mmap
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

VRT_ROOTS = ("VRTDataset", "OGRVRTDataSource")
"""Root elements of virtual rasters and virtual vector files."""

MODEL_FILE_SUFFIXES = (".obj", ".mtl", ".ply", ".gltf", ".glb")
"""Of models, and of what they are made of."""

MOST_XML_BYTES = 64 * 2**20
"""Of a virtual raster's text: some 100,000 parts."""

MOST_LINKED_FILES = 200_000
"""Files that one leads to, directly or by others."""

DATA_ROOTS = ("kml", "FeatureCollection", "gpx", "osm", "osmChange", "svg", "feed", "rss", "JCSDataFile")
"""Root elements of vector files in XML that hold their features themselves; any other may be a description of a service."""

ADDED_ENDINGS = (".aux.xml", ".ovr", ".msk", ".vat.dbf")
"""Endings that GDAL adds to a raster's name: statistics and georeference, overviews, masks."""

OTHER_ENDINGS = (".aux", ".tfw", ".wld", ".jgw", ".pgw", ".prj", ".hdr", ".dbf", ".shx", ".cpg", ".qpj", ".bin")
"""Endings that take the place of a file's own: world files, coordinate systems, parts of shapefiles and of glTF."""

_GEOJSON_SUFFIXES = (".geojson", ".json", ".geojsonl", ".geojsons", ".topojson", ".jsonfg")
_FILE_ELEMENTS = (
    "SourceFilename",
    "SourceDataset",
    "SrcDataSource",
    "SourceVRTFilename",
    "DataSource",
    "Dataset",
    "MaskSourceFile",
)
_FILE_ITEMS = ("X_DATASET", "Y_DATASET", "RPC_DEM", "RPC_DEM_FILE", "OVERVIEW_FILE", "DEM")
_MODELS_TEXT = re.compile(rb"^[ \t]*(?:mtllib|comment[ \t]+TextureFile)[ \t]+([^\r\n]+)", re.MULTILINE)
_PIPELINE = b"gdal_streamed_alg"  # a file that GDAL takes for a command
_LINKED_CRS = re.compile(rb"""(?i)"link"|\\u00[0-7]""")
_ADDRESS = re.compile(r"""[A-Za-z][\w+.-]*://[^\s<>"']+|/vsi\w+/[^\s<>"']+""")
_SOURCE_IN_SQL = re.compile(r"""['"]([^'"]+)['"]\s*\.""")  # FROM 'FILE'.table
_MATERIAL_TEXT = re.compile(rb"^[ \t]*(?:map_\w+|bump|disp|decal|refl|norm)[ \t]+([^\r\n]+)", re.MULTILINE | re.IGNORECASE)


def is_remote(source: str) -> bool:
    """Whether a source is none of the file system's: an address, or a path of GDAL's virtual file systems."""
    return "://" in source or source.startswith("/vsi")


def files_beside(path: Path) -> list[Path]:
    """What would be read with a file, if it lay beside it."""
    stem = path.with_suffix("")
    added = [path.with_name(path.name + ending) for ending in ADDED_ENDINGS]
    return added + [stem.with_name(stem.name + ending) for ending in OTHER_ENDINGS]


def linked_files(source: str) -> tuple[str, ...]:
    """All files that a file leads to, directly or by others, as paths or addresses, in the order in which they are met.

    Of a file that cannot be read, none: whoever opens it says why.
    """
    found: dict[str, None] = {}
    waiting = [source]
    while waiting and len(found) < MOST_LINKED_FILES:
        current = waiting.pop(0)
        for link in _direct(current):
            if link != source and link not in found:
                found[link] = None
                waiting.append(link)
    return tuple(found)


def xml_head(head: bytes) -> str | None:
    """The name of the root element of a text that begins so; ``None`` where it is no XML."""
    text = head.decode("utf-8", "replace").lstrip("\ufeff").lstrip()
    if not text.startswith("<"):
        return None
    text = re.sub(r"<!--.*?(-->|\Z)|<\?.*?(\?>|\Z)|<!DOCTYPE[^>\[]*(\[.*?\])?\s*(>|\Z)", "", text, flags=re.DOTALL).lstrip()
    root = re.match(r"<(?:[\w.-]+:)?([\w.-]+)", text)
    return root[1] if root else ""


def vrt_elements(path: Path) -> ElementTree.Element | None:
    """The text of a virtual raster or vector file; ``None`` for any other file, and for one that cannot be read."""
    try:
        with path.open("rb") as file:
            if xml_head(file.read(4096)) not in VRT_ROOTS or path.stat().st_size > MOST_XML_BYTES:
                return None
        return ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError):
        return None


def _direct(source: str) -> Iterator[str]:
    path = Path(source)
    if is_remote(source) or not path.is_file():
        return
    try:
        names = [*_names_in(path)]
    except (OSError, ValueError):
        return
    for name, from_folder in names:
        if name.startswith("data:") or "\0" in name:
            continue
        yield name if is_remote(name) or name.startswith(("/", "<")) or not from_folder else str((path.parent / name).resolve())
        if path.suffix.lower() in MODEL_FILE_SUFFIXES and (beside := path.parent / Path(name).name).is_file():
            yield str(beside.resolve())  # where models' readers look, too


def _names_in(path: Path) -> Iterator[tuple[str, bool]]:
    """The names of files that a file states, each with whether it is one relative to its folder."""
    suffix = path.suffix.lower()
    if suffix in (".obj", ".ply"):
        yield from ((name, True) for name in _matches(_MODELS_TEXT, path))
    elif suffix == ".mtl":
        yield from ((name, True) for name in _matches(_MATERIAL_TEXT, path))
    elif suffix in (".gltf", ".glb"):
        yield from ((uri, True) for uri in _gltf_addresses(path))
    elif suffix in _GEOJSON_SUFFIXES:
        yield from ((address, True) for address in _linked_crs(path))
    elif (root := vrt_elements(path)) is not None:
        for element in root.iter():
            stated = (element.text or "").strip()
            if element.tag == "SrcSQL":
                yield from ((source, True) for source in _SOURCE_IN_SQL.findall(stated))
            elif stated and (element.tag in _FILE_ELEMENTS or element.get("key") in _FILE_ITEMS):
                yield stated, element.get("relativeToVRT", element.get("relativetoVRT", "0")) == "1" or not stated.startswith("/")
    else:
        yield from ((address, False) for address in _service_addresses(path))


def _service_addresses(path: Path) -> Iterator[str]:
    """Addresses in a description of a web service: in XML that is none of the vector formats."""
    with path.open("rb") as file:
        root = xml_head(head := file.read(4096))
        if root is None or root in DATA_ROOTS:
            return
        text = head + file.read(MOST_XML_BYTES)
    yield from _ADDRESS.findall(text.decode("utf-8", "replace"))


def _linked_crs(path: Path) -> Iterator[str]:
    """Addresses of linked CRS in GeoJSON (GeoJSON 2008, section 3.2), whichever object states them."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
        if text.find(_PIPELINE) >= 0:
            yield from _ADDRESS.findall(text[:].decode("utf-8", "replace"))
        if not _LINKED_CRS.search(text):
            return
        found: list[str] = []

        def look(pairs: list[tuple[str, object]]) -> dict[str, object]:
            each = dict(pairs)
            crs = each.get("crs")
            if isinstance(crs, dict) and str(crs.get("type")).lower() == "link":
                found.append(str((crs.get("properties") or {}).get("href")))
            return each

        json.loads(text[:].decode("utf-8-sig"), object_pairs_hook=look)
    yield from found


def _matches(pattern: re.Pattern[bytes], path: Path) -> Iterator[str]:
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
        for match in pattern.finditer(text):
            stated = match[1].decode("utf-8", "replace").strip()
            yield stated
            if pattern is _MATERIAL_TEXT and " " in stated:  # options may come before the name
                yield stated.split()[-1]


def _gltf_addresses(path: Path) -> Iterator[str]:
    for part in ("buffers", "images"):
        for each in gltf_parts(path, part):
            if isinstance(each.get("uri"), str):
                yield each["uri"]


def gltf_parts(path: Path, part: str) -> list[dict[str, Any]]:
    """What a glTF file states of its ``buffers``, ``accessors`` or ``images``. Raises ``OSError`` and ``ValueError``."""
    with path.open("rb") as file:
        head = file.read(20)
        if head[:4] == b"glTF":
            text = file.read(min(int.from_bytes(head[12:16], "little"), MOST_XML_BYTES))
        else:
            text = head + file.read(MOST_XML_BYTES)
    data = json.loads(text)
    stated = data.get(part) if isinstance(data, dict) else None
    return [each for each in stated if isinstance(each, dict)] if isinstance(stated, list) else []
