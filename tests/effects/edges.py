"""Scenes at the edge of each effect's predicate, and the change of the picture by the effect.

A case is a level and one of its views. The cases of an effect differ in the input of its predicate, in small steps around
the threshold. Comparisons are of the 8-bit pictures with the effect forced on and forced off.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import trimesh
from PIL import Image
from pyogrio import raw
from scipy.ndimage import maximum_filter, minimum_filter

from skugga.selector.planner.planner import make_plan
from skugga.shadows.plan import Plan
from skugga.shadows.registry import NO_SHADOWS
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.effects import EFFECTS
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.level import EffectName, LoadedLevel, load_level
from skugga.terrain.scene import Scene, build_scene
from tests.model_files import board, checker, normal_map
from tests.rasters import ENGINEERING, write_geotiff

UTM, CORNER_M = "EPSG:32633", (500_000.0, 5_300_000.0)

CELLS, CELL_M = 64, 20.0
"""Ground of 64 x 64 cells of 20 m."""

SIZE = 96, 72
"""Pixels of a picture."""

GROUND_CENTRE = (15.0086, 47.8475)
"""Approximate longitude and latitude of the ground's centre."""


@dataclass(frozen=True)
class EffectCase:
    """A level (its keys except ``version``) and its view to draw."""

    name: str
    keys: dict[str, Any]
    view: dict[str, Any]


@dataclass(frozen=True, eq=False)
class EffectChange:
    """The change by an effect in a case.

    Attributes
    ----------
    case
        Name of the case.
    descriptor
        The facts of the case.
    is_called_for
        Whether the effect's predicate says that the scene calls for it. Then the plan has it, except for ``soft_edges``: few
        algorithms that a plan chooses can draw them.
    reason
        The plan's reason.
    ran_when_forced
        Whether the effect ran when forced on.
    max_difference
        Largest difference of a pixel, in steps of 255.
    changed_share
        Share of the pixels that differ by more than one step of 255.
    max_neighbourhood_excess
        Largest difference from the range of the pixel and its neighbours in the other picture, in steps of 255.
    """

    case: str
    descriptor: Descriptor
    is_called_for: bool
    reason: str
    ran_when_forced: bool
    max_difference: int
    changed_share: float
    max_neighbourhood_excess: int

    def __str__(self) -> str:
        status = "runs" if self.is_called_for else "left out"
        figures = f"{self.max_difference:4d} {self.max_neighbourhood_excess:4d} {100.0 * self.changed_share:6.2f} %"
        return f"{self.case:34} {status:8} {figures}  {self.reason}"


