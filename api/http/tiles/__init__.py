"""Tiles and maps of any extent, rendered or from archives."""
