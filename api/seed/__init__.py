"""Pyramids of tiles drawn ahead: `planning` fills the table of tasks, `running` has them drawn, `publishing` makes the archive.

May import: archive_format, catalogue, device_calibration, errors, file_stamps, layers, matrices, workers.
"""