class EffectComparison:
    """Compare pictures of levels with an effect forced on and forced off."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._changes: dict[tuple[EffectName, str], EffectChange] = {}
        y, x = np.mgrid[0:CELLS, 0:CELLS] * CELL_M
        grounds = {
            "hills": 60.0 * np.sin(x / 150.0 + 0.4) * np.sin(y / 190.0) + 20.0 * np.sin((x + 2 * y) / 110.0),
            "slope": 0.2 * x,
            "plain": np.where((x == 0.0) & (y == 0.0), 0.3, 0.0),
            "hill": 120.0 * np.exp(-((x - 320.0) ** 2 + (y - 640.0) ** 2) / 120.0**2),
        }
        percents = (0.1, 0.2, 0.4, 0.7, 1, 2, 3, 4, 6, 8, 12, 20, 35, 50)
        grounds |= {f"valley{percent}": percent / 100.0 * np.abs(x - 640.0) for percent in percents}
        for name, heights in grounds.items():
            write_geotiff(folder / f"{name}.tif", heights.astype(np.float32), UTM, *CORNER_M, CELL_M)
        floor = np.zeros((CELLS, CELLS), np.float32)
        write_geotiff(folder / "floor.tif", floor, ENGINEERING, -CELLS / 2 * CELL_M, CELLS / 2 * CELL_M, CELL_M)
        trimesh.creation.box((4.0, 4.0, 12.0)).export(folder / "post.obj")
        for name, material in board_materials().items():
            board(**material).export(folder / f"{name}.glb")
        tree = shapely.to_wkb(np.array([shapely.Point(0.0, 0.0)], object))
        line = shapely.to_wkb(np.array([shapely.LineString([(-600.0, -310.0), (600.0, 290.0)])], object))
        raw.write(folder / "road.gpkg", line, [np.array([6.0])], ["width"], geometry_type="LineString", crs=ENGINEERING)
        raw.write(folder / "tree.gpkg", tree, [np.array([12.0])], ["height"], geometry_type="Point", crs=ENGINEERING)
        house = shapely.to_wkb(np.array([shapely.box(-7.0, -5.0, 7.0, 5.0)], object))
        raw.write(folder / "house.gpkg", house, [np.array([8.0])], ["height"], geometry_type="Polygon", crs=ENGINEERING)
        x, y = CORNER_M
        road = shapely.to_wkb(np.array([shapely.LineString([(x + 100.0, y - 640.0), (x + 1180.0, y - 600.0)])], object))
        raw.write(folder / "road.gpkg", road, [np.array(["residential"])], ["highway"], geometry_type="LineString", crs=UTM)

    def scene(self, keys: dict[str, Any]) -> Scene:
        """Return the scene of a level with some keys."""
        path = self.folder / "level.yaml"
        path.write_text(json.dumps({"version": 1, **keys}), encoding="utf-8")
        return build_scene(load_level(path))

    def change_by(self, effect: EffectName, case: EffectCase) -> EffectChange:
        """Return the change by an effect in a case. Changes are drawn once."""
        if (effect, case.name) not in self._changes:
            self._changes[effect, case.name] = self._draw_change(effect, case)
        return self._changes[effect, case.name]

    def _draw_change(self, effect: EffectName, case: EffectCase) -> EffectChange:
        scene = self.scene({**case.keys, "views": {"view": case.view}})
        descriptor = describe(scene, scene.view("view"), "view")
        plan = make_plan(descriptor, scene.loaded.level)
        (with_effect, ran), (without_effect, ran_without) = (
            self._picture(scene, effect, plan, is_on) for is_on in (True, False)
        )  # fmt: skip
        assert not ran_without
        called_for = EFFECTS[effect].verdict(effect, descriptor).is_needed
        assert effect == "soft_edges" or (effect in plan.effect_names) == called_for
        reason = next(item.reason for item in (*plan.effects, *plan.left_out) if item.name == effect)
        difference = np.abs(with_effect - without_effect).max(axis=-1)
        excess = max(_neighbourhood_excess(with_effect, without_effect), _neighbourhood_excess(without_effect, with_effect))
        return EffectChange(
            case.name, descriptor, called_for, reason, ran, int(difference.max()), float((difference > 1).mean()), excess
        )  # fmt: skip

    @staticmethod
    def _picture(scene: Scene, effect: EffectName, plan: Plan, is_on: bool) -> tuple[np.ndarray, bool]:
        """Return the picture with an effect forced on or off, drawn by the plan's own algorithms, and whether the effect ran.

        Algorithms that the plan leaves out for want of the effect are those of the rules. Soft edges that are on are the penumbrae
        of the sun's disc, which more algorithms can draw than the taps of a filter.
        """
        level, view = scene.loaded.level, scene.view("view")
        effects = {**dict.fromkeys(EFFECTS[effect].required_effects, "on"), effect: "on" if is_on else "off"}
        forced = level.model_copy(update={"effects": effects})
        own = {
            light: {kind: name for kind, name in algorithm.items() if name != NO_SHADOWS}
            for light, algorithm in plan.algorithm.items()
        }
        overrides: dict[str, Any] = {"algorithm": {light: algorithm for light, algorithm in own.items() if algorithm} or "auto"}
        if effect == "soft_edges" and is_on:
            overrides["filter"] = "sun"
        loaded = LoadedLevel(name="level", path=scene.loaded.path, level=forced, digest="")
        forced_plan = make_plan(describe(scene, view, "view"), forced, overrides)
        if is_on or effect not in SHADOW_SWITCHES:
            for light, algorithm in own.items():
                assert algorithm.items() <= forced_plan.algorithm.get(light, {}).items(), "the plan's own algorithms are not drawn"
        frame = render_frame(replace(scene, loaded=loaded), view, forced_plan)
        return frame.color.astype(np.int32), effect in frame.plan.effect_names


SHADOW_SWITCHES = frozenset({"cast_shadows", "alpha_test", "lamps"})
"""Effects without which some algorithms of the plan have nothing to draw."""


def _neighbourhood_excess(picture: np.ndarray, other: np.ndarray) -> int:
    """Return how far a picture (rows, cols, 3) leaves the range of the other picture's pixel and its eight neighbours."""
    low, high = (filter(other, size=(3, 3, 1), mode="nearest") for filter in (minimum_filter, maximum_filter))
    return int(np.maximum(low - picture, picture - high).max())


def perspective_view(
    position: tuple[float, float, float], target: tuple[float, float, float], fov: float = 50.0, scale: int = 1
) -> dict[str, Any]:
    size = [scale * SIZE[0], scale * SIZE[1]]
    return {"kind": "perspective", "eye": list(position), "target": list(target), "fov": fov, "size": size}


MAP = {"kind": "map", "size": [SIZE[1], SIZE[1]]}

PERSPECTIVE = perspective_view((GROUND_CENTRE[0] - 0.006, GROUND_CENTRE[1] - 0.004, 60.0), (*GROUND_CENTRE, 0.0))
"""View over the ground towards the north-east."""


def skyline_view(up_m: float) -> dict[str, Any]:
    """Return a view from the same eye to a target at a height above the ground. From about 260 m on, at most its last rows show
    ground.
    """
    return perspective_view((GROUND_CENTRE[0] - 0.006, GROUND_CENTRE[1] - 0.004, 60.0), (*GROUND_CENTRE, up_m))


def map_window(east_m: float, south_m: float, side_m: float) -> dict[str, Any]:
    """Return a map of a square of the ground, given its centre."""
    x, y = CORNER_M[0] + east_m, CORNER_M[1] - south_m
    return {**MAP, "bounds": [x - side_m / 2, y - side_m / 2, x + side_m / 2, y + side_m / 2]}


def level_keys(name: str, azimuth: float = 200.0, altitude: float = 30.0, **keys: Any) -> dict[str, Any]:
    return {"terrain": {"source": f"{name}.tif"}, "sun": {"azimuth": azimuth, "altitude": altitude}, **keys}


