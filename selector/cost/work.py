"""What a step of a plan has to do, counted from the descriptor alone: pixels, texels, triangles, trees, faces of volumes.

The counts of each part of an algorithm (named after the algorithm, or after what several share, and after the kind of view or
light where the work is another one) are of things that take the same time whatever the scene, as far as may be: a device's time is
the sum of counts times its rates (``selector.cost.cost_model``). Counts of a map view are those of one block.
"""

from __future__ import annotations

from collections.abc import Collection
from math import ceil

import numpy as np

from selector.cost.task import Task
from shadows.maps.windows import BORDER_TEXELS, POSITION_ERROR, SIZE_STEP
from shadows.plan import (
    HybridSettings,
    LampMapSettings,
    PerspectiveMapSettings,
    Settings,
    ShadowMapSettings,
    SweepSettings,
    TruthSettings,
    VolumeSettings,
)
from shadows.sweep.sweep import STRIPS
from shadows.volumes.tiles import LEAST_TILES, RECTANGLE_FACES, TILE_PX
from terrain.casters.clip_space import PART_PX
from terrain.casters.reach import PATCH_QUADS
from terrain.facts.descriptor import Descriptor
from terrain.facts.parts import TEXEL_LADDER_PX
from terrain.level.level import SUN, AlgorithmName, CasterKind

MARKED_LAYERS = 50.0
"""How many layers drawn in all of the picture take the time of one drawn in marked pixels only: few fill a rectangle there."""

Counts = dict[str, float]
"""How often each thing is done, by name."""

SHEET_TRIANGLES = 2 * PATCH_QUADS**2
"""Triangles of a patch of ground outside of a map's block."""

FINEST_SHARE = 256.0 * POSITION_ERROR
"""A texel of a hybrid's map is never less than so large a share of how far what is seen reaches."""


def work_of(
    descriptor: Descriptor, light: str, kinds: Collection[CasterKind], algorithm: AlgorithmName, settings: Settings | None
) -> dict[str, Counts]:
    """What a step does, by part; nothing for the algorithm ``none``."""
    task = Task(descriptor, light, kinds)
    if algorithm == "none":
        return {}
    if isinstance(settings, HybridSettings):
        return _hybrid(task, settings)
    if isinstance(settings, ShadowMapSettings | LampMapSettings | PerspectiveMapSettings):
        return _maps(task, settings)
    if isinstance(settings, VolumeSettings):
        return {
            _of(task, "silhouettes"): _silhouettes(task),
            _of(task, "counting"): _counting(task, settings),
        }
    if isinstance(settings, SweepSettings):
        return _sweep(task, settings)
    if isinstance(settings, TruthSettings):
        rays = task.facing * settings.sun_samples
        return {"truth": {"blocks": 1.0, "seen": task.seen, "rays": rays, "triangles": _triangles(task)}}
    drawn = {"triangles": task.pictures * task.triangles("meshes"), "trees": task.pictures * task.trees}
    return {"planar": {"blocks": 1.0, "pixels": task.picture_pixels, **drawn}}


def _of(task: Task, part: str) -> str:
    """A part's name with the kind of view, for what is another work in a map."""
    return f"{part}, {task.descriptor.view_kind}"


def _triangles(task: Task) -> float:
    return _ground(task) + task.triangles("meshes") + task.triangles("forest")


