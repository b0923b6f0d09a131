"""Plans over HTTP: of views, of tiles, and of descriptors that clients send."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import get_args

import httpx
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from skugga.api.http.levels.sent_descriptor import MAX_LAMPS, FactsByEffect, SentDescriptor
from skugga.api.settings import Settings
from skugga.api.workers.jobs import DescriptorPlanJob, ZoomTiles
from skugga.api.workers.plan_measurements import PlanMeasurements
from skugga.api.workers.render_worker import run_job
from skugga.api.workers.worker_state import TilePlanCache, WorkerState, block_view, representative_block
from skugga.selector.cost.device_profile import DeviceProfile, profile_digest
from skugga.selector.select import plan_of_view
from skugga.shadows.plan import Plan
from skugga.terrain.cache import estimated_bytes
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene
from tests.api.conftest import ZOOM, Client
from tests.api.http.test_problems import check_problem
from tests.api.workers import fake_workers

PLAN, FACTS = "/levels/hills/plan", "/levels/hills/descriptor"


def _fields(field) -> dict[str, type]:
    """Return the type of each of an effect's facts by name: float, bool or str."""
    (model,) = (part for part in get_args(field.annotation) if part is not type(None))
    kinds = {name: str(part.annotation) for name, part in model.model_fields.items()}
    return {name: bool if "bool" in kind else str if "str" in kind else float for name, kind in kinds.items()}


def profile(**changes) -> DeviceProfile:
    """Return a calibration of the fake device. ``changes`` replace fields."""
    fields = {
        "renderer": fake_workers.RENDERER, "version": "1", "cpus": 2, "engine": "0", "measured": datetime(2026, 1, 1, tzinfo=UTC),
        "took_s": 1.0, "rates_ns": {"map": {"texels": 1.0}},
    }  # fmt: skip
    return DeviceProfile(**{**fields, **changes})


@pytest.fixture(scope="module")
def facts(client: Client) -> dict:
    """The level's descriptor, as the service returns it."""
    return client.get(FACTS).json()


@pytest.mark.parametrize(
    ("view_query", "option_query"),
    [
        ({}, {}),
        ({"view": "map"}, {"policy": "rules", "max_error": "0.01", "max_ms": "12.5"}),
        ({"azimuth": "90", "altitude": "35"}, {"algorithm": "shadow_map", "map_size": "512", "depth_bits": "32", "filter": "5"}),
        ({"zoom": str(ZOOM)}, {"algorithm": "relief=hybrid", "cascades": "2", "mask": "original"}),
        ({"azimuth": "0", "altitude": "-20"}, {}),
    ],
)
def test_plan_of_a_view_equals_that_of_its_descriptor(client: Client, view_query: dict, option_query: dict):
    view_plan = client.get(PLAN, params={**view_query, **option_query})
    descriptor = client.get(FACTS, params=view_query)
    assert view_plan.status_code == descriptor.status_code == 200, (view_plan.text, descriptor.text)
    posted_plan = client.post(
        "/plan", params=option_query, content=descriptor.content, headers={"Content-Type": "application/json"}
    )
    assert posted_plan.status_code == 200, posted_plan.text
    assert posted_plan.json() == view_plan.json()
    Plan.model_validate_json(posted_plan.content)
    Descriptor.model_validate_json(descriptor.content)


def test_plan_contains_the_requested_options(client: Client, facts: dict):
    plan = client.post("/plan", params={"max_error": 0.01, "max_ms": 7, "algorithm": "hybrid"}, json=facts).json()
    assert (plan["target"]["max_error"], plan["target"]["max_ms"], plan["algorithm"]) == (0.01, 7, {"sun": {"relief": "hybrid"}})
    assert any("set by the request" in entry["reason"] for entry in plan["reasons"])


def test_plan_reports_an_uncalibrated_device(client: Client, facts: dict):
    for plan in (client.get(PLAN).json(), client.post("/plan", json=facts).json()):
        assert plan["policy"] == "predict" and any("not calibrated" in entry["reason"] for entry in plan["reasons"])
    rules_plan = client.get(PLAN, params={"policy": "rules"}).json()
    assert not any("not calibrated" in entry["reason"] for entry in rules_plan["reasons"])


