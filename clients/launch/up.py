"""`python -m flexdt.clients.launch.up`: the four servers as processes of one supervisor.

Prints one JSON `ready` line with the addresses on standard output; Ctrl-C, SIGTERM or (under
`child`) the end of its parent stops all. The projector is internal and listens on the loopback
only; `--host` is the twin's and the viewer's.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import sys
from collections.abc import Sequence
from typing import TextIO

from flexdt.library.optional.extras import lacking
from flexdt.message_words import reason_of
from flexdt.runtime.access import PublicAddress, ViewerLimits, limit_names
from flexdt.runtime.process import INVALID, REFUSED
from flexdt.runtime.process_settings import (
    LOOPBACK,
    Address,
    GatewaySettings,
    TwinSettings,
    UpSettings,
    ViewerSettings,
)
from flexdt.runtime.settings import parse, shared, words
from flexdt.runtime.supervisor import (
    Addresses,
    Service,
    ServiceError,
    Supervisor,
    until_signalled,
)

COMPILING = "its first start on a machine compiles the kernels, some ten seconds of processor time"


def services(options: UpSettings) -> tuple[Service, ...]:
    """List the services in starting order: projector, twin and, if chosen, viewer and
    gateway.

    The twin needs the projector's address, viewer and gateway the twin's. Limits
    (NAME=VALUE) that the viewer knows go to the viewer, all others to the twin. The
    projector always listens on the loopback; nothing is started here.

    Args:
        options: of `flexdt up`; each service gets those it knows.

    Returns:
        Services whose command lines are made from the addresses known by then.
    """
    viewer_limits = limit_names(ViewerLimits())
    for_viewer = [x for x in options.limit if x.partition("=")[0] in viewer_limits]
    for_twin = [x for x in options.limit if x not in for_viewer]

    def projector(known: Addresses) -> Sequence[str]:
        """Return module and command-line options of the projector, on this machine's
        loopback address.

        A restarted one keeps the port it had; the memory limit is an option, too.
        """
        given = {
            "host": LOOPBACK,
            "port": port_of("projector", options.projector_port, known),
            "memory_limit": options.projector_memory,
        }
        return ("flexdt.server.projector.main", *words(given))

    def twin(known: Addresses) -> Sequence[str]:
        """Return module and options of the twin server, with the projector's address;
        started again, it continues from its stored state, even if it was begun
        `fresh`.

        It gets the options of `flexdt up` that it knows, the limits that are not the
        viewer's, and the port it had before.
        """
        own = {
            "port": port_of("twin", options.port, known),
            "projector": known["projector"],
            "projector_port": None,
            "limit": for_twin,
        }
        # A restarted twin continues from its stored state, even if the first start was
        # `fresh`.
        if "twin" in known:
            again = {"fresh": False}
        else:
            again = {}
        return (
            "flexdt.server.twin.main",
            *words(shared(options, TwinSettings) | own | again),
        )

    def viewer(known: Addresses) -> Sequence[str]:
        """Return module and command-line options of the viewer, on `viewer_port` or a
        free port, connected to the twin's address.

        It gets the options that it knows and its own limits; the port it had before comes
        first.
        """
        own = {
            "port": port_of("viewer", options.viewer_port, known),
            "twin": known["twin"],
            "twin_cert": options.tls_cert,
            "limit": for_viewer,
            "http_port": None,
        }
        return (
            "flexdt.clients.viewer.main",
            *words(shared(options, ViewerSettings) | own),
        )

    def gateway(known: Addresses) -> Sequence[str]:
        """Return module and command-line options of the gateway, connected to the twin's
        address; without a port given, a free one.

        It listens at its default host; the port it had before comes first.
        """
        own = {
            "port": port_of("gateway", options.gateway_port or 0, known),
            "host": None,
            "server": known["twin"],
            "twin_cert": options.tls_cert,
        }
        return (
            "flexdt.clients.gateway.main",
            *words(shared(options, GatewaySettings) | own),
        )

    made = [Service("projector", projector, slow=COMPILING), Service("twin", twin)]
    if not options.no_viewer:
        made.append(Service("viewer", viewer))
    if options.gateway_port is not None:
        made.append(Service("gateway", gateway))
    return tuple(made)


def port_of(name: str, asked: int, known: Addresses) -> int:
    """Return a service's port: the one before, else `asked`."""
    if name in known:
        return known[name].port
    return asked


