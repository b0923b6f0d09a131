"""The parts of the page that ``api.report.report`` writes: markup, plots and pictures; its template, style and script beside
them.
"""
