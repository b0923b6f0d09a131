"""Disk cache of compiled loops: cache keys, storage, and ahead-of-time compilation of missing entries.

Every module may use the decorators of ``skugga.terrain.compiled``, which build on this package.
"""
