"""The requirements of a view that an algorithm has to serve: kinds of view, light, casters, ground and rays."""

from __future__ import annotations

from typing import Literal

from skugga.shadows.bent_rays import rays_bend
from skugga.shadows.penumbra import light_point_count
from skugga.terrain.facts.descriptor import Descriptor, LightKind
from skugga.terrain.level.level import SUN, CasterKind, Shadows

ViewKind = Literal["map", "bent map", "perspective"]
"""``bent map``: a map that no affine camera fits, because the earth's curvature and the projection bend it."""

GroundKind = Literal["level", "planes", "uneven"]
"""``level``: the ground is level, in a flat world without relief. ``planes``: any other ground, where all visible surfaces lie in
at most ``MAX_RECEIVER_PLANES`` planes. ``uneven``: neither."""

RayKind = Literal["bent rays"]
"""``bent rays``: the sun's rays are no straight lines in the area drawn at once, which is too wide or lies near a pole."""

ExtentKind = Literal["area light"]
"""``area light``: the light is shown as a disc or a ball, with penumbrae."""

Requirement = ViewKind | LightKind | CasterKind | GroundKind | RayKind | ExtentKind
"""One requirement of an algorithm: a kind of view, light, casters, ground or rays, or the extent of a light."""

FALLBACK_REQUIREMENT: Requirement = "bent rays"
"""The requirement for which an algorithm that is requested by name falls back to ``shadow_map`` without an error.

The requirement depends on the zoom, and a level that requests a sweep has all zooms.
"""

MAX_RECEIVER_PLANES = 64
"""Upper bound of the number of planes that receive projected casters, which are drawn once for each plane.

Up to here, shadow volumes take longer: 52 planes of a street take 0.9 of their time on llvmpipe. 1024 planes of a room, most of
them on its books and dishes, take 1.3 of it.
"""

MAX_BEND_PX = 0.25
"""Upper bound, in pixels, of the error of an affine camera that approximates a part of a map.

Algorithms that draw casters in the view itself need such cameras. Above the bound the map is a ``bent map``.
"""

BENT_MAP_REASON = "the map is not affine: at this scale no affine camera fits it within a quarter of a pixel"
"""The reason with which an algorithm that draws casters in the view itself refuses a ``bent map``."""


def is_area_light(descriptor: Descriptor, light: str, shadows: Shadows) -> bool:
    """Return whether a light is shown as an area light.

    The sun is shown as its disc if ``filter`` is ``sun``. A lamp is shown as its ball if it has a radius and either ``filter`` is
    ``sun``, or ``filter`` is ``auto`` and its penumbrae are wider than a pixel.

    Parameters
    ----------
    descriptor
        The facts of a view.
    light
        The name of the light.
    shadows
        The requested shadow settings.

    Returns
    -------
    bool
        Whether the light is shown with penumbrae.
    """
    if light == SUN:
        return shadows.filter == "sun"
    radius_m = next((lamp.radius_m for lamp in descriptor.lamps if lamp.name == light), 0.0)
    return radius_m > 0.0 and (shadows.filter == "sun" or (shadows.filter == "auto" and light_point_count(descriptor, light) > 1))


def requirements_of(
    descriptor: Descriptor, light_kind: LightKind, caster_kind: CasterKind, is_area_light: bool = False
) -> tuple[Requirement, ...]:
    """Return the requirements that an algorithm has to serve for a light and a kind of casters.

    Parameters
    ----------
    descriptor
        The facts of a view.
    light_kind
        The kind of the light.
    caster_kind
        The kind of casters.
    is_area_light
        Whether the light is shown as an area light.

    Returns
    -------
    tuple of Requirement
        The kinds of view, light, casters and ground; then ``bent rays`` and ``area light`` where they apply.
    """
    view: tuple[Requirement, ...] = (
        (descriptor.view_kind, "bent map") if descriptor.bend_px > MAX_BEND_PX else (descriptor.view_kind,)
    )
    rays: tuple[Requirement, ...] = ("bent rays",) if light_kind == "sun" and rays_bend(descriptor) else ()
    extent: tuple[Requirement, ...] = ("area light",) if is_area_light else ()
    return (*view, light_kind, caster_kind, ground_kind(descriptor), *rays, *extent)


def ground_kind(descriptor: Descriptor) -> GroundKind:
    """Return the kind of ground of a view.

    Parameters
    ----------
    descriptor
        The facts of a view.

    Returns
    -------
    GroundKind
        The kind of ground.
    """
    if descriptor.flat_world and descriptor.relief_m <= 0.0:
        return "level"
    return "planes" if descriptor.plane_share == 1.0 and has_few_planes(descriptor) else "uneven"


def has_few_planes(descriptor: Descriptor) -> bool:
    """Return whether the visible ground and meshes are known to lie in at most ``MAX_RECEIVER_PLANES`` planes.

    Parameters
    ----------
    descriptor
        The facts of a view.

    Returns
    -------
    bool
        Whether they do. Leaves do not count.
    """
    return descriptor.receiver_planes is not None and descriptor.receiver_planes <= MAX_RECEIVER_PLANES
