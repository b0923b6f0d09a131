"""`none`: no cast shadows. What is turned away from a light is dark all the same (``skugga.shadows.attached``)."""

from __future__ import annotations

from skugga.shadows.algorithm import Algorithm, Mark

ALGORITHM = Algorithm(name="none", about="no cast shadows", plural="none", needs_opengl=False, mark=Mark("cross", "gray"))
