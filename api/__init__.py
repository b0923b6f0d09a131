"""User-facing parts: the HTTP service, its render processes, the command line, and pages of figures.

The modules beside the folders are shared by them: the table of errors, the settings, the list of levels, layers as files,
and parameters generated from the settings of shadows.
"""
