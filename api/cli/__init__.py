"""The command line: `main` holds the commands, the others what single commands do.

May import: catalogue, device_calibration, errors, file_stamps, film_files, film_span, http, layers, map_probing, matrices,
overviews, point, raster_file, report, seed, settings, shade, shadow_parameters, stac_item, sun_hours, workers.
"""