def _maps(task: Task, settings: ShadowMapSettings | LampMapSettings | PerspectiveMapSettings) -> dict[str, Counts]:
    """Drawing depth maps and looking them up. Both together: a device may put off the one until the other needs it."""
    if isinstance(settings, PerspectiveMapSettings):
        name, windows = f"perspective_shadow_map, {task.light_kind}", [(float(settings.map_size**2), _seen_light_m2(task))]
        looked_up = task.facing
    elif isinstance(settings, LampMapSettings):
        faces = 6 if task.light_kind == "omni" else 1
        name, windows = f"shadow_map, {task.light_kind}", [(float(settings.map_size**2), task.level_light_m2)] * faces
        looked_up = task.seen
    else:
        name, windows = _of(task, "shadow_map"), sun_windows(task.descriptor, settings)
        looked_up = task.facing
    count, texels = float(len(windows)), float(sum(texels for texels, _ in windows))
    leaves, trees = 0.0, 0.0
    for its_texels, window_m2 in windows:
        leaves += its_texels * task.tree_layers if task.trees else 0.0
        trees += task.trees_within(window_m2) if task.light == SUN else task.trees
    counts = {
        "blocks": 1.0, "maps": count, "fitted pixels": task.pixels * count, f"look-ups, filter {settings.filter}": looked_up,
        # The larger a map, the less of it a cache holds.
        "look-ups by texels": looked_up * texels / max(count, 1.0) / 2.0**20,
        "texels": texels, "texels of ground": texels if task.stand("relief") else 0.0, "texels of leaves": leaves,
        # What casters cover of a map: nothing that is seen tells it of a lamp's.
        "texels in shadow": texels * task.facts.cast_share if task.light == SUN else 0.0,
        "triangles": count * task.triangles("meshes"), "trees": count * task.trees,
    }  # fmt: skip
    ground = {"ground": count * _ground(task)}
    if task.in_map:  # the nodes of the block are looked at whatever casts
        ground |= {"pixels": task.pixels, "nodes": _nodes(task)}
    else:
        ground["trees drawn"] = trees
    return {name: counts | ground}


def sun_windows(descriptor: Descriptor, settings: ShadowMapSettings) -> list[tuple[float, float]]:
    """Texels of each of a sun's maps and its area across the light, square metres, as ``shadows.maps.windows`` lays them."""
    spans_m = []
    if descriptor.bands:
        near_m = 0.0
        for cascade in settings.cascades:
            far_m = np.inf if cascade.far_m is None else cascade.far_m
            run = [band for band in descriptor.bands if near_m <= band.near_m < far_m]
            if run:
                spans_m.append((tuple(
                    max(band.high_light_m[k] for band in run) - min(band.low_light_m[k] for band in run) for k in (0, 1)
                ), cascade))  # fmt: skip
            near_m = far_m
    elif descriptor.receivers_light_m is not None:
        spans_m.append((descriptor.receivers_light_m[:2], settings.cascades[0]))
    windows = []
    for span_m, cascade in spans_m:
        size = [side / texel + 2 * BORDER_TEXELS for side, texel in zip(span_m, cascade.texel_m, strict=True)]
        if settings.fit == "tight":
            size = [float(settings.map_size)] * 2
        texels = float(ceil(size[0] / SIZE_STEP) * SIZE_STEP * ceil(size[1] / SIZE_STEP) * SIZE_STEP)
        windows.append((texels, span_m[0] * span_m[1]))
    return windows


def _seen_light_m2(task: Task) -> float:
    """What is seen across the light, square metres."""
    return task.level_light_m2 * task.facts.area_share


def _nodes(task: Task) -> float:
    """Nodes of a map's block, however many pixels they are."""
    return task.pixels * (task.descriptor.pixel_m / task.descriptor.node_m) ** 2


def _silhouettes(task: Task) -> Counts:
    return {
        "blocks": 1.0, "triangles": task.triangles("meshes"), "edges": float(_mesh_edges(task)),
        "ground": _ground(task),
    }  # fmt: skip


def _mesh_edges(task: Task) -> int:
    return task.facts.silhouette_edges if task.stand("meshes") else 0


def _faces(task: Task) -> tuple[float, float, float]:
    """Sides and caps of the volumes of meshes, and faces of those of the ground; twice as many under a lamp."""
    ends = 1.0 if task.light == SUN else 2.0
    closed = getattr(task.stand("meshes"), "closed_share", 0.0)
    caps = task.triangles("meshes") * (1.0 - closed / 2.0)
    ground = (task.triangles("relief") + task.outside_triangles) * task.turned_away
    return ends * _mesh_edges(task), ends * caps, ends * ground


