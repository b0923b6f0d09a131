"""Figures in words and pages: a plan in words, a comparison's summary, table and self-contained HTML report."""
