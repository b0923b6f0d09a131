"""Pyramids of tiles of a level, drawn ahead into one archive.

May import: errors.
"""
