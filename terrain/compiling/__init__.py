"""Compiled loops on disk: what identifies one, where it is stored, and how missing ones are compiled ahead.

Every module may use ``skugga.terrain.compiled``, which stands on it.
"""
