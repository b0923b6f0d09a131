"""Tiles and maps of any extent, drawn or from archives."""
