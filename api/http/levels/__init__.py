"""Routes that describe levels: their list, pages, TileJSON, legends and plans."""