def cast_shadows() -> Iterator[EffectCase]:
    for view_name, view, azimuth in (("map", MAP, 250.0), ("perspective", PERSPECTIVE, 70.0)):
        for altitude in (-1.0, 0.3, 12.0, 24.0, 29.0, 31.0, 34.0, 40.0, 60.0, 88.0):
            yield EffectCase(f"hills {view_name} {altitude}", level_keys("hills", azimuth, altitude), view)
        for altitude in (8.0, 11.0, 11.6, 15.0):
            yield EffectCase(f"slope turned away {view_name} {altitude}", level_keys("slope", 90.0, altitude), view)
        for cover in (0.99, 1.0):
            yield EffectCase(
                f"clouds {view_name} {cover}", level_keys("hills", azimuth, 15.0, weather={"cloud_cover": cover}), view
            )
    for distance_m in (-45.0, -20.0, -14.0, 0.0, 14.0, 20.0, 30.0, 45.0):  # a post 12 m high casts 20.8 m at 30 degrees
        post = [{"source": "post.obj", "at": [0.0, -distance_m]}]
        yield EffectCase(
            f"post {distance_m} m before",
            level_keys("floor", 180.0, meshes=post),
            perspective_view((0, 12, 30), (0, 12.5, 0), 40.0, 3),
        )


def alpha_test() -> Iterator[EffectCase]:
    forest = [{"source": "tree.gpkg", "height": "height", "species": "broadleaf"}]
    post = [{"source": "post.obj", "at": [3.0, 1.0]}]
    for north in np.arange(-24.0, 43.0, 3.0).tolist():
        keys = level_keys("floor", 180.0, forest=forest, meshes=post)
        yield EffectCase(f"looking {north} m north of a tree", keys, perspective_view((0, north, 24), (0, north + 0.5, 0), 30.0, 3))
    yield EffectCase("no tree", level_keys("floor", 180.0, meshes=post), perspective_view((0, 8, 24), (0, 8.5, 0), 30.0, 3))


def soft_edges() -> Iterator[EffectCase]:
    post = [{"source": "post.obj", "at": [0.0, 0.0]}]
    for altitude in (60.0, 30.0, 20.0):
        # Windows at the end of the shadow of the post, 12 m high and 4 m wide: pixels of 0.04 to 1.7 m.
        end_m = 2.0 + 12.0 / float(np.tan(np.radians(altitude)))
        for half_width_m in (1.5, 2.0, 3.0, 4.0, 12.0, 20.0, 40.0, 60.0):
            bounds = [-half_width_m, end_m - half_width_m, half_width_m, end_m + half_width_m]
            keys = level_keys("floor", 180.0, altitude, meshes=post)
            yield EffectCase(f"post {altitude} degrees, {half_width_m} m", keys, {**MAP, "bounds": bounds})


def tapped_edges() -> Iterator[EffectCase]:
    """Yield posts with narrow penumbrae whose edges a shadow map filters by taps if soft edges are forced on."""
    post = [{"source": "post.obj", "at": [0.0, -20.0]}]
    for altitude in (80.0, 70.0, 60.0, 50.0, 40.0):
        for half_width_m in (10.0, 40.0):
            bounds = [-half_width_m, -20.0 - half_width_m, half_width_m, half_width_m - 20.0]
            keys = level_keys("floor", 180.0, altitude, meshes=post, shadows={"algorithm": "shadow_map", "filter": "auto"})
            yield EffectCase(f"post {altitude} degrees, {half_width_m} m", keys, {**MAP, "bounds": bounds})


def outside_casters() -> Iterator[EffectCase]:
    west, north = CORNER_M
    for altitude in (2.0, 3.0, 4.0, 6.0, 8.0, 11.0, 14.0, 18.0, 23.0, 28.0, 40.0, 50.0, 70.0):
        # A window of the hill's east side, in its shadow under the sun in the west.
        bounds = [west + 420.0, north - 900.0, west + 900.0, north - 420.0]
        yield EffectCase(f"beside a hill {altitude}", level_keys("hill", 270.0, altitude), {**MAP, "bounds": bounds})
        full_bounds = [west - 300.0, north - 1600.0, west + 1600.0, north + 300.0]
        yield EffectCase(f"all there is {altitude}", level_keys("hill", 270.0, altitude), {**MAP, "bounds": full_bounds})


def refraction() -> Iterator[EffectCase]:
    for hour in ("05:35", "06:00", "06:30", "07:30", "08:30", "09:30", "11:00", "12:00"):
        for view_name, view in (("map", MAP), ("perspective", PERSPECTIVE)):
            keys = {"terrain": {"source": "hills.tif"}, "sun": {"time": f"2024-04-02T{hour}:00+01:00"}}
            yield EffectCase(f"hills {view_name} {hour}", keys, view)
    for hour in ("07:30", "09:30", "12:00"):
        for side_m in (150.0, 1200.0):
            keys = {"terrain": {"source": "hills.tif"}, "sun": {"time": f"2024-04-02T{hour}:00+01:00"}}
            clouds_at = map_window(640.0, 640.0, side_m)
            yield EffectCase(f"clouds {hour}, {side_m} m", {**keys, "weather": {"cloud_cover": 0.5}}, clouds_at)
    post = [{"source": "post.obj", "at": list(GROUND_CENTRE)}]
    for hour, azimuth, altitude in (("06:15", 88.7, 5.9), ("07:00", 97.1, 13.3), ("10:00", 138.3, 39.9)):
        length_m = 12.0 / float(np.tan(np.radians(altitude)))
        east_m, south_m = (643.4 - length_m * np.sin(np.radians(azimuth)), 649.3 + length_m * np.cos(np.radians(azimuth)))
        for side_m in (5.0, 12.0, 30.0, 200.0, 600.0):  # windows at the end of the post's shadow
            keys = {"terrain": {"source": "plain.tif"}, "sun": {"time": f"2024-04-02T{hour}:00+01:00"}, "meshes": post}
            yield EffectCase(f"post {hour}, {side_m} m", keys, map_window(float(east_m), float(south_m), side_m))
    yield EffectCase("angles", level_keys("hills", 100.0, 10.0), MAP)


