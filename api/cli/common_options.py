"""Options that several commands have, and how their values are read."""

from __future__ import annotations

from typing import Annotated

import typer

from skugga.terrain.errors import InputError

JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
ViewOption = Annotated[str, typer.Option(help="A view of the level.")]
TimeOption = Annotated[str | None, typer.Option(help="Date and time, ISO 8601 with an offset, as 2024-10-21T16:30:00-04:00.")]
AzimuthOption = Annotated[float | None, typer.Option(help="Degrees clockwise from north.")]
AltitudeOption = Annotated[float | None, typer.Option(help="Degrees above the horizon as seen, refraction included.")]
SizeOption = Annotated[str | None, typer.Option(metavar="WxH", help="Pixels.")]
BoundsOption = Annotated[str | None, typer.Option(metavar="W,S,E,N", help="In units of the output CRS.")]
CrsOption = Annotated[str | None, typer.Option(metavar="EPSG", help="Output CRS.")]
SecondsOption = Annotated[float | None, typer.Option(help="The level's clock, seconds: what moves is where it is then.")]


def read_size(text: str | None) -> tuple[int, int] | None:
    """Read the width and height of ``--size``. Raises ``InputError``."""
    if text is None:
        return None
    width, cross, height = text.lower().partition("x")
    if not (
        cross and text.isascii() and width.isdigit() and height.isdigit() and 1 <= int(width) <= 16384 and 1 <= int(height) <= 16384
    ):
        raise InputError("--size", text, "WxH, 1x1 to 16384x16384, as 1280x1024")
    return int(width), int(height)


def read_bounds(text: str | None) -> tuple[float, float, float, float] | None:
    """Read the four numbers of ``--bounds``. Raises ``InputError``."""
    if text is None:
        return None
    try:
        west, south, east, north = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError("--bounds", text, "W,S,E,N: four numbers in units of the output CRS") from None
    return west, south, east, north
