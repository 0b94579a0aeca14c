"""`python -m flexdt.server.up`: projector, twin, viewer, gateway as processes of one supervisor.

Prints one JSON `ready` line with the addresses on standard output; Ctrl-C, SIGTERM or (under
`child`) the end of its parent stops all. The projector is internal and listens on the loopback
only; `--host` is the twin's and the viewer's. It refuses to know what the options mean to the
processes.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import socket
import sys
from collections.abc import Mapping, Sequence
from typing import TextIO

from flexdt.server.access import ViewerLimits, limit_names
from flexdt.server.options import OneLine
from flexdt.server.process import REFUSED
from flexdt.server.supervisor import (
    Address,
    Addresses,
    Service,
    ServiceError,
    Supervisor,
    until_signalled,
)

LOOPBACK = "127.0.0.1"
COMPILING = "its first start after installation compiles the kernels, which takes a minute or two"


def parser() -> argparse.ArgumentParser:
    """The options of `flexdt up`."""
    p = OneLine(prog="flexdt up", description=__doc__)
    p.add_argument("--host", default=LOOPBACK)
    p.add_argument("--port", type=int, default=55000)
    p.add_argument("--projector-port", type=int, default=55001)
    p.add_argument("--projector-memory", metavar="SIZE", help="default: half of the machine's")
    p.add_argument("--viewer-port", type=int, default=8080)
    p.add_argument("--no-viewer", action="store_true")
    p.add_argument("--gateway-port", type=int, help="Acquila's interface there and on the next")
    for name in TWIN_OPTIONS:
        p.add_argument(f"--{name}")
    p.add_argument("--fresh", action="store_true", help="the twin forgets where it left off")
    p.add_argument("--limit", action="append", default=[], metavar="NAME=VALUE")
    return p


TWIN_OPTIONS = ("data", "machine", "profile", "truth", "sample", "speed-up", "physics",
                "token-file", "tls-cert", "tls-key", "http-port", "log-level")  # fmt: skip
"""Options handed on to the twin as they are."""

VIEWER_OPTIONS = {"machine": "machine", "profile": "profile", "data": "data",
                  "token-file": "token-file", "tls-cert": "tls-cert", "tls-key": "tls-key",
                  "twin-cert": "tls-cert", "log-level": "log-level"}  # fmt: skip
"""Option of the viewer -> option of `flexdt up` that it takes its value from."""

GATEWAY_OPTIONS = {"machine": "machine", "profile": "profile", "data": "data",
                   "token-file": "token-file", "twin-cert": "tls-cert"}  # fmt: skip
"""The same for the gateway."""


def services(options: argparse.Namespace) -> tuple[Service, ...]:
    """In starting order: the twin needs the projector's address, the viewer the twin's."""
    for_twin = _words(options, {name: name for name in TWIN_OPTIONS})
    for_viewer = _words(options, VIEWER_OPTIONS)
    for limit in options.limit:
        of_viewer = limit.partition("=")[0] in limit_names(ViewerLimits())
        (for_viewer if of_viewer else for_twin).extend(("--limit", limit))

    def projector(known: Addresses) -> Sequence[str]:
        port = known["projector"].port if "projector" in known else options.projector_port
        most = _words(options, {"memory-limit": "projector-memory"})
        return ("flexdt.server.projector_main", "--host", LOOPBACK, "--port", str(port), *most)

    def twin(known: Addresses) -> Sequence[str]:
        again = "twin" in known
        port = known["twin"].port if again else options.port
        # Started again it goes on from where it was, whatever the first one was told.
        fresh = ["--fresh"] if options.fresh and not again else []
        return ("flexdt.server.twin_main", "--host", options.host, "--port", str(port),
                "--projector", str(known["projector"]), *for_twin, *fresh)  # fmt: skip

    def viewer(known: Addresses) -> Sequence[str]:
        port = known["viewer"].port if "viewer" in known else options.viewer_port
        return ("flexdt.server.viewer_main", "--host", options.host, "--port", str(port),
                "--twin", str(known["twin"]), *for_viewer)  # fmt: skip

    def gateway(known: Addresses) -> Sequence[str]:
        port = known["gateway"].port if "gateway" in known else options.gateway_port
        return ("flexdt.server.gateway_main", "--port", str(port), "--server", str(known["twin"]),
                *_words(options, GATEWAY_OPTIONS))  # fmt: skip

    made = [
        Service("projector", projector, slow=COMPILING),
        Service("twin", twin),
    ]
    if not options.no_viewer:
        made.append(Service("viewer", viewer))
    if options.gateway_port is not None:
        made.append(Service("gateway", gateway))
    return tuple(made)


def _words(options: argparse.Namespace, sources: Mapping[str, str]) -> list[str]:
    given = {name: getattr(options, of.replace("-", "_")) for name, of in sources.items()}
    return [word for name, value in given.items() if value is not None
            for word in (f"--{name}", str(value))]  # fmt: skip


def port_problem(host: str, port: int) -> str | None:
    """Why `port` cannot be listened on, or None; port 0 means any free one."""
    if port == 0:
        return None
    try:
        family, kind, _, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        return (
            f"cannot listen on {Address(host, port)}: {error.strerror}; choose another port, or 0 "
            "for any free one"
        )
    return None


def ready_line(addresses: Addresses, *, secure: bool = False) -> str:
    """The supervisor's `ready` line: the twin's address, and every process's by name."""
    twin = addresses["twin"]
    document: dict[str, object] = {"ready": "up", "host": twin.host, "port": twin.port}
    for name, address in addresses.items():
        entry: dict[str, object] = {"host": address.host, "port": address.port}
        if name == "viewer":
            entry["url"] = f"{'https' if secure else 'http'}://{address}/"
        if name == "gateway":
            entry["inbound"] = address.port + 1
        document[name] = entry
    return json.dumps(document)


def main(argv: Sequence[str] | None = None) -> int:
    """Run until stopped; returns the exit code."""
    options = parser().parse_args(argv)
    secure = options.tls_cert is not None
    wanted = [(options.host, options.port), (LOOPBACK, options.projector_port)]
    if not options.no_viewer:
        wanted.append((options.host, options.viewer_port))
    if options.gateway_port:
        wanted += [(LOOPBACK, options.gateway_port), (LOOPBACK, options.gateway_port + 1)]
    for host, port in wanted:
        problem = port_problem(host, port)
        if problem is not None:
            print(f"flexdt up: {problem}", file=sys.stderr)
            return REFUSED
    supervisor = Supervisor(
        services(options),
        announce=lambda addresses: _say(ready_line(addresses, secure=secure), sys.stdout),
        note=lambda line: _say(f"flexdt up: {line}", sys.stderr),
    )
    try:
        asyncio.run(until_signalled(supervisor))
    except ServiceError as error:
        print(f"flexdt up: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def _say(line: str, stream: TextIO) -> None:
    """Print a line; nobody need read it."""
    with contextlib.suppress(OSError):
        print(line, file=stream, flush=True)


if __name__ == "__main__":
    sys.exit(main())
