"""Figures of a server in Prometheus's text format.

Requests are counted as they are answered; gauges come from whoever knows them, at the moment of the
scrape. It refuses to keep a history.
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


@dataclass
class Requests:
    """Counts and durations of requests, by method."""

    counts: dict[tuple[str, str], int] = field(default_factory=dict)
    times: dict[str, list[float]] = field(default_factory=dict)

    def observe(self, method: str, seconds: float, code: int | None) -> None:
        """A request has been answered; `code` of the error, None for a result."""
        key = (method, "ok" if code is None else str(code))
        self.counts[key] = self.counts.get(key, 0) + 1
        times = self.times.setdefault(method, [0.0] * (len(BUCKETS_S) + 2))
        times[bisect_left(BUCKETS_S, seconds)] += 1.0
        times[-1] += seconds

    def lines(self) -> Iterable[str]:
        """As text."""
        name = "flexdt_requests_total"
        yield f"# HELP {name} Requests answered, by method and error code."
        yield f"# TYPE {name} counter"
        for (method, code), n in sorted(self.counts.items()):
            yield f"{name}{_labels({'method': method, 'code': code})} {n}"
        name = "flexdt_request_seconds"
        yield f"# HELP {name} Time from a request's turn to its answer."
        yield f"# TYPE {name} histogram"
        for method, times in sorted(self.times.items()):
            total = 0.0
            for bound, count in zip((*map(str, BUCKETS_S), "+Inf"), times[:-1], strict=True):
                total += count
                yield f"{name}_bucket{_labels({'method': method, 'le': bound})} {total:g}"
            yield f"{name}_sum{_labels({'method': method})} {times[-1]!r}"
            yield f"{name}_count{_labels({'method': method})} {total:g}"


def render(requests: Requests, figures: Iterable[Figure]) -> str:
    """The page."""
    out = list(requests.lines())
    for figure in figures:
        out.append(f"# HELP {figure.name} {figure.help}")
        out.append(f"# TYPE {figure.name} {figure.kind}")
        out += [f"{figure.name}{_labels(labels)} {value!r}" for labels, value in figure.samples]
    return "\n".join(out) + "\n"


def process_figures(started: float) -> list[Figure]:
    """What Prometheus's own clients tell of a process, where the system tells it.

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
    """The date of now [s]."""
    return time.time()


def _labels(labels: Mapping[str, str]) -> str:
    if not labels:
        return ""
    return "{" + ",".join(f'{k}="{_escaped(v)}"' for k, v in labels.items()) + "}"


def _escaped(value: str) -> str:
    return value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
