"""Figures of a server, and the page on which Prometheus reads them.

Requests are counted as they are answered; gauges are read at the moment of the scrape. Counting is
done here because it happens in every turn of the event loop, where the counters of
`prometheus_client` would cost more than what they count; the text of the page is that library's.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import accumulate
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from prometheus_client import Metric

BUCKETS_S = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.25, 1.0, 5.0)
CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"


@dataclass(frozen=True)
class Figure:
    """One metric: its samples by labels.

    Attributes:
        name: as Prometheus wants it.
        kind: counter, gauge or histogram (of durations in seconds).
        help: one line.
        samples: (labels, value), all with the same names of labels.
    """

    name: str
    kind: Literal["counter", "gauge", "histogram"]
    help: str
    samples: tuple[tuple[Mapping[str, str], float | Histogram], ...]

    def metric(self) -> Metric:
        """The library's form of it."""
        from prometheus_client import Metric

        metric = Metric(self.name.removesuffix("_total"), self.help, self.kind)
        for labels, value in self.samples:
            parts = value.parts() if isinstance(value, Histogram) else [("", {}, value)]
            for suffix, bound, number in parts:
                metric.add_sample(self.name + suffix, {**labels, **bound}, number)
        return metric


def gauge(name: str, help: str, value: float) -> Figure:
    """One value that may go up and down."""
    return Figure(name, "gauge", help, (({}, value),))


def counter(name: str, help: str, value: float) -> Figure:
    """One value that only grows."""
    return Figure(name, "counter", help, (({}, value),))


class Histogram:
    """A histogram of durations."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BUCKETS_S) + 1)
        self._sum = 0.0

    def observe(self, seconds: float) -> None:
        """Count one duration [s]."""
        self._counts[bisect_left(BUCKETS_S, seconds)] += 1
        self._sum += seconds

    def parts(self) -> list[tuple[str, dict[str, str], float]]:
        """(suffix of the name, label, number): the count up to each bound, in all, the sum [s]."""
        counts = list(accumulate(self._counts))
        bounds = (*map(str, BUCKETS_S), "+Inf")
        buckets = [("_bucket", {"le": b}, n) for b, n in zip(bounds, counts, strict=True)]
        return [*buckets, ("_count", {}, counts[-1]), ("_sum", {}, self._sum)]


@dataclass
class Requests:
    """Counts and durations of requests, by method."""

    counts: dict[tuple[str, str], int] = field(default_factory=dict)
    times: dict[str, Histogram] = field(default_factory=dict)

    def observe(self, method: str, seconds: float, code: int | None) -> None:
        """A request has been answered; `code` of the error, None for a result."""
        key = (method, "ok" if code is None else str(code))
        self.counts[key] = self.counts.get(key, 0) + 1
        self.times.setdefault(method, Histogram()).observe(seconds)

    def figures(self) -> list[Figure]:
        """What has been counted."""
        counts = (({"method": m, "code": c}, n) for (m, c), n in sorted(self.counts.items()))
        times = (({"method": m}, times) for m, times in sorted(self.times.items()))
        return [
            Figure("flexdt_requests_total", "counter",
                   "Requests answered, by method and error code.", tuple(counts)),
            Figure("flexdt_request_seconds", "histogram",
                   "Time from a request's turn to its answer.", tuple(times)),
        ]  # fmt: skip


@dataclass(frozen=True)
class _Collected:
    """What `generate_latest` reads; a registry of the library would hold the same and more."""

    metrics: list[Metric]

    def collect(self) -> list[Metric]:
        return self.metrics


def render(figures: Iterable[Figure]) -> str:
    """The page in Prometheus's text format, with what the library knows of the process."""
    from prometheus_client import ProcessCollector, generate_latest

    process = ProcessCollector(registry=None).collect()
    page = _Collected([*(figure.metric() for figure in figures), *process])
    return generate_latest(page).decode()
