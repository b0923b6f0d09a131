"""Messages between the service and its render processes, which are picklable values: jobs, answers and heartbeats.

A plan is a choice of shadow algorithms and settings for a view.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, InstanceOf

from skugga.api.errors import ERROR_REPORTS
from skugga.api.point.irradiation_values import PointIrradiationOptions
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
"""Policies for choosing a plan that a request may name: fixed rules, or predictions of cost and error.

Other policies draw pictures to choose, which takes too long for a request."""


class _Value(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class LevelKey(LevelSource):
    """The source of a level, with a version: a digest that changes with the level's text and with the files that it names."""

    version: str


class BlockJob(_Value):
    """Compute a block of 4 x 4 tiles (1024 x 1024 pixels), and encode it as several files.

    ``block_x`` and ``block_y`` are the block's column and row, counted in blocks from the top left corner of the tile matrix of
    ``zoom``. Each file covers ``tiles_per_side`` x ``tiles_per_side`` tiles.
    """

    level: LevelKey
    matrix_set: str
    zoom: int
    block_x: int
    block_y: int
    format: MapFormat = "png"
    tiles_per_side: int = 1
    request: ProductRequest = ProductRequest()


class ZoomTiles(_Value):
    """All tiles of a level at a zoom of a tile matrix set. They share one plan."""

    matrix_set: str
    zoom: int


class PlanJob(_Value):
    """Make the plan of a level's view, or of the tiles of a zoom, without drawing."""

    level: LevelKey
    view: str | ZoomTiles
    policy: ServedPolicy = "predict"
    request: PictureRequest = PictureRequest()


class DescriptorJob(_Value):
    """Make the descriptor of a level's view, or of the tiles of a zoom: the facts from which plans are made."""

    level: LevelKey
    view: str | ZoomTiles
    request: PictureRequest = PictureRequest()


class DescriptorPlanJob(_Value):
    """Make the plan for a client's descriptor, given as JSON. No level is needed."""

    descriptor_json: str
    policy: ServedPolicy = "predict"
    request: PictureRequest = PictureRequest()


class SnapshotJob(_Value):
    """Compute and encode a picture of a level's view, or of the perspective view of ``camera``.

    ``size`` is (width, height) in pixels; ``None`` means the view's own. ``seconds`` is a time of the level's clock, which moves
    casters, lamps and clouds; ``None`` means the level's own. ``light`` names the light whose visibility is shown; ``None`` means
    the first light.
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

    ``bounds`` are west, south, east, north in units of ``crs``; ``None`` means the whole level. ``crs`` is a code; ``None`` means
    the CRS of the level's own maps. ``size`` is (width, height) in pixels. ``background`` (``RRGGBB``) is the colour behind
    transparent pixels; ``None`` keeps them transparent.
    """

    level: LevelKey
    bounds: tuple[float, float, float, float] | None
    crs: str | None
    size: tuple[int, int]
    format: MapFormat
    background: str | None = None
    request: ProductRequest = ProductRequest()


PointProduct = Literal["report", "horizon", "sky", "irradiation"]
"""What a point job computes: the sun report, the horizon file or the sky chart."""


class PointJob(_Value):
    """Compute the sun report, the horizon file, the sky chart or the irradiation of a point, as ``product`` says.

    ``format`` is the format of a horizon file, or of a chart: ``svg``, ``png``, or ``json`` for the chart's figures. A report is
    always JSON. Irradiation is ``json``, ``csv``, ``svg`` or ``png``, and has options of its own.
    """

    level: LevelKey
    query: PointQuery
    product: PointProduct = "report"
    format: str = "json"
    irradiation: PointIrradiationOptions = PointIrradiationOptions()
    request: PictureRequest = PictureRequest()


class PointsJob(_Value):
    """Compute reports about the sun at many points.

    ``query`` has the date and the clock (time zone) for all points. Points without a time of their own have the sun of
    ``request``.
    """

    level: LevelKey
    points: tuple[TrackPoint, ...]
    query: PointQuery
    request: PictureRequest = PictureRequest()


class Film(_Value):
    """The content of a film: its time span, and a view of the level or the path of a moving camera.

    ``size`` is (width, height) in pixels; ``None`` means that of the view or path. A film whose span has no date keeps the sun of
    ``request`` fixed.
    """

    level: LevelKey
    span: FilmSpan
    view: str = "map"
    path: CameraPathSpec | None = None
    size: tuple[int, int] | None = None
    request: PictureRequest = PictureRequest()

    def film_request(self) -> FilmRequest:
        """Return the film as a request to the engine. It lacks the level and the sun."""
        overrides = self.request.overrides.for_selector()
        return FilmRequest(self.span, self.view, self.path, self.size, overrides=overrides)


class FilmCheckJob(Film):
    """Check all frames of a film before any frame is drawn, and plan the first frame to predict its duration."""


@dataclass(frozen=True, eq=False)
class FilmPlanState:
    """Planning state after a frame of a film, from which the plan of the next frame is made.

    Another process may draw the next frame. Two objects are equal only if they are the same object.
    """

    state: PlanState


class FrameJob(Film):
    """Draw one frame of a film.

    ``frame_number`` counts frames from 0. ``previous_plan_state`` is the planning state after the previous frame; ``None`` for the
    first.
    """

    frame_number: int
    previous_plan_state: InstanceOf[FilmPlanState] | None = None


