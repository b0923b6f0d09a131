"""Find the files and addresses that a data file refers to.

- A virtual raster (VRT) refers to its parts.
- A model refers to its materials and textures.
- The description of a web service refers to the service.
- GeoJSON may refer to a linked CRS.

The references are found in the text of the files, without GDAL. The named files need not exist.
"""

from __future__ import annotations

import json
import mmap
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

VRT_ROOT_ELEMENTS = ("VRTDataset", "OGRVRTDataSource")
"""Root elements of virtual rasters and virtual vector files."""

MODEL_FILE_SUFFIXES = (".obj", ".mtl", ".ply", ".gltf", ".glb")
"""Suffixes of model files and of their materials."""

MAX_XML_BYTES = 64 * 2**20
"""Maximum size of a virtual raster's text: some 100,000 parts."""

MAX_LINKED_FILES = 200_000
"""Maximum number of files that a file refers to, directly or indirectly."""

VECTOR_XML_ROOT_ELEMENTS = ("kml", "FeatureCollection", "gpx", "osm", "osmChange", "svg", "feed", "rss", "JCSDataFile")
"""Root elements of XML vector formats, which contain their features. Other XML may describe a network service."""

APPENDED_SIDECAR_SUFFIXES = (".aux.xml", ".ovr", ".msk", ".vat.dbf")
"""Suffixes of sidecar files that GDAL appends to a raster's name: statistics and georeferencing, overviews, masks."""

REPLACING_SIDECAR_SUFFIXES = (".aux", ".tfw", ".wld", ".jgw", ".pgw", ".prj", ".hdr", ".dbf", ".shx", ".cpg", ".qpj", ".bin")
"""Suffixes of sidecar files that replace a file's suffix: world files, coordinate systems, parts of shapefiles and of glTF."""

_GEOJSON_SUFFIXES = (".geojson", ".json", ".geojsonl", ".geojsons", ".topojson", ".jsonfg")
_FILE_NAME_ELEMENTS = (
    "SourceFilename",
    "SourceDataset",
    "SrcDataSource",
    "SourceVRTFilename",
    "DataSource",
    "Dataset",
    "MaskSourceFile",
)
_FILE_NAME_METADATA_ITEMS = ("X_DATASET", "Y_DATASET", "RPC_DEM", "RPC_DEM_FILE", "OVERVIEW_FILE", "DEM")
_MODEL_LINK = re.compile(rb"^[ \t]*(?:mtllib|comment[ \t]+TextureFile)[ \t]+([^\r\n]+)", re.MULTILINE)
_GDAL_PIPELINE_KEY = b"gdal_streamed_alg"  # key of a file that GDAL runs as a command
_LINKED_CRS = re.compile(rb"""(?i)"link"|\\u00[0-7]""")
_ADDRESS = re.compile(r"""[A-Za-z][\w+.-]*://[^\s<>"']+|/vsi\w+/[^\s<>"']+""")
_SOURCE_IN_SQL = re.compile(r"""['"]([^'"]+)['"]\s*\.""")  # FROM 'FILE'.table
_TEXTURE_LINK = re.compile(rb"^[ \t]*(?:map_\w+|bump|disp|decal|refl|norm)[ \t]+([^\r\n]+)", re.MULTILINE | re.IGNORECASE)


def is_remote(source: str) -> bool:
    """Return whether a source is an address (``://``) or a path of GDAL's virtual file systems (``/vsi``), not an ordinary path."""
    return "://" in source or source.startswith("/vsi")


def sidecar_files(path: Path) -> list[Path]:
    """Return the paths of all possible sidecar files of a file, whether they exist or not."""
    stem = path.with_suffix("")
    added = [path.with_name(path.name + ending) for ending in APPENDED_SIDECAR_SUFFIXES]
    return added + [stem.with_name(stem.name + ending) for ending in REPLACING_SIDECAR_SUFFIXES]


def linked_files(source: str) -> tuple[str, ...]:
    """Return all files that a file refers to, directly or indirectly, as paths or addresses, in breadth-first order.

    The result is empty for an unreadable file. Code that opens the file later raises the error.
    """
    links: dict[str, None] = {}
    queue = [source]
    while queue and len(links) < MAX_LINKED_FILES:
        current = queue.pop(0)
        for link in _direct_links(current):
            if link != source and link not in links:
                links[link] = None
                queue.append(link)
    return tuple(links)


def xml_root_name(head: bytes) -> str | None:
    """Return the name of the root element of an XML text from its first bytes; ``None`` if it is not XML."""
    text = head.decode("utf-8", "replace").lstrip("\ufeff").lstrip()
    if not text.startswith("<"):
        return None
    text = re.sub(r"<!--.*?(-->|\Z)|<\?.*?(\?>|\Z)|<!DOCTYPE[^>\[]*(\[.*?\])?\s*(>|\Z)", "", text, flags=re.DOTALL).lstrip()
    root = re.match(r"<(?:[\w.-]+:)?([\w.-]+)", text)
    return root[1] if root else ""


