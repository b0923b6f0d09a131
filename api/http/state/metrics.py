"""Prometheus metrics: requests by route, queue and render processes, caches, and render passes by algorithm."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.exposition import generate_latest
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from skugga.api.workers.jobs import BlockTiles, Snapshot
from skugga.api.workers.process_life import open_descriptors, resident_bytes

if TYPE_CHECKING:
    from skugga.api.animations.animations import Animations
    from skugga.api.http.state.encoded_tiles import EncodedTiles
    from skugga.api.workers.pool import Pool

METRICS_MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"

REQUEST_BUCKETS_S = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 60.0)
"""Upper bounds in seconds of the histogram of requests."""
PASS_BUCKETS_S = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
"""Upper bounds in seconds of the histogram of render passes."""

MAX_PASS_LABELS = 200
"""Maximum number of label pairs of algorithms and render pass in metrics. Further pairs are counted as ``other``.

Without a limit, requests could create any number of pairs by combining algorithms."""


class ServiceMetrics:
    """The metrics of an application, in a registry of their own. Use them from one event loop."""

    def __init__(self, pool: Pool, tiles: EncodedTiles, animations: Animations) -> None:
        self.registry = CollectorRegistry()
        self._known_passes: set[tuple[str, str]] = set()
        self.requests = Counter("skugga_requests", "Requests answered.", ("route", "method", "status"), registry=self.registry)
        self.request_seconds = Histogram(
            "skugga_request_seconds", "Time to the end of an answer.", ("route",), registry=self.registry, buckets=REQUEST_BUCKETS_S
        )
        self.in_progress = Gauge("skugga_requests_in_progress", "Requests in progress.", registry=self.registry)
        self.pass_seconds = Histogram(
            "skugga_pass_seconds", "Time of a pass of a drawn block or snapshot.", ("algorithm", "stage"),
            registry=self.registry, buckets=PASS_BUCKETS_S,
        )  # fmt: skip
        self.clipped_reaches = Counter(
            "skugga_reach_clipped",
            "Drawn blocks and snapshots for which the data ended before the casters.",
            registry=self.registry,
        )
        self.registry.register(_ServiceCollector(pool, tiles, animations))
        pool.on_picture_finished = self.record_passes

    def record_passes(self, picture: BlockTiles | Snapshot) -> None:
        """Record the milliseconds of each render pass of a block or snapshot, and whether its caster reach was clipped."""
        for name, ms in (*picture.passes, ("encode", picture.encode_ms)):
            pair = picture.headline, name
            if pair not in self._known_passes and len(self._known_passes) >= MAX_PASS_LABELS:
                pair = "other", "other"
            self._known_passes.add(pair)
            self.pass_seconds.labels(*pair).observe(ms / 1000.0)
        if picture.reach_clipped:
            self.clipped_reaches.inc()

    def text(self) -> bytes:
        """Return all metrics in Prometheus' text format."""
        return generate_latest(self.registry)

    def series_names(self) -> set[str]:
        """Return the names of all time series as Prometheus queries use them, with endings such as ``_total``."""
        sample_names = {sample.name for family in self.registry.collect() for sample in family.samples}
        return sample_names | {name for family in self.registry.collect() for name in _names_of(family)}


class _ServiceCollector(Collector):
    """A collector of metrics that are read from the service at each scrape."""

    def __init__(self, pool: Pool, tiles: EncodedTiles, animations: Animations) -> None:
        self._pool, self._tiles, self._animations = pool, tiles, animations

    def collect(self) -> Iterable[Metric]:
        pool, counters, tiles = self._pool, self._pool.counters, self._tiles
        yield GaugeMetricFamily("skugga_ready", "Whether a render process is ready.", float(pool.is_ready))
        yield GaugeMetricFamily("skugga_jobs_waiting", "Jobs in the queue.", pool.queued_count)
        yield GaugeMetricFamily("skugga_jobs_running", "Jobs in render processes.", pool.running_count)
        jobs = CounterMetricFamily("skugga_jobs", "Jobs by how they ended.", labels=("outcome",))
        for outcome in ("answered", "failed", "abandoned", "refused", "expired", "timed_out", "retried"):
            jobs.add_metric([outcome], getattr(counters, f"jobs_{outcome}"))
        yield jobs
        yield GaugeMetricFamily("skugga_render_processes", "Render processes that are ready.", len(pool.ready_pids))
        yield CounterMetricFamily("skugga_render_process_starts", "Render processes that became ready.", counters.processes_started)
        memory = GaugeMetricFamily("skugga_process_memory_bytes", "Resident memory.", labels=("process",))
        memory.add_metric(["service"], resident_bytes())
        for number, pid in enumerate(sorted(pool.ready_pids)):
            memory.add_metric([f"render {number}"], resident_bytes(pid))
        yield memory
        yield GaugeMetricFamily("skugga_open_descriptors", "File descriptors of the service's process.", open_descriptors())
        cache_bytes = GaugeMetricFamily("skugga_cache_bytes", "Bytes of cached entries.", labels=("cache",))
        cache_bytes.add_metric(["tiles"], tiles.cached_bytes)
        cache_bytes.add_metric(["blocks"], pool.cached_bytes)
        cache_bytes.add_metric(["films"], self._animations.cached_bytes)
        yield cache_bytes
        animations = GaugeMetricFamily("skugga_animations", "Animations by status.", labels=("status",))
        for status, count in self._animations.counts.items():
            animations.add_metric([status], count)
        yield animations
        ended = CounterMetricFamily("skugga_animations_ended", "Animations by how they ended.", labels=("status",))
        for status, count in self._animations.ended_counts.items():
            ended.add_metric([status], count)
        yield ended
        lookups = CounterMetricFamily("skugga_cache_requests", "Lookups of tiles in the cache.", labels=("cache", "result"))
        lookups.add_metric(["tiles", "hit"], tiles.hits)
        lookups.add_metric(["tiles", "miss"], tiles.misses)
        yield lookups


def _names_of(family: Metric) -> Iterator[str]:
    """Yield the names of the time series of a family of metrics."""
    endings = {"counter": ("_total",), "histogram": ("_bucket", "_sum", "_count")}
    yield from (family.name + ending for ending in endings.get(family.type, ("",)))
