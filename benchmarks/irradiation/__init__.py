"""Irradiation of whole rasters against truth, and by other tools."""
