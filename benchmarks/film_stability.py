"""Measure how much a film's pixels change that the motion does not explain: shimmer and crawling edges.

    python -m benchmarks.film_stability [-o OUT] [--frames 6] [--size 400x320] [--views spatialace:main ...]

Two films of each view are drawn: a moving sun (``SUN_STEP_DEG`` of azimuth a frame) and a moving camera (``CAMERA_STEP_M`` to the
side). The reference draws the same moments with 16 times as many pixels, by rays, and averages them in linear light. From one frame
to the next, a pixel of a steady film changes as the reference does. The rest is unexplained. The script prints the mean of the
unexplained change of all pixels, and of the pixels on edges (those where the reference changes by more than ``MIN_CHANGE``, or the
film does), in per cent of white; and the same for frames without samples of edges. ``-o`` writes the frames as PNG.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from PIL import Image

from skugga.api.catalogue import find_level
from skugga.selector.select import plan_of_view
from skugga.shadows import render
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from skugga.terrain.srgb import linear_of_srgb, srgb_of_linear

VIEWS = ("spatialace:main", "jacksboro_wooded:village", "jacksboro_wooded:valley", "thesis_room_sun:main", "thesis_street_sun:main")
"""Views by default: level and view."""

SUN_STEP_DEG, CAMERA_STEP_M = 0.25, 0.05
"""Step from frame to frame: the sun's azimuth in a minute, and a camera at 1.2 m/s in 24 frames a second."""

SUBPIXELS = 4
"""Reference pixels along the side of a pixel."""

MIN_CHANGE = 4.0 / 255.0
"""Change of a channel from which on a pixel counts as one on an edge."""


def moments(scene: Scene, view: PerspectiveView, motion: str, count: int) -> Iterator[tuple[Scene, PerspectiveView]]:
    """Yield the scenes and views of a film's frames. ``motion`` is ``sun`` or ``camera``."""
    sun = scene.sun
    assert sun is not None
    for number in range(count):
        if motion == "sun":
            yield scene.with_sun(SunSpec(azimuth=sun.azimuth_deg + SUN_STEP_DEG * number, altitude=sun.altitude_deg)), view
        else:
            yield scene, replace(view, eye_earth_m=view.eye_earth_m + CAMERA_STEP_M * number * view.earth_from_camera[:, 0])


def draw_frame(scene: Scene, view: PerspectiveView, name: str, algorithm: str) -> np.ndarray:
    """Return the colours of a frame, float64 (rows, cols, 3) in [0, 1]."""
    overrides = {} if algorithm == "auto" else {"algorithm": algorithm}
    return render.render_frame(scene, view, plan_of_view(scene, view, name, overrides)).color[..., :3] / 255.0


def draw_reference(scene: Scene, view: PerspectiveView, name: str) -> np.ndarray:
    """Return the colours of a frame as means in linear light over ``SUBPIXELS`` x ``SUBPIXELS`` reference pixels."""
    fine = linear_of_srgb(draw_frame(scene, view.finer(SUBPIXELS), name, "truth"))
    rows, cols = view.rows, view.cols
    return srgb_of_linear(fine.reshape(rows, SUBPIXELS, cols, SUBPIXELS, 3).mean(axis=(1, 3)))


def unexplained_changes(frames: list[np.ndarray], references: list[np.ndarray]) -> tuple[float, float, float]:
    """Return the mean unexplained change of all pixels and of those on edges, in per cent of white, and the share of these."""
    change, expected = np.diff(np.array(frames), axis=0), np.diff(np.array(references), axis=0)
    is_edge = np.maximum(np.abs(change), np.abs(expected)).max(axis=-1) > MIN_CHANGE
    unexplained = np.abs(change - expected).mean(axis=-1)
    on_edges = unexplained[is_edge].mean() if is_edge.any() else 0.0
    return 100.0 * float(unexplained.mean()), 100.0 * float(on_edges), float(is_edge.mean())


def measure_film(scene: Scene, name: str, motion: str, count: int, size: tuple[int, int], folder: Path | None) -> str:
    """Return a row of the table for a view and a motion, and write the frames into a folder."""
    view = scene.view(name, size=size)
    assert isinstance(view, PerspectiveView)
    films: dict[str, list[np.ndarray]] = {"smooth": [], "own points": [], "reference": []}
    for number, (moment, moved_view) in enumerate(moments(scene, view, motion, count)):
        films["smooth"].append(draw_frame(moment, moved_view, name, "auto"))
        with patch.object(render, "smooth_shadow_edges", lambda scene, plan, picture, visibilities, casters, log: visibilities):
            films["own points"].append(draw_frame(moment, moved_view, name, "auto"))
        films["reference"].append(draw_reference(moment, moved_view, name))
        if folder is not None:
            row = np.concatenate([frames[-1] for frames in films.values()], axis=1)
            picture = Image.fromarray((255.0 * row + 0.5).astype(np.uint8))
            picture.save(folder / f"{scene.loaded.name}-{name}-{motion}-{number:02d}.png")
    rows = [unexplained_changes(films[side], films["reference"]) for side in ("smooth", "own points")]
    cells = " | ".join(f"{mean:.2f} | {on_edges:.1f} | {100 * share:.1f}" for mean, on_edges, share in rows)
    return f"| {scene.loaded.name} {name} | {motion} | {cells} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, metavar="OUT")
    parser.add_argument("--frames", type=int, default=5)
    parser.add_argument("--size", default="400x320", metavar="WxH")
    parser.add_argument("--views", nargs="*", default=VIEWS, metavar="LEVEL:VIEW")
    args = parser.parse_args()
    if args.output is not None:
        args.output.mkdir(parents=True, exist_ok=True)
    width, height = (int(side) for side in args.size.split("x"))
    print("| view | moves | all % | edges % | share % | own points: all % | edges % | share % |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for text in args.views:
        level, _, name = text.partition(":")
        scene = build_scene(load_level(find_level(level)))
        for motion in ("sun", "camera"):
            print(measure_film(scene, name, motion, args.frames, (width, height), args.output), flush=True)


if __name__ == "__main__":
    main()
