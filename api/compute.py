"""Compute products block by block, from a request to an array or a file. All front ends use this module."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from skugga.api.contour_lines import write_contours
from skugga.api.device_calibration import calibration_for
from skugga.api.products import PRODUCTS, product_named
from skugga.api.products.product import Product, ProductInput, ProductOptions
from skugga.api.raster_file import RasterFile, RasterMetadata, open_cog
from skugga.api.raster_view import RasterView
from skugga.api.request import ProductRequest
from skugga.selector.select import plan_of_view
from skugga.shadows.draw import draw, picture_of
from skugga.shadows.passes import PassRecord
from skugga.shadows.picture import Picture
from skugga.shadows.plan import Plan
from skugga.shadows.render import Frame, render_frame
from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.caster_types import Reach
from skugga.terrain.errors import InputError
from skugga.terrain.gbuffer.bare_ground import trim_bare_ground_cache
from skugga.terrain.gbuffer.map_block import trim_map_block_cache
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import BLOCK_PX, MapView, blocks_of, overlap_windows
from skugga.terrain.scene import Scene

ViewT = TypeVar("ViewT", bound=MapView | PerspectiveView)

BLOCK_CACHE_BYTES = 24 * MIB
"""Size of the cache of recently computed blocks, for products that need no picture."""

ProgressCallback = Callable[[int, int], None]
"""Callback of progress: the number of finished steps and the total."""


@dataclass(frozen=True, eq=False)
class ComputedProduct:
    """A computed product of a view.

    Attributes
    ----------
    array
        The product's values, (rows, cols) or (rows, cols, bands).
    picture
        The picture from which the product was computed; ``None`` if it needs no picture.
    """

    array: np.ndarray
    picture: Picture | None = None

    @property
    def passes(self) -> tuple[PassRecord, ...]:
        """The passes that drew the picture."""
        return () if self.picture is None else self.picture.passes

    @property
    def reach(self) -> Reach | None:
        """The distance from the view up to which shadow casters were considered."""
        return None if self.picture is None else self.picture.reach


def compute(
    scene: Scene,
    view: MapView | PerspectiveView,
    request: ProductRequest,
    plan: Plan | None,
    light: str | None = None,
    on_block: ProgressCallback | None = None,
) -> ComputedProduct:
    """Compute a product of a view.

    Parameters
    ----------
    scene
        The scene with the request's sun and style (``PictureRequest.applied_to``).
    view
        The view to compute.
    request
        The product and its options.
    plan
        The plan of the view; ``None`` for a product that needs no picture.
    light
        The light whose visibility is computed; ``None`` takes the first.
    on_block
        Called after each block of pixels with the number of finished blocks and the total.

    Returns
    -------
    ComputedProduct
        The array, and the picture if the product needs one.

    Raises
    ------
    InputError
        The product is not defined for this kind of view, or the light does not reach it.
    SkuggaError
        Errors of ``draw`` and of the product.
    """
    product = request.product_record
    check_view(product, view)
    padded = _padded(view, product.margin_px)
    if plan is not None:
        picture = draw_picture(scene, padded, product, plan, light, on_block)
        product_input = ProductInput(scene, padded, request.options, picture)
        return ComputedProduct(_cropped(product.compute(product_input), product.margin_px), picture)
    assert isinstance(view, MapView)
    nodes = view.with_pixels_as_nodes()
    if not view.is_on_nodes and max(nodes.rows, nodes.cols) <= BLOCK_PX:
        return ComputedProduct(_compute_block(scene, nodes, product, request.options))
    out = product.empty_array(request.options, nodes.rows, nodes.cols, scene.height_range_m[0])
    blocks = blocks_of(nodes)  # as for tiles, so that maps and tiles have identical pixels
    for done, (block, row, col) in enumerate(blocks, start=1):
        window, block_window = overlap_windows(nodes, block, row, col)
        out[window] = _cached_block(scene, block, product.name, request.options)[block_window]
        if on_block is not None:
            on_block(done, len(blocks))
    return ComputedProduct(out)


def plan_for(
    scene: Scene,
    view: MapView | PerspectiveView,
    name: str,
    product: Product,
    overrides: dict[str, Any],
    has_time_limit: bool = False,
) -> Plan | None:
    """Return the plan of a view for a product; ``None`` if the product needs no picture.

    ``name`` is the view's name. ``overrides`` replace settings of the level's ``shadows``. ``has_time_limit`` says whether the
    caller compares the plan's expected time with a time limit. Raises ``InputError`` if the product is not defined for this kind of
    view.
    """
    check_view(product, view)
    if not product.needs_of(view):
        return None
    device = calibration_for(scene.loaded.level.shadows, overrides, shows_times=has_time_limit)
    return _plan_of_product(plan_of_view(scene, view, name, overrides, device=device), product)


def _plan_of_product(plan: Plan, product: Product) -> Plan:
    """Return a view's plan as a product needs it: data do not depend on what the air lets one see.

    In the thick of haze, pictures do not compute shadows, since nobody sees them.
    """
    if product.is_display:
        return plan
    reason = "data do not depend on what the air lets one see"
    return plan.without_effect("haze", reason).without_effect("precipitation", reason)


def draw_picture(
    scene: Scene,
    view: MapView | PerspectiveView,
    product: Product,
    plan: Plan,
    light: str | None = None,
    on_block: ProgressCallback | None = None,
) -> Picture:
    """Draw the images of a view's picture that a product needs. Raises the errors of ``compute``.

    ``light`` names the light whose visibility is drawn; ``None`` takes the first. ``on_block(done, total)`` is called after
    each block.
    """
    needed_parts, plan = product.needs_of(view), _plan_of_product(plan, product)
    if light is None and product.pass_layer is None:
        return draw(scene, view, plan, needed_parts, on_block)
    layers = frozenset() if product.pass_layer is None else frozenset({product.pass_layer})
    return picture_of(render_frame(scene, view, plan, on_block, layers).with_light_first(light), needed_parts)


def product_of_frame(scene: Scene, frame: Frame, name: str) -> np.ndarray:
    """Return the product ``name`` of a rendered video frame, (rows, cols) or (rows, cols, bands). Raises ``InputError``."""
    product = product_named(name)
    picture = picture_of(frame, frozenset({"color", "opacity", "visibility", "reach", "frame"}))
    return product.compute(ProductInput(scene, frame.view, product.options(), picture))


def check_view(product: Product, view: MapView | PerspectiveView) -> None:
    """Raise ``InputError`` if a product is not defined for a view's kind."""
    kind = "map" if isinstance(view, MapView) else "perspective"
    if kind not in product.view_kinds:
        allowed = [name for name, candidate in PRODUCTS.items() if kind in candidate.view_kinds]
        raise InputError("layer", product.name, f"the layers of a {kind} view: {', '.join(allowed)}")


