"""Numbers in paths and queries have one spelling, in ASCII digits."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute
from pydantic import BeforeValidator

from skugga.api.http.levels import routes_levels, routes_plan
from skugga.api.http.numbers import INTEGER_OR_WORD, PLAIN_DECIMAL, PLAIN_INTEGER, WholeNumber
from skugga.api.http.parameters import AzimuthQuery
from skugga.api.http.points import routes_point, routes_point_irradiation
from skugga.api.http.server import routes_health
from skugga.api.http.server.problem_handlers import install_problem_handlers
from skugga.api.http.tiles import routes_map, routes_tiles
from skugga.api.http.views import routes_snapshot

MODULES = (
    routes_health, routes_levels, routes_map, routes_plan, routes_point, routes_point_irradiation, routes_snapshot, routes_tiles,
)  # fmt: skip
ROUTERS = [module.router for module in MODULES]


class Client:
    """A client of an application in this process that reads two numbers."""

    def __init__(self) -> None:
        self.app = FastAPI()
        install_problem_handlers(self.app)

        @self.app.get("/tiles/{z}")
        async def tile(z: WholeNumber, azimuth: AzimuthQuery = None) -> list[Any]:
            return [z, azimuth]

    def get(self, address: str, **params: str) -> httpx.Response:
        async def ask() -> httpx.Response:
            async with httpx.AsyncClient(transport=httpx.ASGITransport(self.app), base_url="http://here") as client:
                return await client.get(address, params=params or None)

        return asyncio.run(ask())


@pytest.fixture(scope="module")
def client() -> Client:
    """A client without a running service."""
    return Client()


@pytest.mark.parametrize("text", ["12.0", "1_2", "１２", "+12", "%2012", "12%20", "0x12", "1e1", "٣", "12²", "--1", "9" * 30])
def test_other_spellings_of_integers_are_refused(client, text):
    answer = client.get(f"/tiles/{text}")
    assert answer.status_code == 422 and "a whole number" in answer.json()["detail"], answer.text


@pytest.mark.parametrize(("text", "number"), [("0", 0), ("12", 12), ("-1", -1), ("007", 7)])
def test_integers_are_read(client, text, number):
    assert client.get(f"/tiles/{text}").json() == [number, None]


@pytest.mark.parametrize("text", ["1_2", "１２", "1٣.5", "0x10", "1e", "", "1,5"])
def test_other_spellings_of_decimals_are_refused(client, text):
    answer = client.get("/tiles/1", azimuth=text)
    assert answer.status_code == 422 and "Allowed: a number" in answer.json()["detail"], answer.text


@pytest.mark.parametrize(("text", "number"), [("12", 12.0), ("-1.5", -1.5), ("1e2", 100.0), (" 235", 235.0), (".5", 0.5)])
def test_decimals_are_read(client, text, number):
    assert client.get("/tiles/1", azimuth=text).json() == [1, number]


def parameters(dependant: Dependant) -> Iterator[Any]:
    """Yield the path and query parameters of a route and of all that it depends on."""
    yield from (*dependant.path_params, *dependant.query_params)
    for dependency in dependant.dependencies:
        yield from parameters(dependency)


def test_every_numeric_parameter_is_validated():
    names = set()
    for router in ROUTERS:
        for route in router.routes:
            for parameter in parameters(route.dependant) if isinstance(route, APIRoute) else ():
                annotation = str(parameter.field_info.annotation)
                if not ("int" in annotation or "float" in annotation) or "constr" in annotation:
                    continue
                names.add(parameter.name)
                readers = [read for read in parameter.field_info.metadata if isinstance(read, BeforeValidator)]
                assert set(readers) & {PLAIN_INTEGER, PLAIN_DECIMAL, INTEGER_OR_WORD}, (route.path, parameter.name, annotation)
    assert {"z", "x", "y", "azimuth", "altitude", "lon", "lat", "seconds", "zoom", "year", "map_size", "width"} <= names
