"""Render processes: the pool before them, the jobs they are sent, and what a process does. No OpenGL outside of them.

May import: device_calibration, errors, layers, map_probing, point, settings, sun_hours_layer.
"""
