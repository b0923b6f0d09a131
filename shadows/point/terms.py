"""Words and limits of questions about points."""

from __future__ import annotations

from typing import Literal

CasterType = Literal["relief", "building", "mesh", "forest"]
"""What hides the sun."""

HIGHEST_EYE_M = 10_000.0
"""Of an eye, above the ground."""
