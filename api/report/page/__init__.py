"""The parts of the page that ``skugga.api.report.report`` writes: markup, plots and pictures; its template, style and script beside
them.
"""
