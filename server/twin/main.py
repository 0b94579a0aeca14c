"""`python -m flexdt.server.twin.main`: the twin server as a process.

Chooses every implementation, prints one JSON `ready` line on standard output, ends cleanly on
SIGTERM and SIGINT (a running scan's data set is then marked incomplete). Nothing else is
printed on standard output, and the hidden truth is never printed at all.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from flexdt.library import machines
from flexdt.runtime import access
from flexdt.runtime.log import LEVELS, set_up
from flexdt.runtime.process import (
    FAILED,
    OK,
    announce,
    first_of,
    run_process,
    stop_signal,
)
from flexdt.runtime.process_settings import TwinSettings
from flexdt.runtime.settings import parse

DEFAULT_SAMPLE = "gear"
"""On the stage of a new twin: without metal, so that a first scan has no streaks."""
SWITCH_S = 0.001
"""Longest time that a worker thread keeps the interpreter from the event loop [s]."""
PATIENCE_S = 10.0
"""Longest absence of the projector before a scan pauses [s]."""


async def run(options: TwinSettings) -> int:
    """Run the server until SIGTERM or SIGINT: lock the data directory, restore, serve,
    and end.

    The state of the last server is restored unless `fresh`. The option `sample` counts
    before the state's sample; without either, `DEFAULT_SAMPLE` is put on the stage. The
    memory limit is a quarter of the machine's memory unless stated. The line `ready` is
    printed once clients are served.

    Args:
        options: of the process.

    Returns:
        The exit code: OK, or FAILED if a service of the twin failed for good.

    Raises:
        AccessError, TwinError, OSError: options that do not hold, or an address or a
            directory that cannot be used.
    """
    from flexdt.runtime.files.directory import memory_bytes, open_data
    from flexdt.runtime.files.own_documents import lock_folder

    machine = machines.machine(options.machine)
    profile = machines.profile(options.profile, machine, options.machine)
    root = options.data.absolute()
    access.check_bind(options.host, access.read_token(options.token_file))
    directory = open_data(root)
    release = lock_folder(directory)

    from flexdt.runtime.http_pages import Requests, served_pages
    from flexdt.server.imaging.projections import load_truth
    from flexdt.server.imaging.projector_client import ProjectorClient
    from flexdt.server.imaging.projector_pool import ProjectorPool
    from flexdt.server.imaging.projector_watch import ProjectorWatch
    from flexdt.server.network.tcp import serve
    from flexdt.server.scans.jobs import fresh_seed
    from flexdt.server.twin.application import TwinSession, twin_pages
    from flexdt.server.twin.core import TwinServer
    from flexdt.server.twin.handlers.session_methods import document
    from flexdt.server.twin.message_reading import Reader
    from flexdt.twin.scanner.state import EMPTY_STAGE, Sample

    truth = None
    if options.truth is not None:
        truth = load_truth(options.truth, root)
    token = access.read_token(options.projector_token_file)
    secure = access.client_tls(options.projector_tls_ca)
    clients = [
        ProjectorClient(place.host, place.port, token=token, ssl=secure)
        for place in options.places
    ]
    projector = ProjectorPool(clients, PATIENCE_S)
    requests = Requests()
    reader = Reader()
    twin = TwinServer(
        machine,
        profile,
        projector,
        directory,
        truth=truth,
        speed_up=options.speed_up,
        seed=(lambda: None) if options.no_noise else fresh_seed,
        physics=options.physics,
        scatter=options.scatter,
        rays=options.rays,
        projectors=len(clients),
        memory_limit=options.memory_limit or memory_bytes() // 4,
        projector_room=projector.room,
        projector_watch=ProjectorWatch(clients),
        limits=access.with_limits(
            options.limit,
            access.TwinLimits(),
            access.limit_names(access.ConnectionLimits()),
        ),
    )
    sample = None if options.fresh else twin.recall()
    if sample is None or options.sample is not None:
        name = options.sample or DEFAULT_SAMPLE
        sample = Sample("" if name == EMPTY_STAGE else name)
    await twin.start(sample)
    server = await serve(
        lambda peer: TwinSession(twin, peer),
        options.host,
        options.port,
        token=access.read_token(options.token_file),
        ssl=access.server_tls(options.tls_cert, options.tls_key),
        limits=access.with_limits(
            options.limit,
            access.ConnectionLimits(),
            access.limit_names(access.TwinLimits()),
        ),
        observe=requests.observe,
        read=reader,
    )
    async with served_pages(
        twin_pages(twin, server, projector, requests), options
    ) as pages:
        twin.state()  # what the first answer needs is loaded before anybody waits for it
        document()
        stop = stop_signal()
        announce(
            "twin",
            {
                "host": options.host,
                "port": server.port,
                "machine": machine.name,
                "profile": profile.name,
                "data": str(root),
                **pages,
            },
        )
        await first_of(stop, twin.failed)
    await server.close()
    reader.close()
    await twin.stop()
    await projector.close()
    release()
    return FAILED if twin.failed.is_set() else OK


def main(argv: Sequence[str] | None = None) -> int:
    """Run the twin's process until it is stopped; return the exit code.

    `argv`: None: the command line's.
    """
    options = parse(TwinSettings, argv)
    set_up(level=LEVELS[options.log_level], apart=True)
    sys.setswitchinterval(SWITCH_S)
    return run_process(options, run)


if __name__ == "__main__":
    sys.exit(main())
