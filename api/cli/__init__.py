"""The command line: `lazy_commands` lists the commands, `commands` has a module for each, the others do their work.

May import: catalogue, device_calibration, errors, file_stamps, film_files, film_span, http, layers, level_summary, map_probing,
matrices, overviews, picture_cost, point, raster_file, report, seed, settings, shade, shade_layers, shadow_parameters, stac_item,
sun_hours, sun_quantities, workers.
"""
