"""Expected durations of jobs, learnt from finished jobs of the same kind. The queue uses them to order jobs."""

from __future__ import annotations

from collections.abc import Hashable

from skugga.api.request import ProductRequest
from skugga.api.workers.jobs import (
    BlockJob,
    DescriptorJob,
    DescriptorPlanJob,
    FilmCheckJob,
    FrameJob,
    Job,
    MapJob,
    PlanJob,
    PointJob,
    PointsJob,
    SnapshotJob,
)
from skugga.terrain.cache import MIB, Cache, Missing

INITIAL_ESTIMATE_S: dict[type, float] = {
    BlockJob: 0.5, PlanJob: 0.5, DescriptorPlanJob: 0.1, DescriptorJob: 0.5, SnapshotJob: 2.5, MapJob: 2.5,
    PointJob: 0.1, PointsJob: 1.0, FilmCheckJob: 0.5, FrameJob: 2.5,
}  # fmt: skip
"""Expected seconds of a job whose kind was not measured yet, by type.

The times of snapshots, maps and frames are for ``REFERENCE_PIXELS`` pixels. The values were measured with a software
rasteriser on two cores.
"""

INITIAL_ESTIMATE_OF_DAY_PRODUCT_S = 3.0
"""Expected seconds, before any measurement, of a block of a product of whole dates (hours of sun), which needs many suns."""

REFERENCE_PIXELS = 1280 * 1024
"""Number of pixels to which durations of snapshots, maps and frames are scaled."""

SMOOTHING_FACTOR = 0.3
"""Weight of the newest duration in the exponential moving average."""

MAX_SHORT_JOB_S = 3.0
"""Expected seconds up to which a job counts as short (``ExpectedTimes.is_short``). Short jobs have a reserved process."""


class ExpectedTimes:
    """Moving averages of job durations in seconds.

    There is an average for each kind of job (``kind_of_job``) and for each variant of a kind (``_variant_of``). A variant without
    measurements is expected to take as long as its kind. Durations of snapshots, maps and frames are scaled to ``REFERENCE_PIXELS``
    pixels.
    """

    def __init__(self) -> None:
        self._averages_s: Cache[float] = Cache("skugga.api.workers.expected_times", "process", MIB, lambda _: 512)

    def expected_s(self, job: Job) -> float:
        """Return the expected duration of a job in seconds."""
        average_s = self._average_s(job)
        return (_initial_estimate_s(job) if average_s is None else average_s) * _relative_size_of(job)

    def is_short(self, job: Job) -> bool:
        """Return whether a job is short: its kind was measured, and it is expected to take at most ``MAX_SHORT_JOB_S``."""
        average_s = self._average_s(job)
        return average_s is not None and average_s * _relative_size_of(job) <= MAX_SHORT_JOB_S

    def add_duration(self, job: Job, seconds: float) -> None:
        """Update the averages with the measured duration of a job in seconds."""
        unit_seconds = seconds / _relative_size_of(job)
        for key in _keys_of(job):
            average_s = self._averages_s.get(key)
            self._averages_s.put(
                key,
                value=unit_seconds if isinstance(average_s, Missing) else average_s + SMOOTHING_FACTOR * (unit_seconds - average_s),
            )

    def _average_s(self, job: Job) -> float | None:
        """Return the average duration of the job's variant, or else of its kind, in seconds; ``None`` without measurements."""
        for key in _keys_of(job):
            average_s = self._averages_s.get(key)
            if not isinstance(average_s, Missing):
                return average_s
        return None


def _initial_estimate_s(job: Job) -> float:
    """Return the expected seconds of a job whose kind was not measured yet, without scaling to its pixels."""
    return (
        INITIAL_ESTIMATE_OF_DAY_PRODUCT_S if isinstance(job, BlockJob) and _has_whole_dates(job) else INITIAL_ESTIMATE_S[type(job)]
    )


def _has_whole_dates(job: Job) -> bool:
    """Return whether a job computes a product of whole dates."""
    return isinstance(job.request, ProductRequest) and job.request.product_record.when == "days"


def _keys_of(job: Job) -> tuple[Hashable, Hashable]:
    """Return the keys of a job's averages: that of its variant, then that of its kind."""
    kind = kind_of_job(job)
    return (kind, _variant_of(job)), kind


def _variant_of(job: Job) -> Hashable:
    """Return the variant of a job within its kind, as a key.

    A variant consists of the product, the tile matrix set and zoom, the format and size of tiles, and the product of a point.
    """
    product = job.request.product if isinstance(job.request, ProductRequest) else None
    return product, *(getattr(job, name, None) for name in ("matrix_set", "zoom", "format", "tiles", "product"))


def kind_of_job(job: Job) -> Hashable:
    """Return the kind of a job, as a key. Jobs of one kind take about the same time.

    A kind consists of the type of job, the level and its version, the request's shadow settings, the view, and whether the product
    is of whole dates.
    """
    level = None if isinstance(job, DescriptorPlanJob) else (str(job.level.path), job.level.version)
    return type(job).__name__, level, job.request.overrides.asked, getattr(job, "view", None), _has_whole_dates(job)


def _relative_size_of(job: Job) -> float:
    """Return the pixels of a snapshot, map or frame as a multiple of ``REFERENCE_PIXELS``, at least 0.01; 1 for other jobs."""
    size = job.size if isinstance(job, SnapshotJob | MapJob | FrameJob) else None
    return 1.0 if size is None else max(size[0] * size[1] / REFERENCE_PIXELS, 0.01)