@pytest.mark.parametrize(
    ("query", "parameter", "expected_text"),
    [
        ("policy=measure", "policy", "measure takes too long for a request"),
        ("policy=probe", "policy", "probe takes too long for a request"),
        ("policy=guess", "policy", "rules, predict"),
        ("max_error=-0.01", "max_error", "greater than or equal to 0"),
        ("max_error=1.5", "max_error", "less than or equal to 1"),
        ("max_error=nan", "max_error", "number"),
        ("max_ms=0", "max_ms", "greater than 0"),
        ("max_ms=inf", "max_ms", "finite"),
        ("cascades=5", "cascades", "4"),
        ("map_size=63", "map_size", "64"),
        ("algorithm=truth", "algorithm", "shadow_map"),
        ("algorithm=moon%3Dhybrid", "algorithm", "moon"),
        ("fit=tight", "fit", "unknown parameter"),
        ("max_ms=1&max_ms=2", "max_ms", "more than once"),
    ],
)
def test_plan_names_wrong_parameters(client: Client, facts: dict, query: str, parameter: str, expected_text: str):
    for answer in (client.get(f"{PLAN}?{query}"), client.post(f"/plan?{query}", json=facts)):
        problem = check_problem(answer, 422, "invalid_parameter", parameter)
        assert expected_text in problem["detail"] or expected_text in str(problem)


@pytest.mark.parametrize("query", ["time=2024-06-21T12:00:00Z", "azimuth=1", "view=map", "zoom=3"])
def test_posted_descriptor_excludes_sun_and_view(client: Client, facts: dict, query: str):
    check_problem(client.post(f"/plan?{query}", json=facts), 422, "invalid_parameter", query.split("=")[0])


@pytest.mark.parametrize(
    ("changes", "parameter"),
    [
        ({"pixel_m": -1}, "pixel_m"),
        ({"pixel_m": "wide"}, "pixel_m"),
        ({"relief_m": None}, "relief_m"),
        ({"casters": ["clouds"]}, "casters.0"),
        ({"sun_altitude_deg": 91}, "sun_altitude_deg"),
        ({"view_kind": "fisheye"}, "view_kind"),
        ({"weather": {"cloud_cover": 2}}, "weather.cloud_cover"),
        ({"facts": {"cast_shadows": {"least_slope": "steep"}}}, "facts.cast_shadows.least_slope"),
        ({"facts": {"cast_shadows": {"least_slope": True}}}, "facts.cast_shadows.least_slope"),
        ({"facts": {"clouds": {"cover": None, "taken": 0}}}, "facts.clouds.cover"),
        ({"facts": {"clouds": {"cover": 0.5}}}, "facts.clouds.taken"),
        ({"facts": {"snow": {"lies": 1, "on": True, "why": None}}}, "facts.snow.lies"),
        ({"facts": {"snow": None}}, "facts"),
        ({"facts": {"haze": {"visibility_m": 0}}}, "facts.haze.visibility_m"),
        ({"facts": {"refraction": {"lift_deg": 0.1}}}, "body"),
        ({"receivers_light_m": None}, "body"),
        ({"receivers_light_m": [0, 0, 0]}, "body"),
        ({"facts": {"rain": {}}}, "facts.rain"),
        ({"facts": []}, "facts"),
        ({"level": "hills"}, "level"),
    ],
)
def test_invalid_facts_are_refused_by_name(client: Client, facts: dict, changes: dict, parameter: str):
    problem = check_problem(client.post("/plan", json={**facts, **changes}), 422, "invalid_parameter", parameter)
    remedies = {
        "facts.clouds.taken": "missing. Give a value.",
        "facts.rain": "unknown key. Omit it.",
        "level": "unknown key. Omit it.",
    }
    assert parameter in problem["detail"] and remedies.get(parameter, "Allowed: ") in problem["detail"]


LAMP = {"kind": "omni", "cutoff_deg": 180, "reference_m": 10}


def test_lamps_are_bounded_and_planned_by_a_worker(client: Client, facts: dict):
    lamps = [{"name": f"lamp {n}", **LAMP} for n in range(5000)]
    check_problem(client.post("/plan", json={**facts, "lamps": lamps}), 422, "invalid_parameter", "lamps")
    before = client.service.pool.counters.jobs_answered
    answer = client.post("/plan", json={**facts, "lamps": lamps[:MAX_LAMPS]})
    assert answer.status_code == 200, answer.text
    assert client.service.pool.counters.jobs_answered == before + 1


