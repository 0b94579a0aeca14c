"""How a twin is, for machines that watch.

What the scanner does in detail is in `state.get`.
"""

from __future__ import annotations

from collections import Counter
from typing import get_args

from flexdt.protocol.state_model import JobPhase
from flexdt.runtime.files.directory import free_bytes
from flexdt.runtime.http_pages import Pages, watching_pages
from flexdt.runtime.metrics import Figure, Requests, counter, gauge
from flexdt.server.imaging.projector_client import ProjectorClient
from flexdt.server.imaging.projector_pool import ProjectorPool
from flexdt.server.network.tcp import TcpServer
from flexdt.server.twin.core import TwinServer
from flexdt.server.twin.hub import Topic


def twin_pages(
    twin: TwinServer,
    server: TcpServer,
    projector: ProjectorClient | ProjectorPool,
    requests: Requests,
) -> Pages:
    """The pages of a twin server that runs."""

    def health() -> dict[str, object]:
        job = twin.jobs.current
        return {
            "server": f"flexdt {twin.version}",
            "projector": "connected" if projector.connected else "not connected",
            "job": None if job is None else {"job": job.id, "state": job.phase},
        }

    return watching_pages(
        health, lambda: _figures(twin, server, projector), requests, failed=twin.failed.is_set
    )


def _figures(
    twin: TwinServer, server: TcpServer, projector: ProjectorClient | ProjectorPool
) -> list[Figure]:
    phases = Counter(job.phase for job in twin.jobs.all())
    by_phase = tuple(({"state": p}, float(phases[p])) for p in get_args(JobPhase))
    events = tuple(({"topic": t}, float(twin.hub.count(t))) for t in get_args(Topic))
    safety = tuple(
        ({"state": s}, float(twin.scanner.safety.state == s))
        for s in ("ready", "blocked", "estopped")
    )
    views = projector.views if isinstance(projector, ProjectorPool) else {}
    by_projector = tuple(({"projector": name}, float(n)) for name, n in views.items())
    factor = twin.clock.real_time_factor
    free = [room for room in (free_bytes(twin.root),) if room is not None]
    return [
        gauge("flexdt_connections", "Clients connected.", len(server.links)),
        counter("flexdt_connections_total", "Clients that ever connected.", server.opened),
        Figure("flexdt_events_total", "counter", "Events published, by topic.", events),
        Figure("flexdt_jobs", "gauge", "Jobs known, by state.", by_phase),
        counter("flexdt_frames_total", "Projections of scans made.", twin.jobs.frames_made),
        Figure("flexdt_safety", "gauge", "1 for the safety state in force.", safety),
        gauge("flexdt_clock_seconds", "The twin's clock.", twin.clock.now()),
        gauge("flexdt_real_time_factor", "Twin seconds a second.", factor or 0.0),
        gauge("flexdt_projector_connected", "Whether there is one.", float(projector.connected)),
        Figure("flexdt_projector_views_total", "counter", "Views by projector.", by_projector),
        *(gauge("flexdt_data_free_bytes", "Room on the data disk.", room) for room in free),
    ]