def lamps() -> Iterator[EffectCase]:
    for distance_m in (30.0, 100.0, 250.0, 500.0):
        for intensity in (1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0):
            lamp = {"kind": "omni", "position": [0, 0, 20.0], "intensity": intensity}
            view = perspective_view((0, -distance_m - 10.0, 20.0), (0, -distance_m, 0), 20.0)
            for hour, altitude in (("day", 30.0), ("night", -20.0)):
                yield EffectCase(
                    f"omni {intensity} at {distance_m} m by {hour}",
                    level_keys("floor", 180.0, altitude, lights={"lamp": lamp}),
                    view,
                )
    for angle_deg in (0.0, 20.0, 40.0, 44.0, 47.0, 50.0, 60.0, 90.0):
        target = [100.0 * float(np.sin(np.radians(angle_deg))), 0.0, 100.0 - 100.0 * float(np.cos(np.radians(angle_deg)))]
        lamp = {"kind": "spot", "position": [0, 0, 100.0], "target": target, "cutoff": 35.0}
        keys = {**level_keys("floor"), "sun": "none", "lights": {"lamp": lamp}}
        yield EffectCase(f"spot turned {angle_deg}", keys, perspective_view((0, -10, 60), (0, 0, 0), 20.0))
    lamp = {"kind": "omni", "position": [*GROUND_CENTRE, 10.0], "intensity": 0.05}
    for east_m in (660.0, 800.0, 1000.0, 1200.0):
        yield EffectCase(f"window {east_m}", level_keys("hills", lights={"lamp": lamp}), map_window(east_m, 640.0, 60.0))


def snow() -> Iterator[EffectCase]:
    for name in ("plain", "hills", "slope"):
        for has_snow in (False, True):
            for view_name, view in (("map", MAP), ("perspective", PERSPECTIVE)):
                yield EffectCase(f"{name} {view_name} {has_snow}", level_keys(name, weather={"snow": has_snow}), view)
    for up_m in (200.0, 240.0, 250.0, 260.0, 270.0, 280.0, 320.0):
        yield EffectCase(f"skyline {up_m}", level_keys("plain", weather={"snow": True}), skyline_view(up_m))


def ground_detail() -> Iterator[EffectCase]:
    middle = (0.0, 0.0, 0.0)
    for up_m in (1.7, 30.0, 300.0, 1000.0, 2000.0, 4000.0, 8000.0, 12_000.0, 18_000.0, 30_000.0, 80_000.0):
        yield EffectCase(
            f"slope from {up_m} m",
            level_keys("slope"),
            perspective_view((*GROUND_CENTRE, up_m), (GROUND_CENTRE[0], GROUND_CENTRE[1] + 1e-4, 0.0), 30.0),
        )
    for up_m in (1.7, 300.0, 20_000.0, 60_000.0):
        yield EffectCase(f"floor from {up_m} m", level_keys("floor"), perspective_view((0.0, -1.0, up_m), middle, 30.0))
    for up_m in (200.0, 250.0, 260.0, 270.0, 320.0):
        yield EffectCase(f"skyline {up_m}", level_keys("plain"), skyline_view(up_m))
    yield EffectCase("map", level_keys("hills"), map_window(640.0, 640.0, 20.0))
    yield EffectCase("room", room_keys(), perspective_view((3.7, -2.8, 2.05), (-1.0, 0.5, 0.6), 60.0, 2))
    for style in ("swiss", "grey", "urban", "analysis"):
        yield EffectCase(f"style {style}", level_keys("slope", style={"name": style}), PERSPECTIVE)
    for altitude in (-3.0, -9.0, -30.0):
        yield EffectCase(f"sun at {altitude}", level_keys("slope", altitude=altitude), PERSPECTIVE)


def ground_materials() -> Iterator[EffectCase]:
    middle = (0.0, 0.0, 0.0)
    for up_m in (1.7, 300.0, 8000.0, 80_000.0):
        yield EffectCase(
            f"slope from {up_m} m",
            level_keys("slope"),
            perspective_view((*GROUND_CENTRE, up_m), (GROUND_CENTRE[0], GROUND_CENTRE[1] + 1e-4, 0.0), 30.0),
        )
    for up_m in (1.7, 300.0):
        yield EffectCase(f"floor from {up_m} m", level_keys("floor"), perspective_view((0.0, -1.0, up_m), middle, 30.0))
    for up_m in (200.0, 250.0, 260.0, 270.0, 320.0):
        yield EffectCase(f"skyline {up_m}", level_keys("plain"), skyline_view(up_m))
    yield EffectCase("map", level_keys("hills"), map_window(640.0, 640.0, 20.0))
    for style in ("natural", "swiss", "grey", "urban", "analysis"):
        yield EffectCase(f"style {style}", level_keys("slope", style={"name": style}), PERSPECTIVE)
    for altitude in (12.0, 0.5, -3.0, -9.0, -30.0):
        yield EffectCase(f"sun at {altitude}", level_keys("slope", altitude=altitude), PERSPECTIVE)