def port_problem(option: str, host: str, port: int) -> str | None:
    """Say why a port cannot be listened on; None if it can.

    The port is bound for a moment and freed again. The problem names the address, the system's
    reason and the option to change.

    `option`: that chooses the port; `host`: address to listen on; `port`: 0 means any free one.
    """
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except OSError as error:
        where = f"cannot listen on {Address(host, port)}: {reason_of(error)}"
        return f"{where}; choose another {option}, or 0 for any free one"
    return None


def ready_line(
    addresses: Addresses,
    *,
    secure: bool = False,
    public: PublicAddress | None = None,
) -> str:
    """Format the supervisor's `ready` line: the twin's address, and every process's by name (one
    JSON object, no line end).

    The viewer has a URL too, and the gateway its inbound port (one above its port).

    `addresses`: of the processes; `secure`: the viewer's URL is https; `public`: the viewer's
    address behind a proxy, which its URL is then.
    Returns JSON with ready, host, port, and an object for each process.
    """
    twin = addresses["twin"]
    document: dict[str, object] = {"ready": "up", "host": twin.host, "port": twin.port}
    for name, address in addresses.items():
        entry: dict[str, object] = {"host": address.host, "port": address.port}
        if name == "viewer":
            own = f"{'https' if secure else 'http'}://{address}/"
            entry["url"] = str(public or own)
        if name == "gateway":
            entry["inbound"] = address.port + 1
        document[name] = entry
    return json.dumps(document)


def main(argv: Sequence[str] | None = None) -> int:
    """Check ports and packages, then run the servers until stopped.

    INVALID if the gateway's package is missing, REFUSED if a port is taken (both before
    any start), else the failed server's, or 0. Errors are printed on standard error, one
    line each; only the first port in use is reported. The `ready` line goes to standard
    output once all servers are up. The gateway's pair of ports is checked unless any free
    one is allowed.

    Args:
        argv: command-line arguments; None for those of the process.

    Returns:
        The exit code.
    """
    options = parse(UpSettings, argv)
    secure = options.tls_cert is not None
    wanted = [
        ("--port", options.host, options.port),
        ("--projector-port", LOOPBACK, options.projector_port),
    ]
    if not options.no_viewer:
        wanted.append(("--viewer-port", options.host, options.viewer_port))
    if options.gateway_port:
        pair = (options.gateway_port, options.gateway_port + 1)
        wanted += [("--gateway-port", LOOPBACK, port) for port in pair]
    # Checked before any start: a server would find it only after compiling, and end all.
    if options.gateway_port is not None:
        missing = lacking("zmq", "pyzmq", "gateway")
    else:
        missing = None
    if missing is not None:
        print(f"flexdt up: --gateway-port: {missing}", file=sys.stderr)
        return INVALID
    for problem in filter(None, (port_problem(*place) for place in wanted)):
        print(f"flexdt up: {problem}", file=sys.stderr)
        return REFUSED
    supervisor = Supervisor(
        services(options),
        announce=lambda addresses: _say(
            ready_line(addresses, secure=secure, public=options.public_url), sys.stdout
        ),
        note=lambda line: _say(f"flexdt up: {line}", sys.stderr),
    )
    try:
        asyncio.run(until_signalled(supervisor))
    except ServiceError as error:
        print(f"flexdt up: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def _say(line: str, stream: TextIO) -> None:
    """Print a line; a closed stream is ignored."""
    with contextlib.suppress(OSError):
        print(line, file=stream, flush=True)


if __name__ == "__main__":
    sys.exit(main())
