"""Options that several commands share, and the parsers of their values."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from skugga.api.cli.completion import complete_words
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.level.parts import SkyName, StyleName, StyleSpec

if TYPE_CHECKING:
    from skugga.api.products.product import Product

JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
ViewOption = Annotated[str, typer.Option(help="Name of a view of the level.")]
TimeOption = Annotated[str | None, typer.Option(help="Date and time, ISO 8601 with an offset, such as 2024-10-21T16:30:00-04:00.")]
AzimuthOption = Annotated[float | None, typer.Option(help="Azimuth of the sun, degrees clockwise from north.")]
AltitudeOption = Annotated[float | None, typer.Option(help="Altitude of the sun in degrees, with refraction.")]
SizeOption = Annotated[str | None, typer.Option(metavar="WxH", help="Width and height in pixels.")]
BoundsOption = Annotated[str | None, typer.Option(metavar="W,S,E,N", help="Bounds in units of the output CRS.")]
CrsOption = Annotated[str | None, typer.Option(metavar="EPSG", help="Output CRS.")]
_STYLES, _SKIES = ("auto", *get_args(StyleName)), get_args(SkyName)
StyleOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME|FILE",
        help=f"Style of relief shading: {', '.join(_STYLES)}; or a YAML or JSON file with the keys of a level's style.",
        autocompletion=complete_words(_STYLES),
    ),
]
SlopeExaggerationOption = Annotated[
    float | None, typer.Option(help="Factor of slopes in shading, 0.1 to 20; it does not change cast shadows.")
]
SkyOption = Annotated[
    str | None,
    typer.Option(help=f"Sky that lights the ground of maps: {', '.join(_SKIES)}.", autocompletion=complete_words(_SKIES)),
]
SecondsOption = Annotated[float | None, typer.Option(help="Time on the level's clock, seconds, which moves animated parts.")]


def read_style(style: str | None, slope_exaggeration: float | None = None, sky: str | None = None) -> dict[str, Any]:
    """Return the style of ``--style``, ``--slope-exaggeration`` and ``--sky`` as fields of a ``PictureRequest``.

    ``style`` is a name or a file. The other two options take precedence over the file's keys. A key that is nowhere is absent,
    so the level's applies. Raises ``InputError``, and ``LevelError`` for a wrong file.
    """
    from skugga.terrain.color_ramp import ramp_text
    from skugga.terrain.level.style_file import STYLE_FILE_SUFFIXES, load_style_keys
    from skugga.terrain.style import style_spec

    keys: dict[str, Any] = {}
    if style is not None and style not in _STYLES:
        if Path(style).suffix.lower() not in STYLE_FILE_SUFFIXES:
            raise InputError("--style", style, f"{', '.join(_STYLES)}, or a file whose name ends in .yaml, .yml or .json")
        keys = load_style_keys(Path(style))
        if keys.get("ramp") is not None:
            keys["ramp"] = ramp_text(keys["ramp"])
        style = keys.pop("name", None)
    options = {"style": style, "slope_exaggeration": slope_exaggeration, "sky": sky}
    try:
        style_spec(StyleSpec(), style, slope_exaggeration, sky)
    except InputError as error:
        raise error.renamed(f"--{error.name.replace('_', '-')}") from None
    return keys | {name: value for name, value in options.items() if value is not None}


def check_has_style(product: Product, style: str | None, slope_exaggeration: float | None = None, sky: str | None = None) -> None:
    """Raise ``InputError`` for an option of styles with a product that has no style."""
    for name, value in {"style": style, "slope-exaggeration": slope_exaggeration, "sky": sky}.items():
        if value is not None and not product.is_display:
            raise InputError(f"--{name}", Problem(f"the layer {product.name} has no style"), "Use it with --layer color")


def read_size(text: str | None) -> tuple[int, int] | None:
    """Return the width and height of ``--size``, pixels. Raises ``InputError``."""
    if text is None:
        return None
    width, cross, height = text.lower().partition("x")
    if not (
        cross and text.isascii() and width.isdigit() and height.isdigit() and 1 <= int(width) <= 16384 and 1 <= int(height) <= 16384
    ):
        raise InputError("--size", text, "WxH from 1x1 to 16384x16384, such as 1280x1024")
    return int(width), int(height)


def read_bounds(text: str | None) -> tuple[float, float, float, float] | None:
    """Return west, south, east and north of ``--bounds``. Raises ``InputError``."""
    if text is None:
        return None
    try:
        west, south, east, north = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError("--bounds", text, "W,S,E,N: four numbers in units of the output CRS") from None
    return west, south, east, north
