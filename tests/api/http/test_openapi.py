"""The OpenAPI document is complete, its examples are answered, and all answers conform to it."""

from __future__ import annotations

import copy
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import pytest
import schemathesis
from fastapi import APIRouter
from fastapi.routing import APIRoute
from hypothesis import HealthCheck, Phase, given
from hypothesis import settings as hypothesis_settings
from schemathesis.generation import GenerationMode
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    negative_data_rejection,
    response_schema_conformance,
    status_code_conformance,
)

from skugga.api.http.levels import routes_level_page, routes_levels, routes_location, routes_plan
from skugga.api.http.ogc import routes_wms, routes_wmts
from skugga.api.http.points import routes_point, routes_point_irradiation
from skugga.api.http.problems import PROBLEM_MEDIA_TYPE, problem_kinds
from skugga.api.http.server import routes_health
from skugga.api.http.server.app import create_app
from skugga.api.http.tiles import routes_archives, routes_map, routes_tiles
from skugga.api.http.views import routes_animations, routes_snapshot
from skugga.api.http.views.cameras import CAMERA_PARAMETERS
from skugga.api.settings import Settings
from tests.api.conftest import CORNER, ENGINEERING, ZOOM, Client, running, write_level
from tests.api.http.test_problems import check_problem
from tests.api.workers import fake_workers

ROUTERS: list[APIRouter] = [
    module.router
    for module in (
        routes_wmts, routes_wms, routes_level_page, routes_levels, routes_location, routes_plan, routes_point,
        routes_point_irradiation, routes_tiles, routes_map, routes_snapshot, routes_animations, routes_archives,
        routes_health,
    )
]  # fmt: skip
WMS_OPERATIONS = [
    (method, route.path) for router in ROUTERS for route in router.routes if isinstance(route, APIRoute) for method in route.methods
]

ANIMATIONS_PATH = "/levels/{level}/animations"
JOB_PATHS = "/animations/{animation}", "/animations/{animation}/result"
"""Their examples name an animation that does not exist; ``test_animations`` requests existing ones."""

NOT_MODIFIED_HEADERS = {"If-None-Match": "*"}
"""Headers that let a valid request be answered with 304 instead of being drawn."""

SKY_VIEW_PARAMETERS = "kind", "transmissivity"

IRRADIATION_PARAMETERS = "part", "plane", "albedo", "linke", "tilt"

SUN_HOURS_PARAMETERS = "quantity", "window", "clock", "least_altitude", "color_range"
"""Parameters of hours of sun, which need that layer and a date."""


@pytest.fixture(scope="module")
def document(client: Client) -> dict[str, Any]:
    """The OpenAPI document of the service."""
    return client.get("/openapi.json").json()


