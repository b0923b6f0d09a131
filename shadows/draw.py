"""Draw the arrays of a view that a caller needs, on the fastest path that shows them (``draw``).

This module alone decides whether the heights of bare ground suffice. If they do, no geometry buffer is made for each position of
the sun. If they do not, ``render_frame`` draws. Both paths show the same pixels, so tiles, maps, films and rasters agree.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from skugga.shadows.ground_pictures import ground_picture, heights_determine_shading
from skugga.shadows.passes import PassLog
from skugga.shadows.picture import Needs, Picture
from skugga.shadows.plan import Plan
from skugga.shadows.render import Frame, apply_refraction, check_pixel_count, render_block, render_frame, worse_reach
from skugga.shadows.sunlit_ground import heights_determine_visibility, sunlit_picture
from skugga.shadows.visibility import with_apparent_sun
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView, blocks_of, overlap_windows
from skugga.terrain.scene import Scene

SHADING_NEEDS: Needs = frozenset({"color", "opacity", "reach"})
"""Fields of ``Picture`` that can be drawn from heights alone where these determine the shading."""

VISIBILITY_NEEDS: Needs = frozenset({"visibility", "reach"})
"""Fields of ``Picture`` that can be drawn from heights alone where these determine the sun's visibility."""


def draw(
    scene: Scene, view: MapView | PerspectiveView, plan: Plan, needs: Needs, on_block: Callable[[int, int], None] | None = None
) -> Picture:
    """Draw the needed arrays of a view by a plan.

    Parameters
    ----------
    scene, view, plan
        The scene, the view, and the plan for both.
    needs
        The fields of ``Picture`` to draw.
    on_block
        Function that is called with the numbers of finished and of all blocks, after each block.

    Returns
    -------
    Picture
        The arrays; those that are not needed are ``None``.

    Raises
    ------
    InputError
        The view has more pixels than a frame may have.
    RenderError
        The work fails.
    """
    if not (isinstance(view, MapView) and can_draw_from_heights(scene, view, plan, needs)):
        return picture_of(render_frame(scene, view, plan, on_block), needs)
    check_pixel_count(view)
    log = PassLog()
    scene = apply_refraction(scene, plan, log)
    blocks, picture = blocks_of(view), None
    for done, (block, row, col) in enumerate(blocks, start=1):
        part = _draw_block(scene, block, plan, needs, log)
        if len(blocks) == 1 and (block.rows, block.cols) == (view.rows, view.cols):
            picture = part
        else:
            picture = _copy_window(picture or _empty_picture(view, needs), part, *overlap_windows(view, block, row, col))
        if on_block is not None:
            on_block(done, len(blocks))
    assert picture is not None
    return replace(picture, passes=tuple(log.records.values()))


def can_draw_from_heights(scene: Scene, view: MapView | PerspectiveView, plan: Plan, needs: Needs) -> bool:
    """Return whether the heights of bare ground suffice to draw the needed arrays of a view.

    Loops over heights run in any thread. Other views need OpenGL.
    """
    if not isinstance(view, MapView):
        return False
    scene = with_apparent_sun(scene, plan.effect_names)
    return (needs <= SHADING_NEEDS and heights_determine_shading(scene, plan)) or (
        needs <= VISIBILITY_NEEDS and heights_determine_visibility(scene, view, plan)
    )


def picture_of(frame: Frame, needs: Needs) -> Picture:
    """Return the needed arrays of a frame as a ``Picture``."""
    return Picture(
        frame.valid,
        frame.passes,
        frame.color if "color" in needs else None,
        frame.opacity if "opacity" in needs else None,
        frame.visibility if "visibility" in needs else None,
        frame.reach if "reach" in needs else None,
        frame if "frame" in needs else None,
        shows_sky=not isinstance(frame.view, MapView),
    )


def _draw_block(scene: Scene, block: MapView, plan: Plan, needs: Needs, log: PassLog) -> Picture:
    """Draw a block of a map from heights alone, or by ``render_block`` where triangles are needed or the block is very wide."""
    of_heights = sunlit_picture if needs <= VISIBILITY_NEEDS else ground_picture
    return of_heights(scene, block, plan, needs, log) or picture_of(render_block(scene, block, plan, log), needs)


def _empty_picture(view: MapView, needs: Needs) -> Picture:
    """Return the picture of a view before any block is drawn: arrays of 0 or NaN."""
    size = view.rows, view.cols
    return Picture(
        np.zeros(size, np.bool_),
        (),
        np.zeros((*size, 3), np.uint8) if "color" in needs else None,
        np.zeros(size, np.uint8) if "opacity" in needs else None,
        np.full(size, np.nan, np.float32) if "visibility" in needs else None,
    )


def _copy_window(picture: Picture, part: Picture, window: tuple[slice, slice], part_window: tuple[slice, slice]) -> Picture:
    """Copy the window ``part_window`` of a part into the window ``window`` of the whole picture; return the picture.

    Its reach is the worse of both (``worse_reach``).
    """
    for name in ("valid", "color", "opacity", "visibility"):
        target, array = getattr(picture, name), getattr(part, name)
        if target is not None:
            target[window] = array[part_window]
    reaches = [piece.reach for piece in (picture, part) if piece.reach is not None]
    reach = worse_reach(*reaches) if len(reaches) == 2 else next(iter(reaches), None)
    return replace(picture, reach=reach)
