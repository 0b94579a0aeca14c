"""Figures of a server in Prometheus's text format.

Requests are counted as they are answered; gauges are read at the moment of the scrape.
"""

from __future__ import annotations

import os
import time
from bisect import bisect_left
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

BUCKETS_S = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.25, 1.0, 5.0)
CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"


@dataclass(frozen=True)
class Figure:
    """One metric: its samples by labels.

    Attributes:
        name: as Prometheus wants it.
        kind: counter or gauge.
        help: one line.
        samples: (labels, value).
    """

    name: str
    kind: Literal["counter", "gauge"]
    help: str
    samples: tuple[tuple[Mapping[str, str], float], ...]


def gauge(name: str, help: str, value: float, **labels: str) -> Figure:
    """One value that may go up and down."""
    return Figure(name, "gauge", help, ((labels, value),))


def counter(name: str, help: str, value: float, **labels: str) -> Figure:
    """One value that only grows."""
    return Figure(name, "counter", help, ((labels, value),))


class Histogram:
    """A histogram of durations."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BUCKETS_S) + 1)
        self._sum = 0.0

    def observe(self, seconds: float) -> None:
        """Count one duration [s]."""
        self._counts[bisect_left(BUCKETS_S, seconds)] += 1
        self._sum += seconds

    def lines(self, name: str, labels: Mapping[str, str]) -> Iterable[str]:
        """The samples as text, without HELP and TYPE."""
        total = 0
        for bound, count in zip((*map(str, BUCKETS_S), "+Inf"), self._counts, strict=True):
            total += count
            yield f"{name}_bucket{_labels({**labels, 'le': bound})} {total}"
        yield f"{name}_sum{_labels(labels)} {self._sum!r}"
        yield f"{name}_count{_labels(labels)} {total}"


def histogram(name: str, help: str, each: Iterable[tuple[Mapping[str, str], Histogram]]) -> Lines:
    """Histograms by labels, as text."""
    yield f"# HELP {name} {help}"
    yield f"# TYPE {name} histogram"
    for labels, times in each:
        yield from times.lines(name, labels)


Lines = Iterable[str]


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

    def lines(self) -> Lines:
        """The counts and histograms as text."""
        name = "flexdt_requests_total"
        yield f"# HELP {name} Requests answered, by method and error code."
        yield f"# TYPE {name} counter"
        for (method, code), n in sorted(self.counts.items()):
            yield f"{name}{_labels({'method': method, 'code': code})} {n}"
        yield from histogram(
            "flexdt_request_seconds",
            "Time from a request's turn to its answer.",
            (({"method": method}, times) for method, times in sorted(self.times.items())),
        )


def render(requests: Requests, figures: Iterable[Figure], more: Lines = ()) -> str:
    """The page; `more` are lines as they are."""
    out = [*requests.lines(), *more]
    for figure in figures:
        out.append(f"# HELP {figure.name} {figure.help}")
        out.append(f"# TYPE {figure.name} {figure.kind}")
        out += [f"{figure.name}{_labels(labels)} {value!r}" for labels, value in figure.samples]
    return "\n".join(out) + "\n"


def process_figures(started: float) -> list[Figure]:
    """The figures that Prometheus's own clients report of a process, where the system has them.

    Args:
        started: when the process began [s since 1970].
    """
    used = os.times()
    out = [
        counter("process_cpu_seconds_total", "CPU time used.", used.user + used.system),
        gauge("process_start_time_seconds", "When the process began.", started),
    ]
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        files = len(os.listdir("/proc/self/fd"))
    except (OSError, ValueError, IndexError):
        return out
    size = pages * os.sysconf("SC_PAGE_SIZE")
    out.append(gauge("process_resident_memory_bytes", "Memory in use.", size))
    out.append(gauge("process_open_fds", "Open descriptors.", files))
    return out


def since_1970() -> float:
    """The current time [s since 1970]."""
    return time.time()


def _labels(labels: Mapping[str, str]) -> str:
    if not labels:
        return ""
    return "{" + ",".join(f'{k}="{_escaped(v)}"' for k, v in labels.items()) + "}"


def _escaped(value: str) -> str:
    return value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
