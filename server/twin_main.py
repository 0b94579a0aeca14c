"""`python -m flexdt.server.twin_main`: the twin server as a process.

Chooses every implementation, prints one JSON `ready` line on standard output, ends cleanly on
SIGTERM and SIGINT (a running scan's data set is then marked incomplete). It refuses to print
anything else there, and never the hidden truth.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections.abc import Sequence
from pathlib import Path

from flexdt.server.access import (
    Limits,
    TwinLimits,
    check_bind,
    client_tls,
    limit_names,
    read_token,
    server_tls,
    with_limits,
)
from flexdt.server.clock import SpeedUp, check_speed_up
from flexdt.server.log import LEVELS, set_up
from flexdt.server.options import OneLine, address, watching_options
from flexdt.server.process import OK, announce, run_process, stop_signal
from flexdt.server.supervisor import Address
from flexdt.twin.machine import (
    Machine,
    Profile,
    builtin_machine,
    builtin_machines,
    builtin_profile,
    builtin_profiles,
    default_profile,
    parse_machine,
    parse_profile,
)

LIMITS = "of connections, jobs, uploads, disk or control; may be given several times"
FAILED = 1
PHYSICS = ("ideal", "mono", "poly")
DEFAULT_SAMPLE = "lego"
SWITCH_S = 0.001
"""How long a worker thread may keep the interpreter while the event loop wants it [s]."""
PATIENCE_S = 10.0
"""How long the projector may be away before a scan pauses [s]."""


def parser() -> argparse.ArgumentParser:
    """The process's options."""
    p = OneLine(prog="flexdt twin", description=__doc__)
    p.add_argument("--host", default="127.0.0.1")
    p.add_argument("--port", type=int, default=55000, help="0: any free port")
    p.add_argument("--projector", type=address, default=Address("127.0.0.1", 55001),
                   metavar="HOST:PORT")  # fmt: skip
    p.add_argument("--projector-token-file", type=Path)
    p.add_argument("--projector-tls-ca", type=Path, metavar="FILE",
                   help="speak TLS with the projector; trust this certificate")  # fmt: skip
    p.add_argument("--data", type=Path, default=Path("data"), help="data directory")
    p.add_argument("--machine", default="flexray", help="a shipped machine's name, or a TOML file")
    p.add_argument("--profile", help="a shipped profile's name, or a TOML file")
    p.add_argument("--truth", type=Path, help="hidden misalignment, TOML; outside the data")
    p.add_argument("--speed-up", default="1", help='a number or "max"')
    p.add_argument("--sample", help='on the stage at start, or "empty"; else the last one')
    p.add_argument("--fresh", action="store_true", help="forget where the last server left off")
    p.add_argument("--limit", action="append", default=[], metavar="NAME=VALUE", help=LIMITS)
    p.add_argument(
        "--physics", choices=PHYSICS, default="ideal", help="how images are made (docs/physics.md)"
    )
    p.add_argument("--no-noise", action="store_true", help="counts are expectations")
    watching_options(p)
    p.add_argument("--token-file", type=Path, help="clients must bring this file's token")
    p.add_argument("--tls-cert", type=Path)
    p.add_argument("--tls-key", type=Path)
    return p


def find_machine(name: str) -> Machine:
    """A machine by shipped name or file.

    Raises:
        TwinError: neither, or a file that does not hold.
    """
    if name in builtin_machines() or not Path(name).exists():
        return builtin_machine(name)
    return parse_machine(Path(name).read_text(encoding="utf-8"), name)


def find_profile(name: str | None, machine: Machine, file: str) -> Profile:
    """A profile by shipped name or file; the default of the machine from `file` if None.

    Raises:
        TwinError: neither, or a file that does not hold.
    """
    chosen = machine.default_profile if name is None else name
    if chosen in builtin_profiles() or not Path(chosen).exists():
        return default_profile(machine, file) if name is None else builtin_profile(chosen)
    return parse_profile(Path(chosen).read_text(encoding="utf-8"), chosen)


def speed_up_of(text: str) -> SpeedUp:
    """The clock's speed-up.

    Raises:
        LimitError: not a positive number and not "max".
    """
    try:
        return check_speed_up(text if text == "max" else float(text))
    except ValueError:
        return check_speed_up(text)


async def run(options: argparse.Namespace) -> int:
    """Serve until SIGTERM or SIGINT; returns the exit code."""
    from flexdt.server.atomic import probe
    from flexdt.server.core import TwinServer
    from flexdt.server.health import twin_pages
    from flexdt.server.http import serve_http
    from flexdt.server.jobs import fresh_seed
    from flexdt.server.lock import FolderLock
    from flexdt.server.metrics import Requests
    from flexdt.server.projector_client import ProjectorClient
    from flexdt.server.reading import Reader
    from flexdt.server.tcp import serve
    from flexdt.server.truth import load_truth
    from flexdt.server.twin_app import TwinApp
    from flexdt.twin.state import Sample

    machine = find_machine(options.machine)
    profile = find_profile(options.profile, machine, options.machine)
    root = options.data.absolute()
    check_bind(options.host, read_token(options.token_file))
    probe(root)
    lock = FolderLock(root)
    truth = None if options.truth is None else load_truth(options.truth, root)
    token = read_token(options.projector_token_file)
    secure = client_tls(options.projector_tls_ca)
    projector = ProjectorClient(
        options.projector.host, options.projector.port, token=token, patience_s=PATIENCE_S,
        ssl=secure,
    )  # fmt: skip
    requests, reader = Requests(), Reader()
    twin = TwinServer(
        machine,
        profile,
        projector,
        root,
        truth=truth,
        speed_up=speed_up_of(options.speed_up),
        seed=(lambda: None) if options.no_noise else fresh_seed,
        physics=options.physics,
        limits=with_limits(options.limit, TwinLimits(), limit_names(Limits())),
    )
    sample = None if options.fresh else twin.recall()
    if sample is None or options.sample is not None:
        wish = options.sample or DEFAULT_SAMPLE
        sample = Sample("" if wish == "empty" else wish)
    await twin.start(sample)
    server = await serve(
        TwinApp(twin),
        options.host,
        options.port,
        token=read_token(options.token_file),
        ssl=server_tls(options.tls_cert, options.tls_key),
        limits=with_limits(options.limit, Limits(), limit_names(TwinLimits())),
        observe=requests.observe,
        read=reader,
    )
    pages = None
    if options.http_port is not None:
        pages = await serve_http(
            twin_pages(twin, server, projector, requests),
            options.http_host,
            options.http_port,
            token=read_token(options.token_file),
        )
    twin.state()  # what the first answer needs is loaded before anybody waits for it
    stop = stop_signal()
    announce("twin", {
        "host": options.host, "port": server.port, "machine": machine.name,
        "profile": profile.name, "data": str(root),
        **({} if pages is None else {"http_port": pages.port}),
    })  # fmt: skip
    waits = [asyncio.create_task(e.wait()) for e in (stop, twin.failed)]
    await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    for wait in waits:
        wait.cancel()
    if pages is not None:
        await pages.close()
    await server.close()
    reader.close()
    await twin.stop()
    await projector.close()
    lock.release()
    return FAILED if twin.failed.is_set() else OK


def main(argv: Sequence[str] | None = None) -> int:
    """Run the process; returns its exit code."""
    options = parser().parse_args(argv)
    set_up(level=LEVELS[options.log_level], apart=True)
    sys.setswitchinterval(SWITCH_S)
    return run_process("twin", options, run)


if __name__ == "__main__":
    sys.exit(main())
