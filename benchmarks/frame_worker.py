"""A process that draws frames of one view and reports their costs, with the packages in its ``PYTHONPATH``.

    python -P benchmarks/frame_worker.py LEVEL VIEW WIDTHxHEIGHT OVERRIDES

``benchmarks.frames`` starts it, once for this checkout and once for each reference checkout. So it imports nothing of the
benchmarks before a ``yardstick`` request, and only modules that older checkouts also have. LEVEL is a bundled level's name or a
file. OVERRIDES is a JSON object from plan names to their overrides. Each input line is a JSON object, whose key ``do`` names the
request:

``plan``
    Make the plans of the view for the positions ``sun`` and ``camera``.
``frame``
    Draw a frame by the plan named ``plan``, with sun and camera at the positions with the numbers ``sun`` and ``camera``. Before,
    clear the caches with the lifetimes in the list ``clear``.
``yardstick``
    Draw the same frame by ``benchmarks.yardstick``, with a depth map of ``map_size`` texels a side (0: none) and ``taps`` taps a
    side.
``save``
    Write the last picture to ``path``, a PNG file, or with its visibilities (n, rows, cols) a NumPy file.

The answer to each request is a line with a JSON object of its costs.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

PROCESS_START_S = time.perf_counter()

import moderngl  # noqa: E402
import numpy as np  # noqa: E402

from skugga.api.catalogue import find_level  # noqa: E402
from skugga.selector.select import plan_of_view  # noqa: E402
from skugga.shadows.render import render_frame  # noqa: E402
from skugga.terrain.cache import clear_caches  # noqa: E402
from skugga.terrain.geo.camera import PerspectiveView  # noqa: E402
from skugga.terrain.gl.programs import record_draw_calls  # noqa: E402
from skugga.terrain.level.level import load_level  # noqa: E402
from skugga.terrain.level.parts import SunSpec  # noqa: E402
from skugga.terrain.scene import Scene, build_scene  # noqa: E402

IMPORTS_END_S = time.perf_counter()

GOLDEN_RATIO = 0.5 * (np.sqrt(5.0) - 1.0)
"""Position number n is the fractional part of n * ``GOLDEN_RATIO``, as a share of the ranges below. Positions never repeat, and
successive ones are far apart."""

SUN_RANGE_DEG, SUN_RANGE_MINUTES = 4.0, 16.0
"""Range of the sun in degrees of azimuth, or in minutes if the level has a time. It begins at the level's own sun. Successive
positions differ by at least two fifths of it, as in a film of a day in steps of six minutes or more."""

CAMERA_TRAVEL_M = 3.0
"""Range of the camera, to its right. Successive positions differ by 1.1 to 1.9 m."""


class ReadCounters:
    """Counters of reads from the OpenGL device during one frame: their number and bytes."""

    def __init__(self) -> None:
        self.reads, self.read_bytes, self._within = 0, 0, 0

    @contextmanager
    def count_read(self, array: Any) -> Iterator[None]:
        """Count a read from the device. Reads nested in it are not counted again.

        ``array`` is the array that is read into. Its bytes count. Other objects, or ``None``, count no bytes.
        """
        self._within += 1
        try:
            yield
        finally:
            self._within -= 1
        if not self._within:
            self.reads += 1
            self.read_bytes += array.nbytes if isinstance(array, np.ndarray) else 0


READ_COUNTERS = ReadCounters()


def count_reads() -> None:
    """Count, from now on, all reads from OpenGL by any call of moderngl or PyOpenGL."""
    from OpenGL import GL

    kinds = ("Framebuffer", "Texture", "TextureArray", "Texture3D", "TextureCube", "Buffer")
    read_functions = [
        (getattr(moderngl, kind), name) for kind in kinds for name in ("read", "read_into", "read_chunks", "read_chunks_into")
    ]
    read_functions += [(GL, name) for name in ("glReadPixels", "glGetTexImage", "glGetBufferSubData", "glMapBufferRange")]
    for owner, name in read_functions:
        if hasattr(owner, name):
            setattr(owner, name, _counting_wrapper(getattr(owner, name)))


def _counting_wrapper(call: Any) -> Any:
    """Return a function that does the same as ``call`` and counts it in ``READ_COUNTERS``."""

    def wrapper(*args: Any, **kwargs: Any) -> Any:
        arrays = [argument for argument in (*args, *kwargs.values()) if isinstance(argument, np.ndarray)]
        with READ_COUNTERS.count_read(arrays[-1] if arrays else None):
            return call(*args, **kwargs)

    return wrapper


class ViewVariants:
    """The level's scene and view, and numbered variants with moved sun or camera."""

    def __init__(self, scene: Scene, view: PerspectiveView) -> None:
        self.scene, self.view = scene, view
        self._moved: dict[int, Scene] = {0: scene}

    def with_sun_number(self, number: int) -> Scene:
        """Return the scene under the sun with a number; 0 is the level's own sun."""
        if number not in self._moved:
            sun, share = self.scene.sun, number * GOLDEN_RATIO % 1.0
            assert sun is not None
            if sun.time is not None:
                spec = SunSpec(time=sun.time + timedelta(minutes=SUN_RANGE_MINUTES * share))
            else:
                spec = SunSpec(azimuth=sun.azimuth_deg + SUN_RANGE_DEG * share, altitude=sun.altitude_deg)
            self._moved = {0: self.scene, number: self.scene.with_sun(spec)}  # frames under one sun share a scene, as in a film
        return self._moved[number]

    def with_camera_number(self, number: int) -> PerspectiveView:
        """Return the view from the camera position with a number; 0 is the level's own position."""
        if number == 0:
            return self.view
        right = self.view.earth_from_camera[:, 0]
        return replace(self.view, eye_earth_m=self.view.eye_earth_m + CAMERA_TRAVEL_M * (number * GOLDEN_RATIO % 1.0) * right)


