"""Bundled levels: ``skugga levels`` lists them."""

from pathlib import Path

LEVELS_FOLDER = Path(__file__).resolve().parent