def _compute_block(
    scene: Scene, block: MapView, product: Product, options: Any, on_step: Callable[[], None] = lambda: None
) -> np.ndarray:
    """Return the values of a product that needs no picture in one block: a rectangular section of the pixels of a map view.

    ``block`` is that section as a map view of its own. ``options`` are the product's. ``on_step`` is called after each step of a
    product over days, such as one date. The result has the shape (rows, cols) or (rows, cols, bands).
    """
    product_input = ProductInput(scene, _padded(block, product.margin_px), options, None, on_step)
    return _cropped(product.compute(product_input), product.margin_px)


def _picture_block(scene: Scene, block: MapView, product: Product, options: Any, plan: Plan) -> np.ndarray:
    """Return the values of a product in one block of a map view's pixels, computed from a picture that is drawn for it.

    ``block`` is that section as a map view of its own. The picture does not record its reach, the distance up to which
    casters count.
    """
    padded = _padded(block, product.margin_px)
    picture = draw(scene, padded, plan, product.needs - {"reach"})
    return _cropped(product.compute(ProductInput(scene, padded, options, picture)), product.margin_px)


@cached("scene", BLOCK_CACHE_BYTES)
def _cached_block(scene: Scene, block: MapView, product: str, options: ProductOptions) -> np.ndarray:
    """Return ``_compute_block`` of a block, from the cache if possible; ``product`` is the product's name.

    Clients that tile maps themselves request many small maps of one block.
    """
    return _compute_block(scene, block, PRODUCTS[product], options)


