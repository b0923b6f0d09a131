"""Constants shared by readers and writers of PMTiles archives: https://github.com/protomaps/PMTiles/blob/main/spec/v3/spec.md"""

from __future__ import annotations

from pmtiles.tile import TileType

PMTILES_HEADER_BYTES = 127

FORMAT_BY_TILE_TYPE = {TileType.PNG: "png", TileType.JPEG: "jpg", TileType.WEBP: "webp", TileType.AVIF: "avif"}
"""URL suffix by the tile type of the header."""

TILE_TYPE_BY_FORMAT = {format: tile_type for tile_type, format in FORMAT_BY_TILE_TYPE.items()}

ARCHIVED_MEDIA_TYPES = {"png": "image/png", "jpg": "image/jpeg", "webp": "image/webp", "avif": "image/avif"}
"""Media type of an archive's tiles by their URL suffix."""
