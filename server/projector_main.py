"""`python -m flexdt.server.projector_main`: the projector server as a process.

Compiles its kernels, then prints one JSON `ready` line on standard output. SIGTERM and SIGINT end
it cleanly. Only this module chooses the implementation and touches the process.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from flexdt.server.access import Limits, read_token, server_tls, with_limits
from flexdt.server.log import LEVELS, set_up
from flexdt.server.metrics import Requests
from flexdt.server.options import OneLine, watching_options
from flexdt.server.process import OK, announce, run_process, stop_signal

CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")
UNITS = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40}


def memory_size(text: str) -> int:
    """Bytes of "4GiB", "512M" or "1000000".

    Raises:
        ValueError: not a size.
    """
    match = re.fullmatch(r"(\d+\.?\d*)\s*([kmgt]?)i?b?", text.strip().lower())
    size = 0 if match is None else int(float(match[1]) * UNITS[match[2]])
    if size <= 0:
        raise ValueError(f"{text!r} is not a size such as 512M or 4GiB")
    return size


def default_memory() -> int:
    """Half of the memory there is: the machine's, or the container's where that is less [bytes]."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with contextlib.suppress(OSError, ValueError):  # no container, or none with a limit ("max")
        memory = min(memory, int(CGROUP_LIMIT.read_text(encoding="ascii")))
    return memory // 2


def parser() -> argparse.ArgumentParser:
    """The process's options."""
    p = OneLine(prog="flexdt projector", description=__doc__)
    p.add_argument("--host", default="127.0.0.1")
    p.add_argument("--port", type=int, default=55001, help="0: any free port")
    p.add_argument("--threads", type=int, help="of the projector; default: all cores")
    p.add_argument("--memory-limit", type=memory_size, metavar="SIZE", help="default: half of it")
    p.add_argument("--limit", action="append", default=[], metavar="NAME=VALUE",
                   help="of connections; may be given several times")  # fmt: skip
    watching_options(p)
    p.add_argument("--token-file", type=Path, help="clients must bring this file's token")
    p.add_argument("--tls-cert", type=Path)
    p.add_argument("--tls-key", type=Path)
    return p


async def run(options: argparse.Namespace) -> int:
    """Serve until SIGTERM or SIGINT; returns the exit code."""
    from flexdt.server.http import serve_http
    from flexdt.server.projector.health import projector_pages
    from flexdt.server.projector.kernels import backend, begin
    from flexdt.server.projector.service import serve_projector
    from flexdt.twin.projection.cpu import threads as all_threads

    threads = options.threads or all_threads()
    limit = options.memory_limit or default_memory()
    requests = Requests()
    server = await serve_projector(
        options.host,
        options.port,
        memory_limit=limit,
        begin=lambda: begin(threads),
        facts={"backend": backend(), "threads": threads},
        limits=with_limits(options.limit, Limits()),
        observe=requests.observe,
        token=read_token(options.token_file),
        ssl=server_tls(options.tls_cert, options.tls_key),
    )
    pages = None
    if options.http_port is not None:
        pages = await serve_http(
            projector_pages(server, requests),
            options.http_host,
            options.http_port,
            token=read_token(options.token_file),
        )
    stop = stop_signal()
    announce("projector", {
        "host": options.host, "port": server.port, "threads": threads, "memory_limit": limit,
        **({} if pages is None else {"http_port": pages.port}),
    })  # fmt: skip
    await stop.wait()
    if pages is not None:
        await pages.close()
    await server.close()
    return OK


def main(argv: Sequence[str] | None = None) -> int:
    """Run the process; returns its exit code."""
    options = parser().parse_args(argv)
    set_up(level=LEVELS[options.log_level], apart=True)
    return run_process("projector", options, run)


if __name__ == "__main__":
    sys.exit(main())
