"""Contact sheets of scenes and styles under four suns, with the effects that each picture ran, and their times.

    python -m benchmarks.styles FOLDER -o OUT [--old OTHER_OUT] [--picture docs/images/styles.webp] [--side 480] [--places ...]

FOLDER has the sample rasters. The script writes a sheet of all styles for each place and light into OUT: mountains, city, plain,
forest, village, valley, street and room, at noon and in the evening, in summer and in winter. With ``--old`` the sheets that an
earlier version wrote into OTHER_OUT are shown above the new ones. ``OUT/effects.md`` has the table of pictures, and ``--picture``
writes the sheet of the docs.

The proof that effects run only where they are called for: an effect that ran is read from the record of passes, shader programs and
loops, and the script fails if the record and the plan of a picture differ.
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
from skugga.terrain.effects import EFFECTS
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from skugga.terrain.style import STYLES

LIGHTS = {
    "summer-noon": SunSpec(azimuth=195.0, altitude=62.0), "summer-evening": SunSpec(azimuth=280.0, altitude=13.0),
    "winter-noon": SunSpec(azimuth=185.0, altitude=20.0), "winter-evening": SunSpec(azimuth=232.0, altitude=6.0),
}  # fmt: skip
"""Suns by name, as at some 45 degrees north."""


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
    "landscape, in perspective": StyledPlace("spatialace", view="main"),
    "street, in perspective": StyledPlace("thesis_street_sun", view="main"),
    "room, in perspective": StyledPlace("thesis_room_sun", view="main"),
}
"""Places by name."""

SHOWN_PLACES = ("high mountains", "city")
"""Places of the docs' picture, on a winter's noon."""

UNRECORDED_EFFECTS = frozenset({"soft_edges"})
"""Effects that some algorithms run without a trace in the record."""


def place_scene(place: StyledPlace, folder: Path, scratch: Path) -> Scene:
    """Return the scene of a place. ``folder`` has the sample rasters. For a raster, a level file is written into ``scratch``."""
    if "/" not in place.source:
        return build_scene(load_level(find_level(place.source)))
    keys = json.loads(json.dumps(place.keys).replace('"forest/', f'"{folder}/forest/'))
    level = scratch / "level.yaml"
    level.write_text(json.dumps({"version": 1, "terrain": {"source": str(folder / place.source)}, **keys}), encoding="utf-8")
    return build_scene(load_level(level))


def draw_picture(scene: Scene, place: StyledPlace, style: str, light: SunSpec, width_px: int) -> tuple[np.ndarray, str]:
    """Draw a place in a style under a sun, ``width_px`` pixels wide.

    Returns
    -------
    picture
        uint8 (rows, cols, 3), white where no surface is.
    effects
        The effects that ran with their times, and the effects left out: two cells of a Markdown table.

    Raises
    ------
    RuntimeError
        An effect ran that the plan does not list, or a listed one did not run.
    """
    scene = scene.with_sun(light).with_style(style)
    view = scene.view(place.view)
    if place.view == "map":
        west, south, east, north = view.bounds
        x, y, reach = (west + east) / 2, (south + north) / 2, place.kept_middle_share * min(east - west, north - south) / 2
        view = scene.view("map", (x - reach, y - reach, x + reach, y + reach), scene.map_crs.to_string(), (width_px, width_px))
    else:
        view = scene.view(place.view, size=(width_px, round(width_px * view.rows / view.cols)))
    plan = plan_of_view(scene, view, place.view, {})
    frame = render_frame(scene, view, plan)
    # Passes of cast shadows are named after the light, the casters and the algorithm: "sun/relief: sweep".
    left_out_by_parts = {"cast_shadows" if ": " in record.name else record.name for record in frame.passes if record.is_left_out}
    if (frame.effects ^ plan.effect_names) - UNRECORDED_EFFECTS - left_out_by_parts:
        raise RuntimeError(f"{place.source} {style}: planned {sorted(plan.effect_names)}, ran {sorted(frame.effects)}")
    times_ms = {record.name: record.ms for record in frame.passes}
    ran = [f"{name} {times_ms[name]:.0f} ms" if name in times_ms else name for name in EFFECTS if name in frame.effects]
    left_out = [name for name in EFFECTS if name not in frame.effects]
    return np.where(frame.opaque_mask[..., None], frame.color, np.uint8(255)), f"{', '.join(ran)} | {', '.join(left_out)}"


def draw_sheet(folder: Path, name: str, light: str, width_px: int) -> tuple[Image.Image, list[str]]:
    """Return all styles of a place (a key of ``PLACES``) under a light (a key of ``LIGHTS``), side by side, and the table's rows.

    ``folder`` has the sample rasters. Each picture is ``width_px`` pixels wide.
    """
    place = PLACES[name]
    pictures, rows = [], []
    with tempfile.TemporaryDirectory() as scratch:
        scene = place_scene(place, folder, Path(scratch))
        for style in STYLES:
            picture, effects = draw_picture(scene, place, style, LIGHTS[light], width_px)
            pictures.append(picture)
            rows.append(f"| {name} | {light} | {style} | {effects} |")
    return Image.fromarray(np.concatenate(pictures, axis=1)), rows


def below_old_sheet(sheet: Image.Image, old_path: Path) -> Image.Image:
    """Return a sheet below the one of the same name that an earlier version wrote, if there is any."""
    if not old_path.exists():
        return sheet
    with Image.open(old_path) as old:
        page = Image.new("RGB", (max(old.width, sheet.width), old.height + sheet.height), "white")
        page.paste(old, (0, 0))
        page.paste(sheet, (0, old.height))
    return page


def main() -> None:
    """Write the sheets."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--old", type=Path, metavar="OTHER_OUT")
    parser.add_argument("--lights", nargs="*", default=list(LIGHTS), choices=list(LIGHTS))
    parser.add_argument("--side", type=int, default=480)
    parser.add_argument("--places", nargs="*", default=list(PLACES), choices=list(PLACES))
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    table = ["| place | light | style | effects that ran | left out |", "| --- | --- | --- | --- | --- |"]
    for name in args.places:
        for light in args.lights:
            file_name = f"{name.replace(', ', '-').replace(' ', '-')}-{light}.png"
            sheet, rows = draw_sheet(args.folder.resolve(), name, light, args.side)
            sheet.save(args.output / file_name)
            if args.old is not None:
                below_old_sheet(sheet, args.old / file_name).save(args.output / f"compared-{file_name}")
            table += rows
            print(f"{args.output / file_name}: {', '.join(STYLES)}", flush=True)
    (args.output / "effects.md").write_text("\n".join(table) + "\n", encoding="utf-8")
    if args.picture is not None:
        rows = [np.asarray(draw_sheet(args.folder.resolve(), name, "winter-noon", 320)[0]) for name in SHOWN_PLACES]
        Image.fromarray(np.concatenate(rows)).save(args.picture, quality=88, method=6)
        print(args.picture)


if __name__ == "__main__":
    main()
