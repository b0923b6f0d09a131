"""Draw the pictures of the gallery by the commands that ``docs/gallery.md`` shows below them.

    python -m scripts.draw_gallery [NAME ...] [--data DIR] [--page docs/gallery.md] [-o docs/images]

Without names it draws every picture whose command it can run. ``DIR`` has the downloaded files that commands name, with the names
that they have at their sources; level files come from ``examples/gallery``. Pictures whose files are missing are skipped, with a
line that says so, and so are those of ``OTHER_SCRIPTS``.

Pictures and frames of films are reduced to ``MAX_SIDE_PX``. A raster of numbers gets the colours of ``COLORMAPS`` between its
percentiles of 2 and 98, as QGIS shows one; a mask is black and white.
"""

from __future__ import annotations

import argparse
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import pairwise
from pathlib import Path

import numpy as np
import rasterio
from PIL import Image

from scripts.contact_sheet import encode_webp

ROOT = Path(__file__).resolve().parents[1]
PAGE_PATH = ROOT / "docs" / "gallery.md"
PICTURE_FOLDER = ROOT / "docs" / "images"
LEVEL_FOLDER = ROOT / "examples" / "gallery"

OTHER_SCRIPTS = {
    "edges": "several commands, cut by hand",
    "effects-ambient_occlusion": "an effect off and on, docs/reports/effects.md",
    "effects-facades": "an effect off and on, docs/reports/effects.md",
    "scenes": "scripts/contact_sheet.py",
    "styles": "benchmarks/styles.py",
    "viewer": "a browser",
}
"""Pictures of the gallery that no single command draws, and where they come from."""

MAX_SIDE_PX = 1080
"""Longest side of a picture. A card of the page is at most half as wide, on screens of two pixels to each of CSS."""

MAX_BYTES = 88_000
"""Limit of a picture's file, so that the whole page loads at most 3 MB."""

COLORMAPS = {"hours": "inferno", "first": "viridis", "irradiation": "inferno", "sky_view": "gray"}
"""Name of matplotlib's colour map, by a word of the command that writes a raster of numbers; ``hours`` is the default quantity."""

COLOR_PERCENTILES = 2.0, 98.0
FILM_COLUMNS, FILM_GAP_PX = 3, 8

DATA_FILE = re.compile(r"[\w./-]+\.(?:tif|vrt|yaml|gpkg|shp|geojson|csv)\b")
"""Name of a file that a command or a level file reads."""

OUTPUT_OPTIONS = ("-o", "--output", "--picture")
COMMANDS_WITHOUT_OUTPUT = ("serve",)
"""Commands that show a picture and write no file."""


@dataclass(frozen=True)
class GalleryPicture:
    """A picture of the page and the command below it.

    Attributes
    ----------
    name
        Name of the file without its suffix.
    arguments
        Words of its first command after ``skugga``; empty if no command follows before the next picture.
    """

    name: str
    arguments: tuple[str, ...]

    @property
    def output(self) -> str | None:
        """File or folder that the command writes, or ``None``."""
        return next((path for word, path in pairwise(self.arguments) if word in OUTPUT_OPTIONS), None)

    @property
    def inputs(self) -> set[str]:
        """Names of the files that the command reads."""
        return {word for word in self.arguments if DATA_FILE.fullmatch(word) and word != self.output}


def gallery_pictures(page: str) -> list[GalleryPicture]:
    """Return the pictures of the page in their order.

    Parameters
    ----------
    page
        The Markdown text.
    """
    pictures = []
    for part in re.split(r"(?=!\[[^]]*\]\(images/)", page)[1:]:
        name = re.match(r"!\[[^]]*\]\(images/([\w-]+)\.\w+\)", part)
        block = re.search(r"^```sh\n(.*?)^```$", part, re.DOTALL | re.MULTILINE)
        lines = block[1].replace("\\\n", " ").splitlines() if block else []
        command = next((line for line in lines if line.startswith("skugga ")), "")
        if name:
            pictures.append(GalleryPicture(name[1], tuple(shlex.split(command, comments=True)[1:])))
    return pictures


def fill_folder(picture: GalleryPicture, folder: Path, data: Path | None) -> list[str]:
    """Copy the files that a picture's command and its level file read into a folder, and return the names of missing ones.

    A file comes with those of the same stem, which are parts of a shapefile. ``examples`` is linked.
    """
    (folder / "examples").symlink_to(ROOT / "examples")
    names = set(picture.inputs)
    for level in (LEVEL_FOLDER / name for name in picture.inputs if (LEVEL_FOLDER / name).is_file()):
        shutil.copy(level, folder)
        names |= set(DATA_FILE.findall(" ".join(re.findall(r"(?:source|surface|ground): *([^ ,}\n]+)", level.read_text("utf-8")))))
    for file in (file for name in names if data for file in data.glob(f"{Path(name).stem}.*")):
        shutil.copy(file, folder)
    return sorted(name for name in names if not (folder / name).is_file())


def run_command(arguments: Sequence[str], folder: Path) -> None:
    """Run ``skugga`` in a folder. Raises ``subprocess.CalledProcessError``."""
    program = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from skugga.api.cli.main import main; main()"
    subprocess.run([sys.executable, "-c", program, *arguments], cwd=folder, check=True)


