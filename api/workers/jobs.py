"""What the service and its render processes say to each other: picklable values, nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, InstanceOf

from skugga.api.errors import OUTCOMES
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
"""Policies that a request may name; ``measure`` takes minutes, at design time."""


class _Value(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class LevelKey(LevelSource):
    """What a level is loaded from, and a version that changes with its text and the files that it names."""

    version: str


class BlockJob(_Value):
    """Compute a block of 4 x 4 tiles (1024 x 1024 px) and encode it: block (x, y) of a tile matrix counts from its corner.

    ``tiles``: each picture shows so many tiles a side.
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
    """The tiles of a zoom, of which all have the same plan."""

    matrix_set: str
    zoom: int


class PlanJob(_Value):
    """Make the plan of a level's view, or of tiles, without drawing it."""

    level: LevelKey
    view: str | Tiles
    policy: ServedPolicy = "predict"
    request: PictureRequest = PictureRequest()


class DescriptorJob(_Value):
    """Describe a level's view, or tiles: what plans are made from."""

    level: LevelKey
    view: str | Tiles
    request: PictureRequest = PictureRequest()


class DescribedPlanJob(_Value):
    """Make the plan of a descriptor, as JSON: of a scene that is known by its facts alone."""

    descriptor_json: str
    policy: ServedPolicy = "predict"
    request: PictureRequest = PictureRequest()


class SnapshotJob(_Value):
    """Compute a level's view, or another one that is ``seen_from`` elsewhere, and encode it.

    ``size`` is (width, height) in pixels, ``seconds`` what the level's clock says; ``None`` leaves either to the level.
    ``light`` is the one whose visibility is shown, ``None`` the first.
    """

    level: LevelKey
    view: str
    seen_from: PerspectiveSpec | None = None
    format: PictureFormat
    size: tuple[int, int] | None = None
    light: str | None = None
    seconds: float | None = None
    request: ProductRequest = ProductRequest()


class MapJob(_Value):
    """Compute a map of any extent of a level and encode it.

    ``bounds`` are west, south, east, north in units of ``crs``, ``None`` the level's own; ``size`` is (width, height) in pixels.
    What is transparent shows a ``background`` (``RRGGBB``), if there is one.
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
    """Look at the sun from a point: its report as JSON, its horizon in a ``format`` of files, its sky's chart as svg or png, or
    the chart's figures as json.
    """

    level: LevelKey
    query: PointQuery
    product: PointProduct = "report"
    format: str = "json"
    request: PictureRequest = PictureRequest()


class PointsJob(_Value):
    """Look at the sun from many points, on the day and by the clock of a query."""

    level: LevelKey
    points: tuple[TrackPoint, ...]
    query: PointQuery
    request: PictureRequest = PictureRequest()


class Film(_Value):
    """What a film of a level shows: when it plays, and one of the level's views, or a camera along a ``path``; ``size`` is (width,
    height), ``None`` leaves it to either. The sun of a request is that of a film without dates.
    """

    level: LevelKey
    span: FilmSpan
    view: str = "map"
    path: CameraPathSpec | None = None
    size: tuple[int, int] | None = None
    request: PictureRequest = PictureRequest()

    def film_request(self) -> FilmRequest:
        """The same as the engine takes it."""
        overrides = self.request.overrides.for_selector()
        return FilmRequest(self.span, self.view, self.path, self.size, overrides=overrides)


class FilmCheckJob(Film):
    """Look at all frames of a film before any is drawn, and plan the first one."""


@dataclass(frozen=True, eq=False)
class CarriedPlans:
    """What a frame's plan leaves for the plan of the next one, which another process may make. Equal to itself alone."""

    state: PlanState


class FrameJob(Film):
    """Draw a frame of a film, counted from 0, by plans that go on from those of the frame before it."""

    number: int
    before: InstanceOf[CarriedPlans] | None = None


Job = (
    BlockJob | MapJob | PlanJob | DescribedPlanJob | DescriptorJob | SnapshotJob | PointJob | PointsJob
    | FilmCheckJob | FrameJob
)  # fmt: skip


@dataclass(frozen=True)
class Ping:
    """Asks an idle render process whether it still answers, and tells it the blocks of levels to prepare for while it is idle."""

    first_blocks: tuple[BlockJob, ...] = ()


@dataclass(frozen=True)
class Pong:
    """It does. ``missing_loops`` of all recorded ones are stored nowhere, as far as it has counted them."""

    missing_loops: int = 0


@dataclass(frozen=True)
class Preparing:
    """What a render process does before it is ready, or before a job, and how far it is.

    Attributes
    ----------
    task : str
        In words for people, as "compiling loops for map tiles".
    done, total : int
        Steps; ``total`` is 0 while it is unknown.
    """

    task: str
    done: int = 0
    total: int = 0


@dataclass(frozen=True)
class Ready:
    """A render process has warmed up: what it draws with, by OpenGL's names, the calibration that its plans go by, and which of
    EGL's devices it has. ``missing_loops`` of all recorded ones are stored nowhere yet.
    """

    renderer: str
    device: DeviceProfile | None = None
    version: str = ""
    egl_device: str = ""
    missing_loops: int = 0


@dataclass(frozen=True, eq=False)
class BlockTiles:
    """The tiles of a block, by row and column in it, in one layer and format; ``drawn`` for this answer, or kept.

    ``headline`` are the plan's algorithms as in overrides; ``passes`` are names with milliseconds; the caster reach is in metres,
    ``None`` where each of many suns had its own; ``renderer`` drew it, by plans of a version (``PlanBasis``). ``unprobed`` is
    the class of a map whose plan goes by predictions alone (``skugga.api.workers.map_plans``).
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
    """A finished snapshot or map: the bytes of its file and the milliseconds that encoding took; the rest is as in a block."""

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
    """The bytes of a point's report, of its horizon file or of its chart; of many points JSON, a list."""

    body: bytes


@dataclass(frozen=True)
class FilmChecked:
    """A film can be drawn as far as is known beforehand; its frames are expected to take so long, if anything is predicted."""

    frame_ms: float | None


@dataclass(frozen=True, eq=False)
class FilmPicture:
    """A frame of a film: ``color`` uint8 (rows, cols, 3), and what its plan leaves for the next one."""

    color: np.ndarray
    after: CarriedPlans


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
        """The data of an error."""
        kind = type(error).__name__
        if isinstance(error, InputError):
            value = error.value if isinstance(error.value, str | int | float | None) else repr(error.value)
            return cls(kind, str(error), error.name, value, error.allowed, fatal)
        return cls(kind, str(error), fatal=fatal)

    def error(self) -> SkuggaError:
        """The error of the data."""
        kind = {known.__name__: known for known in OUTCOMES}.get(self.kind, RenderError)
        if issubclass(kind, InputError):
            return kind(self.name or "", self.value, self.allowed or "")
        return kind(self.message)


Result = BlockTiles | Snapshot | PlanAnswer | DescriptorAnswer | PointAnswer | FilmChecked | FilmPicture
Answer = Result | Failure