class FrameWorker:
    """The view of a level with its plans, which answers requests."""

    def __init__(self, level: str, view: str, size: tuple[int, int], overrides: dict[str, dict[str, Any]]) -> None:
        start = time.perf_counter()
        scene = build_scene(load_level(Path(level) if os.sep in level else find_level(level)))
        scene_view = scene.view(view, size=size)
        assert isinstance(scene_view, PerspectiveView)
        self.variants, self.name, self.overrides = ViewVariants(scene, scene_view), view, overrides
        self.plans: dict[str, Any] = {}
        self.yardsticks: dict[tuple[int, int], Any] = {}
        self.picture: np.ndarray | None = None
        self.visibility = np.zeros((0, 0, 0), np.float32)
        self.scene_ms = 1000.0 * (time.perf_counter() - start)

    def plan(self, request: dict[str, Any]) -> dict[str, Any]:
        """Answer a ``plan`` request: make the plans, and return milliseconds, renderer, and algorithms and passes by plan."""
        scene, view = (
            self.variants.with_sun_number(request.get("sun", 0)),
            self.variants.with_camera_number(request.get("camera", 0)),
        )
        wall, cpu = time.perf_counter(), time.process_time()
        for name in request.get("plans", self.overrides):
            self.plans[name] = plan_of_view(scene, view, self.name, self.overrides[name])
        costs: dict[str, Any] = {"ms": 1000.0 * (time.perf_counter() - wall), "cpu_ms": 1000.0 * (time.process_time() - cpu)}
        from skugga.terrain.gl.device import renderer_and_version

        costs["renderer"] = " ".join(renderer_and_version())
        return {
            **costs,
            "plans": {name: {"algorithms": plan.algorithms_text, "passes": plan.passes} for name, plan in self.plans.items()},
        }

    def frame(self, request: dict[str, Any]) -> dict[str, Any]:
        """Answer a ``frame`` request: draw the frame, and return times, counts of draws and reads, digests and peak memory."""
        if request.get("clear"):
            clear_caches(*request["clear"])
        scene, view = (
            self.variants.with_sun_number(request.get("sun", 0)),
            self.variants.with_camera_number(request.get("camera", 0)),
        )
        self.picture, self.visibility = None, self.visibility[:0]  # releases the last frame before the next, as a service does
        READ_COUNTERS.reads, READ_COUNTERS.read_bytes = 0, 0
        wall, cpu = time.perf_counter(), time.process_time()
        with record_draw_calls() as calls:
            frame = render_frame(scene, view, self.plans[request["plan"]])
        costs = {"ms": 1000.0 * (time.perf_counter() - wall), "cpu_ms": 1000.0 * (time.process_time() - cpu)}
        self.picture, self.visibility = frame.color, np.stack(list(frame.visibilities.values()))
        passes = {record.name: record.ms for record in frame.passes}
        passes["outside of passes"] = costs["ms"] - sum(passes.values())
        triangles = sum(record.triangles for record in frame.passes)
        counts = {
            "reads": READ_COUNTERS.reads,
            "read_mib": READ_COUNTERS.read_bytes / 2**20,
            "draws": len(calls),
            "triangles": triangles,
        }
        digests = {"color": array_digest([frame.color]), "visibility": array_digest([self.visibility])}
        return {**costs, **counts, **digests, "passes_ms": passes, "peak_gb": peak_gb()}

    def yardstick(self, request: dict[str, Any]) -> dict[str, Any]:
        """Answer a ``yardstick`` request: draw the frame without Skugga's shadows, and return times, counts and peak memory."""
        from benchmarks.yardstick import Yardstick

        scene, view = (
            self.variants.with_sun_number(request.get("sun", 0)),
            self.variants.with_camera_number(request.get("camera", 0)),
        )
        key = request["map_size"], request["taps"]
        if key not in self.yardsticks:
            self.yardsticks[key] = Yardstick(self.variants.scene, self.variants.view, *key)
            for _ in range(3):  # compiles, and uploads
                self.yardsticks[key].draw(scene, view)
        yardstick = self.yardsticks[key]
        READ_COUNTERS.reads, READ_COUNTERS.read_bytes = 0, 0
        wall, cpu = time.perf_counter(), time.process_time()
        with record_draw_calls() as calls:
            self.picture = yardstick.draw(scene, view)[..., :3]
        costs = {"ms": 1000.0 * (time.perf_counter() - wall), "cpu_ms": 1000.0 * (time.process_time() - cpu)}
        counts = {
            "reads": READ_COUNTERS.reads,
            "read_mib": READ_COUNTERS.read_bytes / 2**20,
            "draws": len(calls),
            "triangles": yardstick.triangles,
        }
        return {**costs, **counts, "passes_ms": {}, "peak_gb": peak_gb()}

    def save(self, request: dict[str, Any]) -> dict[str, Any]:
        """Answer a ``save`` request: write the last picture, and return an empty object."""
        from PIL import Image

        assert self.picture is not None
        if request["path"].endswith(".npz"):
            np.savez(request["path"], color=self.picture, visibility=self.visibility)
        else:
            Image.fromarray(self.picture).save(request["path"])
        return {}


def array_digest(arrays: list[np.ndarray]) -> str:
    """Return a digest of the contents of arrays, 16 hexadecimal digits."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def peak_gb() -> float:
    """Return the peak memory of this process in 10^9 bytes. (``getrusage`` would include the parent's.)"""
    with open("/proc/self/status", encoding="ascii") as status:
        (line,) = (line for line in status if line.startswith("VmHWM:"))
    return 1024.0 * float(line.split()[1]) / 1e9


def main() -> None:
    """Read requests from standard input and answer each with a line, until the input ends."""
    level, view, size, overrides = sys.argv[1:]
    width, height = (int(side) for side in size.split("x"))
    answers, sys.stdout = sys.stdout, sys.stderr  # printed text is no answer
    worker = FrameWorker(level, view, (width, height), json.loads(overrides))
    count_reads()
    ready = {"import_ms": 1000.0 * (IMPORTS_END_S - PROCESS_START_S), "scene_ms": worker.scene_ms}
    print(json.dumps(ready), file=answers, flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        handlers = {"plan": worker.plan, "frame": worker.frame, "yardstick": worker.yardstick, "save": worker.save}
        print(json.dumps(handlers[request["do"]](request)), file=answers, flush=True)


if __name__ == "__main__":
    main()
