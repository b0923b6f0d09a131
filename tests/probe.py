"""Run every front end with added features, and print their answers as JSON. ``tests.copies`` runs this on a modified
copy.

``python -m tests.probe HILLS PLANE``. Its render process draws only the added product; otherwise it answers with its job.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from skugga.api.cli import main as cli
from skugga.api.encoding import encode_picture
from skugga.api.http.server.app import create_app
from skugga.api.products.product import ProductInput
from skugga.api.settings import Settings
from skugga.api.workers.block_tiles import tiles_of_picture
from skugga.api.workers.jobs import (
    BlockJob,
    BlockTiles,
    DescriptorJob,
    DescriptorPlanJob,
    HeartbeatRequest,
    HeartbeatResponse,
    PlanJob,
    PlanResult,
    Snapshot,
    WorkerReady,
)
from skugga.api.workers.render_worker import run_job
from skugga.api.workers.worker_config import WorkerConfig
from skugga.api.workers.worker_state import WorkerState, block_view
from skugga.selector.candidates import name_of
from skugga.shadows.maps.settings import ShadowMapSettings
from skugga.shadows.picture import Picture
from skugga.terrain.describe import describe
from skugga.terrain.errors import SkuggaError
from skugga.terrain.geo.grid import BLOCK_PX
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene
from tests.api.conftest import running

PRODUCT = "steepness"
"""Name of the added product."""

TILES = "/levels/hills/tiles/WebMercatorQuad/12/2144/1432"
TILE, SNAPSHOT, PLAN = f"{TILES}.png", "/levels/hills/snapshot.png", "/levels/hills/plan"


def echo_worker(pipe: Connection, config: WorkerConfig) -> None:
    """Run a render process that draws ``PRODUCT``, and otherwise answers with the job's options and the sun that it would
    draw under.
    """
    state = WorkerState("told")
    pipe.send(WorkerReady("told"))
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        if isinstance(job, HeartbeatRequest):
            pipe.send(HeartbeatResponse())
            continue
        if isinstance(job, DescriptorJob | DescriptorPlanJob) or getattr(job.request, "product", None) == PRODUCT:
            pipe.send(run_job(job, state))
            continue
        sun = job.request.applied_to(build_scene(load_level(job.level.path))).sun
        payload = json.dumps([job.request.overrides.for_selector(), None if sun is None else sun.altitude_deg])
        if isinstance(job, PlanJob):
            pipe.send(PlanResult(payload))
            continue
        side = BLOCK_PX
        valid, quarter = np.ones((side, side), np.bool_), np.full((side, side), 0.25, np.float32)
        shadow = np.full((side, side), 191, np.uint8)
        picture, scene = (
            Picture(valid, (), np.zeros((side, side, 3), np.uint8), shadow, quarter),
            build_scene(load_level(job.level.path)),
        )
        if isinstance(job, BlockJob):
            tiles = tiles_of_picture(picture, job.request, scene, block_view(job), job.format, job.tiles_per_side)
            pipe.send(BlockTiles(tiles, 0.0, payload, (), 0.0, 0.0, False, "told"))  # type: ignore[arg-type]
        else:
            part = picture.part((slice(0, 8), slice(0, 8)))
            body = encode_picture(job.request.product_record.compute(ProductInput(scene, scene.view(), None, part)), job.format)
            pipe.send(Snapshot(body, 0.0, payload, (), 0.0, 0.0, False, "told"))


def run_skugga(*arguments: str) -> tuple[int, str, str]:
    """Return exit status, standard output and standard error of ``skugga``."""
    sys.argv = ["skugga", *arguments]
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        try:
            cli.main()
            status: Any = 0
        except SystemExit as exit_exception:
            status = exit_exception.code
    return status, out.getvalue(), err.getvalue()


def parameter_by_path(document: dict[str, Any], name: str) -> dict[str, Any]:
    """Return the description of a parameter by the paths that accept it."""
    return {
        path: parameter
        for path, methods in document["paths"].items()
        for method in methods.values()
        for parameter in method.get("parameters", ())
        if parameter["name"] == name
    }


def probe_setting(level: Path, client: httpx.Client) -> dict[str, Any]:
    """Return answers about a setting ``gloss`` of ``dull`` or ``bright``."""
    from skugga.api.report.plan_text import format_plan
    from skugga.selector.pin import pinned_text, pins
    from skugga.selector.planner.planner import make_plan

    glossy_level = level.with_name("glossy.json")
    glossy_level.write_text(json.dumps({**json.loads(level.read_text()), "shadows": {"gloss": "bright"}}))
    invalid_level = level.with_name("wrong.json")
    invalid_level.write_text(json.dumps({**json.loads(level.read_text()), "shadows": {"gloss": "loud"}}))
    try:
        refusal = str(load_level(invalid_level).level.shadows)
    except SkuggaError as error:
        refusal = str(error)
    loaded = load_level(level)
    scene = build_scene(loaded)
    descriptor = describe(scene, scene.view("map"))
    plan = make_plan(descriptor, loaded.level, {"algorithm": "shadow_map", "gloss": "bright"})

    class Glossy(ShadowMapSettings):
        gloss: str = "dull"

    settings = {
        light: {kind: Glossy(**kind_settings.model_dump(), gloss="bright") for kind, kind_settings in kinds.items()}
        for light, kinds in plan.settings.items()
    }
    plan = plan.model_copy(update={"settings": settings})
    pin_choices = pins(plan, descriptor, loaded.level)
    picture = level.with_name("picture.png")
    stats = level.with_name("stats.json")
    render_output = run_skugga(
        "render",
        str(level),
        "--size",
        "32x32",
        "--algorithm",
        "none",
        "--gloss",
        "bright",
        "-o",
        str(picture),
        "--stats",
        str(stats),
    )
    facts = client.get("/levels/hills/descriptor").json()
    params = {"gloss": "bright"}
    return {
        "level file": [load_level(glossy_level).level.shadows.model_dump()["gloss"], refusal],
        "help": {name: run_skugga(name, "--help")[1] for name in ("render", "select")},
        "render": [render_output, json.loads(stats.read_text())["plan"]["reasons"]],
        "select": run_skugga("select", str(level), "--policy", "rules", "--gloss", "bright", "--json"),
        "refused": run_skugga("select", str(level), "--gloss", "loud"),
        "openapi": parameter_by_path(client.get("/openapi.json").json(), "gloss"),
        "http": {
            "tile": client.get(TILE, params=params).headers["x-skugga-algorithm"],
            "snapshot": client.get(SNAPSHOT, params=params).headers["x-skugga-algorithm"],
            "plan": client.get(PLAN, params=params).json(),
            "tilejson": client.get("/levels/hills/WebMercatorQuad/tilejson.json", params=params).json()["tiles"],
        },
        "plan of facts": client.post("/plan", params={**params, "policy": "rules"}, json=facts).json()["reasons"],
        "refusals": [client.get(path, params={"gloss": "loud"}).json() for path in (TILE, SNAPSHOT, PLAN)],
        "tags": {path: [client.get(path, params=query).headers["etag"] for query in ({}, params)] for path in (TILE, SNAPSHOT)},
        "pin": pinned_text(level.read_text(), pin_choices, ["Chosen."]),
        "words": format_plan(plan, "A plan."),
        "candidate": name_of(plan),
    }


def write_inclined_plane(raster: Path) -> None:
    """Overwrite a raster with ground that rises 0.75 to the east for each unit of the map."""
    import rasterio

    with rasterio.open(raster, "r+") as dataset:
        columns = np.arange(dataset.width, dtype=np.float32) * np.float32(0.75 * dataset.res[0])
        dataset.write(np.broadcast_to(columns, dataset.shape), 1)


def probe_product(level: Path, client: httpx.Client) -> dict[str, Any]:
    """Return answers about a product ``steepness`` with a ``gain`` of 2, of ground that rises 0.75 to the east for each
    metre of the map.
    """
    import rasterio
    from morecantile import tms as matrix_sets
    from PIL import Image
    from pmtiles.reader import MmapSource, Reader

    import skugga
    from skugga.api.products import product_table

    level_path, layer = f"/levels/{level.stem}", f"{level.stem}:{PRODUCT}"
    tiles = TILES.replace("/levels/hills", level_path)
    tile_path = f"{tiles}.png"
    params, folder = {"layer": PRODUCT, "gain": 2}, level.parent
    raster, archive = folder / "steepness.tif", folder / "steepness.pmtiles"

    def value_range(array: np.ndarray, rim: int = 4) -> list[float]:
        """Return the minimum and maximum within the data, and the share of valid pixels there."""
        valid = np.isfinite(array)
        rows, cols = (np.flatnonzero(valid.any(axis=axis)) for axis in (1, 0))
        part = array[rows[0] + rim : rows[-1] - rim + 1, cols[0] + rim : cols[-1] - rim + 1]
        return [float(np.nanmin(part)), float(np.nanmax(part)), float(np.isfinite(part).mean())]

    def fetch_values(path: str, **extra_params: object) -> np.ndarray:
        answer = client.get(path, params={**params, **extra_params})
        assert answer.status_code == 200, answer.text
        return np.load(io.BytesIO(answer.content))

    def centre_colors(content: bytes) -> list[list[int]]:
        """Return the colours in the centre of a picture."""
        picture = np.asarray(Image.open(io.BytesIO(content)).convert("RGBA"))
        rows, cols = (np.flatnonzero((picture[..., 3] == 255).any(axis=axis)) for axis in (1, 0))
        part = picture[rows[0] + 4 : rows[-1] - 3, cols[0] + 4 : cols[-1] - 3]
        return np.unique(part.reshape(-1, 4), axis=0).tolist()

    output = run_skugga("compute", str(level), "--product", PRODUCT, "--gain", "2", "-o", str(raster))
    assert output[0] == 0, output
    with rasterio.open(raster) as dataset, skugga.open_level(level) as open_level:
        command_array, python_array = dataset.read(1), open_level.compute(PRODUCT, gain=2.0)
    neighbour_tiles = [[fetch_values(tiles.replace("2144/1432", f"{x}/{y}") + ".npy") for x in (2143, 2144)] for y in (1431, 1432)]
    bounds = matrix_sets.get("WebMercatorQuad").xy_bounds(2144, 1432, 12)
    wms = {
        "SERVICE": "WMS", "REQUEST": "GetMap", "LAYERS": layer, "CRS": "EPSG:3857", "BBOX": ",".join(map(str, bounds)),
        "WIDTH": 200, "HEIGHT": 200, "FORMAT": "image/png", "TRANSPARENT": "TRUE", "GAIN": 2,
    }  # fmt: skip
    output = run_skugga(
        "seed", str(level), "--zooms", "12-12", "--layer", PRODUCT, "--gain", "2", "--workers", "1", "-o", str(archive)
    )
    assert output[0] == 0, output
    with archive.open("rb") as file:
        seeded = Reader(MmapSource(file)).get(12, 2144, 1432)
    tile = client.get(tile_path, params=params)
    assert seeded == tile.content, "the archive has the tile that the service has"
    tilejson = client.get(f"{level_path}/WebMercatorQuad/tilejson.json", params=params).json()
    level_document = client.get(level_path).json()
    documents = {
        name: client.get(address).text
        for name, address in (
            ("wms", "/wms?SERVICE=WMS&REQUEST=GetCapabilities"), ("wmts", "/wmts/1.0.0/WMTSCapabilities.xml"),
        )
    }  # fmt: skip
    mask = ("--product", "mask", "--gain", "2", "-o", str(raster))
    return {
        "command": value_range(command_array), "python": value_range(python_array),
        "tile": value_range(fetch_values(f"{tiles}.npy")), "double tile": value_range(fetch_values(f"{tiles}@2x.npy")),
        "across blocks": value_range(np.block(neighbour_tiles)),
        "map": value_range(fetch_values(f"{level_path}/map.npy", width=300)), "colors": centre_colors(tile.content),
        "wms": centre_colors(client.get("/wms", params=wms).content), "seeded": centre_colors(seeded),
        "map_layers": level_document["map_layers"], "products": {item["name"]: item for item in level_document["products"]},
        "tilejson": {"tiles": tilejson["tiles"][0], "legend": tilejson["skugga"]["legend"]["title"]},
        "legend": [client.get(f"{level_path}/legend.{kind}", params=params).headers["content-type"] for kind in ("png", "svg")],
        **{f"{name} capabilities": [layer in text, "LegendURL" in text] for name, text in documents.items()},
        "help": " ".join(run_skugga("compute", "--help")[1].split()),
        "openapi": parameter_by_path(client.get("/openapi.json").json(), "gain"), "docs": product_table(),
        "tags": [client.get(tile_path, params={**params, "gain": gain}).headers["etag"] for gain in (2, 3)],
        "refusals": [
            client.get(tile_path, params=query).json() for query in ({"gain": 2}, {**params, "gain": 99}, {**params, "gain": "x"})
        ],
        "refused": [
            run_skugga("compute", str(level), *mask),
            run_skugga("compute", str(level), "--product", PRODUCT, "--gain", "99", "-o", str(raster)),
        ],
        "in perspective": run_skugga("render", str(level), "--view", "across", "--layer", PRODUCT, "-o", str(raster)),
    }  # fmt: skip


def probe_parameter(level: Path, client: httpx.Client) -> dict[str, Any]:
    """Return answers about a parameter ``raised``: degrees added to the sun's altitude."""
    params = {"azimuth": 200, "altitude": 30, "raised": 12}
    suns = ({"azimuth": 200, "altitude": 30}, params)
    return {
        "openapi": parameter_by_path(client.get("/openapi.json").json(), "raised"),
        "http": [client.get(path, params=params).headers["x-skugga-algorithm"] for path in (TILE, SNAPSHOT)],
        "tilejson": client.get("/levels/hills/WebMercatorQuad/tilejson.json", params=params).json()["tiles"],
        "tags": {path: [client.get(path, params=sun).headers["etag"] for sun in suns] for path in (TILE, SNAPSHOT)},
        "refusal": client.get(TILE, params={"raised": "high"}).json(),
    }


if __name__ == "__main__":
    hills, plane = Path(sys.argv[1]), Path(sys.argv[2])
    write_inclined_plane(plane.with_suffix(".tif"))
    with running(create_app(Settings(workers=1), [hills, plane], echo_worker)) as served:
        probes = {"setting": (probe_setting, hills), "product": (probe_product, plane), "parameter": (probe_parameter, hills)}
        print(json.dumps({feature: probe(level, served) for feature, (probe, level) in probes.items()}))