def parameters(operation: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the parameters of an operation of the OpenAPI document."""
    yield from operation.get("parameters", ())


def address_of(operation: dict[str, Any]) -> str:
    """Return the address in an operation's example."""
    return operation["description"].rpartition("For example: `")[2].rstrip("`").partition(" ")[2]


def test_document_lists_every_route(document: dict[str, Any]):
    assert {(method.upper(), path) for path, operations in document["paths"].items() for method in operations} == set(
        WMS_OPERATIONS
    )


@pytest.mark.parametrize(("method", "path"), WMS_OPERATIONS)
def test_operation_is_described_with_examples(document: dict[str, Any], method: str, path: str):
    operation = document["paths"][path][method.lower()]
    assert operation["summary"] and len(operation["description"].split("For example")[0]) > 20
    for parameter in parameters(operation):
        assert parameter["description"] and parameter["schema"]["examples"], parameter["name"]
    for content in operation.get("requestBody", {}).get("content", {}).values():
        assert content["example"]
    for status, answer in operation["responses"].items():
        assert answer["description"]
        if status.startswith("2") and status != "204":
            assert answer["content"], status
    assert not {"HTTPValidationError", "Infinity", "NaN"} & set(json.dumps(operation).split())


@pytest.mark.parametrize(("method", "path"), WMS_OPERATIONS)
def test_operation_example_is_answered(client: Client, document: dict[str, Any], method: str, path: str):
    operation = document["paths"][path][method.lower()]
    body = operation.get("requestBody", {}).get("content", {}).get("application/json", {}).get("example")
    if path == "/readyz":
        client.get("/levels/hills/plan")  # by now a render worker is ready
    answer = client.request(method, address_of(operation), json=body)
    status = 404 if path in JOB_PATHS else 202 if path == ANIMATIONS_PATH else 200
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"].split(";")[0] in operation["responses"][str(status)]["content"]


def companion_parameters(operation: dict[str, Any], parameter: dict[str, Any]) -> dict[str, Any]:
    """Return the parameters that a parameter requires."""
    name = parameter["name"]
    if {"tilt", "to"} <= {item["name"] for item in parameters(operation)}:  # irradiation at a point
        return {"azimuth": {"tilt": 35}, "to": {"date": "2024-03-21"}}.get(name, {})
    if name.lower() in ("azimuth", "altitude"):
        other, degrees = ("altitude", 22) if name.lower() == "azimuth" else ("azimuth", 235)
        return {other.upper() if name.isupper() else other: degrees}
    has_sun_hours = "least_altitude" in {item["name"] for item in parameters(operation)}
    is_eye_height = name == "height" and parameter["description"].endswith("Metres above the ground.")
    if has_sun_hours and (name in SUN_HOURS_PARAMETERS or is_eye_height):
        return {"layer": "sunhours", "date": "2024-03-21"}
    if name in CAMERA_PARAMETERS:
        return {"eye": "8.43,47.5,300", "target": "8.44,47.51,0"}
    if has_sun_hours and name in SKY_VIEW_PARAMETERS:
        return {"layer": "sky_view"}
    if has_sun_hours and name == "year":
        return {"layer": "irradiation"}
    if has_sun_hours and name == "plane_azimuth":
        return {"layer": "irradiation", "date": "2024-03-21", "tilt": "35"}
    if has_sun_hours and name in IRRADIATION_PARAMETERS:
        return {"layer": "irradiation", "date": "2024-03-21"}
    return {"date": {"layer": "sunhours"}, "tms": {"zoom": ZOOM}}.get(name, {}) if has_sun_hours or name == "tms" else {}


@pytest.mark.parametrize(("method", "path"), [method_path for method_path in WMS_OPERATIONS if "legend" not in method_path[1]])
def test_parameter_examples_are_valid(client: Client, document: dict[str, Any], method: str, path: str):
    """Each example is requested alone, or with the parameters that it needs. Legends exist for some layers only."""
    operation = document["paths"][path][method.lower()]
    body = operation.get("requestBody", {}).get("content", {}).get("application/json", {}).get("example")
    address, _, query = address_of(operation).partition("?")
    for parameter in parameters(operation):
        if parameter["in"] == "query":
            query_parameters = (
                dict(parse_qsl(query))
                | companion_parameters(operation, parameter)
                | {parameter["name"]: parameter["schema"]["examples"][0]}
            )
            answer = client.request(method, address, params=query_parameters, json=body, headers=NOT_MODIFIED_HEADERS)
            assert answer.status_code in (200, 304), (query_parameters, answer.text)


def test_document_lists_every_kind_of_problem(document: dict[str, Any]):
    documented_codes: dict[str, set[str]] = {}
    for operations in document["paths"].values():
        for operation in operations.values():
            for status, answer in operation["responses"].items():
                content = answer.get("content", {}).get(PROBLEM_MEDIA_TYPE)
                if content is not None:
                    assert content["schema"] == {"$ref": "#/components/schemas/Problem"}
                    documented_codes.setdefault(status, set()).update(content["examples"])
    expected: dict[str, set[str]] = {}
    for kind in problem_kinds():
        if kind.status not in (401, 405):  # 401 needs a service with a token; 405 needs a method that is not documented
            expected.setdefault(str(kind.status), set()).add(kind.code)
    assert documented_codes == expected


def test_document_requires_the_token_if_set(serve_with):
    client = serve_with(fake_workers.scripted, api_token="a secret token")
    document = client.get("/openapi.json", headers={"Authorization": "Bearer a secret token"}).json()
    for path, operations in document["paths"].items():
        for operation in operations.values():
            is_open = path in ("/healthz", "/readyz")
            assert ("401" in operation["responses"]) == ("security" in operation) == (not is_open), path
    assert document["components"]["securitySchemes"]["token"]["scheme"] == "bearer"


def narrow_document(document: dict[str, Any]) -> dict[str, Any]:
    """Return the document with existing names and places only, few pixels and few points, so that requests reach the renderer."""
    narrow = copy.deepcopy(document)
    x, y = CORNER
    places: dict[str, dict[str, Any]] = {
        "level": {"enum": ["hills", "timed", "site", "nowhere"]}, "archive": {"enum": ["shadows", "nowhere"]},
        "tms": {"enum": ["WebMercatorQuad", "WorldCRS84Quad", "Nowhere"]},
        "z": {"minimum": ZOOM, "maximum": ZOOM + 1},
        "x": {"minimum": x - 1, "maximum": x + 1}, "y": {"minimum": y - 1, "maximum": y + 1},
        "lon": {"minimum": 8.38, "maximum": 8.5}, "lat": {"minimum": 47.47, "maximum": 47.56},
        "width": {"minimum": 0, "maximum": 64}, "height": {"minimum": 0, "maximum": 64}, "year": {"maximum": 1801},
        "size": {"enum": ["16x16", "64x32", "0x0", "9x9999"]},
        "crs": {"enum": ["OGC:CRS84", "EPSG:3857", "EPSG:32632", "EPSG:3031"]},
    }  # fmt: skip
    for operations in narrow["paths"].values():
        for operation in operations.values():
            for parameter in parameters(operation):
                schema = parameter["schema"]
                place = places.get(parameter["name"], {})
                for part in [schema, *schema.get("anyOf", ())]:
                    if part.get("type") in ("string", "number", "integer"):
                        part.update({key: value for key, value in place.items() if key == "enum" or part["type"] != "string"})
    narrow["components"]["schemas"]["PointsQuery"]["properties"]["points"]["maxItems"] = 5
    return narrow


@pytest.fixture(scope="module")
def narrow_schema(document: dict[str, Any]) -> schemathesis.BaseSchema:
    """The OpenAPI schema with existing names and places only (``narrow_document``)."""
    return schemathesis.openapi.from_dict(narrow_document(document))


@pytest.fixture(scope="module")
def full_schema(document: dict[str, Any]) -> schemathesis.BaseSchema:
    """The complete OpenAPI schema."""
    return schemathesis.openapi.from_dict(document)


@pytest.mark.parametrize(("method", "path"), WMS_OPERATIONS)
def test_answers_conform_to_the_document(
    client: Client, narrow_schema: schemathesis.BaseSchema, full_schema: schemathesis.BaseSchema, method: str, path: str
):
    """Generated valid and invalid requests cause no server error, and only documented statuses, media types and JSON.

    The service refuses what the document forbids.
    """
    checks = [status_code_conformance, content_type_conformance, response_schema_conformance]
    negative_operation = full_schema[path][method]
    kinds = [(narrow_schema[path][method], GenerationMode.POSITIVE, checks)]
    if {item["name"] for item in parameters(negative_operation.definition.raw)} - {"level", "archive"}:  # any text is a valid name
        kinds.append((negative_operation, GenerationMode.NEGATIVE, [*checks, negative_data_rejection]))
    for operation, mode, checks in kinds:

        @hypothesis_settings(max_examples=3, phases=[Phase.generate], suppress_health_check=list(HealthCheck), database=None)
        @given(case=operation.as_strategy(generation_mode=mode))
        def request_and_validate(case: schemathesis.Case) -> None:
            answer = case.call(base_url=str(client.base_url), headers=NOT_MODIFIED_HEADERS, timeout=60, allow_redirects=False)
            assert answer.status_code < 500, answer.text
            case.validate_response(answer, checks=checks)  # noqa: B023

        request_and_validate()


CHECKS = (
    "not_a_server_error", "status_code_conformance", "content_type_conformance", "response_schema_conformance",
    "unsupported_method", "allow_header_conformance",
)  # fmt: skip


@pytest.mark.long
def test_schemathesis_finds_no_fault_in_a_minute(folder: Path, hills_level: Path, tmp_path: Path):
    """A real service answers examples, values at and past every bound, and random ones.

    Requests come one after the other, so that the service sheds no load.
    """
    levels = [
        hills_level,
        write_level(folder, "timed", sun={"time": "2024-06-21T18:00:00+02:00"}),
        write_level(folder, "site", ENGINEERING),
    ]
    animations = {"max_animation_pixels": 2**14, "animations_waiting": 1000, "animation_abandoned_s": 1.0}
    settings = Settings(workers=1, max_snapshot_pixels=2**16, new_suns_per_minute=0, **animations)
    with running(create_app(settings, levels)) as client:
        assert client.get("/levels/hills/plan").status_code == 200  # by now a render worker is ready
        schema_file = tmp_path / "openapi.json"
        schema_file.write_text(json.dumps(narrow_document(client.get("/openapi.json").json())), encoding="utf-8")
        command = [
            sys.executable, "-m", "schemathesis.cli", "run", str(schema_file), "--url", str(client.base_url),
            "--checks", ",".join(CHECKS), "--phases", "examples,coverage,fuzzing", "--max-examples", "30", "--max-time", "50",
            "--request-timeout", "60",
            "--generation-deterministic", "--no-color", "--warnings", "off",
        ]  # fmt: skip
        process = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=400)
        assert process.returncode == 0, process.stdout
        counters = client.service.pool.counters
        assert counters.jobs_failed == 0 and counters.jobs_answered > 5, "requests reach the render process"


