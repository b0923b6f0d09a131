"""The command line: `main` holds the commands, the others what single commands do.

May import: calibrated, catalogue, errors, http, layers, report, settings, shadow_parameters.
"""
