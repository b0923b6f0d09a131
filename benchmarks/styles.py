"""Contact sheets of every named style: mountains, city, plain and forest, at noon and in the evening, as maps and in perspective.

    python -m benchmarks.styles FOLDER -o OUT [--picture docs/images/styles.webp] [--side 480]

FOLDER has the sample rasters. The script writes a sheet of all styles for each place and light into OUT. ``--picture`` also writes
the sheet of the docs.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from skugga.api.catalogue import find_level
from skugga.selector.select import plan_of_view
from skugga.shadows.render import render_frame
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from skugga.terrain.style import STYLES

LIGHTS = {"noon": SunSpec(azimuth=195.0, altitude=48.0), "evening": SunSpec(azimuth=255.0, altitude=13.0)}
"""Suns by name."""


@dataclass(frozen=True)
class StyledPlace:
    """A place to draw.

    Attributes
    ----------
    source
        Raster in the folder of sample rasters, or name of a bundled level.
    view
        Name of the view.
    kept_middle_share
        Side of the central square of a map that is drawn, as a share of the map's shorter side.
    keys
        Further keys of the level file.
    """

    source: str
    view: str = "map"
    kept_middle_share: float = 1.0
    keys: dict[str, Any] = field(default_factory=dict)


PLACES = {
    "mountains": StyledPlace("mountain/grenoble_copernicus_4326.tif", kept_middle_share=0.6),
    "high mountains": StyledPlace("mountain/vinschgau_250m_utm32.tif"),
    "city": StyledPlace("urban/goteborg_1m/DSM.tif"),
    "plain": StyledPlace("odd/texas_flat_3arcsec_4326.tif", keys={"style": {"slope_exaggeration": 3}}),
    "forest": StyledPlace(
        "forest/quebec_DTM.tif", kept_middle_share=0.5, keys={"forest": [{"source": "forest/quebec_CHM.tif", "species": "conifer"}]}
    ),
    "valley, in perspective": StyledPlace("jacksboro_wooded", view="valley"),
    "village, in perspective": StyledPlace("jacksboro_wooded", view="village"),
}
"""Places by name."""

SHOWN_PLACES = ("high mountains", "city")
"""Places of the docs' picture, in the evening."""


def place_scene(place: StyledPlace, folder: Path, scratch: Path) -> Scene:
    """Return the scene of a place. ``folder`` has the sample rasters. For a raster, a level file is written into ``scratch``."""
    if "/" not in place.source:
        return build_scene(load_level(find_level(place.source)))
    keys = json.loads(json.dumps(place.keys).replace('"forest/', f'"{folder}/forest/'))
    level = scratch / "level.yaml"
    level.write_text(json.dumps({"version": 1, "terrain": {"source": str(folder / place.source)}, **keys}), encoding="utf-8")
    return build_scene(load_level(level))


def draw_picture(scene: Scene, place: StyledPlace, style: str, light: SunSpec, width_px: int) -> np.ndarray:
    """Draw a place in a style under a sun: uint8 (rows, cols, 3), ``width_px`` pixels wide, white where no surface is."""
    scene = scene.with_sun(light).with_style(style)
    view = scene.view(place.view)
    if place.view == "map":
        west, south, east, north = view.bounds
        x, y, reach = (west + east) / 2, (south + north) / 2, place.kept_middle_share * min(east - west, north - south) / 2
        view = scene.view("map", (x - reach, y - reach, x + reach, y + reach), scene.map_crs.to_string(), (width_px, width_px))
    else:
        view = scene.view(place.view, size=(width_px, round(width_px * view.rows / view.cols)))
    frame = render_frame(scene, view, plan_of_view(scene, view, place.view, {}))
    return np.where(frame.opaque_mask[..., None], frame.color, np.uint8(255))


def draw_sheet(folder: Path, name: str, light: str, width_px: int) -> Image.Image:
    """Return all styles of a place (a key of ``PLACES``) under a light (a key of ``LIGHTS``), side by side.

    ``folder`` has the sample rasters. Each picture is ``width_px`` pixels wide.
    """
    place = PLACES[name]
    with tempfile.TemporaryDirectory() as scratch:
        scene = place_scene(place, folder, Path(scratch))
        parts = [draw_picture(scene, place, style, LIGHTS[light], width_px) for style in STYLES]
    return Image.fromarray(np.concatenate(parts, axis=1))


def main() -> None:
    """Write the sheets."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--side", type=int, default=480)
    parser.add_argument("--places", nargs="*", default=list(PLACES), choices=list(PLACES))
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    for name in args.places:
        for light in LIGHTS:
            target = args.output / f"{name.replace(', ', '-').replace(' ', '-')}-{light}.png"
            draw_sheet(args.folder.resolve(), name, light, args.side).save(target)
            print(f"{target}: {', '.join(STYLES)}", flush=True)
    if args.picture is not None:
        rows = [np.asarray(draw_sheet(args.folder.resolve(), name, "evening", 320)) for name in SHOWN_PLACES]
        Image.fromarray(np.concatenate(rows)).save(args.picture, quality=88, method=6)
        print(args.picture)


if __name__ == "__main__":
    main()
