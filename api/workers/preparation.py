"""What a render process does for the levels that are served before it says that it is ready.

It opens each and finds how much of the sky its ground sees. An installation that has not drawn a level yet draws it a few times:
then every loop and shader that pictures of it need is compiled, and lies in the caches of numba and of the driver. A stamp in the
user's cache says so to the processes that follow. A level that cannot be drawn is left to its first request, which says why.

Loops over bare ground differ by the sun and by the size of pixels. All else is drawn with OpenGL and shaded from a geometry buffer,
the same for any: a block of it may take long, and one is enough.
"""

from __future__ import annotations

import hashlib
import logging
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import date
from pathlib import Path

import numba
import numpy as np
from llvmlite.binding import get_host_cpu_features, get_host_cpu_name

from api.point.report import PointQuery, point_report
from api.sun_hours_layer import SunHoursQuery
from api.workers.jobs import BlockJob, LevelKey, ServedPictures, SnapshotJob, SunHoursJob
from api.workers.render_worker import MAX_SCENES, WorkerState, plan_of_tiles, run_job
from shadows.ground_pictures import SKY_PASS
from terrain.errors import InputError, NoOpenGLError, SkuggaError
from terrain.gbuffer.covered_nodes import is_bare
from terrain.gl import device as gl
from terrain.ground.sky_view_factor import sky_view
from terrain.scene import Scene
from terrain.user_cache import user_cache

ROOT = Path(__file__).resolve().parents[2]
COMPILED_FOLDERS = "api", "selector", "shadows", "terrain"

ANY_DAY = date(2024, 3, 20)

log = logging.getLogger("skugga.worker")


def prepare(served: Sequence[ServedPictures], state: WorkerState, say: Callable[[str], None]) -> None:
    """Prepare for the levels that are served, as many as a process keeps open, and ``say`` what takes its time."""
    engine, levels = _engine() if served else "", served[:MAX_SCENES]
    for number, level in enumerate(levels, 1):
        name = level.level.path.stem
        try:
            scene, stamp = state.scenes.get(level.level), _stamp_of(level.level, engine)
            if not stamp.exists():
                jobs = _needed(level, scene)
                for done, job in enumerate(jobs):
                    at = f"level {number} of {len(levels)}, picture {done + 1} of {len(jobs)}"
                    say(f"first start with {name}: compiling what its pictures need ({at})")
                    with suppress(NoOpenGLError):  # it has been said that there is none
                        run_job(job, state)
                _look_from_the_middle(scene)
                _find_hours(level, scene, state)
                _leave(stamp)
            _find_sky(level, scene, state)
        except SkuggaError as error:
            say(f"level {name} cannot be drawn yet: {error}")
        except Exception as error:  # a bug with one level's pictures must not keep the service from the others
            log.exception("level %s cannot be prepared for", name)
            say(f"level {name} cannot be prepared for: {type(error).__name__}")


def _needed(level: ServedPictures, scene: Scene) -> list[BlockJob | SnapshotJob]:
    if is_bare(scene):
        return list(level.pictures)
    blocks, views = ([job for job in level.pictures if isinstance(job, kind)] for kind in (BlockJob, SnapshotJob))
    return [*blocks[:1], *views]


def _find_sky(level: ServedPictures, scene: Scene, state: WorkerState) -> None:
    for job in level.pictures:
        if isinstance(job, BlockJob):
            seen = job.request.seen(scene)
            if SKY_PASS in plan_of_tiles(job, seen, state).runs:
                sky_view(seen.elevation, seen.world)
            return


def _look_from_the_middle(scene: Scene) -> None:
    """Compile what points need: a report of one does, in the middle of the level, if that is on its data."""
    flat = scene.world.flat
    lon, lat = (0.0, 0.0) if flat else (scene.world.anchor_lon_deg, scene.world.anchor_lat_deg)
    with suppress(InputError):
        point_report(scene, PointQuery(lon=lon, lat=lat, date=None if flat else ANY_DAY))


def _find_hours(level: ServedPictures, scene: Scene, state: WorkerState) -> None:
    """Compile what hours of sun need: a block of them does."""
    block = next((job for job in level.pictures if isinstance(job, BlockJob)), None)
    if block is not None and is_bare(scene):
        asked = block.model_dump(include={"matrix_set", "zoom", "block_x", "block_y"})
        run_job(SunHoursJob(level=level.level, **asked, query=SunHoursQuery(date=ANY_DAY)), state)


def _engine() -> str:
    """What changes with anything that compiled loops and shaders hang on."""
    sources = sorted(path for package in COMPILED_FOLDERS for path in (ROOT / package).rglob("*.py"))
    stamps = [(str(path), path.stat().st_mtime_ns) for path in sources]
    cpu = get_host_cpu_name(), get_host_cpu_features().flatten()
    known = sys.version, numba.__version__, np.__version__, cpu, *gl.renderer_and_version(), stamps
    return hashlib.sha256(repr((known, os.environ.get("NUMBA_CACHE_DIR"))).encode()).hexdigest()


def _stamp_of(level: LevelKey, engine: str) -> Path:
    return user_cache("compiled") / hashlib.sha256(f"{engine} {level.path} {level.version}".encode()).hexdigest()[:24]


def _leave(stamp: Path) -> None:
    """A folder that cannot be written is no error: the next process draws anew."""
    try:
        stamp.parent.mkdir(parents=True, exist_ok=True)
        stamp.touch()
    except OSError as error:
        log.warning("%s cannot be written: %s", stamp, error.strerror)
