"""The house: which room may import which. Floors import floors below; no circle; each folder's ``__init__`` says what it may."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

FLOORS = ("terrain", "shadows", "selector", "api")
"""From the ground up: a floor imports only those before it."""

LEAVES = {
    "terrain.errors",
    "terrain.compiled",
    "terrain.compiling",
    "terrain.cache",
    "terrain.cores",
    "terrain.interpolation",
    "terrain.interpolation_loops",
    "terrain.srgb",
    "terrain.user_cache",
    "terrain.whole_files",
}
"""What every module may import; they import one another at most."""

MAY_IMPORT = {
    "terrain.compiling": "",
    "terrain.level": "",
    "terrain.geo": "level",
    "terrain.ground": "geo level",
    "terrain.meshes": "geo ground level",
    "terrain.trees": "geo ground level",
    "terrain.lights": "geo ground level",
    "terrain.scene_objects": "geo ground level lights meshes trees",
    "terrain.own_sun": "geo ground level",
    "terrain.viewpoint": "geo ground level",
    "terrain.climate": "",
    "terrain.style": "climate level",
    "terrain.camera_path": "geo ground level",
    "terrain.scene": "geo ground level lights own_sun scene_objects style",
    "terrain.gl": "",
    "terrain.gbuffer": "geo gl ground level lights meshes scene scene_objects trees",
    "terrain.casters": "gbuffer geo ground level scene scene_objects trees",
    "terrain.shading_loops": "gbuffer style",
    "terrain.shading": "climate gbuffer geo ground scene shading_loops style",
    "terrain.sky": "geo scene shading_loops",
    "terrain.facts": "casters gbuffer geo ground level lights meshes scene scene_objects trees",
    "terrain.effects": "casters facts gbuffer geo ground level lights scene scene_objects shading shading_loops sky style",
    "terrain.describe": "casters effects facts gbuffer geo ground scene",
    "shadows.passes": "",
    "shadows.work": "",
    "shadows.attached": "",
    "shadows.layer_collector": "passes",
    "shadows.executed_effects": "passes",
    "shadows.bent_rays": "",
    "shadows.penumbra": "",
    "shadows.algorithm": "bent_rays passes penumbra work",
    "shadows.area_light": "algorithm attached passes work",
    "shadows.maps": "algorithm area_light attached passes penumbra work",
    "shadows.volumes": "algorithm area_light attached passes work",
    "shadows.hybrid": "algorithm attached layer_collector maps passes volumes work",
    "shadows.none": "algorithm",
    "shadows.planar": "algorithm maps passes work",
    "shadows.sweep": "algorithm passes work",
    "shadows.truth": "algorithm area_light attached passes work",
    "shadows.point": "",
    "shadows.registry": "algorithm hybrid maps none planar sweep truth volumes",
    "shadows.plan": "algorithm registry",
    "shadows.block_casters": "passes plan registry",
    "shadows.visibility": "attached block_casters passes plan registry",
    "shadows.coarse_pixels": "block_casters layer_collector passes plan registry visibility",
    "shadows.map_edges": "block_casters coarse_pixels passes plan visibility",
    "shadows.render": "block_casters coarse_pixels executed_effects layer_collector map_edges passes plan registry visibility",
    "shadows.ground_pictures": "coarse_pixels passes plan render visibility",
    "shadows.sunlit_ground": "attached coarse_pixels passes plan visibility",
    "shadows.sun_hours": "plan render sweep",
    "selector.formatting": "",
    "selector.choices": "",
    "selector.mixes": "",
    "selector.ranking": "formatting",
    "selector.belief": "",
    "selector.expected_loss": "belief ranking",
    "selector.portfolio": "choices mixes",
    "selector.planner": "choices formatting",
    "selector.cost": "belief",
    "selector.candidates": "mixes planner",
    "selector.pin": "choices planner",
    "selector.seen": "",
    "selector.film_request": "",
    "selector.options": "belief choices cost expected_loss planner portfolio ranking seen",
    "selector.predict": "choices cost expected_loss formatting options planner ranking seen",
    "selector.measure": "belief candidates choices cost expected_loss formatting options planner predict ranking seen",
    "selector.map_probes": "seen",
    "selector.kept_probes": "cost map_probes",
    "selector.select": "choices cost measure planner predict seen",
    "selector.replanning": "choices cost formatting planner portfolio select",
    "selector.film": "film_request formatting replanning",
    "api.archive_format": "",
    "api.errors": "",
    "api.png": "",
    "api.terrain_encodings": "",
    "api.layers": "png terrain_encodings",
    "api.settings": "",
    "api.shadow_parameters": "",
    "api.catalogue": "",
    "api.level_summary": "device_calibration picture_cost",
    "api.report": "picture_cost",
    "api.point": "",
    "api.raster_file": "",
    "api.overviews": "raster_file",
    "api.stac_item": "raster_file",
    "api.film_span": "",
    "api.animated_webp": "",
    "api.film_files": "animated_webp png",
    "api.shade_layers": "layers",
    "api.shade": "device_calibration raster_file shade_layers",
    "api.contour_lines": "",
    "api.color_scale": "",
    "api.sun_quantities": "",
    "api.sun_hours_layer": "color_scale sun_quantities",
    "api.sun_hours": "contour_lines device_calibration raster_file shade sun_quantities",
    "api.device_calibration": "report",
    "api.map_probing": "",
    "api.file_stamps": "",
    "api.exhaustion": "errors",
    "api.picture_cost": "errors settings",
    "api.workers": "device_calibration errors exhaustion layers map_probing picture_cost point settings sun_hours_layer",
    "api.library": "catalogue device_calibration film_span layers point raster_file shade shade_layers sun_hours",
    "api.animations": "errors exhaustion film_files settings workers",
    "api.matrices": "errors",
    "api.seed": "archive_format catalogue device_calibration errors file_stamps layers matrices workers",
    "api.http": (
        "animations archive_format color_scale errors exhaustion file_stamps film_span layers matrices point settings "
        "shadow_parameters sun_hours_layer workers"
    ),
    "api.cli": (
        "catalogue device_calibration errors file_stamps film_files film_span http layers level_summary map_probing matrices "
        "overviews picture_cost point raster_file report seed settings shade shade_layers shadow_parameters stac_item sun_hours "
        "sun_quantities workers"
    ),
}
"""Room, or module beside the rooms -> those of its own floor that it imports. Floors below are open to all."""


def room_of(path: Path) -> str:
    """``terrain.geo`` for ``terrain/geo/sun.py``, ``terrain.scene`` for ``terrain/scene.py``."""
    return f"{path.parts[0]}.{Path(path.parts[1]).stem}"


def imports_of(root: Path) -> Iterator[tuple[Path, str]]:
    """Every import of one of our modules: the file and the room that it is from. Imports inside of functions count too."""
    for floor in FLOORS:
        for path in sorted((root / floor).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Import):
                    names = [alias.name for alias in node.names]
                elif isinstance(node, ast.ImportFrom):
                    # "from terrain import scene" is of terrain.scene, "from terrain.geo import sun" of terrain.geo
                    names = [f"{node.module}.{alias.name}" for alias in node.names]
                    assert node.level == 0, f"{path}: relative import"
                else:
                    continue
                for name in names:
                    words = name.split(".")
                    if words[0] in FLOORS and len(words) > 1:
                        yield path.relative_to(root), ".".join(words[:2])


def complaints(root: Path, may_import: dict[str, str]) -> list[str]:
    """What is wrong with the imports of a tree."""
    found: list[str] = []
    used: dict[str, set[str]] = {room: set() for room in may_import}
    for path, other in imports_of(root):
        if len(path.parts) == 2 and path.stem == "__init__":
            found.append(f"{path}: a floor's own __init__ imports nothing")
            continue
        room = room_of(path)
        ours, theirs = room.split(".")[0], other.split(".")[0]
        if room == other:
            continue
        if room in LEAVES:
            if other not in LEAVES:
                found.append(f"{path}: a leaf imports {other}")
        elif FLOORS.index(theirs) > FLOORS.index(ours):
            found.append(f"{path}: {other} is on a floor above")
        elif theirs == ours and other not in LEAVES:
            if room not in may_import:
                found.append(f"{path}: {room} is in no table")
            elif other.split(".")[1] not in may_import[room].split():
                found.append(f"{path}: {room} may not import {other}")
            else:
                used[room].add(other.split(".")[1])
    for room, names in may_import.items():
        found += [f"{room}: may import {name}, and does not" for name in names.split() if name not in used[room]]
    try:
        graph = {room: {f"{room.split('.')[0]}.{name}" for name in names.split()} for room, names in may_import.items()}
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        found.append(f"a circle: {' -> '.join(error.args[1])}")
    return found


def test_rooms_import_what_they_may_and_in_no_circle():
    assert complaints(ROOT, MAY_IMPORT) == []


def test_every_room_says_what_lives_there_and_what_it_may_import():
    rooms = {
        f"{floor}.{folder.parent.name}": folder
        for floor in FLOORS
        for folder in sorted((ROOT / floor).glob("*/__init__.py"))
    }  # fmt: skip
    assert rooms
    for room, path in rooms.items():
        said = " ".join((ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").split())
        expected = ", ".join(sorted(MAY_IMPORT[room].split())) or "no other room"
        assert said.count("May import: ") == 1, path
        assert f"May import: {expected}." in said, path


def test_every_room_and_module_is_in_the_table():
    there = {room_of(path.relative_to(ROOT)) for floor in FLOORS for path in (ROOT / floor).glob("*.py")}
    there |= {f"{floor}.{path.parent.name}" for floor in FLOORS for path in (ROOT / floor).glob("*/__init__.py")}
    there -= {f"{floor}.__init__" for floor in FLOORS}
    assert there == set(MAY_IMPORT) | LEAVES


def test_raw_opengl_is_in_one_room():
    for floor in FLOORS:
        for path in (ROOT / floor).rglob("*.py"):
            raw = re.search(r"^\s*(?:from|import) OpenGL\b", path.read_text(encoding="utf-8"), re.MULTILINE)
            assert raw is None or room_of(path.relative_to(ROOT)) == "terrain.gl", path


@pytest.mark.parametrize(
    ("file", "line", "complaint"),
    [
        ("terrain/low/a.py", "from shadows.x import y", "floor above"),
        ("terrain/low/a.py", "def f():\n    from terrain.high.b import y", "may not import terrain.high"),
        ("terrain/low/a.py", "from terrain import high", "may not import terrain.high"),
        ("terrain/low/a.py", "import terrain.high.b", "may not import terrain.high"),
        ("terrain/errors.py", "from terrain.low.a import y", "a leaf imports"),
        ("terrain/new/c.py", "from terrain.low.a import y", "in no table"),
        ("terrain/__init__.py", "from terrain.low.a import y", "imports nothing"),
        ("terrain/high/b.py", "", "may import low, and does not"),
    ],
)
def test_what_is_wrong_is_noticed(tmp_path, file, line, complaint):
    table = {"terrain.low": "", "terrain.high": "low"}
    for path, text in {"terrain/low/a.py": "", "terrain/high/b.py": "from terrain.low.a import x", file: line}.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text, encoding="utf-8")
    (found,) = complaints(tmp_path, table)
    assert complaint in found


def test_a_circle_is_noticed(tmp_path):
    for path, text in {"terrain/a/x.py": "import terrain.b.y", "terrain/b/y.py": "import terrain.a.x"}.items():
        (tmp_path / path).parent.mkdir(parents=True)
        (tmp_path / path).write_text(text, encoding="utf-8")
    (found,) = complaints(tmp_path, {"terrain.a": "b", "terrain.b": "a"})
    assert found.startswith("a circle")