def _blocks_of_view(scene: Scene, view: MapView, product: Product, options: Any) -> list[tuple[MapView, int, int]]:
    """Return the blocks in which a product of a map view is computed: each as a view, with its first row and column in ``view``."""
    return blocks_of(view) if product.blocks is None else product.blocks(scene, view, options)


def _padded(view: ViewT, margin_px: int) -> ViewT:
    """Return a view extended by ``margin_px`` pixels on each side."""
    if not margin_px:
        return view
    return view.part(-margin_px, -margin_px, view.rows + 2 * margin_px, view.cols + 2 * margin_px)  # type: ignore[return-value]


def _cropped(array: np.ndarray, margin_px: int) -> np.ndarray:
    """Return an array without its outermost ``margin_px`` pixels on each side."""
    return array[margin_px : array.shape[0] - margin_px, margin_px : array.shape[1] - margin_px]


@dataclass(frozen=True, eq=False)
class PlannedRequest:
    """A request with its scene and its plan, before its raster is computed.

    Attributes
    ----------
    request
        The request.
    scene
        The scene with the request's sun and style.
    plan
        The plan of all blocks; ``None`` if the product needs no picture.
    """

    request: ProductRequest
    scene: Scene
    plan: Plan | None


@dataclass(frozen=True, eq=False)
class RasterPart:
    """The values of a raster in one block, a rectangular section of its cells.

    Attributes
    ----------
    request
        Index of the request whose raster it is.
    row, col
        First row and column in the raster.
    array
        Values, (rows, cols) or (rows, cols, bands).
    """

    request: int
    row: int
    col: int
    array: np.ndarray


def plan_requests(
    scene: Scene, raster: RasterView, requests: Sequence[ProductRequest], overrides: dict[str, Any]
) -> list[PlannedRequest]:
    """Return several requests for one product with their plans, which are made for the middle block of a raster.

    ``overrides`` replace settings of the level's ``shadows``. Raises ``SkuggaError`` if a request is wrong.
    """
    product, view = requests[0].product_record, raster.view
    check_view(product, view)
    for request in requests:
        if product.when == "sun" and scene.sun is None and request.sun is None:
            raise InputError.missing("time", "The level has no sun. Give a time, or an azimuth and an altitude")
    scenes = [request.applied_to(scene) for request in requests]
    plans = _plans_of_scenes(scenes, view, product, overrides)
    return [PlannedRequest(*parts) for parts in zip(requests, scenes, plans, strict=True)]


def raster_parts(
    scene: Scene, raster: RasterView, planned_requests: Sequence[PlannedRequest], on_step: ProgressCallback | None = None
) -> Iterator[RasterPart]:
    """Yield the values of a raster block by block, for each of several planned requests for one product. Raises ``SkuggaError``.

    Only one block is in memory at a time. The values of one block follow each other, one array for each request. Work that is
    independent of the sun is thus done once for each block. ``on_step(done, total)`` is called after each step, of all blocks and
    requests.
    """
    product, view = planned_requests[0].request.product_record, raster.view
    blocks = _blocks_of_view(scene, view, product, planned_requests[0].request.options)
    total = sum(product.step_count(planned_request.request.options) for planned_request in planned_requests) * len(blocks)
    done = 0

    def report_step() -> None:
        nonlocal done
        done += 1
        if on_step is not None:
            on_step(done, total)

    for block, row, col in blocks:
        window, block_window = overlap_windows(view, block, row, col)
        for number, planned_request in enumerate(planned_requests):
            if planned_request.plan is None:
                array = _compute_block(planned_request.scene, block, product, planned_request.request.options, report_step)
            else:
                array = _picture_block(planned_request.scene, block, product, planned_request.request.options, planned_request.plan)
            yield RasterPart(number, *raster.window_in_raster_order(window[0].start, window[1].start, array[block_window]))
            if product.when != "days":
                report_step()
        trim_bare_ground_cache(1)
        trim_map_block_cache(1)