def _counting(task: Task, settings: VolumeSettings, marked: float | None = None) -> Counts:
    """Counting volumes in all of the picture, or in the share of its tiles that is ``marked``.

    Sides reach across the picture, into as many rectangles as lie along it; caps are small. Layers that cover a rectangle are not
    drawn, and the more there are, the more do: time grows far slower than their number. How slowly was found by measuring.
    """
    edges, caps, ground = _faces(task)
    faces = edges + caps + ground
    rectangle_tiles = (2.0 * max(RECTANGLE_FACES / max(faces, 1.0), LEAST_TILES)) ** 2
    rectangles = max(task.pixels / TILE_PX**2 / rectangle_tiles, 1.0)
    sides = 2.0 if settings.stencil == "two_pass" else 1.0
    drawn = edges * np.sqrt(rectangles) + caps + ground
    layers = sides * task.facts.volume_layers if task.stand("meshes") else 0.0
    counts = {"blocks": 1.0, "pixels": task.pixels}
    if marked is None:
        counts |= {"faces drawn": sides * drawn, "facing": task.facing, "layers": task.facing * np.sqrt(np.log1p(layers))}
    else:
        deep = np.log1p(MARKED_LAYERS * layers * marked)
        counts |= {"faces beside marks": sides * drawn * marked**0.25, "layers beside marks": task.facing * deep}
    if task.in_map:
        parts = np.ceil(task.descriptor.rows / PART_PX) * np.ceil(task.descriptor.cols / PART_PX)
        relief = 1.0 + task.outside_triangles / SHEET_TRIANGLES if task.stand("relief") else 0.0
        counts["sheets"] = parts * (relief + (task.stand("meshes") is not None))
    return counts


def _ground(task: Task) -> float:
    return task.triangles("relief") + task.outside_triangles


def _hybrid(task: Task, settings: HybridSettings) -> dict[str, Counts]:
    texel_px, size = _texel_px(task, settings.map.map_size)
    counting = {
        _of(task, "silhouettes"): _silhouettes(task),
        _of(task, "counting"): _counting(task, settings, _uncertain(task, texel_px + TILE_PX)),
    }
    if settings.mask == "original":
        return counting | _maps(task, settings.map)
    _, caps, ground = _faces(task)
    faces = 6.0 if task.light_kind == "omni" else 1.0
    texels = faces * size**2
    drawn = {
        "blocks": 1.0, "texels": texels, "texels of ground": texels if task.stand("relief") else 0.0,
        "texels in shadow": texels * task.facts.cast_share, "caps": caps, "ground": ground, "facing": task.facing,
    }  # fmt: skip
    mask = {"blocks": 1.0, "facing": task.facing, "pixels": task.pixels, "texels": texels}
    return counting | {_of(task, "conservative map"): drawn, "mask": mask}


def _texel_px(task: Task, map_size: int) -> tuple[float, float]:
    """A texel of a hybrid's one map in pixels, and texels a side."""
    across_m = np.sqrt(_seen_light_m2(task))
    far_m = max((band.far_m for band in task.descriptor.bands), default=across_m)
    texel_m = max(across_m / map_size, FINEST_SHARE * far_m / 2.0)
    return texel_m / task.descriptor.pixel_m, across_m / texel_m


def _uncertain(task: Task, side_px: float) -> float:
    """The share of the picture within squares of a side, pixels, that a shadow's edge passes through; 1 where nothing is known."""
    if not task.facts.casts:
        return 1.0
    ladder = np.log2(TEXEL_LADDER_PX)
    shares = [
        band.share * np.interp(np.log2(side_px), ladder, band.differs)
        for kind, casting in task.facts.casts.items() if kind in task.kinds
        for band in casting.bands
    ]  # fmt: skip
    return float(min(sum(shares), 1.0))


def _sweep(task: Task, settings: SweepSettings) -> dict[str, Counts]:
    nodes = _nodes(task) + task.outside_triangles / 2.0 if task.in_map else _ground_nodes(task)
    strips = STRIPS if settings.filter == "sun" else 1
    rasterised = task.triangles("relief") * task.decimated
    counts = {
        "blocks": 1.0, "nodes": nodes, "steps": nodes * settings.lines * strips, "pixels": task.pixels, "points": task.seen,
        "answers": task.seen * strips, "decimated": rasterised, "outside": task.outside_triangles / 2.0,
    }  # fmt: skip
    return {_of(task, "sweep"): counts}


def _ground_nodes(task: Task) -> float:
    """Nodes of a perspective view's whole ground; half its triangles where they are not told."""
    relief = task.stand("relief")
    return task.triangles("relief") / 2.0 if relief is None or relief.nodes is None else float(relief.nodes)
