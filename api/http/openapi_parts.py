"""Parts of the OpenAPI document: path parameters with examples, responses and problem documents of routes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import Path

from skugga.api.http.numbers import PLAIN_INTEGER
from skugga.api.http.problems import PROBLEM_MEDIA_TYPE, Problem, problem_kinds

ResponseDocs = dict[int | str, dict[str, Any]]
"""Documented responses by HTTP status, for the argument ``responses`` of FastAPI's routes."""

LEVEL_ERROR_STATUSES = 404, 422, 500
"""Error statuses of routes that describe a level."""

WORK_ERROR_STATUSES = 404, 422, 429, 500, 503, 504
"""Error statuses of routes that use a render process."""

COMMON_ERROR_STATUSES = 400, 422, 431, 500
"""Error statuses of every route."""

UNEXPECTED_ERROR_STATUSES = {500}

PROBLEM_SCHEMA = {"$ref": f"#/components/schemas/{Problem.__name__}"}

PLAN_DOCS: ResponseDocs = {200: {"content": {"application/json": {"schema": {"$ref": "#/components/schemas/Plan"}}}}}
"""The response with a plan.

``skugga.api.http.server.openapi`` adds the schema ``Plan`` to the document on demand, since building that schema imports the
settings of all algorithms."""

LevelPath = Annotated[str, Path(description="A level by its name, as `/levels` lists them.", examples=["jacksboro"])]
MatrixSetPath = Annotated[
    str,
    Path(description="A tile matrix set by its name, as `tile_matrix_sets` of the level lists them.", examples=["WebMercatorQuad"]),
]
ZoomPath = Annotated[int, PLAIN_INTEGER, Path(description="Zoom: one of those of the level in the tile matrix set.", examples=[11])]
ColumnPath = Annotated[int, PLAIN_INTEGER, Path(description="Column of the tile, from the west.", examples=[544])]
RowPath = Annotated[int, PLAIN_INTEGER, Path(description="Row of the tile, from the north.", examples=[800])]


def problem_docs(*statuses: int) -> ResponseDocs:
    """Return the documented responses with problem documents for some statuses, with an example of each kind of problem."""
    return {
        status: {"description": HTTPStatus(status).phrase, "content": {PROBLEM_MEDIA_TYPE: _problem_content(status)}}
        for status in statuses
    }


def _problem_content(status: int) -> dict[str, Any]:
    """Return the schema and the examples of the problem documents with an HTTP status."""
    kinds = [kind for kind in problem_kinds() if kind.status == status]
    return {
        "schema": PROBLEM_SCHEMA,
        "examples": {kind.code: {"summary": kind.description, "value": kind.example} for kind in kinds},
    }


def exception_docs(*statuses: int) -> ResponseDocs:
    """Return the documented responses with OGC exceptions in XML for some statuses.

    Status 500 may also have a problem document, since unexpected errors are answered by one.
    """
    responses: ResponseDocs = {}
    for status in statuses:
        problem_content = {PROBLEM_MEDIA_TYPE: _problem_content(status)} if status in UNEXPECTED_ERROR_STATUSES else {}
        content = {"text/xml": {"schema": {"type": "string"}}, **problem_content}
        responses[status] = {"description": f"{HTTPStatus(status).phrase}: an exception", "content": content}
    return responses


def file_docs(description: str, media_types: Iterable[str]) -> ResponseDocs:
    """Return the documented responses of a route that sends a file in one of some media types, or 304."""
    return {
        200: {"description": description, "content": {media_type: {} for media_type in media_types}},
        304: {"description": "The client has it (`If-None-Match`)."},
    }


def example_query(*names: str, **values: str) -> dict[str, Any]:
    """Return the query of a route's example request, for the argument ``openapi_extra``.

    The query has the parameters ``names`` with their own examples, and the parameters ``values`` with the given values.
    """
    return {EXAMPLE_QUERY_KEY: dict.fromkeys(names, "") | values}


EXAMPLE_QUERY_KEY = "x-example-query"


def ogc_parameters(**parameters: tuple[str, str]) -> dict[str, Any]:
    """Return the documentation of an OGC service's query parameters, each with a description and an example.

    OGC parameters may be in upper or lower case, so FastAPI cannot read them from a function's signature.
    """
    return {
        "parameters": [
            {"name": name, "in": "query", "description": description, "schema": {"type": "string", "examples": [example]}}
            for name, (description, example) in parameters.items()
        ]
    }


def with_standard_bounds(schema: Any) -> Any:
    """Return a JSON schema whose numeric bounds have the standard keywords, inside the number's own schema.

    For ``Annotated[float | None, ...]`` pydantic writes bounds as ``ge``, ``le``, ``gt`` and ``lt``, outside the number's schema.
    """
    if isinstance(schema, list):
        return [with_standard_bounds(subschema) for subschema in schema]
    if not isinstance(schema, Mapping):
        return schema
    converted = {key: with_standard_bounds(value) for key, value in schema.items() if key not in STANDARD_BOUND_KEYWORDS}
    bounds = {
        STANDARD_BOUND_KEYWORDS[key]: value
        for key, value in schema.items()
        if key in STANDARD_BOUND_KEYWORDS and isinstance(value, int | float)
    }
    numbers = [
        subschema for subschema in (converted, *converted.get("anyOf", ())) if subschema.get("type") in ("number", "integer")
    ]
    for number in numbers:
        number.update(bounds)
    return converted


STANDARD_BOUND_KEYWORDS = {"ge": "minimum", "le": "maximum", "gt": "exclusiveMinimum", "lt": "exclusiveMaximum"}