def test_unsupported_method_is_405_with_allow(client: Client):
    for path, allowed in (
        ("levels", "GET, HEAD"),
        ("levels/hills/point", "GET, HEAD, POST"),
        ("plan", "POST"),
        ("healthz", "GET, HEAD"),
    ):
        answer = client.delete(path)
        assert check_problem(answer, 405, "method_not_allowed", None)["detail"].endswith(f"Allowed: {allowed}.")
        assert answer.headers["allow"] == allowed


@pytest.mark.parametrize(("method", "path"), WMS_OPERATIONS)
def test_cors_preflight_allows_any_headers(client: Client, document: dict[str, Any], method: str, path: str):
    """Any header is safe on every route, because no request of a page carries cookies."""
    names = "authorization, cache-control, if-none-match, traceparent, x-request-id"
    headers = {
        "Origin": "https://map.example", "Access-Control-Request-Method": method, "Access-Control-Request-Headers": names,
    }  # fmt: skip
    answer = client.options(address_of(document["paths"][path][method.lower()]), headers=headers)
    assert answer.status_code == 200 and answer.headers["access-control-allow-origin"] == "*"
    assert set(names.split(", ")) <= set(answer.headers["access-control-allow-headers"].lower().split(", "))
    assert method in answer.headers["access-control-allow-methods"]


