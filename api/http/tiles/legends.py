"""Legends of layers as pictures."""

from __future__ import annotations

from fastapi import Request, Response
from starlette.concurrency import run_in_threadpool

from skugga.api.color_scale import LEGEND_MEDIA_TYPES, LegendFormat
from skugga.api.http.answers import GIVEN_SUN_S, cache_headers, is_fresh, tag_of
from skugga.api.http.state.served_levels import ServedLevel
from skugga.api.sun_hours_layer import SUN_HOURS_LAYER, SunHoursQuery


async def legend_answer(request: Request, served: ServedLevel, asked: SunHoursQuery, format: LegendFormat) -> Response:
    """The legend of hours of sun as a picture. Raises ``InputError``."""
    headers = cache_headers(tag_of("legend", format, served.version, f"layer={SUN_HOURS_LAYER}&{asked.query()}"), GIVEN_SUN_S)
    if is_fresh(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    scale = await run_in_threadpool(asked.color_scale, served.world)
    body = await run_in_threadpool(scale.legend, format)
    return Response(body, headers=headers, media_type=LEGEND_MEDIA_TYPES[format])
