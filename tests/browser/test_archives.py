"""MapLibre shows archives of tiles, through the service or from a plain file server; npm's ``pmtiles`` reads every tile."""

from __future__ import annotations

import base64
import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from skugga.api.http.server.app import create_app
from skugga.api.http.state.archive_file import ArchiveFile
from skugga.api.settings import Settings
from tests.api.conftest import Client, running, write_tiles
from tests.api.seed.pmtiles_checker import check_archive
from tests.browser.conftest import skip_missing
from tests.browser.map_clients import CLIENTS, MapClient, RangeFileServer, pixel_differences, serve_folder
from tests.browser.test_page_lines import CORNER, LIBRARY_BY_NAME

NODE = Path(__file__).parents[2] / ".venv" / "bin" / "node"

READ_TILES_SCRIPT = """
import { readFileSync } from "node:fs";
import { PMTiles } from "pmtiles";
const [path, places] = JSON.parse(readFileSync(0, "utf8"));
const bytes = readFileSync(path);
const archive = new PMTiles({
  getKey: () => path,
  getBytes: async (offset, length) => ({data: bytes.buffer.slice(bytes.byteOffset + offset, bytes.byteOffset + offset + length)}),
});
const tiles = [];
for (const [z, x, y] of places) {
  const found = await archive.getZxy(z, x, y);
  tiles.push(found ? Buffer.from(found.data).toString("base64") : null);
}
console.log(JSON.stringify({header: await archive.getHeader(), metadata: await archive.getMetadata(), tiles}));
"""


@pytest.fixture(scope="module")
def archive(service: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an archive of the service's tiles round the corner, at the corner's zoom and the one before."""
    tiles = {}
    for zoom, column, row in (
        *(
            (CORNER.zoom, CORNER.column + column_offset, CORNER.row + row_offset)
            for column_offset in (-1, 0)
            for row_offset in (-1, 0)
        ),
        (CORNER.zoom - 1, CORNER.column // 2, CORNER.row // 2),
    ):
        tiles[zoom, column, row] = service.get(f"/levels/jacksboro/tiles/{CORNER.tms}/{zoom}/{column}/{row}.png").content
    path = tmp_path_factory.mktemp("archives") / "jacksboro.pmtiles"
    return write_tiles(path, tiles, bounds=tuple(service.get("/levels/jacksboro").json()["bounds"]), level="jacksboro")


@pytest.fixture
def maplibre(map_client: MapClient) -> MapClient:
    """Return a MapLibre map centred on the corner."""
    map_client.open("maplibre")
    map_client.run(LIBRARY_BY_NAME["MapLibre"].create_map_script, lonLat=CORNER.lon_lat, zoom=CORNER.zoom)
    return map_client


@pytest.fixture
def archive_service(archive: Path) -> Iterator[Client]:
    """Yield a service of the archive alone, which has no render worker."""
    with running(create_app(Settings(workers=1), [], archives=[archive])) as client:
        yield client


ADD_ARCHIVE_SCRIPT = """async ({url}) => {
  map.addSource('archive', {type: 'raster', url, tileSize: 256});
  map.addLayer({id: 'archive', type: 'raster', source: 'archive', paint: {'raster-fade-duration': 0}});
  await idle();
  const {attribution, minzoom, maxzoom} = map.getSource('archive');
  return {attribution, minzoom, maxzoom};
}"""


def test_maplibre_shows_an_archive_by_its_tilejson(maplibre: MapClient, service: Client, archive_service: Client):
    maplibre.allow(str(archive_service.base_url))
    source = maplibre.run(ADD_ARCHIVE_SCRIPT, url=f"{archive_service.base_url}/archives/jacksboro/tilejson.json")
    assert source == {"attribution": "nobody", "minzoom": CORNER.zoom - 1, "maxzoom": CORNER.zoom}
    pixels = maplibre.pixels()
    assert pixels.std() > 10, "the map is not of one colour"
    assert pixel_differences(pixels, CORNER.tiles(service)).max() == 0
    assert archive_service.service.pool.ready_pids == set()


def test_pmtiles_protocol_reads_a_plain_file(maplibre: MapClient, service: Client, archive: Path):
    """The plugin requests byte ranges from a server that knows nothing of tiles."""
    with serve_folder(archive.parent, RangeFileServer) as address:
        maplibre.allow(address)
        maplibre.page.add_script_tag(url="node_modules/pmtiles/dist/pmtiles.js")
        maplibre.run(
            """() => {
              maplibregl.addProtocol('pmtiles', new pmtiles.Protocol({metadata: true}).tile);
            }"""
        )
        source = maplibre.run(ADD_ARCHIVE_SCRIPT, url=f"pmtiles://{address}/{archive.name}")
        assert (source["minzoom"], source["maxzoom"]) == (CORNER.zoom - 1, CORNER.zoom)
        pixels = maplibre.pixels()
    assert pixels.std() > 10, "the map is not of one colour"
    assert pixel_differences(pixels, CORNER.tiles(service)).max() == 0


def test_npm_pmtiles_reads_every_tile(archive: Path, tmp_path: Path):
    """The second archive has leaf directories and runs; the reader finds no tile where the archive has none."""
    if not (CLIENTS / "node_modules" / "pmtiles").is_dir():
        skip_missing("there is no pmtiles: 'make test-browser' installs it")
    many = tmp_path / "many.pmtiles"
    ocean, land = (archive_tile for archive_tile in list(check_archive(archive).tiles.values())[:2])
    write_tiles(many, {(8, x, y): ocean[:100] if x % 5 else land[: 50 + (x * y) % 999] for x in range(256) for y in range(255)})
    assert ArchiveFile(many).header["leaf_directory_length"] > 0
    for path in (archive, many):
        read = check_archive(path)
        lacking = [(8, x, 255) for x in range(0, 256, 50)] if path == many else [(3, 0, 0)]
        places = [*read.tiles, *lacking]
        process = subprocess.run(
            [NODE, "--input-type=module", "-e", READ_TILES_SCRIPT], cwd=CLIENTS, input=json.dumps([str(path), places]),
            capture_output=True, text=True, check=True, timeout=300,
        )  # fmt: skip
        answer = json.loads(process.stdout)
        tiles = [None if encoded is None else base64.b64decode(encoded) for encoded in answer["tiles"]]
        assert tiles == [*read.tiles.values(), *[None] * len(lacking)]
        assert answer["metadata"] == read.metadata
        header = answer["header"]
        assert (header["minZoom"], header["maxZoom"], header["clustered"]) == (
            read.header["min_zoom"],
            read.header["max_zoom"],
            True,
        )
        assert [header[name] for name in ("numAddressedTiles", "numTileEntries", "numTileContents")] == [
            read.header[name] for name in ("addressed", "entries", "contents")
        ]
