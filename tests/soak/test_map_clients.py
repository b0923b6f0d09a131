"""Map clients beside each other and beside a greedy one: no tile of a map is refused, and each client gets its share.

A map client does not ask again for a tile that was refused, so a refusal is a hole in its map.
"""

from __future__ import annotations

import asyncio
import itertools
from pathlib import Path

import pytest

from tests.api.conftest import CORNER, ZOOM
from tests.soak.clients import Answers, Connection
from tests.soak.service import service

pytestmark = pytest.mark.soak

TILES_PER_CLIENT = 115
"""Tiles of a client's maps: 5 x 5 at one zoom, then 10 x 9 at the next."""

CONCURRENCY = 8
"""Requests that a map client sends at a time."""

GREEDY_CONCURRENCY = 200


def map_paths(client: int) -> list[str]:
    """Return the paths of a map's tiles under a sun that no other client asks for."""
    sun = f"azimuth={20 + 37 * client % 360}&altitude={12 + client}"
    paths = []
    for zoom, columns, rows in ((ZOOM + 2, 5, 5), (ZOOM + 3, 10, 9)):
        left, top = (CORNER[0] << zoom - ZOOM) - columns // 2, (CORNER[1] << zoom - ZOOM) - rows // 2
        tiles = itertools.product(range(left, left + columns), range(top, top + rows))
        paths += [f"/levels/hills/tiles/WebMercatorQuad/{zoom}/{x}/{y}.png?{sun}" for x, y in tiles]
    assert len(paths) == TILES_PER_CLIENT
    return paths


def greedy_paths() -> list[str]:
    """Return paths of expensive pictures, all different: hours of sun, masks with 512 pixels as TIFF, and snapshots."""
    paths = []
    for n in range(2000):
        zoom, x, y = ZOOM + n % 4, CORNER[0] << n % 4, CORNER[1] << n % 4
        sun = f"azimuth={n % 360}&altitude={3 + n / 40:.3f}"
        paths += [
            f"/levels/hills/tiles/WebMercatorQuad/{zoom}/{x}/{y}.png?layer=sunhours&date=2024-{1 + n % 12:02}-{1 + n % 28:02}",
            f"/levels/hills/tiles/WebMercatorQuad/{zoom}/{x}/{y}@2x.tif?layer=mask&{sun}",
            f"/levels/hills/snapshot.png?eye=8.43,47.5,300&target=8.45,47.51,0&size=1600x1200&{sun}",
        ]
    return paths


async def send_all(port: int, address: str, paths: list[str], concurrency: int, answers: Answers) -> None:
    """Send requests for ``paths`` from one address, some at a time. None is sent twice: map clients do not retry."""
    remaining = iter(paths)

    async def send_remaining() -> None:
        connection = Connection(port, address)
        try:
            for path in remaining:
                await connection.get(path, answers)
                if answers.statuses[-1] != 200:
                    await asyncio.sleep(1.0)
        finally:
            connection.close()

    await asyncio.gather(*(send_remaining() for _ in range(concurrency)))


@pytest.mark.parametrize(("clients", "has_greedy"), [(1, False), (8, False), (7, True)])
def test_no_tile_of_a_map_is_refused(clients: int, has_greedy: bool, tmp_path: Path, capsys: pytest.CaptureFixture):
    """One render process. The level is cold: nothing of it was drawn since the service started."""
    maps, greedy = [Answers() for _ in range(clients)], Answers()
    paths = greedy_paths() if has_greedy else []

    async def run(port: int) -> None:
        greedy_task = asyncio.create_task(send_all(port, "127.0.0.99", paths, GREEDY_CONCURRENCY, greedy))
        await asyncio.sleep(3.0 if has_greedy else 0.0)  # the pictures of the greedy client are in the queue first
        await asyncio.gather(*(send_all(port, f"127.0.0.{2 + n}", map_paths(n), CONCURRENCY, maps[n]) for n in range(clients)))
        greedy_task.cancel()
        await asyncio.gather(greedy_task, return_exceptions=True)

    with service(tmp_path, SKUGGA_WORKERS="1") as (port, _, _):
        asyncio.run(run(port))
    with capsys.disabled():
        print()
        for n, answers in enumerate(maps):
            print(answers.summary(f"map client {n}") + f", longest {max(answers.seconds):.1f} s")
        if has_greedy:
            print(greedy.summary("greedy client"))
    assert [answers.count(200) for answers in maps] == [TILES_PER_CLIENT] * clients
    half_s = [answers.ms(0.5) / 1000 for answers in maps]
    assert max(half_s) < 2.0 * min(half_s) + 0.5, "the median times of all clients are similar, so they got equal shares"
    if has_greedy:
        assert greedy.count(503) > 0 and set(greedy.statuses) <= {200, 503, 504}
        assert greedy.retry_after_count >= greedy.count(503)