def vrt_elements(path: Path) -> ElementTree.Element | None:
    """Return the root element of a virtual raster or vector file; ``None`` for any other file and for an unreadable one."""
    try:
        with path.open("rb") as file:
            if xml_root_name(file.read(4096)) not in VRT_ROOT_ELEMENTS or path.stat().st_size > MAX_XML_BYTES:
                return None
        return ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError):
        return None


def _direct_links(source: str) -> Iterator[str]:
    """Yield the files that a file refers to itself, as absolute paths or addresses; none for an unreadable file."""
    path = Path(source)
    if is_remote(source) or not path.is_file():
        return
    try:
        names = [*_file_names_in(path)]
    except (OSError, ValueError):
        return
    for name, is_relative in names:
        if name.startswith("data:") or "\0" in name:
            continue
        yield name if is_remote(name) or name.startswith(("/", "<")) or not is_relative else str((path.parent / name).resolve())
        if path.suffix.lower() in MODEL_FILE_SUFFIXES and (sidecar := path.parent / Path(name).name).is_file():
            yield str(sidecar.resolve())  # readers of models look in their own folder, too


def _file_names_in(path: Path) -> Iterator[tuple[str, bool]]:
    """Yield the file names in a file, each with a bool: whether the name is relative to the file's folder."""
    suffix = path.suffix.lower()
    if suffix in (".obj", ".ply"):
        yield from ((name, True) for name in _link_matches(_MODEL_LINK, path))
    elif suffix == ".mtl":
        yield from ((name, True) for name in _link_matches(_TEXTURE_LINK, path))
    elif suffix in (".gltf", ".glb"):
        yield from ((uri, True) for uri in _gltf_addresses(path))
    elif suffix in _GEOJSON_SUFFIXES:
        yield from ((address, True) for address in _linked_crs(path))
    elif (root := vrt_elements(path)) is not None:
        for element in root.iter():
            text = (element.text or "").strip()
            if element.tag == "SrcSQL":
                yield from ((source, True) for source in _SOURCE_IN_SQL.findall(text))
            elif text and (element.tag in _FILE_NAME_ELEMENTS or element.get("key") in _FILE_NAME_METADATA_ITEMS):
                yield text, element.get("relativeToVRT", element.get("relativetoVRT", "0")) == "1" or not text.startswith("/")
    else:
        yield from ((address, False) for address in _service_addresses(path))


def _service_addresses(path: Path) -> Iterator[str]:
    """Yield the addresses in a file if it may describe a web service: XML that is none of ``VECTOR_XML_ROOT_ELEMENTS``."""
    with path.open("rb") as file:
        root = xml_root_name(head := file.read(4096))
        if root is None or root in VECTOR_XML_ROOT_ELEMENTS:
            return
        text = head + file.read(MAX_XML_BYTES)
    yield from _ADDRESS.findall(text.decode("utf-8", "replace"))


def _linked_crs(path: Path) -> Iterator[str]:
    """Yield the addresses of linked CRSs in any object of a GeoJSON file (GeoJSON 2008, section 3.2).

    If the file is a pipeline that GDAL would run, all addresses in it are yielded, too.
    """
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
        if text.find(_GDAL_PIPELINE_KEY) >= 0:
            yield from _ADDRESS.findall(text[:].decode("utf-8", "replace"))
        if not _LINKED_CRS.search(text):
            return
        addresses: list[str] = []

        def collect(pairs: list[tuple[str, object]]) -> dict[str, object]:
            json_object = dict(pairs)
            crs = json_object.get("crs")
            if isinstance(crs, dict) and str(crs.get("type")).lower() == "link":
                addresses.append(str((crs.get("properties") or {}).get("href")))
            return json_object

        json.loads(text[:].decode("utf-8-sig"), object_pairs_hook=collect)
    yield from addresses


def _link_matches(pattern: re.Pattern[bytes], path: Path) -> Iterator[str]:
    """Yield the file names that the first group of ``pattern`` matches in a file."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
        for match in pattern.finditer(text):
            link = match[1].decode("utf-8", "replace").strip()
            yield link
            if pattern is _TEXTURE_LINK and " " in link:  # options may precede the name
                yield link.split()[-1]


def _gltf_addresses(path: Path) -> Iterator[str]:
    """Yield the addresses of the buffers and images of a glTF file."""
    for part in ("buffers", "images"):
        for item in gltf_array(path, part):
            if isinstance(item.get("uri"), str):
                yield item["uri"]


def gltf_array(path: Path, array_name: str) -> list[dict[str, Any]]:
    """Return one array of a glTF file, such as ``buffers``, ``accessors`` or ``images``, as JSON objects.

    Raises ``OSError`` if the file cannot be read, and ``ValueError`` if it is not JSON.
    """
    with path.open("rb") as file:
        head = file.read(20)
        if head[:4] == b"glTF":
            text = file.read(min(int.from_bytes(head[12:16], "little"), MAX_XML_BYTES))
        else:
            text = head + file.read(MAX_XML_BYTES)
    data = json.loads(text)
    items = data.get(array_name) if isinstance(data, dict) else None
    return [item for item in items if isinstance(item, dict)] if isinstance(items, list) else []
