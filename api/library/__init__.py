"""Skugga from Python: arrays, open levels, xarray's accessor and notebooks. ``skugga`` re-exports what is public.

May import: catalogue, device_calibration, film_span, layers, point, raster_file, shade, shade_layers, sun_hours.
"""