GENERATED_VALUES = {
    float: st.none() | st.floats(allow_nan=False) | st.sampled_from(["Infinity", "-Infinity", 0, 0.0, 1, 0.5, -3]),
    bool: st.booleans(),
    str: st.none() | st.text(max_size=5),
}
KNOWN_FACTS = st.fixed_dictionaries(
    {},
    optional={
        effect: st.fixed_dictionaries({}, optional={name: GENERATED_VALUES[kind] for name, kind in _fields(field).items()})
        for effect, field in FactsByEffect.model_fields.items()
    },
)
ARBITRARY_FACTS = st.dictionaries(
    st.sampled_from(sorted(FactsByEffect.model_fields)),
    st.dictionaries(
        st.sampled_from(["cover", "lies", "hidden", "x"]), GENERATED_VALUES[float] | st.booleans() | st.text(max_size=3)
    ),
)


@given(generated_facts=KNOWN_FACTS | ARBITRARY_FACTS, view_kind=st.sampled_from(["map", "perspective"]))
@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_all_accepted_facts_can_be_planned(facts: dict, generated_facts: dict, view_kind: str):
    """The effects' predicates must not fail on facts that the model accepts. The worker's job runs in this process."""
    merged_facts = {effect: {**facts["facts"].get(effect, {}), **values} for effect, values in generated_facts.items()}
    try:
        descriptor = SentDescriptor.model_validate({**facts, "view_kind": view_kind, "facts": {**facts["facts"], **merged_facts}})
    except ValidationError:
        return
    with np.errstate(all="ignore"):
        run_job(DescriptorPlanJob(descriptor_json=descriptor.as_descriptor_json(), policy="rules"), WorkerState("a renderer"))


@pytest.mark.parametrize(
    ("body", "parameter"),
    [(b"", "body"), (b"[]", "body"), (b"{", "body"), (b"3", "body"), (b'{"view": NaN}', "view"), (b"{}", "view")],
)
def test_body_that_is_no_descriptor_is_refused(client: Client, body: bytes, parameter: str):
    answer = client.post("/plan", content=body, headers={"Content-Type": "application/json"})
    check_problem(answer, 422, "invalid_parameter", parameter)


@pytest.mark.parametrize("number", [5e-324, 1e-13, 3.5e307, -1e16, 10**400], ids=str)
def test_extreme_numbers_are_refused_by_name(client: Client, facts: dict, number: float):
    """Arithmetic with them once overflowed to infinity, and the plan failed with an internal error."""
    answer = client.post("/plan", json={**facts, "pixel_m": number})
    check_problem(answer, 422, "invalid_parameter", "body")
    assert "pixel_m" in answer.json()["detail"]


def test_unknown_fact_is_named(client: Client, facts: dict):
    answer = client.post("/plan", json=facts | {"shadowyness": 1})
    problem = answer.json()
    assert answer.status_code == 422
    assert (problem["parameter"], problem["detail"]) == ("shadowyness", "shadowyness: unknown key. Omit it.")


def test_missing_fact_is_named(client: Client, facts: dict):
    check_problem(
        client.post("/plan", json={key: facts[key] for key in facts if key != "node_m"}), 422, "invalid_parameter", "node_m"
    )