def read_picture(picture: GalleryPicture, folder: Path) -> Image.Image:
    """Return what a command wrote: a picture, a sheet of a film's frames, or a raster in colours."""
    output = picture.output or ""
    if "%" in output:
        frames = sorted((folder / output).parent.glob("*" + Path(output).suffix))
        return film_sheet([Image.open(frame).convert("RGB") for frame in frames])
    if (folder / output).is_dir():  # of ``compare``: error pictures, one a row
        output = str(Path(output) / min(file.name for file in (folder / output).glob("*.png")))
    if output.endswith(".tif"):
        return color_raster(folder / output, next(COLORMAPS[word] for word in (*picture.arguments, "hours") if word in COLORMAPS))
    image = Image.open(folder / output)
    return image.convert("RGBA" if "A" in image.getbands() and image.getextrema()[-1][0] < 255 else "RGB")  # type: ignore[index]


def film_sheet(frames: Sequence[Image.Image]) -> Image.Image:
    """Return the frames of a film in rows of ``FILM_COLUMNS``."""
    width, height = frames[0].size
    step_x, step_y = width + FILM_GAP_PX, height + FILM_GAP_PX
    rows = -(-len(frames) // FILM_COLUMNS)
    sheet = Image.new("RGB", (min(len(frames), FILM_COLUMNS) * step_x - FILM_GAP_PX, rows * step_y - FILM_GAP_PX), "white")
    for number, frame in enumerate(frames):
        sheet.paste(frame, (number % FILM_COLUMNS * step_x, number // FILM_COLUMNS * step_y))
    return sheet


def color_raster(path: Path, colormap: str) -> Image.Image:
    """Return the first band of a raster: a mask (uint8) in grey, numbers in colours, cells without data transparent.

    A small raster is enlarged by a whole factor, so that its cells stay squares.
    """
    from matplotlib import colormaps

    with rasterio.open(path) as raster:
        band = raster.read(1)
    if band.dtype == np.uint8:
        image = Image.fromarray(band)
    else:
        valid = np.isfinite(band)
        low, high = np.percentile(band[valid], COLOR_PERCENTILES)
        colors = colormaps[colormap](np.clip((np.where(valid, band, low) - low) / (high - low), 0.0, 1.0), bytes=True)
        colors[~valid] = 0
        image = Image.fromarray(colors if not valid.all() else colors[..., :3])
    factor = max(1, MAX_SIDE_PX // max(image.size))
    return image.resize((image.width * factor, image.height * factor), Image.Resampling.NEAREST)


def reduce_picture(image: Image.Image) -> Image.Image:
    """Return a picture whose longest side is at most ``MAX_SIDE_PX``."""
    scale = MAX_SIDE_PX / max(image.size)
    if scale >= 1.0:
        return image
    return image.resize((round(image.width * scale), round(image.height * scale)), Image.Resampling.LANCZOS)


def encode_picture(image: Image.Image) -> bytes:
    """Return a picture as WebP: a mask without loss, others at the best quality that ``MAX_BYTES`` allows."""
    if image.mode != "L":
        return encode_webp(image, MAX_BYTES)
    buffer = BytesIO()
    image.save(buffer, "WEBP", lossless=True, method=6)
    return buffer.getvalue()


def draw(pictures: Sequence[GalleryPicture], data: Path | None, output: Path) -> Iterator[str]:
    """Draw pictures into the folder ``output`` and yield a line about each."""
    for picture in pictures:
        if picture.name in OTHER_SCRIPTS:
            yield f"{picture.name}: skipped, drawn by {OTHER_SCRIPTS[picture.name]}"
            continue
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            if missing := fill_folder(picture, folder, data):
                yield f"{picture.name}: skipped, missing in --data: {', '.join(missing)}"
                continue
            run_command(picture.arguments, folder)
            image = reduce_picture(read_picture(picture, folder))
            content = encode_picture(image)
        (output / f"{picture.name}.webp").write_bytes(content)
        yield f"{picture.name}: {image.width} x {image.height}, {len(content) / 1000:.0f} kB"


def main() -> int:
    """Draw the pictures and return the exit status."""
    parser = argparse.ArgumentParser(description="Draw the pictures of the gallery by the commands below them.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="pictures to draw; default: all")
    parser.add_argument("--data", type=Path, help="folder with the downloaded files that commands name")
    parser.add_argument("--page", type=Path, default=PAGE_PATH, help="the page")
    parser.add_argument("-o", "--output", type=Path, default=PICTURE_FOLDER, help="folder of the pictures")
    arguments = parser.parse_args()
    pictures = gallery_pictures(arguments.page.read_text(encoding="utf-8"))
    if unknown := sorted(set(arguments.names) - {picture.name for picture in pictures}):
        parser.error(f"{', '.join(unknown)}: not on the page. Use a name of its pictures")
    chosen = [picture for picture in pictures if not arguments.names or picture.name in arguments.names]
    for line in draw(chosen, arguments.data, arguments.output):
        print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
