"""Messages between the service and its render processes: picklable values only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, InstanceOf

from skugga.api.errors import ERROR_REPORTS
from skugga.api.point.values import PointQuery, TrackPoint
from skugga.api.products.product import MapFormat, PictureFormat
from skugga.api.request import PictureRequest, ProductRequest
from skugga.selector.film_request import FilmRequest, FilmSpan
from skugga.terrain.errors import InputError, RenderError, SkuggaError
from skugga.terrain.level.camera_file import CameraPathSpec
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import PerspectiveSpec

if TYPE_CHECKING:
    from skugga.selector.cost.device_profile import DeviceProfile
    from skugga.selector.map_probes import MapClass
    from skugga.selector.replanning import PlanState

ServedPolicy = Literal["rules", "predict"]
"""Policies that a request may name. ``measure`` takes minutes and is for design time."""


class _Value(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class LevelKey(LevelSource):
    """The source of a level, with a version that changes with its text and the files that it names."""

    version: str


class BlockJob(_Value):
    """Compute and encode a block of 4 x 4 tiles (1024 x 1024 px): block (x, y) counts from the corner of a tile matrix.

    Each picture covers ``tiles`` x ``tiles`` tiles.
    """

    level: LevelKey
    matrix_set: str
    zoom: int
    block_x: int
    block_y: int
    format: MapFormat = "png"
    tiles: int = 1
    request: ProductRequest = ProductRequest()


class Tiles(_Value):
    """The tiles of a zoom, which share one plan."""

    matrix_set: str
    zoom: int


class PlanJob(_Value):
    """Make the plan of a level's view, or of tiles, without drawing it."""

    level: LevelKey
    view: str | Tiles
    policy: ServedPolicy = "predict"
    request: PictureRequest = PictureRequest()


class DescriptorJob(_Value):
    """Make the descriptor of a level's view, or of tiles: the input of plans."""

    level: LevelKey
    view: str | Tiles
    request: PictureRequest = PictureRequest()


class DescribedPlanJob(_Value):
    """Make the plan of a descriptor given as JSON, for a scene known by its facts alone."""

    descriptor_json: str
    policy: ServedPolicy = "predict"
    request: PictureRequest = PictureRequest()


class SnapshotJob(_Value):
    """Compute and encode a level's view, or another perspective (``camera``).

    ``size`` is (width, height) in pixels and ``seconds`` the time of the level's clock; ``None`` uses the level's own.
    ``light`` names the light whose visibility is shown; ``None`` is the first.
    """

    level: LevelKey
    view: str
    camera: PerspectiveSpec | None = None
    format: PictureFormat
    size: tuple[int, int] | None = None
    light: str | None = None
    seconds: float | None = None
    request: ProductRequest = ProductRequest()


class MapJob(_Value):
    """Compute and encode a map of any extent of a level.

    ``bounds`` are west, south, east, north in units of ``crs``; ``None`` uses the level's own. ``size`` is (width, height) in
    pixels. ``background`` (``RRGGBB``) fills transparent pixels; ``None`` keeps them transparent.
    """

    level: LevelKey
    bounds: tuple[float, float, float, float] | None
    crs: str | None
    size: tuple[int, int]
    format: MapFormat
    background: str | None = None
    request: ProductRequest = ProductRequest()


PointProduct = Literal["report", "horizon", "sky"]


class PointJob(_Value):
    """Compute a point's sun report (JSON), horizon file (``format``), sky chart (svg or png), or the chart's figures (json)."""

    level: LevelKey
    query: PointQuery
    product: PointProduct = "report"
    format: str = "json"
    request: PictureRequest = PictureRequest()


class PointsJob(_Value):
    """Compute the sun's state at many points, on the day and clock time of a query."""

    level: LevelKey
    points: tuple[TrackPoint, ...]
    query: PointQuery
    request: PictureRequest = PictureRequest()


class Film(_Value):
    """The content of a film: a time span, and one of the level's views or a camera along a ``path``.

    ``size`` is (width, height) in pixels; ``None`` uses that of the view or path. A film without dates uses the sun of its
    request.
    """

    level: LevelKey
    span: FilmSpan
    view: str = "map"
    path: CameraPathSpec | None = None
    size: tuple[int, int] | None = None
    request: PictureRequest = PictureRequest()

    def film_request(self) -> FilmRequest:
        """Return the request in the engine's form."""
        overrides = self.request.overrides.for_selector()
        return FilmRequest(self.span, self.view, self.path, self.size, overrides=overrides)


class FilmCheckJob(Film):
    """Check all frames of a film before any is drawn, and plan the first one."""


@dataclass(frozen=True, eq=False)
class PlanHandover:
    """Planning state that a frame hands to the next one, which another process may draw. Compared by identity."""

    state: PlanState


class FrameJob(Film):
    """Draw a frame of a film, counted from 0. Its plans continue those of the previous frame."""

    number: int
    previous_plans: InstanceOf[PlanHandover] | None = None


