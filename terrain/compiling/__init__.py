"""Disk cache of compiled loops: cache keys, storage, and ahead-of-time compilation of missing entries.

A loop is a function that numba compiles to machine code, and a numba dispatcher is the Python object that calls it.

Every module may use the decorators of ``skugga.terrain.compiled``, which build on this package.
"""
