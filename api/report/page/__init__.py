"""Parts of the page of ``skugga.api.report.report``: markup, plots, pictures, and files with template, style and script."""
