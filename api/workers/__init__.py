"""Render processes: the pool before them, the jobs they are sent, and what a process does. No OpenGL outside of them.

May import: device_calibration, errors, exhaustion, layers, map_probing, picture_cost, point, settings, sun_hours_layer.
"""
