"""The sun at a point as users get it: the report, horizon files for solar tools, a picture with the sun's paths, points in files.

May import: no other room.
"""
