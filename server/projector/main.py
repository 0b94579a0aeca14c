"""`python -m flexdt.server.projector.main`: the projector server as a process.

Compiles its kernels, then prints one JSON `ready` line on standard output. SIGTERM and
SIGINT end it cleanly. Only this module chooses the implementation and touches the
process.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from flexdt.runtime.access import ConnectionLimits, read_token, server_tls, with_limits
from flexdt.runtime.files.directory import memory_bytes
from flexdt.runtime.log import LEVELS, set_up
from flexdt.runtime.process import OK, announce, announce_bound, run_process, stop_signal
from flexdt.runtime.process_settings import ProjectorSettings
from flexdt.runtime.settings import parse


async def run(options: ProjectorSettings) -> int:
    """Serve until SIGTERM or SIGINT, then close the server.

    It uses all threads and half of the memory unless options say otherwise. The port is
    announced when it is bound, the addresses, threads and memory limit [bytes] when it is
    ready.

    Args:
        options: of the process.

    Returns:
        The exit code, always OK.

    Raises:
        AccessError, OSError: the address, the token or the TLS files cannot be used.
    """
    from flexdt.runtime.http_pages import Requests, served_pages
    from flexdt.server.projector.compute import backend, begin
    from flexdt.server.projector.service import projector_pages, serve_projector
    from flexdt.twin.projection.cpu import threads as all_threads

    threads = options.threads or all_threads()
    limit = options.memory_limit or memory_bytes() // 2
    requests = Requests()
    server = await serve_projector(
        options.host,
        options.port,
        memory_limit=limit,
        begin=lambda: begin(threads),
        bound=lambda port: announce_bound("projector", options.host, port),
        facts={"backend": backend(), "threads": threads},
        limits=with_limits(options.limit, ConnectionLimits()),
        observe=requests.observe,
        token=read_token(options.token_file),
        ssl=server_tls(options.tls_cert, options.tls_key),
    )
    async with served_pages(projector_pages(server, requests), options) as pages:
        stop = stop_signal()
        announce(
            "projector",
            {
                "host": options.host,
                "port": server.port,
                "threads": threads,
                "memory_limit": limit,
                **pages,
            },
        )
        await stop.wait()
    await server.close()
    return OK


def main(argv: Sequence[str] | None = None) -> int:
    """Run the projector's process until it is stopped; return its exit code."""
    options = parse(ProjectorSettings, argv)
    set_up(level=LEVELS[options.log_level], apart=True)
    return run_process(options, run)


if __name__ == "__main__":
    sys.exit(main())
