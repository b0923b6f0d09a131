"""Descriptions of levels: lists, TileJSON, plans, health and documentation."""

import json
import re

import numpy as np
import pytest
from pydantic import BaseModel, ConfigDict, Field

from skugga.api.http.state.served_levels import ServedLevels
from tests.api.conftest import SUN, Client, write_level

TILEJSON = "/levels/{}/WebMercatorQuad/tilejson.json"


class TileJson(BaseModel):
    """The fields that TileJSON 3.0.0 requires of a raster document, and ours."""

    model_config = ConfigDict(extra="forbid")

    tilejson: str = Field(pattern=r"^3\.0\.0$")
    tiles: list[str] = Field(min_length=1)
    name: str
    attribution: str
    scheme: str = Field(pattern="^xyz$")
    minzoom: int = Field(ge=0, le=30)
    maxzoom: int = Field(ge=0, le=30)
    bounds: tuple[float, float, float, float]
    center: tuple[float, float, int]
    skugga: dict


def test_levels_are_listed_with_their_facts(client: Client):
    levels = {level["name"]: level for level in client.get("/levels").json()}
    assert list(levels) == ["hills", "timed", "site"]
    hills = levels["hills"]
    assert (hills["title"], hills["attribution"]) == ("The hills", "nobody")
    assert hills["views"] == ["map"]
    assert hills["layers"] == ["color", "shadow", "mask"]
    assert hills["algorithms"] == [
        "shadow_map", "perspective_shadow_map", "light_space_perspective_map", "shadow_volume", "hybrid",
        "reconstructed_volume", "planar", "sweep", "none",
    ]  # fmt: skip
    assert hills["sun"] == SUN
    assert levels["timed"]["sun"] == {"time": "2024-06-21T18:00:00+02:00"}
    west, south, east, north = hills["bounds"]
    assert np.allclose([(west + east) / 2, (south + north) / 2], [8.4375, 47.517], atol=0.01)
    assert hills["minzoom"] < hills["maxzoom"]
    assert hills["tile_matrix_sets"]["WebMercatorQuad"] == {key: hills[key] for key in ("minzoom", "maxzoom")}
    assert client.get("/levels/hills").json() == hills
    assert hills["time_zone"] == "Europe/Zurich"
    assert not hills["sun_is_default"]


def test_level_without_a_sun_reports_a_default_sun(tmp_path):
    (level,) = ServedLevels([write_level(tmp_path, "bare", sun=None)]).cached_levels()
    summary = level.summary()
    assert summary["sun_is_default"]
    assert set(summary["sun"]) == {"azimuth", "altitude"}, "a low sun that suits the place, without a time"


def test_engineering_level_is_listed_without_bounds(client: Client):
    site = client.get("/levels/site").json()
    assert (site["bounds"], site["minzoom"], site["maxzoom"], site["tile_matrix_sets"]) == (None, None, None, {})
    assert site["time_zone"] is None
    assert client.get("/levels/site/plan").json()["view"] == "map"


def test_tiles_are_served_from_minzoom_to_maxzoom(client: Client):
    tilejson = client.get(TILEJSON.format("hills")).json()
    west, south, east, north = tilejson["bounds"]
    from morecantile import tms

    for zoom, status in (
        (tilejson["minzoom"] - 1, 404), (tilejson["minzoom"], 200), (tilejson["maxzoom"], 200), (tilejson["maxzoom"] + 1, 404),
    ):  # fmt: skip
        tile = tms.get("WebMercatorQuad").tile((west + east) / 2, (south + north) / 2, zoom)
        address = tilejson["tiles"][0].format(z=tile.z, x=tile.x, y=tile.y)
        assert client.head(address).status_code == status, zoom


