"""Skugga from Python: arrays, open levels, xarray's accessor and notebooks. ``skugga`` re-exports what is public."""
