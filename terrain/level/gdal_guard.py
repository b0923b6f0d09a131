"""What GDAL is kept from, and how much it keeps, whoever asks it: by its own settings, in the environment of this process and of
those that it starts.

Both GDALs of a process (rasterio and pyogrio bring one each) read the environment, drivers' names when they are first used.
"""

from __future__ import annotations

import os

REMOTE_DRIVERS = (
    "ADBC", "AmigoCloud", "Carto", "CSW", "DAAS", "EEDA", "EEDAI", "Elasticsearch", "GDALG", "GPSBabel", "HTTP", "KMLSUPEROVERLAY",
    "MRF", "NGW", "OAPIF", "OGCAPI", "PLMOSAIC", "PLSCENES", "PostGISRaster", "PostgreSQL", "STACIT", "STACTA", "WCS", "WFS",
    "WMS", "WMTS",
)  # fmt: skip
"""Drivers by which a file leads to a service, or a program is run."""

NO_CODE = {"GDAL_VRT_ENABLE_PYTHON": "NO"}

NO_REMOTE_READS = {
    "GDAL_SKIP": ",".join(REMOTE_DRIVERS),
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "/vsicurl/none",  # the only file that its virtual file systems may ask for
    "GDAL_HTTP_PROXY": "127.0.0.1:9",  # the discard port: where drivers ask the web by themselves, nobody answers
    "GDAL_HTTP_MAX_RETRY": "0",
    "GML_DOWNLOAD_SCHEMA": "NO",
    "PROJ_NETWORK": "OFF",
}
"""Settings under which nothing is read from other machines, whatever a file leads to."""


CACHE_LIMITS = {
    "GDAL_CACHEMAX": "128",  # MB of cells as read, each process; GDAL's own 5 % of the machine's memory are gigabytes
    "GDAL_MAX_DATASET_POOL_SIZE": "100",  # parts of virtual rasters that are open: each is a file descriptor
    "GDAL_MAX_DATASET_POOL_RAM_USAGE": "128MB",  # and what they take, of which GDAL's own limit is a quarter of the machine's
}
"""What GDAL may keep in a process, where the environment does not say it."""


def cap_caches() -> None:
    """Bound what GDAL keeps in this process and in those that it starts from now on; what the environment says goes before. To be
    called before the first raster is opened.
    """
    for name, value in CACHE_LIMITS.items():
        os.environ.setdefault(name, value)


def forbid_code() -> None:
    """Virtual rasters run no Python."""
    os.environ.update(NO_CODE)


def forbid_remote_reads() -> None:
    """Nothing is read from other machines. To be called before the first file is opened."""
    os.environ.update(NO_REMOTE_READS)
    # Where GDAL tells of drivers to skip that it does not have. What a read fails by is raised, not written there.
    os.environ.setdefault("CPL_LOG", os.devnull)
