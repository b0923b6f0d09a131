"""Reports: a plan as text, and a comparison as a summary, a table and a self-contained HTML page."""
