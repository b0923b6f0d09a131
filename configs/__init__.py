"""Bundled levels: ``skugga levels`` lists them."""

from pathlib import Path

LEVELS_FOLDER = Path(__file__).resolve().parent
"""Folder of the level files (``*.yaml``) that come with Skugga."""
