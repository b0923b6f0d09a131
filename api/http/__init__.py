"""The HTTP service: routes, parameters, answers and problems, tile matrices, and the levels that are served.

May import: animations, archive_format, color_scale, errors, exhaustion, file_stamps, film_span, layers, matrices, point, settings,
shadow_parameters, sun_hours_layer, workers.
"""