Job = (
    BlockJob | MapJob | PlanJob | DescribedPlanJob | DescriptorJob | SnapshotJob | PointJob | PointsJob
    | FilmCheckJob | FrameJob
)  # fmt: skip


@dataclass(frozen=True)
class Ping:
    """Heartbeat request to an idle render process. It names the blocks of levels to prepare while idle."""

    first_blocks: tuple[BlockJob, ...] = ()


@dataclass(frozen=True)
class Pong:
    """Heartbeat answer. ``missing_loops`` counts the recorded loops without a stored binary, as far as they were counted."""

    missing_loops: int = 0


@dataclass(frozen=True)
class Preparing:
    """Progress of a render process before it is ready, or before a job.

    Attributes
    ----------
    task : str
        The step in words, for example "compiling loops for map tiles".
    done, total : int
        Number of steps; ``total`` is 0 while unknown.
    """

    task: str
    done: int = 0
    total: int = 0


@dataclass(frozen=True)
class Ready:
    """A render process has warmed up.

    Attributes
    ----------
    renderer : str
        OpenGL's name of the renderer.
    device : DeviceProfile or None
        Calibration that its plans use.
    version : str
        OpenGL's version; empty without OpenGL.
    egl_device : str
        Name of its EGL device.
    missing_loops : int
        Number of recorded loops that are not stored yet.
    """

    renderer: str
    device: DeviceProfile | None = None
    version: str = ""
    egl_device: str = ""
    missing_loops: int = 0


@dataclass(frozen=True, eq=False)
class BlockTiles:
    """The tiles of a block in one layer and format.

    Attributes
    ----------
    tiles : dict
        Files by row and column in the block.
    encode_ms : float
        Duration of encoding in milliseconds.
    headline : str
        Algorithms of the plan, written as in overrides.
    passes : tuple
        Names of passes with milliseconds.
    reach_used_m, reach_needed_m : float or None
        Caster reach in metres; ``None`` if each of many suns had its own.
    reach_clipped : bool
        Whether the reach was clipped.
    renderer : str
        Renderer that drew the block.
    plan_version : str
        Version of the plans (``PlanBasis``).
    drawn : bool
        Whether the block was drawn for this answer, and not cached.
    unprobed : MapClass or None
        Class of the map if its plan relies on predictions alone (``skugga.api.workers.map_plans``).
    """

    tiles: dict[tuple[int, int], bytes]
    encode_ms: float
    headline: str
    passes: tuple[tuple[str, float], ...]
    reach_used_m: float | None
    reach_needed_m: float | None
    reach_clipped: bool
    renderer: str
    plan_version: str = ""
    drawn: bool = True
    unprobed: MapClass | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of the tiles."""
        return sum(map(len, self.tiles.values()))


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A finished snapshot or map: the bytes of its file and the duration of encoding; the other fields as in ``BlockTiles``."""

    body: bytes
    encode_ms: float
    headline: str
    passes: tuple[tuple[str, float], ...]
    reach_used_m: float | None
    reach_needed_m: float | None
    reach_clipped: bool
    renderer: str
    plan_version: str = ""

    @property
    def nbytes(self) -> int:
        """Bytes of the file."""
        return len(self.body)


@dataclass(frozen=True)
class PlanAnswer:
    """A plan as JSON."""

    plan_json: str


@dataclass(frozen=True)
class DescriptorAnswer:
    """A descriptor as JSON."""

    descriptor_json: str


@dataclass(frozen=True)
class PointAnswer:
    """The bytes of a point's report, horizon file or chart; a JSON list for many points."""

    body: bytes


@dataclass(frozen=True)
class FilmChecked:
    """Result of a film check without errors. ``frame_ms`` is the expected duration per frame, if predicted."""

    frame_ms: float | None


@dataclass(frozen=True, eq=False)
class FilmPicture:
    """A frame of a film: ``color`` uint8 (rows, cols, 3), and the planning state for the next frame."""

    color: np.ndarray
    next_plans: PlanHandover


@dataclass(frozen=True)
class Failure:
    """A domain error as data. ``fatal`` says that the render process ends with it."""

    kind: str
    message: str
    name: str | None = None
    value: Any = None
    allowed: str | None = None
    fatal: bool = False

    @classmethod
    def of(cls, error: SkuggaError, fatal: bool = False) -> Failure:
        """Return the data of an error."""
        kind = type(error).__name__
        if isinstance(error, InputError):
            value = error.value if isinstance(error.value, str | int | float | None) else repr(error.value)
            return cls(kind, str(error), error.name, value, error.allowed, fatal)
        return cls(kind, str(error), fatal=fatal)

    def error(self) -> SkuggaError:
        """Return the error that the data describes."""
        kind = {error_class.__name__: error_class for error_class in ERROR_REPORTS}.get(self.kind, RenderError)
        if issubclass(kind, InputError):
            return kind(self.name or "", self.value, self.allowed or "")
        return kind(self.message)


Result = BlockTiles | Snapshot | PlanAnswer | DescriptorAnswer | PointAnswer | FilmChecked | FilmPicture
Answer = Result | Failure
