"""What the service and its render processes say to each other: picklable values, nothing else."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from api.errors import OUTCOMES
from api.layers import PictureLayer
from terrain.errors import InputError, RenderError, SkuggaError
from terrain.level.level import parse_algorithm
from terrain.level.parts import SunSpec

if TYPE_CHECKING:
    from selector.cost.device_profile import DeviceProfile

PictureFormat = Literal["png", "webp", "jpg"]

ServedPolicy = Literal["rules", "predict"]
"""Policies that a request may name; ``measure`` takes minutes, at design time."""


class _Value(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Overrides(_Value):
    """What a request asks of the shadows; ``None`` leaves it to the level. ``algorithm`` is as the query spells it.

    Every field is one of ``terrain.level.level.Shadows``; what else a request asks is a field of the jobs, as ``sun`` is.
    """

    algorithm: str | None = None
    map_size: int | None = None
    depth_bits: int | None = None
    filter: int | str | None = None
    bias: str | None = None
    culling: str | None = None
    stencil: str | None = None
    counting: str | None = None
    mask: str | None = None

    def for_selector(self) -> dict[str, Any]:
        """As policies of ``selector.select`` take them. Raises ``InputError``."""
        algorithm = None if self.algorithm is None else parse_algorithm(self.algorithm)
        return {**self.model_dump(), "algorithm": algorithm}


class PlanOverrides(Overrides):
    """What a request asks of a plan: of the shadows, and what they may cost."""

    max_error: float | None = None
    max_ms: float | None = None
    cascades: int | None = None


class LevelKey(_Value):
    """A level's file and a version that changes with its text and the files that it names."""

    path: Path
    version: str


class BlockJob(_Value):
    """Draw a block of 4 x 4 tiles (1024 x 1024 px): block (x, y) of a tile matrix counts from its corner."""

    level: LevelKey
    matrix_set: str
    zoom: int
    block_x: int
    block_y: int
    sun: SunSpec | None = None
    overrides: Overrides = Overrides()


class Tiles(_Value):
    """The tiles of a zoom, of which all have the same plan."""

    matrix_set: str
    zoom: int


class PlanJob(_Value):
    """Make the plan of a level's view, or of tiles, without drawing it."""

    level: LevelKey
    view: str | Tiles
    policy: ServedPolicy = "predict"
    sun: SunSpec | None = None
    overrides: PlanOverrides = PlanOverrides()


class DescriptorJob(_Value):
    """Describe a level's view, or tiles: what plans are made from."""

    level: LevelKey
    view: str | Tiles
    sun: SunSpec | None = None


class SnapshotJob(_Value):
    """Draw a level's view and encode one layer of it.

    ``size`` is (width, height) in pixels, ``seconds`` the clock of moving casters; ``None`` leaves either to the level.
    ``light`` is the one whose visibility the layer shows, ``None`` the first.
    """

    level: LevelKey
    view: str
    layer: PictureLayer
    format: PictureFormat
    size: tuple[int, int] | None = None
    light: str | None = None
    seconds: float | None = None
    sun: SunSpec | None = None
    overrides: Overrides = Overrides()


Job = BlockJob | PlanJob | DescriptorJob | SnapshotJob


@dataclass(frozen=True)
class Ready:
    """A render process has warmed up: what it draws with, and the calibration that its plans go by while it lives."""

    renderer: str
    device: DeviceProfile | None = None


@dataclass(frozen=True, eq=False)
class Block:
    """A finished block: ``color`` (rows, cols, 3) uint8, ``visibility`` (rows, cols) float32, NaN off the surface.

    ``plan_json`` is the plan, ``headline`` its algorithms as in overrides; ``passes`` are names with milliseconds;
    the caster reach is in metres; ``renderer`` drew it, by plans of a ``calibration`` (its digest).
    """

    color: np.ndarray
    visibility: np.ndarray
    plan_json: str
    headline: str
    passes: tuple[tuple[str, float], ...]
    reach_used_m: float
    reach_needed_m: float
    reach_clipped: bool
    renderer: str
    calibration: str = ""

    @property
    def there(self) -> np.ndarray:
        """Where there is a surface."""
        return ~np.isnan(self.visibility)

    opaque = there

    def part(self, row: int, col: int, side: int) -> Block:
        """The square part of a block whose first pixel is (row, col)."""
        pixels = slice(row, row + side), slice(col, col + side)
        return replace(self, color=self.color[pixels], visibility=self.visibility[pixels])

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return self.color.nbytes + self.visibility.nbytes


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A finished snapshot: the bytes of its file and the milliseconds that encoding took; the rest is as in a block."""

    body: bytes
    encode_ms: float
    headline: str
    passes: tuple[tuple[str, float], ...]
    reach_used_m: float
    reach_needed_m: float
    reach_clipped: bool
    renderer: str
    calibration: str = ""

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


Result = Block | Snapshot | PlanAnswer | DescriptorAnswer
Answer = Result | Failure
