"""What is said of levels: their list, pages, TileJSON and plans."""
