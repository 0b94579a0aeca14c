"""How a twin is, for machines that watch: the pages `/healthz` and `/metrics`.

It refuses to tell what the scanner does in detail: that is `state.get`'s business.
"""

from __future__ import annotations

import json
from collections import Counter
from http import HTTPStatus
from typing import get_args

from flexdt.protocol.state import JobPhase
from flexdt.server.atomic import free_bytes
from flexdt.server.core import TwinServer
from flexdt.server.http import Page, Pages
from flexdt.server.hub import Topic
from flexdt.server.log import dropped
from flexdt.server.metrics import (
    CONTENT_TYPE,
    Figure,
    Requests,
    counter,
    gauge,
    process_figures,
    render,
    since_1970,
)
from flexdt.server.projector_client import ProjectorClient
from flexdt.server.tcp import TcpServer


def twin_pages(
    twin: TwinServer, server: TcpServer, projector: ProjectorClient, requests: Requests
) -> Pages:
    """The pages of a twin server that runs."""
    started = since_1970()

    def healthz() -> Page:
        failed = twin.failed.is_set()
        job = twin.jobs.current
        document = {
            "status": "failed" if failed else "ok",
            "server": f"flexdt {twin.version}",
            "projector": "connected" if projector.connected else "not connected",
            "job": None if job is None else {"job": job.id, "state": job.phase},
        }
        status = HTTPStatus.SERVICE_UNAVAILABLE if failed else HTTPStatus.OK
        return Page(json.dumps(document) + "\n", status)

    def metrics() -> Page:
        figures = [*_figures(twin, server, projector), *process_figures(started)]
        return Page(render(requests, figures), content_type=CONTENT_TYPE)

    return {"/healthz": healthz, "/metrics": metrics}


def _figures(twin: TwinServer, server: TcpServer, projector: ProjectorClient) -> list[Figure]:
    phases = Counter(job.phase for job in twin.jobs.all())
    by_phase = tuple(({"state": p}, float(phases[p])) for p in get_args(JobPhase))
    events = tuple(({"topic": t}, float(twin.hub.count(t))) for t in get_args(Topic))
    safety = tuple(
        ({"state": s}, float(twin.scanner.safety.state == s))
        for s in ("ready", "blocked", "estopped")
    )
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
        *(gauge("flexdt_data_free_bytes", "Room on the data disk.", room) for room in free),
        counter("flexdt_log_dropped_total", "Log lines nobody took in time.", dropped()),
    ]