Job = (
    BlockJob | MapJob | PlanJob | DescriptorPlanJob | DescriptorJob | SnapshotJob | PointJob | PointsJob
    | FilmCheckJob | FrameJob
)  # fmt: skip


@dataclass(frozen=True)
class HeartbeatRequest:
    """Heartbeat request to an idle render process. While idle, the process opens the levels of ``preload_blocks``."""

    preload_blocks: tuple[BlockJob, ...] = ()


@dataclass(frozen=True)
class HeartbeatResponse:
    """Answer to a ``HeartbeatRequest``.

    ``missing_loop_count`` is the number of loops (functions that numba compiles) without machine code in the cache on disk; 0
    until the process has counted them.
    """

    missing_loop_count: int = 0


@dataclass(frozen=True)
class PreparationProgress:
    """Progress of a preparation that a render process makes before it is ready, or before it can start a job.

    Attributes
    ----------
    task : str
        The step in words, for example "compiling loops for map tiles".
    done, total : int
        Number of finished steps, and of all steps; ``total`` is 0 while unknown.
    """

    task: str
    done: int = 0
    total: int = 0


@dataclass(frozen=True)
class WorkerReady:
    """Message of a render process that it has warmed up and waits for jobs.

    Attributes
    ----------
    renderer : str
        OpenGL's name of the renderer.
    device : DeviceProfile or None
        Calibration (measured costs of algorithms on the device) that its plans use; ``None`` without one.
    version : str
        OpenGL's version; empty without OpenGL.
    egl_device : str
        Name of its EGL device.
    missing_loop_count : int
        As in ``HeartbeatResponse``.
    """

    renderer: str
    device: DeviceProfile | None = None
    version: str = ""
    egl_device: str = ""
    missing_loop_count: int = 0


@dataclass(frozen=True, eq=False)
class BlockTiles:
    """The tiles of a block in one layer and format.

    Attributes
    ----------
    tiles : dict
        Encoded files by (row, column) in the block, in units of a file's size.
    encode_ms : float
        Duration of encoding in milliseconds.
    headline : str
        Algorithms of the plan (``Plan.algorithms_text``), or the name of a product that needs no plan.
    passes : tuple
        Name and milliseconds of each render pass.
    reach_used_m, reach_needed_m : float or None
        Distances towards the sun in metres in which shadow casters were searched, and had to be searched. ``None`` if no single
        sun lit the block.
    reach_clipped : bool
        Whether the level's data ends before the needed distance.
    renderer : str
        OpenGL's name of the renderer that drew the block.
    plan_version : str
        Version of the level's plans (``PlanMeasurements.version_of``).
    is_newly_drawn : bool
        Whether the block was drawn for this answer, and did not come from the process's cache.
    unprobed_class : MapClass or None
        Class (scale and sun) of the map if a probe of the level would improve its plan; else ``None``.
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
    is_newly_drawn: bool = True
    unprobed_class: MapClass | None = None

    @property
    def nbytes(self) -> int:
        """Total bytes of the encoded files."""
        return sum(map(len, self.tiles.values()))


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A finished snapshot or map. ``body`` has the bytes of its file; the other fields are as in ``BlockTiles``."""

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
        """Number of bytes of the file."""
        return len(self.body)


@dataclass(frozen=True)
class PlanResult:
    """A plan as JSON."""

    plan_json: str


@dataclass(frozen=True)
class DescriptorResult:
    """A descriptor as JSON."""

    descriptor_json: str


@dataclass(frozen=True)
class PointResult:
    """The bytes of a point's report, horizon file or chart; a JSON list for many points."""

    body: bytes


@dataclass(frozen=True)
class FilmCheckResult:
    """Result of a film check without errors. ``frame_ms`` is the predicted duration of a frame; ``None`` without a prediction."""

    frame_ms: float | None


@dataclass(frozen=True, eq=False)
class FilmPicture:
    """A frame of a film: its colours, uint8 (rows, cols, 3), and the planning state for the next frame."""

    color: np.ndarray
    next_plan_state: FilmPlanState


@dataclass(frozen=True)
class Failure:
    """A ``SkuggaError`` as picklable data.

    Attributes
    ----------
    kind : str
        Name of the error's class.
    message : str
        The error's message.
    name, value, allowed : optional
        Arguments of an ``InputError``: the parameter, its value, and what is allowed.
    is_fatal : bool
        Whether the render process ends after this answer.
    """

    kind: str
    message: str
    name: str | None = None
    value: Any = None
    allowed: str | None = None
    is_fatal: bool = False

    @classmethod
    def from_error(cls, error: SkuggaError, is_fatal: bool = False) -> Failure:
        """Return an error as data. ``is_fatal`` says whether the render process ends after it."""
        kind = type(error).__name__
        if isinstance(error, InputError):
            value = error.value if isinstance(error.value, str | int | float | None) else repr(error.value)
            return cls(kind, str(error), error.name, value, error.allowed, is_fatal)
        return cls(kind, str(error), is_fatal=is_fatal)

    def to_error(self) -> SkuggaError:
        """Return the error that the data describes. Errors of unknown classes become ``RenderError``."""
        kind = {error_class.__name__: error_class for error_class in ERROR_REPORTS}.get(self.kind, RenderError)
        if issubclass(kind, InputError):
            return kind(self.name or "", self.value, self.allowed or "")
        return kind(self.message)


Result = BlockTiles | Snapshot | PlanResult | DescriptorResult | PointResult | FilmCheckResult | FilmPicture
Answer = Result | Failure
