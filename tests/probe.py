"""What all front ends make of something more, printed as JSON: run by ``tests.copies`` on a copy of the house.

``python -m tests.probe LEVEL setting|layer|parameter``. Its render process draws nothing: it answers with what it was told.
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
from skugga.api.http.server.app import create_app
from skugga.api.layers import encode_picture, picture_layer
from skugga.api.settings import Settings
from skugga.api.workers.block_tiles import PicturedBlock, encoded_tiles
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
from skugga.api.workers.render_worker import run_job
from skugga.api.workers.worker_config import WorkerConfig
from skugga.api.workers.worker_state import WorkerState
from skugga.selector.candidates import name_of
from skugga.shadows.maps.settings import ShadowMapSettings
from skugga.terrain.describe import describe
from skugga.terrain.errors import SkuggaError
from skugga.terrain.geo.grid import BLOCK_PX
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene
from tests.api.conftest import running

TILES = "/levels/hills/tiles/WebMercatorQuad/12/2144/1432"
TILE, SNAPSHOT, PLAN = f"{TILES}.png", "/levels/hills/snapshot.png", "/levels/hills/plan"


def told(pipe: Connection, config: WorkerConfig) -> None:
    """A render process that answers with the job's wishes, and under which sun it would draw."""
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
        there, quarter = np.ones((side, side), np.bool_), np.full((side, side), 0.25, np.float32)
        block = PicturedBlock(np.zeros((side, side, 3), np.uint8), np.full((side, side), 191, np.uint8), there, quarter)
        if isinstance(job, BlockJob):
            pipe.send(BlockTiles(encoded_tiles(block, job.layer, job.format, job.tiles), 0.0, said, (), 0.0, 0.0, False, "told"))
        else:
            body = encode_picture(picture_layer(block.part(0, 0, 8), job.layer), f".{job.format}")
            pipe.send(Snapshot(body, 0.0, said, (), 0.0, 0.0, False, "told"))


def command(*arguments: str) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of ``skugga``."""
    sys.argv = ["skugga", *arguments]
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        try:
            cli.main()
            status: Any = 0
        except SystemExit as ended:
            status = ended.code
    return status, out.getvalue(), err.getvalue()


def asked_of(document: dict[str, Any], name: str) -> dict[str, Any]:
    """A parameter by the paths that take it."""
    return {
        path: parameter
        for path, methods in document["paths"].items()
        for method in methods.values()
        for parameter in method.get("parameters", ())
        if parameter["name"] == name
    }


def setting(level: Path, client: httpx.Client) -> dict[str, Any]:
    """A setting ``gloss`` of ``dull`` or ``bright``."""
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


def layer(level: Path, client: httpx.Client) -> dict[str, Any]:
    """A layer ``dusk`` of gray, 100 where a quarter is lit."""
    from PIL import Image

    picture, wrong = level.with_name("dusk.png"), level.with_name("dusk.npy")
    size = ("--size", "32x32", "--algorithm", "none", "--layer", "dusk")
    drawn = command("render", str(level), *size, "-o", str(picture))
    bodies = [client.get(path, params={"layer": "dusk"}) for path in (TILE, f"{TILES}.webp", SNAPSHOT, f"{TILES}@2x.png")]
    return {
        "render": [drawn, np.asarray(Image.open(picture)).max().item()],
        "refused": command("render", str(level), *size, "-o", str(wrong)),
        "help": " ".join(command("render", "--help")[1].split()),
        "http": [np.unique(np.asarray(Image.open(io.BytesIO(each.content)).convert("L"))).tolist() for each in bodies],
        "off the data": np.unique(
            np.asarray(Image.open(io.BytesIO(client.get(TILE.replace("2144", "2244"), params={"layer": "dusk"}).content)))
        ).tolist(),
        "refusal": client.get(f"{TILES}.jpg", params={"layer": "dusk"}).json(),
        "unknown": client.get(TILE, params={"layer": "dawn"}).json(),
        "layers": client.get("/levels/hills").json()["layers"],
        "openapi": asked_of(client.get("/openapi.json").json(), "layer"),
    }


def parameter(level: Path, client: httpx.Client) -> dict[str, Any]:
    """A parameter ``raised``: degrees that the sun stands higher."""
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
    with running(create_app(Settings(workers=1), [level_file], told)) as served:
        print(json.dumps({"setting": setting, "layer": layer, "parameter": parameter}[what](level_file, served)))
