"""The Python API: arrays, open levels, xarray's accessor and notebooks. ``skugga`` re-exports its public names."""
