"""Run every front end with an added feature, and print their answers as JSON. ``tests.copies`` runs this on a modified
copy.

``python -m tests.probe LEVEL setting|product|parameter``. Its render process draws nothing, except for a product: it
answers with its job.
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
from skugga.api.products.product import Part
from skugga.api.settings import Settings
from skugga.api.workers.block_tiles import tiles_of_picture
from skugga.api.workers.jobs import (
    BlockJob,
    BlockTiles,
    DescribedPlanJob,
    DescriptorJob,
    Ping,
    PlanAnswer,
    PlanJob,
    Pong,
    Ready,
    Snapshot,
)
from skugga.api.workers.render_worker import run_job, run_worker
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

TILES = "/levels/hills/tiles/WebMercatorQuad/12/2144/1432"
TILE, SNAPSHOT, PLAN = f"{TILES}.png", "/levels/hills/snapshot.png", "/levels/hills/plan"


def told(pipe: Connection, config: WorkerConfig) -> None:
    """Run a render process that answers with the job's options and the sun that it would draw under."""
    pipe.send(Ready("told"))
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        if isinstance(job, Ping):
            pipe.send(Pong())
            continue
        if isinstance(job, DescriptorJob | DescribedPlanJob):
            pipe.send(run_job(job, WorkerState("told")))
            continue
        sun = job.request.seen(build_scene(load_level(job.level.path))).sun
        said = json.dumps([job.request.overrides.for_selector(), None if sun is None else sun.altitude_deg])
        if isinstance(job, PlanJob):
            pipe.send(PlanAnswer(said))
            continue
        side = BLOCK_PX
        valid, quarter = np.ones((side, side), np.bool_), np.full((side, side), 0.25, np.float32)
        shadow = np.full((side, side), 191, np.uint8)
        picture, scene = (
            Picture(valid, (), np.zeros((side, side, 3), np.uint8), shadow, quarter),
            build_scene(load_level(job.level.path)),
        )
        if isinstance(job, BlockJob):
            tiles = tiles_of_picture(picture, job.request, scene, block_view(job), job.format, job.tiles)
            pipe.send(BlockTiles(tiles, 0.0, said, (), 0.0, 0.0, False, "told"))  # type: ignore[arg-type]
        else:
            part = picture.part((slice(0, 8), slice(0, 8)))
            body = encode_picture(job.request.record.compute(Part(scene, scene.view(), None, part)), job.format)
            pipe.send(Snapshot(body, 0.0, said, (), 0.0, 0.0, False, "told"))


def command(*arguments: str) -> tuple[int, str, str]:
    """Return exit status, standard output and standard error of ``skugga``."""
    sys.argv = ["skugga", *arguments]
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        try:
            cli.main()
            status: Any = 0
        except SystemExit as ended:
            status = ended.code
    return status, out.getvalue(), err.getvalue()


def asked_of(document: dict[str, Any], name: str) -> dict[str, Any]:
    """Return the description of a parameter by the paths that accept it."""
    return {
        path: parameter
        for path, methods in document["paths"].items()
        for method in methods.values()
        for parameter in method.get("parameters", ())
        if parameter["name"] == name
    }