def test_tilejson_describes_the_level(client: Client):
    answer = client.get(TILEJSON.format("hills"))
    document = TileJson.model_validate(answer.json())
    (template,) = document.tiles
    assert template == f"{client.base_url}/levels/hills/tiles/WebMercatorQuad/{{z}}/{{x}}/{{y}}.png"
    assert document.bounds == tuple(client.get("/levels/hills").json()["bounds"])
    assert document.skugga == {"layer": "color", "tile_matrix_set": "WebMercatorQuad", "sun": SUN}
    assert "max-age" in answer.headers["cache-control"]


def test_tilejson_template_keeps_the_query(client: Client):
    query = {"layer": "shadow", "time": "2024-06-21T19:00:00+02:00", "algorithm": "relief=none", "map_size": "512"}
    document = client.get(TILEJSON.format("hills"), params={**query, "format": "webp"}).json()
    (template,) = document["tiles"]
    address, _, query_text = template.partition("?")
    assert address.endswith("/{z}/{x}/{y}.webp")
    assert dict(part.split("=") for part in query_text.replace("%3A", ":").replace("%2B", "+").split("&")) == {
        **query, "algorithm": "relief%3Dnone",
    }  # fmt: skip
    sun = document["skugga"]["sun"]
    assert sun["time"] == query["time"]
    assert 275 < sun["azimuth"] < 290 and 18 < sun["altitude"] < 25  # the north-west, two and a half hours before sunset


def test_tilejson_gives_the_angles_of_the_level_time(client: Client):
    sun = client.get(TILEJSON.format("timed")).json()["skugga"]["sun"]
    assert set(sun) == {"time", "azimuth", "altitude"}
    assert 260 < sun["azimuth"] < 280


def test_descriptions_have_etags(client: Client):
    for address in ("/levels", "/levels/hills", TILEJSON.format("hills"), "/levels/hills/plan"):
        tag = client.get(address).headers["etag"]
        not_modified = client.get(address, headers={"If-None-Match": tag})
        assert (not_modified.status_code, not_modified.content) == (304, b"")


def test_plan_of_a_view_names_its_algorithms(client: Client):
    plan = client.get("/levels/hills/plan", params={"view": "map"}).json()
    keys = {"view", "policy", "algorithm", "settings", "effects", "left_out", "rejected", "passes", "predicted", "target"}
    assert keys <= set(plan)
    assert plan["algorithm"] == {"sun": {"relief": "sweep"}}
    night = client.get("/levels/hills/plan", params={"azimuth": 0, "altitude": -20}).json()
    assert night["algorithm"] == {"sun": {"relief": "none"}}


@pytest.mark.parametrize("address", ["/healthz", "/readyz"])
def test_health_answers_are_ok_and_uncached(client: Client, address: str):
    client.get("/levels/hills/plan")  # by now a render worker is ready
    answer = client.get(address)
    assert answer.status_code == 200
    assert answer.headers["cache-control"] == "no-store"


def test_readiness_names_the_renderer(client: Client):
    client.get("/levels/hills/plan")
    assert client.get("/readyz").json()["renderer"] == client.service.pool.renderer


def test_openapi_documents_tiles_and_problems(client: Client):
    assert client.get("/docs").status_code == 200
    document = client.get("/openapi.json").json()
    paths = document["paths"]
    assert "/levels/{level}/tiles/{tms}/{z}/{x}/{y}.{format}" in paths
    tile = paths["/levels/{level}/tiles/{tms}/{z}/{x}/{y}.{format}"]["get"]
    assert {"time", "azimuth", "altitude", "algorithm", "layer"} <= {parameter["name"] for parameter in tile["parameters"]}
    schema = document["components"]["schemas"]["Problem"]
    assert tile["responses"]["422"]["content"]["application/problem+json"]["schema"] == {"$ref": "#/components/schemas/Problem"}
    assert {"type", "title", "status", "detail", "code", "parameter", "preparing"} == set(schema["properties"])
    references = set(re.findall(r'"#/components/schemas/(\w+)"', json.dumps(document)))
    assert references <= set(document.get("components", {}).get("schemas", {}))
