"""Irradiation: the energy of sunlight and skylight on ground over a period, with the terrain in the way."""
