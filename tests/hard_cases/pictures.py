"""Contact sheet of some hard cases.

python -m tests.hard_cases.pictures [docs/images/hard-cases.webp]
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import trimesh
from PIL import Image, ImageDraw, ImageFont

from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene
from tests.hard_cases.blocks import block, flat_terrain
from tests.hard_cases.bodies import FLOOR, eye
from tests.hard_cases.cases import Trial, View
from tests.hard_cases.landscapes import far_peak
from tests.hard_cases.test_bodies import UNUSUAL_BODIES, arrange_in_rows
from tests.hard_cases.test_properties import COUNTEREXAMPLES, scene_of
from tests.hard_cases.test_rasters import CORNER_M, UTM, plateau_with_holes
from tests.hard_cases.test_wires import SIDE_M, SUN, view_from_above, wires
from tests.rasters import ENGINEERING
from tests.render import render

WIDTH_PX, HEIGHT_PX, TEXT_PX, GAP_PX = 440, 330, 16, 12
PAPER, INK = (255, 255, 255), (24, 24, 24)


def color_image(scene: Scene, view: View, **overrides: Any) -> Image.Image:
    """Return a view in colour, white off the surface."""
    frame = render(scene, view, **overrides)
    return Image.fromarray(np.where(frame.opaque_mask[..., None], frame.color, 255).astype(np.uint8))


def visibility_image(scene: Scene, view: View, **overrides: Any) -> Image.Image:
    """Return a view's visibility, lit white and shadow dark: under low suns colours hardly differ."""
    visibility = np.nan_to_num(render(scene, view, **overrides).visibility, nan=1.0)
    return Image.fromarray(np.rint(90.0 + 150.0 * visibility).astype(np.uint8)).convert("RGB")


def bodies(trial: Trial) -> Image.Image:
    """Draw the shadows of unusual meshes."""
    views = {"eye": eye((22, 42, 26), (0, 2, 0), fov=50)}
    scene = trial.scene(FLOOR, (200, 35), [arrange_in_rows(list(UNUSUAL_BODIES.values())[:6])], "bodies", views=views)
    return color_image(scene, scene.view("eye", size=(WIDTH_PX, HEIGHT_PX)), algorithm="shadow_volume")


def curvature(trial: Trial) -> Image.Image:
    """Return the same mesa under the same sun in a flat world, and below it on the globe.

    The panel shows 190 km from left to right and 8 km from top to bottom, three times as high. The sun stands to the left.
    """
    strips = []
    for curved in (False, True):
        peak = far_peak(trial, 1500.0, 0.5, 4000.0, curved)
        west, south, east, north = peak.map_bounds
        middle, edge = (west + east) / 2.0, (south + north) / 2.0 - peak.length_m
        view = peak.scene.view(bounds=(middle - 4e3, edge - 1e4, middle + 4e3, edge + 1.8e5), size=(37, 2 * WIDTH_PX))
        strip = visibility_image(peak.scene, view, algorithm="shadow_map").transpose(Image.Transpose.ROTATE_270)
        strips.append(strip.resize((WIDTH_PX, (HEIGHT_PX - GAP_PX) // 2), Image.Resampling.NEAREST))
    return stack_vertically(strips)


def needle(trial: Trial) -> Image.Image:
    """Draw the shadow of a single high cell."""
    heights = np.zeros((96, 128), np.float32)
    heights[48, 16] = 3000.0
    scene = trial.scene(trial.raster(heights, ENGINEERING, 0.0, 0.0, 32.0, "needle"), (270, 45), name="needle")
    return color_image(scene, scene.view(size=(WIDTH_PX, HEIGHT_PX)), algorithm="sweep")


def holes(trial: Trial) -> Image.Image:
    """Draw a plateau with holes in its data."""
    raster = trial.raster(plateau_with_holes(128), UTM, *CORNER_M, 8.0, "holes", nodata=-9999.0)
    scene = trial.scene(raster, (310, 30), name="holes", effects={"cast_shadows": "on"})
    west, south, east, north = scene.view(size=(64, 64)).bounds
    part = west, south + (north - south) / 8, east, north - (north - south) / 8
    return color_image(scene, scene.view(bounds=part, size=(WIDTH_PX, HEIGHT_PX)), algorithm="shadow_map")


def masks(trial: Trial) -> Image.Image:
    """Return wires of half a texel, drawn with the original and the conservative mask of the hybrid."""
    anchor = block((0.02, 0.02, 0.02), (SIDE_M, SIDE_M))
    meshes = [trimesh.util.concatenate([*wires(0.5 * SIDE_M / 61), anchor])]
    scene, halves = trial.scene(flat_terrain(), SUN, meshes, "wires"), []
    for mask in ("original", "conservative"):
        view: MapView = view_from_above(scene, WIDTH_PX)
        image = color_image(scene, view, algorithm="hybrid", mask=mask, map_size=64)
        halves.append(image.crop((0, HEIGHT_PX // 3, WIDTH_PX, HEIGHT_PX // 3 + (HEIGHT_PX - GAP_PX) // 2)))
    return stack_vertically(halves)


def horizon(trial: Trial) -> Image.Image:
    """Draw the visibility of a sun one degree above the horizon."""
    scene = scene_of(next(iter(COUNTEREXAMPLES.values())), trial.folder).with_sun(SunSpec(azimuth=270, altitude=1))
    west, south, east, north = scene.view(size=(64, 64)).bounds
    part = west, south + (north - south) / 8, east, north - (north - south) / 8
    return visibility_image(scene, scene.view(bounds=part, size=(WIDTH_PX, HEIGHT_PX)), algorithm="hybrid")


def stack_vertically(strips: list[Image.Image]) -> Image.Image:
    """Return one image with strips below one another."""
    canvas = Image.new("RGB", (WIDTH_PX, sum(strip.height for strip in strips) + GAP_PX * (len(strips) - 1)), PAPER)
    top = 0
    for strip in strips:
        canvas.paste(strip, (0, top))
        top += strip.height + GAP_PX
    return canvas


PANELS: dict[str, Callable[[Trial], Image.Image]] = {
    "H16: bodies that are none, by shadow volumes": bodies,
    "H24: 1500 m under a sun of 0.5°, flat and on the globe": curvature,
    "G6: one cell of 3000 m": needle,
    "G1: holes of every sentinel, islands, one cell": holes,
    "H21: thin wires by Chan and Durand's mask, and by ours": masks,
    "X2: teeth of a saw and a house, sun at 1°": horizon,
}


def contact_sheet() -> Image.Image:
    """Return all panels, three in a row, each with its caption."""
    rows = -(-len(PANELS) // 3)
    canvas = Image.new("RGB", (3 * WIDTH_PX + 4 * GAP_PX, rows * (HEIGHT_PX + 2 * TEXT_PX + GAP_PX) + GAP_PX), PAPER)
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(TEXT_PX)
    with TemporaryDirectory() as folder:
        for number, (caption, make) in enumerate(PANELS.items()):
            left = GAP_PX + number % 3 * (WIDTH_PX + GAP_PX)
            top = GAP_PX + number // 3 * (HEIGHT_PX + 2 * TEXT_PX + GAP_PX)
            canvas.paste(make(Trial("", False, Path(folder))), (left, top))
            draw.text((left, top + HEIGHT_PX + 4), caption, INK, font)
    return canvas


if __name__ == "__main__":
    contact_sheet().save(sys.argv[1] if len(sys.argv) > 1 else "docs/images/hard-cases.webp", quality=82, method=6)
