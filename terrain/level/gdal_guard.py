"""Security and cache settings of GDAL, as environment variables of this process and of its child processes.

A process has two copies of GDAL, one from rasterio and one from pyogrio. Both read the environment variables. They read
``GDAL_SKIP``, the names of the drivers that GDAL must not load, when they are first used.
"""

from __future__ import annotations

import os

REMOTE_DRIVERS = (
    "ADBC", "AmigoCloud", "Carto", "CSW", "DAAS", "EEDA", "EEDAI", "Elasticsearch", "GDALG", "GPSBabel", "HTTP", "KMLSUPEROVERLAY",
    "MRF", "NGW", "OAPIF", "OGCAPI", "PLMOSAIC", "PLSCENES", "PostGISRaster", "PostgreSQL", "STACIT", "STACTA", "WCS", "WFS",
    "WMS", "WMTS",
)  # fmt: skip
"""GDAL drivers with which a file can refer to a network service or run a program."""

PYTHON_CODE_BLOCK_SETTINGS = {"GDAL_VRT_ENABLE_PYTHON": "NO"}

SETTINGS_AGAINST_REMOTE_READS = {
    "GDAL_SKIP": ",".join(REMOTE_DRIVERS),
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "/vsicurl/none",  # the only file that GDAL's network file systems may request
    "GDAL_HTTP_PROXY": "127.0.0.1:9",  # the discard port: requests that drivers send by themselves fail
    "GDAL_HTTP_MAX_RETRY": "0",
    "GML_DOWNLOAD_SCHEMA": "NO",
    "PROJ_NETWORK": "OFF",
}
"""GDAL and PROJ settings that block all network reads, whatever a file refers to."""


CACHE_LIMIT_SETTINGS = {
    "GDAL_CACHEMAX": "128",  # MB of raster blocks per process; GDAL's default of 5 % of RAM is gigabytes
    "GDAL_MAX_DATASET_POOL_SIZE": "100",  # open parts of virtual rasters: each takes a file descriptor
    "GDAL_MAX_DATASET_POOL_RAM_USAGE": "128MB",  # memory of these parts; GDAL's default is a quarter of RAM
}
"""Limits of GDAL's caches in a process, unless the environment sets them."""


def limit_gdal_caches() -> None:
    """Limit GDAL's caches in this process and in child processes that it starts later.

    Variables that are already set keep their values. Call this before the first raster is opened.
    """
    for name, value in CACHE_LIMIT_SETTINGS.items():
        os.environ.setdefault(name, value)


def forbid_python_code() -> None:
    """Forbid Python code in virtual rasters."""
    os.environ.update(PYTHON_CODE_BLOCK_SETTINGS)


def forbid_remote_reads() -> None:
    """Block network reads of GDAL and PROJ. Call this before the first file is opened."""
    os.environ.update(SETTINGS_AGAINST_REMOTE_READS)
    # GDAL logs the drivers in GDAL_SKIP that it does not have. Errors of reads are raised, not logged there.
    os.environ.setdefault("CPL_LOG", os.devnull)
