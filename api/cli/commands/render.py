"""``skugga render``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from skugga.api.cli.common_options import (
    AltitudeOption,
    AzimuthOption,
    BoundsOption,
    CrsOption,
    SecondsOption,
    SizeOption,
    SkyOption,
    SlopeExaggerationOption,
    StyleOption,
    TimeOption,
    ViewOption,
    read_bounds,
    read_size,
    read_style,
)
from skugga.api.cli.completion import complete_words
from skugga.api.cli.level_argument import with_level_argument
from skugga.api.cli.options import overrides_of, with_shadow_options
from skugga.api.cli.outputs import check_output_files
from skugga.api.cli.product_parameters import split_product_options, with_product_options
from skugga.api.cli.progress import ProgressBar
from skugga.api.cli.times import sun_from_options
from skugga.api.products import PRODUCTS, product_named
from skugga.api.products.product import Product
from skugga.terrain.atomic_files import write_atomically
from skugga.terrain.errors import InputError
from skugga.terrain.level.level_source import LevelSource

# Names of layers: products of a moment, and intermediate pictures of an algorithm's render passes.
_LAYERS = [name for name, product in PRODUCTS.items() if product.pass_layer is None and product.when != "days"]
_PASS_LAYERS = [name for name, product in PRODUCTS.items() if product.pass_layer is not None]
_LayerOption = Annotated[
    str,
    typer.Option(
        help=f"{', '.join(_LAYERS[:-1])} or {_LAYERS[-1]}; or an intermediate picture of an algorithm: {', '.join(_PASS_LAYERS)}.",
        autocompletion=complete_words([*_LAYERS, *_PASS_LAYERS]),
    ),
]


@with_level_argument
@with_product_options(_LAYERS, after_parameter="layer")
@with_shadow_options("render")
def render(
    level: LevelSource,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="File to write; the suffix sets the format. Films: .webp, .mp4 or frames/%04d.png."),
    ],
    view: ViewOption = "map",
    layer: _LayerOption = "color",
    time: TimeOption = None,
    azimuth: AzimuthOption = None,
    altitude: AltitudeOption = None,
    size: SizeOption = None,
    bounds: BoundsOption = None,
    crs: CrsOption = None,
    light: Annotated[str | None, typer.Option(help="Light to show, for layers of a single light.")] = None,
    style: StyleOption = None,
    slope_exaggeration: SlopeExaggerationOption = None,
    sky: SkyOption = None,
    seconds: SecondsOption = None,
    start: Annotated[
        str | None,
        typer.Option("--from", metavar="TIME", help="Film: first time, or first clock reading such as 0s."),
    ] = None,
    end: Annotated[str | None, typer.Option("--to", metavar="TIME", help="Film: last time or reading.")] = None,
    step: Annotated[str | None, typer.Option(metavar="10m", help="Film: interval between frames, such as 30s, 10m or 1h.")] = None,
    path: Annotated[
        Path | None, typer.Option(metavar="CAMERA.yaml", help="Film: key positions and times of a moving camera.")
    ] = None,
    fps: Annotated[float | None, typer.Option(help="Film: frames per second of playback; default: 25.")] = None,
    lossless: Annotated[bool, typer.Option("--lossless", help="Film as .webp: lossless compression, six times the size.")] = False,
    max_ms: Annotated[
        float | None,
        typer.Option(help="Longest expected time of a block, view or frame, ms; default: the limit of a service (60 s).", min=0.0),
    ] = None,
    stats: Annotated[
        Path | None, typer.Option(metavar="FILE.json", help="Write plan, passes, times and caster reach as JSON.")
    ] = None,
    **declared_options: Any,
) -> None:
    """Render a view of a level to an image file, or to a film with a moving sun or camera."""
    from skugga.api.cli.film import FilmOptions, render_film
    from skugga.api.cli.snapshot import snapshot, snapshot_statistics
    from skugga.api.request import ProductRequest

    product = product_named(layer, (*_LAYERS, *_PASS_LAYERS))
    options, declared_options = split_product_options(product, declared_options)
    film = FilmOptions(start, end, step, path, fps, lossless)
    if film.used_option_names:
        if light is not None:
            raise InputError.conflict("--light", film.used_option_names[0], "Leave out --light: films show all lights")
        sun, style_overrides = sun_from_options(time, azimuth, altitude), read_style(style, slope_exaggeration, sky)
        view_options = read_size(size), read_bounds(bounds), crs, seconds
        render_film(
            level,
            output,
            film,
            view,
            layer,
            sun,
            overrides_of("render", declared_options),
            *view_options,
            style_overrides,
            stats,
            max_ms,
        )
        return
    check_output(product, output)
    check_output_files(level, [("--output", output), ("--stats", stats)])
    overrides = overrides_of("render", declared_options)
    with ProgressBar("Rendering") as advance:
        request = ProductRequest(product=layer, options=options, sun=sun_from_options(time, azimuth, altitude))
        extent, style_overrides = (read_size(size), read_bounds(bounds), crs), read_style(style, slope_exaggeration, sky)
        result = snapshot(level, view, request, overrides, *extent, advance, seconds, light, max_ms, style_overrides)
    result.write(request, output)
    if stats is not None:
        write_atomically(stats, json.dumps(snapshot_statistics(result), indent=2) + "\n")


def check_output(product: Product, path: Path) -> None:
    """Raise ``InputError`` unless the suffix is that of a format of the product."""
    suffixes = [f".{format}" for format in product.formats]
    if path.suffix.lower() not in suffixes:
        raise InputError("--output", str(path), f"{', '.join(suffixes)} for layer {product.name}")
    if not path.parent.is_dir():
        raise FileNotFoundError(2, "folder not found", str(path))
