"""The sun at a point: the report, horizon files for solar tools, a picture with the sun's paths, points in files."""
