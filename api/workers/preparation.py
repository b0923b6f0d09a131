"""Prepare an idle render process for later requests: open levels, and import modules that few requests need."""

from __future__ import annotations

import logging
from datetime import UTC, datetime

from skugga.api.workers.jobs import BlockJob
from skugga.api.workers.worker_state import WorkerState, plan_of_tiles
from skugga.shadows.ground_pictures import SKY_VIEW_PASS
from skugga.terrain.errors import SkuggaError
from skugga.terrain.geo.sun import apparent_sun_position
from skugga.terrain.ground.sky_view_factor import sky_view

log = logging.getLogger("skugga.worker")


def prepare_level(block: BlockJob, state: WorkerState) -> None:
    """Open the level of a block, and compute the level's sky view factors if the block's plan needs them.

    The process caches both. If the level cannot be opened, the reason is logged. The first request for the level raises the error
    again.
    """
    name = block.level.path.stem
    try:
        scene = block.request.applied_to(state.scenes.get(block.level))
        if SKY_VIEW_PASS in plan_of_tiles(block, scene, state).effect_names:
            sky_view(scene.elevation, scene.world)
    except SkuggaError as error:
        log.warning("level %s cannot be drawn yet: %s", name, error)
    except Exception:  # a bug with one level must not block other levels
        log.exception("level %s cannot be prepared", name)


def import_pvlib() -> None:
    """Import pvlib, which computes sun positions. The import takes half a second, and only requests with a time need it."""
    apparent_sun_position(datetime(2024, 6, 21, 12, tzinfo=UTC), 0.0, 0.0)
