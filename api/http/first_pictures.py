"""The pictures of served levels that render processes draw on a first start, so that all that pictures need is compiled."""

from __future__ import annotations

from api.http.served_levels import DEFAULT_MATRIX_SET, ServedLevel, ServedLevels
from api.matrices import OVERZOOMS, matrix_set_of
from api.workers.block_tiles import place_in_block
from api.workers.jobs import BlockJob, PictureRequest, ServedPictures, SnapshotJob
from terrain.level.parts import SunSpec

SUNS = SunSpec(azimuth=350.0, altitude=35.0), SunSpec(azimuth=80.0, altitude=5.0)
"""Along rows and along columns, high and low: loops differ. The level's own has its turn, too."""


def served_pictures(levels: ServedLevels) -> tuple[ServedPictures, ...]:
    """What to draw of each level: tiles whose pixels are coarse, of the data's size and magnified, and all views."""
    return tuple(ServedPictures(level.key, (*_blocks(level), *_views(level))) for level in levels.known())


def _blocks(level: ServedLevel) -> list[BlockJob]:
    zooms = level.zooms.get(DEFAULT_MATRIX_SET)
    if zooms is None or level.bounds is None:
        return []
    west, south, east, north = level.bounds
    jobs = []
    for zoom in dict.fromkeys((max(zooms.last - OVERZOOMS, zooms.first), zooms.first, zooms.last)):
        tile = matrix_set_of(DEFAULT_MATRIX_SET).tile((west + east) / 2.0, (south + north) / 2.0, zoom)
        (x, y), _ = place_in_block(tile.x, tile.y, 1)
        for request in _requests(level):
            jobs.append(BlockJob(level=level.key, matrix_set=DEFAULT_MATRIX_SET, zoom=zoom, block_x=x, block_y=y, request=request))
    return jobs


def _views(level: ServedLevel) -> list[SnapshotJob]:
    """In their own size: the plan of a smaller picture may be another."""
    return [
        SnapshotJob(level=level.key, view=name, layer="color", format="png")
        for name, size in level.view_sizes.items()
        if size is not None
    ]


def _requests(level: ServedLevel) -> list[PictureRequest]:
    own = PictureRequest()
    return [own] if level.loaded.level.sun == "none" else [own, *(PictureRequest(sun=sun) for sun in SUNS)]
