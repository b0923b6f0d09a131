"""The sun at a point: reports, horizon files for solar tools, sky charts, and points from files."""
