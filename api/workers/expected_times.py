"""How long a job is expected to take, learnt from those of its kind that were done: what waits is ordered by it."""

from __future__ import annotations

from collections.abc import Hashable

from skugga.api.request import ProductRequest
from skugga.api.workers.jobs import (
    BlockJob,
    DescribedPlanJob,
    DescriptorJob,
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

FIRST_GUESS_S: dict[type, float] = {
    BlockJob: 0.5, PlanJob: 0.5, DescribedPlanJob: 0.1, DescriptorJob: 0.5, SnapshotJob: 2.5, MapJob: 2.5,
    PointJob: 0.1, PointsJob: 1.0, FilmCheckJob: 0.5, FrameJob: 2.5,
}  # fmt: skip
"""Seconds of a job of which nothing is known yet, of a snapshot, map or frame of ``USUAL_PX``: with a software rasteriser on two
cores.
"""

FIRST_GUESS_OF_DAYS_S = 3.0
"""The same of a block of tiles of many suns."""

USUAL_PX = 1280 * 1024

NEWEST_SHARE = 0.3
"""Share of the newest time in the mean."""

LIGHT_S = 3.0
"""Jobs that are known to take no longer are light."""


class ExpectedTimes:
    """Means of how long jobs took: of snapshots, maps and frames per pixel.

    They are kept by kind of job, and more finely by what is drawn (``_variant_of``). A variant that was not seen yet is expected to
    take as long as its kind.
    """

    def __init__(self) -> None:
        self._seconds: Cache[float] = Cache("skugga.api.workers.expected_times", "process", MIB, lambda _: 512)

    def of(self, job: Job) -> float:
        """Seconds that a job is expected to take."""
        known = self._known(job)
        return (_first_guess_s(job) if known is None else known) * _size_of(job)

    def is_light(self, job: Job) -> bool:
        """Whether jobs of its kind were done before, and took little."""
        known = self._known(job)
        return known is not None and known * _size_of(job) <= LIGHT_S

    def learn(self, job: Job, seconds: float) -> None:
        """A job took so long."""
        took = seconds / _size_of(job)
        for key in _keys_of(job):
            known = self._seconds.get(key)
            self._seconds.put(key, value=took if isinstance(known, Missing) else known + NEWEST_SHARE * (took - known))

    def _known(self, job: Job) -> float | None:
        for key in _keys_of(job):
            known = self._seconds.get(key)
            if not isinstance(known, Missing):
                return known
        return None


def _first_guess_s(job: Job) -> float:
    return FIRST_GUESS_OF_DAYS_S if isinstance(job, BlockJob) and _is_of_days(job) else FIRST_GUESS_S[type(job)]


def _is_of_days(job: Job) -> bool:
    """Whether a job computes a product of whole dates."""
    return isinstance(job.request, ProductRequest) and job.request.record.when == "days"


def _keys_of(job: Job) -> tuple[Hashable, Hashable]:
    """What times of a job are kept by, the finest first."""
    kind = kind_of_job(job)
    return (kind, _variant_of(job)), kind


def _variant_of(job: Job) -> Hashable:
    """What of a job changes its time, besides its kind: the product, the scale, and how many bytes are encoded."""
    product = job.request.product if isinstance(job.request, ProductRequest) else None
    return product, *(getattr(job, name, None) for name in ("matrix_set", "zoom", "format", "tiles"))


def kind_of_job(job: Job) -> Hashable:
    """Jobs of one kind take about as long: those of a version of a level for which the same is asked of the shadows."""
    level = None if isinstance(job, DescribedPlanJob) else (str(job.level.path), job.level.version)
    return type(job).__name__, level, job.request.overrides.asked, getattr(job, "view", None), _is_of_days(job)


def _size_of(job: Job) -> float:
    """How much of what is known of its kind a job is."""
    size = job.size if isinstance(job, SnapshotJob | MapJob | FrameJob) else None
    return 1.0 if size is None else max(size[0] * size[1] / USUAL_PX, 0.01)
