"""`none`: no cast shadows. Surfaces that face away from a light stay dark (``skugga.shadows.attached_shadow``)."""

from __future__ import annotations

from skugga.shadows.algorithm import Algorithm, PlotMarker

ALGORITHM = Algorithm(
    name="none", description="no cast shadows", plural_name="none", needs_opengl=False, marker=PlotMarker("cross", "gray")
)
