"""Parts that users meet: the HTTP service, its render processes, the command line, the Python library, and HTML reports.

The modules beside the folders are shared by these parts. They hold the table of errors, the settings, the look-up of levels, the
encoding of layers as files, and parameters that are generated from the shadow settings.
"""
