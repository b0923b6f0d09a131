"""What users touch: the HTTP service, its render processes, the command line, and pages of figures.

Beside the folders lies what these share: the table of errors, settings, the levels there are, layers as files,
and parameters made of the settings of shadows.
"""
