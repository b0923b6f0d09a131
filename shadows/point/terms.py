"""Kinds of casters and limits for queries about the sun at a point."""

from __future__ import annotations

from typing import Literal

CasterType = Literal["relief", "building", "mesh", "forest"]
"""The kinds of casters that hide the sun."""

MAX_EYE_HEIGHT_M = 10_000.0
"""Upper limit of the eye's height above the ground."""
