"""A service over small levels, with one real render process for all tests of a run, and services with fake processes."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx
import numpy as np
import pytest
import rasterio
import uvicorn
from affine import Affine
from fastapi import FastAPI
from morecantile import tms as matrix_sets
from pmtiles.tile import zxy_to_tileid

from skugga.api.http.server.app import create_app
from skugga.api.http.server.bounded_headers import HeaderLimitProtocol
from skugga.api.http.server.server import Server, log_config
from skugga.api.http.state.service import Service
from skugga.api.request import ProductRequest
from skugga.api.seed.archive import ArchiveMetadata, ShardIndex, write_archive
from skugga.api.settings import Settings
from skugga.api.workers.block_tiles import empty_tile
from skugga.api.workers.piped_process import WorkerTarget
from tests.rasters import ENGINEERING

ZOOM = 12
CORNER = 2144, 1432
"""Column and row of the tile at the corner of four blocks: its north-west corner, near 8.4 degrees east and 47.5 north."""

CELL_M, CELLS = 30.0, 400
SUN = {"azimuth": 250, "altitude": 18}


def hills() -> np.ndarray:
    """Return ridges of some 700 m, (400, 400) float32."""
    row, col = np.mgrid[:CELLS, :CELLS].astype(np.float32)
    return 900 + 350 * np.sin(col / 14) * np.cos(row / 23) + 4 * np.sin(col * row / 97)


def write_level(folder: Path, name: str, crs: str = "EPSG:3857", **keys) -> Path:
    """Write a level file over hills whose centre is the corner of four blocks (in an engineering CRS: at an arbitrary
    place).
    """
    corner = matrix_sets.get("WebMercatorQuad").xy_bounds(*CORNER, ZOOM)
    half = CELLS * CELL_M / 2
    raster = folder / f"{name}.tif"
    with rasterio.open(
        raster, "w", driver="GTiff", width=CELLS, height=CELLS, count=1, dtype="float32", crs=crs,
        transform=Affine(CELL_M, 0, corner.left - half, 0, -CELL_M, corner.top + half),
    ) as dataset:  # fmt: skip
        dataset.write(hills(), 1)
    path = folder / f"{name}.yaml"
    level = {"version": 1, "title": f"The {name}", "attribution": "nobody", "sun": SUN}
    level["terrain"] = {"source": raster.name}
    path.write_text(json.dumps({**level, **keys}), encoding="utf-8")
    return path


PNG = empty_tile(ProductRequest(product="shadow"), "png")


def write_tiles(
    path: Path,
    tiles: Mapping[tuple[int, int, int], bytes],
    format: str = "png",
    bounds: tuple[float, float, float, float] = (8.3, 47.4, 8.6, 47.6),
    **skugga_overrides: str,
) -> Path:
    """Write an archive of tiles by zoom, column and row.

    ``skugga_overrides`` adds to the usual metadata, or replaces it.
    """
    index, shard = ShardIndex.from_tiles({zxy_to_tileid(*zxy): tile for zxy, tile in tiles.items()})
    skugga = {"layer": "color", "format": format, "tms": "WebMercatorQuad", "query": "", "level": "hills"} | skugga_overrides
    zooms = [zoom for zoom, _, _ in tiles]
    metadata = {"name": "Hills", "attribution": "nobody", "skugga": skugga}
    facts = ArchiveMetadata(format, bounds, min(zooms), max(zooms), metadata)  # type: ignore[arg-type]
    write_archive(path, [index], lambda _: shard, facts)
    return path


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the levels."""
    return tmp_path_factory.mktemp("levels")


@pytest.fixture(scope="session")
def hills_level(folder: Path) -> Path:
    """Write the level of most tests."""
    return write_level(folder, "hills")


class Client(httpx.Client):
    """HTTP client of a service, with the service and its server as attributes."""

    service: Service
    server: Server


@contextmanager
def running(app: FastAPI) -> Iterator[Client]:
    """Run a real server of an application on a free port, and yield a client of it."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        log = log_config(app.state.service.settings)
        config = uvicorn.Config(app, log_config=log, http=HeaderLimitProtocol, access_log=False, timeout_graceful_shutdown=3)
        server = Server(config, app.state.service)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        try:
            # The socket listens already, so a request waits until the server accepts it. Tests that patch the service
            # get it after its start: a start that fails would leave its render processes running.
            # Certificates are not read: that takes as long as the service's start.
            with Client(base_url=f"http://127.0.0.1:{port}", timeout=120, verify=False) as client:
                client.service, client.server = app.state.service, server
                client.get("/healthz")
                yield client
        finally:
            server.should_exit = True
            thread.join()


@pytest.fixture(scope="session")
def client(folder: Path, hills_level: Path) -> Iterator[Client]:
    """Run a service with one real render process over three levels and an archive of one tile.

    The levels are ``hills``, ``timed`` (its sun by a time) and ``site`` (in an engineering CRS). The archive is
    ``shadows``.
    """
    timed = write_level(folder, "timed", sun={"time": "2024-06-21T18:00:00+02:00"})
    site = write_level(folder, "site", ENGINEERING)
    archive = write_tiles(folder / "shadows.pmtiles", {(ZOOM, *CORNER): PNG}, layer="shadow")
    with running(create_app(Settings(workers=1), [hills_level, timed, site], archives=[archive])) as client:
        yield client


@pytest.fixture
def serve_with(hills_level: Path) -> Iterator[Callable[..., Client]]:
    """Return ``serve_with(target, **settings)``: it starts a service whose one render process runs ``target``, and returns
    a client.
    """
    with ExitStack() as stack:

        def make(target: WorkerTarget, **settings) -> Client:
            app = create_app(Settings(**{"workers": 1} | settings), [hills_level], target)
            return stack.enter_context(running(app))

        yield make
