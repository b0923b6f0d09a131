"""Build the OpenAPI document of an application, with examples that work for its levels."""

from __future__ import annotations

from typing import Any
from urllib.parse import quote, urlencode

from fastapi import APIRouter, FastAPI
from fastapi.openapi.utils import get_openapi

from skugga.api.http.openapi_parts import COMMON_ERROR_STATUSES, EXAMPLE_QUERY_KEY, problem_docs, with_standard_bounds
from skugga.api.http.problems import Problem
from skugga.api.http.server.bearer_token import PUBLIC_PATHS
from skugga.api.http.state.archive_file import ArchiveFile
from skugga.api.http.state.served_levels import DEFAULT_MATRIX_SET, ServedLevel
from skugga.api.http.state.service import Service
from skugga.api.matrices import matrix_set_of

EXAMPLE_DEGREE_DECIMALS = 5
"""Decimals of degrees in examples."""


def install_openapi(app: FastAPI, service: Service) -> None:
    """Replace the application's method ``openapi`` by one that builds the completed document once, at its first call."""

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
            app.openapi_schema = _complete_document(document, service)
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]


def _complete_document(document: dict[str, Any], service: Service) -> dict[str, Any]:
    """Return FastAPI's OpenAPI document with problem documents, the schema of plans, authentication and working examples."""
    has_token, location_examples = service.settings.api_token is not None, level_examples(service.levels.cached_levels())
    document = with_standard_bounds(document)
    schemas = document["components"]["schemas"]
    schemas[Problem.__name__] = Problem.model_json_schema(mode="serialization")
    schemas |= _plan_schemas()
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            needs_token = has_token and path not in PUBLIC_PATHS
            responses = problem_docs(*COMMON_ERROR_STATUSES, *([401] if needs_token else [])) | _with_integer_statuses(
                operation["responses"]
            )
            operation["responses"] = {str(status): responses[status] for status in sorted(responses)}
            if needs_token:
                operation["security"] = [{"token": []}]
            _set_examples(
                operation,
                archive_examples(service.archives.cached_archives()) if path.startswith("/archives") else location_examples,
            )
            query = operation.pop(EXAMPLE_QUERY_KEY, {})
            operation["description"] += f"\n\nFor example: `{method.upper()} {example_address(path, operation, query)}`"
    if has_token:
        document["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
    return document


def _plan_schemas() -> dict[str, Any]:
    """Return the JSON schemas of ``Plan`` and its parts by name, as FastAPI writes them for a route that returns a plan."""
    from skugga.shadows.plan import Plan

    router = APIRouter()
    router.add_api_route("/plan", lambda: None, response_model=Plan)
    schemas: dict[str, Any] = get_openapi(title="", version="", routes=router.routes)["components"]["schemas"]
    return schemas


def _with_integer_statuses(responses: dict[str, Any]) -> dict[int | str, Any]:
    """Return the documented responses by integer status, without those that FastAPI adds for validation errors."""
    return {int(status): answer for status, answer in responses.items() if "HTTPValidationError" not in str(answer)}


def level_examples(levels: list[ServedLevel]) -> dict[str, Any]:
    """Return examples of parameters that name a level or a place on it, by parameter.

    They are for the first level with tiles, else for the first level.
    """
    levels_on_earth = [level for level in levels if level.bounds is not None and DEFAULT_MATRIX_SET in level.zooms]
    if not levels_on_earth:
        return {"level": levels[0].name} if levels else {}
    level = levels_on_earth[0]
    assert level.bounds is not None
    west, south, east, north = (round(edge_deg, EXAMPLE_DEGREE_DECIMALS) for edge_deg in level.bounds)
    lon, lat = round((west + east) / 2, EXAMPLE_DEGREE_DECIMALS), round((south + north) / 2, EXAMPLE_DEGREE_DECIMALS)
    zoom = level.zooms[DEFAULT_MATRIX_SET].first
    tile = matrix_set_of(DEFAULT_MATRIX_SET).tile(lon, lat, zoom)
    bbox = f"{west},{south},{east},{north}"
    return {
        "level": level.name, "z": zoom, "x": tile.x, "y": tile.y, "zoom": zoom, "lon": lon, "lat": lat, "bbox": bbox,
        "points": [{"lon": lon, "lat": lat}],
        "LAYER": f"{level.name}:color", "LAYERS": f"{level.name}:color", "QUERY_LAYERS": f"{level.name}:color",
        "TILEMATRIX": str(zoom), "TILEROW": str(tile.y), "TILECOL": str(tile.x), "BBOX": bbox,
    }  # fmt: skip


def archive_examples(archives: dict[str, ArchiveFile]) -> dict[str, Any]:
    """Return examples of the parameters that name an archive's tile, by parameter, for the first tile of the first archive."""
    for name, archive in archives.items():
        zoom, x, y = archive.first_tile
        return {"archive": name, "z": zoom, "x": x, "y": y, "format": archive.format}
    return {}


def _set_examples(operation: dict[str, Any], location_examples: dict[str, Any]) -> None:
    """Write examples into the parameters and the body of an operation. ``location_examples`` are values by parameter."""
    for parameter in operation.get("parameters", ()):
        if parameter["name"] in location_examples:
            parameter["schema"]["examples"] = [location_examples[parameter["name"]]]
        # Swagger UI fills its form with ``example``. Optional parameters get none, since not all can be combined.
        if parameter.get("required") and "examples" in parameter["schema"]:
            parameter["example"] = parameter["schema"]["examples"][0]
    for content in operation.get("requestBody", {}).get("content", {}).values():
        example = content["schema"].pop("examples")[0]
        content["example"] = {key: location_examples.get(key, value) for key, value in example.items()}


def example_address(path: str, operation: dict[str, Any], query: dict[str, str]) -> str:
    """Return the path and query of an operation's example request.

    The query has the required parameters and those of ``query``. An empty value in ``query`` means the parameter's own example.
    """
    parameters = operation.get("parameters", [])
    examples = {
        parameter["name"]: parameter["schema"]["examples"][0] for parameter in parameters if "examples" in parameter["schema"]
    }
    for parameter in parameters:
        if parameter["in"] == "path":
            path = path.replace(f"{{{parameter['name']}}}", quote(str(examples[parameter["name"]])))
    query_values = (
        dict.fromkeys(parameter["name"] for parameter in parameters if parameter["in"] == "query" and parameter.get("required"))
        | query
    )
    pairs = urlencode({name: value or examples[name] for name, value in query_values.items()}, safe=":,/+")
    return f"{path}?{pairs}" if pairs else path