def roads() -> Iterator[EffectCase]:
    for width_m in (0.5, 0.9, 1.1, 1.2, 1.5, 3.0, 8.0):
        keys = level_keys("plain", roads=[{"source": "road.gpkg", "width": width_m}])
        yield EffectCase(f"road of {width_m} m", keys, map_window(640.0, 640.0, 1200.0))
        yield EffectCase(f"river of {width_m} m", level_keys("plain", rivers=keys["roads"]), map_window(640.0, 640.0, 1200.0))
        above = perspective_view((*GROUND_CENTRE, 1200.0), (GROUND_CENTRE[0], GROUND_CENTRE[1] + 1e-4, 0.0))
        yield EffectCase(f"road of {width_m} m from above", keys, above)
    keys = level_keys("hills", roads=[{"source": "road.gpkg"}])
    for south_m in (640.0, 700.0, 800.0, 1000.0):
        yield EffectCase(f"window {south_m} m south", keys, map_window(640.0, south_m, 100.0))
    for width_m in (3.0, 8.0, 20.0):
        wide = level_keys("plain", roads=[{"source": "road.gpkg", "width": width_m}])
        yield EffectCase(f"road of {width_m} m in perspective", wide, PERSPECTIVE)
    for up_m in (0.0, 300.0, 600.0):
        yield EffectCase(f"skyline {up_m}", keys, skyline_view(up_m))
    for style in ("swiss", "grey", "urban", "analysis"):
        styled = level_keys("plain", roads=[{"source": "road.gpkg"}], style={"name": style})
        yield EffectCase(f"style {style}", styled, map_window(640.0, 640.0, 300.0))
    yield EffectCase("no road", level_keys("hills"), PERSPECTIVE)


def board_materials() -> dict[str, dict[str, Any]]:
    """Return the materials of boards by the names of their files."""
    stripes = np.indices((64, 64))[1] % 2 * 2.0 - 1.0
    materials: dict[str, dict[str, Any]] = {"checker": {"baseColorTexture": checker(1)}}
    materials |= {f"check {side}": {"baseColorTexture": checker(side)} for side in (2, 8)}
    for steps in (0, 1, 2, 4, 20):
        grey = np.where(np.asarray(checker(16)) > 0, 140 + steps, 140 - steps).astype(np.uint8)
        materials[f"grey {steps}"] = {"baseColorTexture": Image.fromarray(grey)}
    white = {"metallicFactor": 1.0, "roughnessFactor": 1.0, "baseColorTexture": Image.new("RGB", (4, 4), (230, 230, 230))}
    for tilt in (0.0, 0.1, 0.3):
        materials[f"tilt {tilt}"] = {**white, "normalTexture": normal_map(tilt * stripes, 0.0)}
        materials[f"wide {tilt}"] = {**white, "normalTexture": normal_map(tilt, 0.0)}
    for roughness in (0.2, 0.5, 1.0):
        for metallic in (0.0, 1.0):
            materials[f"gloss {roughness} {metallic}"] = {
                "roughnessFactor": roughness, "metallicFactor": metallic, "baseColorFactor": [120, 90, 60, 255],
            }  # fmt: skip
    return materials


def board_keys(name: str, altitude: float = 30.0, **keys: Any) -> dict[str, Any]:
    """Return the keys of a floor with a board in its middle."""
    return level_keys("floor", 200.0, altitude, meshes=[{"source": f"{name}.glb", "at": [0.0, 0.0]}], **keys)


def view_of_board(distance_m: float, east_m: float = 0.0) -> dict[str, Any]:
    return perspective_view((1.0, -distance_m, 3.0), (east_m, 0.0, 2.0), 30.0)


def textures() -> Iterator[EffectCase]:
    for distance_m in (8.0, 10.0, 14.0, 18.0, 22.0, 26.0, 30.0, 40.0, 60.0, 100.0):
        yield EffectCase(f"squares of a texel from {distance_m} m", board_keys("checker"), view_of_board(distance_m))
        yield EffectCase(f"squares of 2 texels from {distance_m} m", board_keys("check 2"), view_of_board(distance_m))
    for steps in (0, 1, 2, 4, 20):
        yield EffectCase(f"grey by {steps}", board_keys(f"grey {steps}"), view_of_board(12.0))
        yield EffectCase(f"grey by {steps} by night", board_keys(f"grey {steps}", -30.0), view_of_board(12.0))
    for east_m in (0.0, 4.0, 8.0, 12.0, 30.0):
        yield EffectCase(f"looking {east_m} m past a board", board_keys("check 8"), view_of_board(20.0, east_m))
    yield EffectCase("map of a board", board_keys("check 8"), {**MAP, "bounds": [-8.0, -8.0, 8.0, 8.0]})
    yield EffectCase("no board", level_keys("floor"), view_of_board(20.0))


