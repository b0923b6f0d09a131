"""`none`: no cast shadows. Surfaces that face away from a light stay dark (``skugga.shadows.attached``)."""

from __future__ import annotations

from skugga.shadows.algorithm import Algorithm, Mark

ALGORITHM = Algorithm(name="none", description="no cast shadows", plural="none", needs_opengl=False, mark=Mark("cross", "gray"))
