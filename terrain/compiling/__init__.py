"""Compiled loops on disk: what identifies one, where it is stored, and how missing ones are compiled ahead.

A leaf of the house: every module may use ``terrain.compiled``, which stands on it. May import: no other room.
"""
