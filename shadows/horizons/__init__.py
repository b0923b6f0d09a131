"""Horizons of whole rasters: the horizon angle of every node towards many azimuths, and the sky view factors that follow."""
