"""Settings of the service, from environment variables ``SKUGGA_*``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, SecretStr, ValidationError, field_validator
from pydantic_core import PydanticCustomError
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from skugga.api.base_maps import MAX_BASE_MAPS, BaseMap, parse_base_maps
from skugga.terrain.cores import usable_cores
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.gl.egl_devices import AUTO_DEVICE, parse_device_setting
from skugga.terrain.level.level_errors import allowed_phrase

MAX_DEFAULT_WORKERS = 4
"""Maximum of the default number of render processes. With a software rasteriser each takes about 1.5 GB."""


def default_workers() -> int:
    """Return the default number of render processes: one per core, at most ``MAX_DEFAULT_WORKERS``.

    Several processes draw more blocks per second than one process whose software rasteriser uses several threads.
    """
    return min(usable_cores(), MAX_DEFAULT_WORKERS)


class Settings(BaseSettings):
    """Settings of the service. Every field is an environment variable: ``workers`` is ``SKUGGA_WORKERS``.

    Times are in seconds, sizes in bytes.
    """

    model_config = SettingsConfigDict(env_prefix="SKUGGA_", frozen=True, env_ignore_empty=True)

    host: str = Field(default="127.0.0.1", description="Address to listen on.")
    port: int = Field(default=8000, ge=0, le=65535, description="Port to listen on; 0 takes a free one.")
    public_url: str | None = Field(
        default=None,
        pattern=r"^https?://[^/?#]+[^?#]*$",
        description="URL at which clients reach the service, for links in TileJSON; default: the request's.",
    )
    access_log: bool = Field(default=False, description="Log every request.")
    log_format: Literal["text", "json"] = Field(default="text", description="Format of log lines: text, or a JSON object each.")
    api_token: SecretStr | None = Field(
        default=None, min_length=8, description="Token that clients send as `Authorization: Bearer ...`; default: none is needed."
    )
    cors_origins: Annotated[tuple[str, ...], NoDecode] = Field(
        default=("*",), description="Origins whose pages may read the answers, separated by commas."
    )
    max_connections: int = Field(default=1000, ge=1, description="Simultaneous connections, if there are enough file descriptors.")
    client_timeout_s: float = Field(
        default=20.0,
        gt=0,
        description="Seconds that a client may take to send a request's headers or body, or pause reading.",
    )
    workers: int = Field(default_factory=default_workers, ge=1, le=256, description="Render processes.")
    queue_length: int = Field(
        default=64,
        ge=1,
        description="Tiles of each client that may always wait in the queue: a screenful, whatever their expected time.",
    )
    queue_work_s: float = Field(
        default=20.0,
        gt=0,
        description="Seconds of expected work in the queue above which a client's further pictures are refused, except a screenful "
        "of tiles.",
    )
    queue_timeout_s: float = Field(default=60.0, gt=0, description="Seconds that a picture may wait in the queue.")
    render_timeout_s: float = Field(default=60.0, gt=0, description="Seconds after which a picture is given up.")
    start_timeout_s: float = Field(default=300.0, gt=0, description="Seconds within which a render process has to start.")
    calibrate_when_idle: bool = Field(
        default=True,
        description="Whether a device without a calibration is calibrated while the service is idle; else run `skugga calibrate`.",
    )
    probe_when_idle: bool = Field(
        default=True,
        description="Whether levels with map requests are probed while the service is idle; else run `skugga select --all-scales "
        "--write`.",
    )
    recycle_blocks: int = Field(default=1000, ge=1, description="Blocks and snapshots after which a render process is replaced.")
    block_cache_bytes: int = Field(default=64 * 2**20, ge=0, description="Memory for encoded blocks of tiles and snapshots.")
    tile_cache_bytes: int = Field(default=256 * 2**20, ge=0, description="Memory for encoded tiles as sent (some 60 KiB each).")
    max_snapshot_pixels: int = Field(default=2048 * 2048, ge=1, description="Pixels of a snapshot; more are refused.")
    max_animation_frames: int = Field(default=720, ge=0, description="Frames of an animation; 0 disables animations.")
    max_animation_frame_pixels: int = Field(
        default=1920 * 1080, ge=1, description="Pixels of each frame of an animation; more are refused."
    )
    max_animation_pixels: int = Field(
        default=2**27, ge=1, description="Pixels of all frames of an animation together; more are refused."
    )
    animations_at_a_time: int = Field(default=1, ge=1, le=64, description="Animations that are drawn simultaneously.")
    animations_waiting: int = Field(default=4, ge=0, description="Animations that may wait in the queue; more are refused.")
    animation_abandoned_s: float = Field(
        default=60.0, gt=0, description="Seconds without a request for an animation after which it is no longer drawn."
    )
    animation_age_s: float = Field(default=3600.0, gt=0, description="Seconds that a finished animation is kept.")
    animations_kept: int = Field(default=32, ge=1, description="Finished animations that are kept, with or without a film.")
    animation_bytes: int = Field(
        default=256 * 2**20,
        ge=2**20,
        description="Bytes of finished films, which are stored in the folder of temporary files.",
    )
    max_body_bytes: int = Field(default=2**20, ge=1, description="Bytes of a request's body; more are refused.")
    level_check_s: float = Field(
        default=1.0,
        ge=0,
        description="Seconds between two checks of a level's files for changes.",
    )
    level_timeout_s: float = Field(
        default=5.0,
        gt=0,
        description="Seconds that requests wait until a changed level is read. After that its old version is served.",
    )
    time_grain_s: int = Field(
        default=60,
        ge=0,
        le=86400,
        description="Seconds to whose multiples `time` is rounded, so that more requests share a picture.",
    )
    new_suns_per_minute: int = Field(
        default=600, ge=0, description="New suns that one client address may request in a minute; 0: no limit."
    )
    empty_tile: Literal["transparent", "204", "404"] = Field(
        default="transparent", description="Answer for a tile within the zoom range but outside the data."
    )
    base_maps: Annotated[tuple[BaseMap, ...], NoDecode] = Field(
        default=(),
        max_length=MAX_BASE_MAPS,
        description="Base maps that the viewer offers, as JSON: a list of objects with `title`, `tiles` (an address with `{z}`, "
        "`{x}` and `{y}`, or a path of this service), `attribution` and `maxzoom`.",
    )
    base_maps_only: bool = Field(
        default=False,
        description="Whether the viewer takes tiles from the servers of these base maps only; else users may paste an address.",
    )
    levels: Path | None = Field(
        default=None, description="Folder whose level files (`.yaml`, `.yml`) are served; `SIGHUP` reloads the list."
    )
    data_roots: Annotated[tuple[Path, ...], NoDecode] = Field(
        default=(),
        description="Folders that may contain level files and data, separated by commas, besides `SKUGGA_LEVELS` and the folders "
        "of the files that the service is started with.",
    )
    remote_sources: bool = Field(default=False, description="Whether levels may name rasters that are not local files.")
    expect_renderer: str | None = Field(
        default=None, description="Text that the OpenGL renderer's name must contain; else no render process starts."
    )
    egl_device: str = Field(
        default=AUTO_DEVICE,
        description="Device to draw with, for all commands: `auto`, `software`, or numbers of devices (`0`, `0,1`), among which "
        "render processes are distributed; `skugga doctor` lists them.",
    )

    @field_validator("cors_origins", "data_roots", mode="before")
    @classmethod
    def _split_by_commas(cls, value: Any) -> Any:
        return tuple(part.strip() for part in value.split(",") if part.strip()) if isinstance(value, str) else value

    @field_validator("base_maps", mode="before")
    @classmethod
    def _parse_base_maps(cls, value: Any) -> Any:
        return parse_base_maps(value)

    @field_validator("egl_device")
    @classmethod
    def _check_egl_device(cls, value: str) -> str:
        try:
            parse_device_setting(value)
        except InputError as error:
            raise PydanticCustomError("egl_device", "{allowed}", {"allowed": error.allowed}) from None
        return value


_SECRETS = {"api_token"}
"""Settings whose values are never shown."""


def load_settings(**overrides: Any) -> Settings:
    """Return the settings of the environment. ``overrides``, such as those of a command line, take precedence.

    Raises ``InputError``, which names the environment variable or the argument.
    """
    try:
        return Settings(**overrides)
    except ValidationError as error:
        detail = error.errors()[0]
        field = str(detail["loc"][0])
        name = field if field in overrides else f"SKUGGA_{field.upper()}"
        allowed = allowed_phrase(detail)
        if field in _SECRETS:
            raise InputError(name, Problem("the value is not allowed"), f"Allowed: {allowed}") from None
        raise InputError(name, detail["input"], allowed) from None