def _plans_of_scenes(scenes: Sequence[Scene], view: MapView, product: Product, overrides: dict[str, Any]) -> list[Plan | None]:
    """Return one plan for each scene, made for the middle block; ``None`` if the product needs no picture."""
    if not product.needs:
        return [None] * len(scenes)
    blocks = blocks_of(view)
    middle, device = blocks[len(blocks) // 2][0], calibration_for(scenes[0].loaded.level.shadows, overrides)
    return [plan_of_view(lit_scene, middle, "map", overrides, device=device) for lit_scene in scenes]


def write_rasters(
    scene: Scene,
    raster: RasterView,
    requests: Sequence[ProductRequest],
    paths: Sequence[Path],
    overrides: dict[str, Any] | None = None,
    on_step: ProgressCallback | None = None,
    contours: tuple[Path, Sequence[float]] | None = None,
) -> None:
    """Write a raster file for each of several requests, and optionally contours of the first raster.

    ``paths`` are the files, in the order of the requests. ``overrides`` replace settings of the level's ``shadows``.
    ``contours`` is the file of the contours and their values. ``on_step(done, total)`` is called after each step. Raises the
    errors of ``plan_requests`` and ``raster_parts``, and ``OSError``.
    """
    planned_requests = plan_requests(scene, raster, requests, overrides or {})
    metadata = [raster_metadata(planned_request, overrides or {}) for planned_request in planned_requests]
    with ExitStack() as stack:
        files: list[RasterFile] = [
            stack.enter_context(
                open_cog(
                    path,
                    raster.crs,
                    raster.transform,
                    raster.shape,
                    request.product_record.profile(request.options),
                    request.product_record.is_smooth,
                    file_metadata,
                )  # fmt: skip
            )
            for request, path, file_metadata in zip(requests, paths, metadata, strict=True)
        ]
        for part in raster_parts(scene, raster, planned_requests, on_step):
            files[part.request].write(part.row, part.col, part.array)
    if contours is not None:
        write_contours(paths[0], contours[1], contours[0])


def raster_array(scene: Scene, raster: RasterView, request: ProductRequest, overrides: dict[str, Any] | None = None) -> np.ndarray:
    """Return a raster as one array (rows, cols) or (rows, cols, bands). Raises the errors of ``write_rasters``."""
    planned_requests = plan_requests(scene, raster, [request], overrides or {})
    out = request.product_record.empty_array(request.options, *raster.shape, scene.height_range_m[0])
    for part in raster_parts(scene, raster, planned_requests):
        rows, cols = part.array.shape[:2]
        out[part.row : part.row + rows, part.col : part.col + cols] = part.array
    return out


def raster_metadata(planned_request: PlannedRequest, overrides: dict[str, Any]) -> RasterMetadata:
    """Return a raster's metadata: the product, the level, the options or the sun, the algorithms and the requested settings.

    The sun's angles are those at the centre of the level. The algorithms are those of the plan.
    """
    request, scene, plan = planned_request.request, planned_request.scene, planned_request.plan
    product, sun = request.product_record, scene.sun
    description, unit = product.description_and_unit(request.options)
    tags = {"layer": product.name, "level": scene.loaded.name, **product.tags(request.options, scene)}
    if product.when == "sun":
        if sun is not None:
            tags |= {
                "time": "" if sun.time is None else sun.time.isoformat(),
                "sun_azimuth_deg": f"{sun.azimuth_deg:.4f}", "sun_altitude_deg": f"{sun.altitude_deg:.4f}",
            }  # fmt: skip
        requested = {name: value for name, value in overrides.items() if value is not None and name != "algorithm"}
        tags |= {
            "algorithm": "" if plan is None else plan.algorithms_text,
            **{f"shadows_{name}": str(value) for name, value in requested.items()},
        }
    return RasterMetadata(f"{product.name}: {description}", product.band_names(request.options), unit, tags)
