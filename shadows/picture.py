"""``Picture``: the arrays of a drawn view that its caller needs, and no others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from skugga.shadows.passes import PassRecord
    from skugga.shadows.render import Frame
    from skugga.terrain.casters.caster_types import Reach
    from skugga.terrain.geo.grid import PixelWindow

Need = Literal["color", "opacity", "visibility", "reach", "frame"]
"""A field of ``Picture`` that a caller may need. ``frame`` includes all arrays that a geometry buffer provides."""

Needs = frozenset[Need]
"""The fields of ``Picture`` that a caller needs."""


@dataclass(frozen=True, eq=False)
class Picture:
    """The arrays of a drawn view. Row 0 is the upper row; in a map it is the northern row.

    Attributes
    ----------
    valid
        bool (rows, cols): valid mask, where the view shows a surface.
    passes
        The passes that ran, in the order of their first run.
    color
        uint8 (rows, cols, 3), sRGB; ``None`` unless needed.
    opacity
        uint8 (rows, cols): the opacity of the first light's shadow as it is shown, 0 off the surface; ``None`` unless needed.
    visibility
        float32 (rows, cols) in [0, 1]: the first light's visibility at the pixels' own points, NaN off the surface; ``None`` unless
        needed.
    reach
        The distance to which casters were searched; ``None`` unless needed.
    frame
        The rendered view with all of its arrays (``skugga.shadows.render.Frame``); ``None`` unless needed.
    shows_sky
        Whether pixels off the surface show the sky, as in a perspective view.
    """

    valid: np.ndarray
    passes: tuple[PassRecord, ...]
    color: np.ndarray | None = None
    opacity: np.ndarray | None = None
    visibility: np.ndarray | None = None
    reach: Reach | None = None
    frame: Frame | None = None
    shows_sky: bool = False

    @property
    def opaque_mask(self) -> np.ndarray:
        """Where the colour is valid, bool (rows, cols): on the surface, and in the sky of a perspective view."""
        return np.ones(self.valid.shape, np.bool_) if self.shows_sky else self.valid

    def part(self, window: PixelWindow) -> Picture:
        """Return the rows and columns ``window`` of the picture as a picture, in which the field ``frame`` is ``None``."""
        color, opacity, visibility = (
            None if array is None else array[window] for array in (self.color, self.opacity, self.visibility)
        )  # fmt: skip
        return Picture(self.valid[window], self.passes, color, opacity, visibility, self.reach, shows_sky=self.shows_sky)