def normal_maps() -> Iterator[EffectCase]:
    for distance_m in (8.0, 10.0, 12.0, 14.0, 18.0, 22.0, 30.0, 50.0, 80.0):
        for tilt in (0.0, 0.3):
            yield EffectCase(f"stripes of {tilt} from {distance_m} m", board_keys(f"tilt {tilt}"), view_of_board(distance_m))
    for tilt in (0.0, 0.1, 0.3):
        for altitude in (-30.0, 10.0, 50.0):
            yield EffectCase(f"tilt of {tilt}, sun at {altitude}", board_keys(f"wide {tilt}", altitude), view_of_board(15.0))
    for east_m in (4.0, 8.0, 12.0, 30.0):
        yield EffectCase(f"looking {east_m} m past a board", board_keys("wide 0.3"), view_of_board(20.0, east_m))
    yield EffectCase("map of a board", board_keys("wide 0.3"), {**MAP, "bounds": [-8.0, -8.0, 8.0, 8.0]})
    yield EffectCase("no board", level_keys("floor"), view_of_board(20.0))


def highlights() -> Iterator[EffectCase]:
    for roughness in (0.2, 0.5, 1.0):
        for metallic in (0.0, 1.0):
            for altitude in (-2.0, 10.0, 50.0):
                name = f"gloss {roughness} {metallic}"
                yield EffectCase(f"{name}, sun at {altitude}", board_keys(name, altitude), view_of_board(15.0))
    for east_m in (4.0, 8.0, 12.0, 30.0):
        yield EffectCase(f"looking {east_m} m past a board", board_keys("gloss 0.5 0.0"), view_of_board(20.0, east_m))
    for cover in (0.5, 1.0):
        keys = board_keys("gloss 0.5 1.0", weather={"cloud_cover": cover})
        yield EffectCase(f"clouds of {cover}", keys, view_of_board(15.0))
    yield EffectCase("snow", board_keys("gloss 0.5 1.0", weather={"snow": True}), view_of_board(15.0))
    yield EffectCase("map of a board", board_keys("gloss 0.5 1.0"), {**MAP, "bounds": [-8.0, -8.0, 8.0, 8.0]})
    yield EffectCase("no board", level_keys("floor"), view_of_board(20.0))


def facades() -> Iterator[EffectCase]:
    for roof in ("auto", "flat"):
        house = level_keys("floor", meshes=[{"source": "house.gpkg", "height": "height", "roof": roof}])
        for distance_m in (20.0, 45.0, 80.0, 100.0, 120.0, 145.0, 170.0, 185.0, 230.0, 420.0):
            view = perspective_view((0.6 * distance_m, -0.8 * distance_m, 5.0), (0.0, 0.0, 3.0), 40.0)
            yield EffectCase(f"{roof} roof, {distance_m} m away", house, view)
    for east_m in (0.0, 25.0, 40.0, 70.0):
        yield EffectCase(f"looking {east_m} m beside", house, perspective_view((0.0, -60.0, 5.0), (east_m, 0.0, 3.0), 40.0))
    near = perspective_view((24.0, -32.0, 5.0), (0.0, 0.0, 3.0), 40.0)
    for style in ("swiss", "grey", "urban", "analysis"):
        yield EffectCase(f"style {style}", {**house, "style": {"name": style}}, near)
    for altitude in (2.0, -9.0, -30.0):
        yield EffectCase(f"sun at {altitude}", {**house, "sun": {"azimuth": 200.0, "altitude": altitude}}, near)
    post = level_keys("floor", meshes=[{"source": "post.obj", "at": [0.0, 0.0]}])
    yield EffectCase("model", post, near)
    yield EffectCase("map", house, {**MAP, "bounds": [-30.0, -30.0, 30.0, 30.0]})


def crowns() -> Iterator[EffectCase]:
    forest = [{"source": "tree.gpkg", "height": "height", "species": "broadleaf"}]
    for altitude in (-2.0, 5.0, 20.0, 45.0):
        for east in (0.0, 12.0, 16.0, 20.0, 40.0):
            keys = level_keys("floor", 240.0, altitude, forest=forest)
            yield EffectCase(
                f"looking {east} m past a tree, sun at {altitude}", keys, perspective_view((0, -40, 8), (east, 0, 6), 30.0, 2)
            )
    yield EffectCase("map of a tree", level_keys("floor", 240.0, forest=forest), {**MAP, "bounds": [-20.0, -20.0, 20.0, 20.0]})
    yield EffectCase("no tree", level_keys("floor", 240.0), perspective_view((0, -40, 8), (0, 0, 6), 30.0))