def setting(level: Path, client: httpx.Client) -> dict[str, Any]:
    """Return answers about a setting ``gloss`` of ``dull`` or ``bright``."""
    from skugga.api.report.plan_text import format_plan
    from skugga.selector.pin import pinned_text, pins
    from skugga.selector.planner.planner import make_plan

    more = level.with_name("glossy.json")
    more.write_text(json.dumps({**json.loads(level.read_text()), "shadows": {"gloss": "bright"}}))
    wrong = level.with_name("wrong.json")
    wrong.write_text(json.dumps({**json.loads(level.read_text()), "shadows": {"gloss": "loud"}}))
    try:
        refusal = str(load_level(wrong).level.shadows)
    except SkuggaError as error:
        refusal = str(error)
    loaded = load_level(level)
    scene = build_scene(loaded)
    descriptor = describe(scene, scene.view("map"))
    plan = make_plan(descriptor, loaded.level, {"algorithm": "shadow_map", "gloss": "bright"})

    class Glossy(ShadowMapSettings):
        gloss: str = "dull"

    settings = {
        light: {kind: Glossy(**its.model_dump(), gloss="bright") for kind, its in kinds.items()}
        for light, kinds in plan.settings.items()
    }
    plan = plan.model_copy(update={"settings": settings})
    chosen = pins(plan, descriptor, loaded.level)
    picture = level.with_name("picture.png")
    stats = level.with_name("stats.json")
    drawn = command(
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
    asked = {"gloss": "bright"}
    return {
        "level file": [load_level(more).level.shadows.model_dump()["gloss"], refusal],
        "help": {name: command(name, "--help")[1] for name in ("render", "select")},
        "render": [drawn, json.loads(stats.read_text())["plan"]["reasons"]],
        "select": command("select", str(level), "--policy", "rules", "--gloss", "bright", "--json"),
        "refused": command("select", str(level), "--gloss", "loud"),
        "openapi": asked_of(client.get("/openapi.json").json(), "gloss"),
        "http": {
            "tile": client.get(TILE, params=asked).headers["x-skugga-algorithm"],
            "snapshot": client.get(SNAPSHOT, params=asked).headers["x-skugga-algorithm"],
            "plan": client.get(PLAN, params=asked).json(),
            "tilejson": client.get("/levels/hills/WebMercatorQuad/tilejson.json", params=asked).json()["tiles"],
        },
        "plan of facts": client.post("/plan", params={**asked, "policy": "rules"}, json=facts).json()["reasons"],
        "refusals": [client.get(path, params={"gloss": "loud"}).json() for path in (TILE, SNAPSHOT, PLAN)],
        "tags": {path: [client.get(path, params=query).headers["etag"] for query in ({}, asked)] for path in (TILE, SNAPSHOT)},
        "pin": pinned_text(level.read_text(), chosen, ["Chosen."]),
        "words": format_plan(plan, "A plan."),
        "candidate": name_of(plan),
    }


def plane(raster: Path) -> None:
    """Overwrite a raster with ground that rises 0.75 to the east for each unit of the map."""
    import rasterio

    with rasterio.open(raster, "r+") as dataset:
        columns = np.arange(dataset.width, dtype=np.float32) * np.float32(0.75 * dataset.res[0])
        dataset.write(np.broadcast_to(columns, dataset.shape), 1)


def product(level: Path, client: httpx.Client) -> dict[str, Any]:
    """Return answers about a product ``steepness`` with a ``gain`` of 2, of ground that rises 0.75 to the east for each
    metre of the map.
    """
    import rasterio
    from morecantile import tms as matrix_sets
    from PIL import Image
    from pmtiles.reader import MmapSource, Reader

    import skugga
    from skugga.api.products import product_table

    asked, folder = {"layer": "steepness", "gain": 2}, level.parent
    raster, archive = folder / "steepness.tif", folder / "steepness.pmtiles"

    def inside(array: np.ndarray, rim: int = 4) -> list[float]:
        """Return the minimum and maximum within the data, and the share of valid pixels there."""
        known = np.isfinite(array)
        rows, cols = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
        part = array[rows[0] + rim : rows[-1] - rim + 1, cols[0] + rim : cols[-1] - rim + 1]
        return [float(np.nanmin(part)), float(np.nanmax(part)), float(np.isfinite(part).mean())]

    def values(path: str, **more: object) -> np.ndarray:
        answer = client.get(path, params={**asked, **more})
        assert answer.status_code == 200, answer.text
        return np.load(io.BytesIO(answer.content))

    def colors(content: bytes) -> list[list[int]]:
        """Return the colours in the centre of a picture."""
        picture = np.asarray(Image.open(io.BytesIO(content)).convert("RGBA"))
        rows, cols = (np.flatnonzero((picture[..., 3] == 255).any(axis=axis)) for axis in (1, 0))
        part = picture[rows[0] + 4 : rows[-1] - 3, cols[0] + 4 : cols[-1] - 3]
        return np.unique(part.reshape(-1, 4), axis=0).tolist()

    done = command("compute", str(level), "--product", "steepness", "--gain", "2", "-o", str(raster))
    assert done[0] == 0, done
    with rasterio.open(raster) as dataset, skugga.open_level(level) as opened:
        by_command, by_python = dataset.read(1), opened.compute("steepness", gain=2.0)
    around = [[values(TILES.replace("2144/1432", f"{x}/{y}") + ".npy") for x in (2143, 2144)] for y in (1431, 1432)]
    bounds = matrix_sets.get("WebMercatorQuad").xy_bounds(2144, 1432, 12)
    wms = {
        "SERVICE": "WMS", "REQUEST": "GetMap", "LAYERS": "hills:steepness", "CRS": "EPSG:3857", "BBOX": ",".join(map(str, bounds)),
        "WIDTH": 200, "HEIGHT": 200, "FORMAT": "image/png", "TRANSPARENT": "TRUE", "GAIN": 2,
    }  # fmt: skip
    done = command(
        "seed", str(level), "--zooms", "12-12", "--layer", "steepness", "--gain", "2", "--workers", "1", "-o", str(archive)
    )
    assert done[0] == 0, done
    with archive.open("rb") as file:
        seeded = Reader(MmapSource(file)).get(12, 2144, 1432)
    tile = client.get(TILE, params=asked)
    assert seeded == tile.content, "the archive has the tile that the service has"
    said = client.get("/levels/hills/WebMercatorQuad/tilejson.json", params=asked).json()
    level_said = client.get("/levels/hills").json()
    documents = {
        name: client.get(address).text
        for name, address in (
            ("wms", "/wms?SERVICE=WMS&REQUEST=GetCapabilities"), ("wmts", "/wmts/1.0.0/WMTSCapabilities.xml"),
        )
    }  # fmt: skip
    mask = ("--product", "mask", "--gain", "2", "-o", str(raster))
    return {
        "command": inside(by_command), "python": inside(by_python), "tile": inside(values(f"{TILES}.npy")),
        "double tile": inside(values(f"{TILES}@2x.npy")), "across blocks": inside(np.block(around)),
        "map": inside(values("/levels/hills/map.npy", width=300)), "colors": colors(tile.content),
        "wms": colors(client.get("/wms", params=wms).content), "seeded": colors(seeded),
        "map_layers": level_said["map_layers"], "products": {each["name"]: each for each in level_said["products"]},
        "tilejson": {"tiles": said["tiles"][0], "legend": said["skugga"]["legend"]["title"]},
        "legend": [client.get(f"/levels/hills/legend.{kind}", params=asked).headers["content-type"] for kind in ("png", "svg")],
        **{f"{name} capabilities": ["hills:steepness" in text, "LegendURL" in text] for name, text in documents.items()},
        "help": " ".join(command("compute", "--help")[1].split()),
        "openapi": asked_of(client.get("/openapi.json").json(), "gain"), "docs": product_table(),
        "tags": [client.get(TILE, params={**asked, "gain": gain}).headers["etag"] for gain in (2, 3)],
        "refusals": [
            client.get(TILE, params=query).json() for query in ({"gain": 2}, {**asked, "gain": 99}, {**asked, "gain": "x"})
        ],
        "refused": [
            command("compute", str(level), *mask),
            command("compute", str(level), "--product", "steepness", "--gain", "99", "-o", str(raster)),
        ],
        "in perspective": command("render", str(level), "--view", "across", "--layer", "steepness", "-o", str(raster)),
    }  # fmt: skip


def parameter(level: Path, client: httpx.Client) -> dict[str, Any]:
    """Return answers about a parameter ``raised``: degrees added to the sun's altitude."""
    asked = {"azimuth": 200, "altitude": 30, "raised": 12}
    suns = ({"azimuth": 200, "altitude": 30}, asked)
    return {
        "openapi": asked_of(client.get("/openapi.json").json(), "raised"),
        "http": [client.get(path, params=asked).headers["x-skugga-algorithm"] for path in (TILE, SNAPSHOT)],
        "tilejson": client.get("/levels/hills/WebMercatorQuad/tilejson.json", params=asked).json()["tiles"],
        "tags": {path: [client.get(path, params=sun).headers["etag"] for sun in suns] for path in (TILE, SNAPSHOT)},
        "refusal": client.get(TILE, params={"raised": "high"}).json(),
    }


if __name__ == "__main__":
    level_file, what = Path(sys.argv[1]), sys.argv[2]
    if what == "product":
        plane(level_file.with_suffix(".tif"))
    worker = run_worker if what == "product" else told
    with running(create_app(Settings(workers=1), [level_file], worker)) as served:
        print(json.dumps({"setting": setting, "product": product, "parameter": parameter}[what](level_file, served)))