def test_body_over_the_limit_is_413(client: Client):
    limit = Settings().max_body_bytes
    check_problem(client.post("/plan", content=b" " * (limit + 1)), 413, "too_large", "body")

    def body_parts():
        for _ in range(limit // 2**16 + 2):
            yield b" " * 2**16

    answer = client.post("/plan", content=body_parts())
    assert answer.status_code == 413 and answer.headers["content-type"] == "application/problem+json"
    assert "SKUGGA_MAX_BODY_BYTES" in answer.json()["detail"]


@pytest.mark.parametrize(
    ("query", "status", "code", "parameter"),
    [
        ("zoom=99", 404, "not_found", "zoom"),
        (f"zoom={ZOOM}&tms=Nowhere", 404, "not_found", "tms"),
        (f"zoom={ZOOM}&view=map", 422, "invalid_parameter", "view"),
        ("tms=WebMercatorQuad", 422, "invalid_parameter", "zoom"),
        ("view=ridge", 422, "invalid_parameter", "view"),
    ],
)
def test_unknown_views_and_zooms_are_refused(client: Client, query: str, status: int, code: str, parameter: str):
    for address in (PLAN, FACTS):
        check_problem(client.get(f"{address}?{query}"), status, code, parameter)


def test_cors_allows_posting_a_descriptor(client: Client):
    headers = {
        "Origin": "https://map.example",
        "Access-Control-Request-Method": "POST",
        "Access-Control-Request-Headers": "content-type",
    }
    answer = client.options("/plan", headers=headers)
    assert answer.status_code == 200 and "POST" in answer.headers["access-control-allow-methods"]


def test_openapi_documents_plans(client: Client):
    document = client.get("/openapi.json").json()
    schemas, paths = document["components"]["schemas"], document["paths"]

    def response_schema(path: str, method: str) -> str:
        return paths[path][method]["responses"]["200"]["content"]["application/json"]["schema"]["$ref"].split("/")[-1]

    assert response_schema("/levels/{level}/plan", "get") == response_schema("/plan", "post")
    assert set(Plan.model_fields) == set(schemas[response_schema("/plan", "post")]["properties"])
    assert set(Descriptor.model_fields) <= set(schemas[response_schema("/levels/{level}/descriptor", "get")]["properties"])
    body = paths["/plan"]["post"]["requestBody"]["content"]["application/json"]["schema"]
    assert "Descriptor" in json.dumps(body)
    names = {parameter["name"] for parameter in paths["/plan"]["post"]["parameters"]}
    assert {"policy", "max_error", "max_ms", "algorithm", "map_size", "cascades", "depth_bits", "filter"} <= names
    assert not names & {"time", "azimuth", "altitude", "view"}


def calibrated(pipe, config) -> None:
    """Run a fake worker whose device is calibrated."""
    from skugga.api.workers.jobs import WorkerReady

    class Pipe:
        def __getattr__(self, name):
            return getattr(pipe, name)

        def send(self, answer) -> None:
            pipe.send(WorkerReady(answer.renderer, profile()) if isinstance(answer, WorkerReady) else answer)

    fake_workers.scripted(Pipe(), config)


def plan_etag(client: Client) -> str:
    """Return the entity tag of a snapshot, which depends on the version of its plan."""
    client.post("/plan", content=b"{}")
    while not client.service.pool.is_ready:
        client.get("/readyz")
    answer: httpx.Response = client.get("/levels/hills/snapshot.png", headers={"If-None-Match": "*"})
    assert answer.status_code == 304
    return answer.headers["etag"]


def test_etags_depend_on_the_calibration(serve_with):
    plain, other = serve_with(fake_workers.scripted), serve_with(calibrated)
    assert plan_etag(plain) != plan_etag(other)
    assert other.service.pool.plan_version(None) == profile_digest(profile()) != profile_digest(profile(took_s=2.0))
    assert plain.service.pool.plan_version(None) == ""


def test_tiles_of_a_zoom_share_one_cached_plan(gl, hills_level):
    from skugga.api.workers.jobs import BlockJob, LevelKey
    from skugga.api.workers.worker_state import plan_of_tiles

    scene = build_scene(load_level(hills_level))
    jobs = [
        BlockJob(level=LevelKey(path=hills_level, version="1"), matrix_set="WebMercatorQuad", zoom=ZOOM, block_x=x, block_y=357)
        for x in (535, 536)
    ]
    plans = [plan_of_view(scene, block_view(job), policy="rules") for job in jobs]
    assert plans[0] == plans[1]
    state = WorkerState("a renderer")
    tile_plans = [plan_of_tiles(job, scene, state) for job in jobs]
    assert tile_plans[0] is tile_plans[1]
    assert tile_plans[0].model_copy(update={"reasons": plans[0].reasons}) == plans[0]
    tiles = representative_block(scene, ZoomTiles(matrix_set="WebMercatorQuad", zoom=ZOOM))
    assert (tiles.row0 // 1024, tiles.col0 // 1024) in {(357, 535), (357, 536), (358, 535), (358, 536)}
    other = plan_of_tiles(jobs[0].model_copy(update={"zoom": ZOOM - 1}), scene, state)
    assert other is not tile_plans[0]
    state.measurements = PlanMeasurements(profile())
    predictions_plan = plan_of_tiles(jobs[0], scene, state)
    assert predictions_plan.reasons != tile_plans[0].reasons and plan_of_tiles(jobs[1], scene, state) is predictions_plan


def test_plan_cache_evicts_the_least_recently_used():
    cache, built_keys = TilePlanCache(limit_bytes=2 * estimated_bytes("plan 1")), []

    def plan_of(key: int) -> str:
        return cache.get(key, lambda: built_keys.append(key) or f"plan {key}")  # type: ignore[arg-type,return-value]

    assert [plan_of(key) for key in (1, 2, 1, 3, 1, 2)] == [f"plan {key}" for key in (1, 2, 1, 3, 1, 2)]
    assert built_keys == [1, 2, 3, 2]