def ambient_occlusion() -> Iterator[EffectCase]:
    posts = [{"source": "post.obj", "at": [[0.0, 6.0 * k] for k in range(-4, 5)]}]
    for altitude in (-20.0, -8.0, -3.0, 5.0, 20.0, 60.0):
        for east_m in (0.0, 20.0, 60.0):
            keys = level_keys("floor", 240.0, altitude, meshes=posts)
            view = perspective_view((-30.0, -20.0, 12.0), (east_m, 10.0, 2.0), 30.0, 2)
            yield EffectCase(f"looking {east_m} m past posts, sun at {altitude}", keys, view)
    forest = [{"source": "tree.gpkg", "height": "height", "species": "broadleaf"}]
    for east_m in (0.0, 12.0, 20.0, 40.0, 80.0):
        view = perspective_view((0, -40, 8), (east_m, 0, 6), 30.0, 2)
        yield EffectCase(f"looking {east_m} m past a tree", level_keys("floor", 240.0, 20.0, forest=forest), view)
    for overcast in (0.0, 1.0):
        weather = {"cloud_cover": overcast}
        yield EffectCase(
            f"room under {overcast}", room_keys(weather=weather), perspective_view((3.7, -2.8, 2.05), (-1, 0.5, 0.6), 60.0)
        )
    yield EffectCase("map of posts", level_keys("floor", 240.0, meshes=posts), {**MAP, "bounds": [-20.0, -20.0, 20.0, 20.0]})
    yield EffectCase("no object", level_keys("hills", 240.0), PERSPECTIVE)


def clouds() -> Iterator[EffectCase]:
    for cover in (0.0, 0.001, 0.01, 0.03, 0.06, 0.1, 0.2, 0.4, 0.6, 0.8, 0.9, 0.97, 0.999, 1.0):
        for view_name, view, seconds in (("map", MAP, 0), ("perspective", PERSPECTIVE, 300)):
            yield EffectCase(f"{view_name} {cover}", level_keys("hills", weather={"cloud_cover": cover}, seconds=seconds), view)
    for altitude in (-1.0, 0.01, 0.5):
        yield EffectCase(
            f"half the sky, sun at {altitude}", level_keys("hills", altitude=altitude, weather={"cloud_cover": 0.5}), MAP
        )
    for east_m in range(100, 1200, 100):  # the first clouds of a window
        yield EffectCase(
            f"window {east_m}", level_keys("hills", weather={"cloud_cover": 0.2}, seconds=60.0), map_window(east_m, 600.0, 50.0)
        )
    for up_m in (240.0, 260.0, 280.0, 320.0):
        yield EffectCase(f"skyline {up_m}", level_keys("plain", altitude=20.0, weather={"cloud_cover": 0.8}), skyline_view(up_m))


def precipitation() -> Iterator[EffectCase]:
    for kind in ("none", "rain", "snowfall"):
        for rate in (0.1, 1.0, 20.0):
            weather = {"precipitation": kind, "precipitation_rate": rate}
            for view_name, view in (("map", MAP), ("perspective", PERSPECTIVE)):
                yield EffectCase(f"{kind} {rate} {view_name}", level_keys("hills", weather=weather, seconds=300), view)


def sky_view() -> Iterator[EffectCase]:
    for percent in (1, 2, 3, 4, 6, 8, 12, 20, 35, 50):
        for view_name, view in (("map", MAP), ("perspective", PERSPECTIVE)):
            yield EffectCase(f"valley of {percent} % {view_name}", level_keys(f"valley{percent}"), view)
        overcast = level_keys(f"valley{percent}", weather={"cloud_cover": 1.0})
        yield EffectCase(f"valley of {percent} %, overcast", overcast, MAP)
    for name in ("plain", "slope"):
        yield EffectCase(name, level_keys(name), MAP)
    for altitude in (-20.0, -3.0, 70.0):
        yield EffectCase(f"shallow valley, sun at {altitude}", level_keys("valley4", altitude=altitude), MAP)
    for south_m in (640.0, 800.0, 1000.0, 1150.0):  # a hill far north of the window
        for side_m in (50.0, 200.0):
            yield EffectCase(f"{side_m} m of ground {south_m} m south", level_keys("hill"), map_window(450.0, south_m, side_m))


def sky_light() -> Iterator[EffectCase]:
    for sky in ("even", "clear", "overcast"):
        for name in ("plain", "slope", "hills", "valley20", "floor"):
            yield EffectCase(f"{sky} sky on {name}", level_keys(name, style={"name": "natural", "sky": sky}), MAP)
        yield EffectCase(f"{sky} sky in perspective", level_keys("hills", style={"name": "natural", "sky": sky}), PERSPECTIVE)
    for style in ("natural", "swiss", "grey", "urban", "analysis"):
        yield EffectCase(f"style {style}", level_keys("hills", style={"name": style}), MAP)
    post = [{"source": "post.obj", "at": [0.0, 0.0]}]
    window = {**MAP, "bounds": [-30.0, -30.0, 30.0, 30.0]}
    yield EffectCase("post on a floor", level_keys("floor", style={"name": "natural", "sky": "clear"}, meshes=post), window)


def texture_shading() -> Iterator[EffectCase]:
    for percent in (0.1, 0.2, 0.4, 0.7, 1, 2, 4, 8, 20, 50):
        yield EffectCase(f"valley of {percent} %", level_keys(f"valley{percent}"), MAP)
        overcast = level_keys(f"valley{percent}", weather={"cloud_cover": 1.0})
        yield EffectCase(f"valley of {percent} %, overcast", overcast, MAP)
    for name in ("plain", "slope", "hills", "hill"):
        yield EffectCase(name, level_keys(name), MAP)
        yield EffectCase(f"{name} in perspective", level_keys(name), PERSPECTIVE)
    for altitude in (-20.0, -3.0, 70.0):
        yield EffectCase(f"shallow valley, sun at {altitude}", level_keys("valley4", altitude=altitude), MAP)
    for style in ("swiss", "grey", "urban", "analysis"):
        yield EffectCase(f"style {style}", level_keys("hills", style={"name": style}), MAP)


