"""Parts of the HTML page that ``skugga.api.report.report`` writes: markup, plots, pictures, and the template, style and script."""