def test_cors_origins_restrict_pages(serve_with):
    client = serve_with(fake_workers.scripted, cors_origins=("https://map.example",), api_token="a secret token")
    for origin, allowed in (("https://map.example", True), ("https://elsewhere.example", False)):
        headers = {"Origin": origin, "Access-Control-Request-Method": "GET", "Access-Control-Request-Headers": "authorization"}
        assert (client.options("/levels", headers=headers).status_code == 200) == allowed
        refusal = client.get("/levels", headers={"Origin": origin})
        check_problem(refusal, 401, "unauthorized", None)
        assert ("access-control-allow-origin" in refusal.headers) == allowed, "a page of an allowed origin can read the refusal"
        assert refusal.headers["vary"] == "Origin"
    assert client.get("/levels").headers["vary"] == "Origin", "caches keep answers apart by origin"


@pytest.mark.parametrize("path", ["/healthz", "/readyz", "/metrics"])
def test_head_of_health_has_no_body(client: Client, path: str):
    head_response, get_response = client.head(path), client.get(path)
    assert (head_response.status_code, head_response.content, head_response.headers["content-type"]) == (
        200,
        b"",
        get_response.headers["content-type"],
    )


@pytest.mark.parametrize(("method", "path"), [method_path for method_path in WMS_OPERATIONS if "{level}" in method_path[1]])
def test_unknown_level_is_a_documented_404(client: Client, document: dict[str, Any], method: str, path: str):
    operation = document["paths"][path][method.lower()]
    address = address_of(operation).replace("/levels/hills", "/levels/nowhere").replace("LAYERS=hills", "LAYERS=nowhere")
    body = operation.get("requestBody", {}).get("content", {}).get("application/json", {}).get("example")
    answer = client.request(method, address, json=body)
    assert answer.status_code == 404
    assert answer.headers["content-type"].split(";")[0] in operation["responses"]["404"]["content"]
