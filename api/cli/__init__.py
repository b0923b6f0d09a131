"""The command line: `main` holds the commands, the others what single commands do.

May import: catalogue, device_calibration, errors, http, layers, map_probing, overviews, point, raster_file, report, settings,
shade, shadow_parameters, stac_item, sun_hours.
"""