def water() -> Iterator[EffectCase]:
    for level in (-90.0, -80.0, -70.0, -60.0, -40.0, 0.0, 70.0):
        for view_name, view in (("map", MAP), ("perspective", PERSPECTIVE)):
            yield EffectCase(f"level {level} {view_name}", level_keys("hills", 40.0, 20.0, water={"level": level}), view)
    for altitude in (-30.0, -10.0, -3.0):
        yield EffectCase(f"lake by night {altitude}", level_keys("hills", 40.0, altitude, water={"level": -40.0}), MAP)
    for below_m in (-0.01, 0.0, 0.0005, 0.002, 0.01):  # ground within SHORE_M of the water's height is water
        yield EffectCase(f"floor {below_m} m above the water", level_keys("floor", altitude=70.0, water={"level": -below_m}), MAP)
    for level in (-75.0, -70.0, -60.0):  # ponds outside the window, or lost in the averages of a small map
        for size in (2, 8, 72):
            yield EffectCase(
                f"ponds at {level} of {size} pixels", level_keys("hills", water={"level": level}), {**MAP, "size": [size, size]}
            )
        for east_m in (200.0, 700.0, 1150.0):
            yield EffectCase(
                f"ponds at {level}, {east_m} m east", level_keys("hills", water={"level": level}), map_window(east_m, 640.0, 150.0)
            )
    yield EffectCase("no water", level_keys("hills", 40.0, 20.0), PERSPECTIVE)


def haze() -> Iterator[EffectCase]:
    for visibility in (1e3, 1e4, 1e5, 3e5, 6e5, 1e6, 1.5e6, 2e6, 3e6, 5e6, 1e7):
        yield EffectCase(
            f"hills {visibility:g} m", level_keys("hills", 220.0, 20.0, weather={"visibility": visibility}), PERSPECTIVE
        )
    yield EffectCase("clear", level_keys("hills", 220.0, 20.0), PERSPECTIVE)
    for distance_m in (0.5, 1.0, 1.5, 2.0, 3.0, 5.0, 8.0, 12.0):  # ground below an eye, in clear air
        yield EffectCase(
            f"clear, {distance_m} m above a floor", level_keys("floor"), perspective_view((0, 0, distance_m), (0, 0.01, 0), 20.0)
        )
    yield EffectCase("map", level_keys("hills", 220.0, 20.0, weather={"visibility": 2000.0}), MAP)
    for name, eye, target, fov in (
        ("main", (3.7, -2.8, 2.05), (-1.0, 0.5, 0.6), 60.0),
        ("close", (-1.9, -2.5, 1.75), (0.5, -0.5, 0.5), 55.0),
    ):
        for visibility in (None, 2e4, 2e3):
            weather = {} if visibility is None else {"visibility": visibility}
            yield EffectCase(f"room {name}, {visibility}", room_keys(weather=weather), perspective_view(eye, target, fov, 6))
    for distance_m in (20.0, 60.0, 120.0, 180.0, 300.0, 500.0):  # white posts in the light of a lamp by night
        posts = [{"source": "post.obj", "at": [[0.0, 6.0 * k] for k in range(-4, 5)], "color": [1.0, 1.0, 1.0]}]
        lamp = {"kind": "omni", "position": [-25.0, 0.0, 15.0], "intensity": 3.0}
        keys = {"terrain": {"source": "floor.tif"}, "sun": "none", "lights": {"lamp": lamp}, "meshes": posts}
        view = perspective_view((-0.8 * distance_m, 0.0, 0.6 * distance_m), (0.0, 0.0, 4.0), 15.0, 6)
        yield EffectCase(f"lamp at {distance_m} m", keys, view)


def room_keys(**keys: Any) -> dict[str, Any]:
    """Return the keys of the bundled room under the sun."""
    sun = {"azimuth": 208.0, "altitude": 60.0}
    return {"terrain": {"flat": {"size": [24, 24], "cells": [100, 100]}}, "meshes": [{"generate": "room"}], "sun": sun, **keys}


CASES: dict[str, Callable[[], Iterator[EffectCase]]] = {
    "refraction": refraction, "cast_shadows": cast_shadows, "alpha_test": alpha_test, "soft_edges": soft_edges,
    "outside_casters": outside_casters, "snow": snow, "clouds": clouds, "sky_view": sky_view,
    "ambient_occlusion": ambient_occlusion,
    "sky_light": sky_light, "texture_shading": texture_shading, "lamps": lamps, "water": water,
    "haze": haze, "ground_materials": ground_materials, "ground_detail": ground_detail, "roads": roads, "facades": facades,
    "crowns": crowns, "textures": textures, "normal_maps": normal_maps, "highlights": highlights,
    "precipitation": precipitation,
}  # fmt: skip
"""Effect -> its cases."""

EDGE_MOVING_EFFECTS = frozenset({"refraction", "soft_edges"})
"""Effects that move edges, and that are left out if they move them by less than a pixel. A pixel on an edge then changes sides.
Tests compare it with the other picture's pixel and its neighbours.
"""
