"""`flexdt up`, `twin`, `projector`, `viewer`, `gateway`: become the process in question.

The servers are programs of their own (`python -m flexdt.server...`); this process turns into one,
so signals and exit codes are the server's. It refuses to import any of them.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

import typer

from flexdt.clients.cli import values
from flexdt.clients.cli.options import MachineName, ProfileName, SpeedUp

Host = Annotated[str, typer.Option("--host", help="Address to listen on.")]
Data = Annotated[
    str | None, typer.Option("--data", metavar="DIR", help="Data directory: all that is written.")
]
Truth = Annotated[
    str | None,
    typer.Option("--truth", metavar="FILE", help="Hidden misalignment (TOML, parameter = value)."),
]
TokenFile = Annotated[
    str | None,
    typer.Option("--token-file", metavar="FILE", help="Clients must show this file's token."),
]
Sample = Annotated[
    str | None,
    typer.Option("--sample", metavar="NAME", help="On the stage at start, or 'empty'."),
]
PhysicsName = Annotated[
    Literal["ideal", "mono", "poly"] | None,
    typer.Option("--physics", help="How images are made; default ideal, see docs/physics.md."),
]
Fresh = Annotated[bool, typer.Option("--fresh", help="Forget where the last twin left off.")]
Limit = Annotated[
    list[str] | None,
    typer.Option("--limit", metavar="NAME=VALUE", help="May be given several times."),
]
HttpPort = Annotated[
    int | None,
    typer.Option("--http-port", min=0, max=65535, help="Serve /healthz and /metrics there."),
]
HttpHost = Annotated[str | None, typer.Option("--http-host", help="Loopback if left out.")]
LogLevel = Annotated[
    Literal["debug", "info", "warning", "error"] | None,
    typer.Option("--log-level", help="debug: every request."),
]
TlsCert = Annotated[str | None, typer.Option("--tls-cert", metavar="FILE", help="Certificate.")]
TlsKey = Annotated[str | None, typer.Option("--tls-key", metavar="FILE", help="Private key.")]


def register(app: typer.Typer) -> None:
    """Add this module's commands."""
    app.command("up")(up)
    app.command("twin")(twin)
    app.command("projector")(projector)
    app.command("viewer")(viewer)
    app.command("gateway")(gateway)


def up(
    host: Host = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Twin; 0 is any free.")] = 55000,
    projector_port: Annotated[int, typer.Option(min=0, max=65535)] = 55001,
    projector_memory: Annotated[
        str | None, typer.Option("--projector-memory", metavar="SIZE", help="Volumes; e.g. 4GiB.")
    ] = None,
    viewer_port: Annotated[int, typer.Option(min=0, max=65535)] = 8080,
    no_viewer: Annotated[bool, typer.Option("--no-viewer", help="Without the browser.")] = False,
    gateway_port: Annotated[
        int | None,
        typer.Option(
            "--gateway-port", min=0, max=65534, help="Acquila's interface too; see gateway."
        ),
    ] = None,
    data: Data = None,
    machine: MachineName = None,
    profile: ProfileName = None,
    truth: Truth = None,
    sample: Sample = None,
    speed_up: SpeedUp = None,
    physics: PhysicsName = None,
    token_file: TokenFile = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
    fresh: Fresh = False,
    limit: Limit = None,
    http_port: HttpPort = None,
    log_level: LogLevel = None,
) -> None:
    """Start projector, twin and viewer; Ctrl-C stops all.

    They run as processes under one supervisor, which restarts a dead one. Prints one
    JSON `ready` line with the addresses once everything listens.
    """
    become(
        "flexdt.server.up",
        {
            "host": host,
            "port": port,
            "projector-port": projector_port,
            "projector-memory": projector_memory,
            "viewer-port": viewer_port,
            "no-viewer": no_viewer,
            "gateway-port": gateway_port,
            "fresh": fresh,
            "limit": limit,
            "http-port": http_port,
            "log-level": log_level,
        }
        | _twin_options(
            data, machine, profile, truth, sample, speed_up, physics, token_file, tls_cert, tls_key
        ),
    )


def twin(
    host: Host = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 is any free.")] = 55000,
    projector: Annotated[
        str | None,
        typer.Option(
            "--projector",
            metavar="HOST:PORT",
            help="Where the projector listens; 127.0.0.1:55001 if left out.",
        ),
    ] = None,
    projector_port: Annotated[
        int | None,
        typer.Option("--projector-port", min=1, max=65535, help="As --projector 127.0.0.1:PORT."),
    ] = None,
    projector_token_file: Annotated[
        str | None,
        typer.Option("--projector-token-file", metavar="FILE", help="Shown to the projector."),
    ] = None,
    projector_tls_ca: Annotated[
        str | None,
        typer.Option("--projector-tls-ca", metavar="FILE", help="Speak TLS with it; trust this."),
    ] = None,
    data: Data = None,
    machine: MachineName = None,
    profile: ProfileName = None,
    truth: Truth = None,
    sample: Sample = None,
    speed_up: SpeedUp = None,
    physics: PhysicsName = None,
    token_file: TokenFile = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
    fresh: Fresh = False,
    limit: Limit = None,
    http_port: HttpPort = None,
    http_host: HttpHost = None,
    log_level: LogLevel = None,
) -> None:
    """Run the twin server alone."""
    if projector is not None and projector_port is not None:
        raise typer.BadParameter("give --projector or --projector-port, not both")
    if projector is None:
        projector = f"127.0.0.1:{55001 if projector_port is None else projector_port}"
    values.server(projector)
    become(
        "flexdt.server.twin_main",
        {
            "host": host,
            "port": port,
            "projector": projector,
            "projector-token-file": projector_token_file,
            "projector-tls-ca": projector_tls_ca,
            "fresh": fresh,
            "limit": limit,
            "http-port": http_port,
            "http-host": http_host,
            "log-level": log_level,
        }
        | _twin_options(
            data, machine, profile, truth, sample, speed_up, physics, token_file, tls_cert, tls_key
        ),
    )


def projector(
    host: Host = "127.0.0.1",
    port: Annotated[
        int, typer.Option("--port", "--projector-port", min=0, max=65535, help="0 is any free.")
    ] = 55001,
    threads: Annotated[
        int | None, typer.Option("--threads", min=1, help="Of the kernels; all cores if left out.")
    ] = None,
    memory_limit: Annotated[
        str | None, typer.Option("--memory-limit", metavar="SIZE", help="E.g. 4GiB.")
    ] = None,
    token_file: TokenFile = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
    limit: Limit = None,
    http_port: HttpPort = None,
    http_host: HttpHost = None,
    log_level: LogLevel = None,
) -> None:
    """Run the projector server alone."""
    _together(tls_cert, tls_key)
    become(
        "flexdt.server.projector_main",
        {
            "host": host,
            "port": port,
            "threads": threads,
            "memory-limit": memory_limit,
            "token-file": token_file,
            "tls-cert": tls_cert,
            "tls-key": tls_key,
            "limit": limit,
            "http-port": http_port,
            "http-host": http_host,
            "log-level": log_level,
        },
    )


def viewer(
    host: Host = "127.0.0.1",
    port: Annotated[
        int, typer.Option("--port", "--viewer-port", min=0, max=65535, help="0 is any free.")
    ] = 8080,
    twin: Annotated[
        str, typer.Option("--twin", metavar="HOST:PORT", help="Where the twin listens.")
    ] = values.DEFAULT_SERVER,
    data: Data = None,
    machine: MachineName = None,
    profile: ProfileName = None,
    token_file: TokenFile = None,
    twin_cert: Annotated[
        str | None, typer.Option("--twin-cert", metavar="FILE", help="Trust it as the twin's.")
    ] = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
    limit: Limit = None,
    http_port: HttpPort = None,
    http_host: HttpHost = None,
    log_level: LogLevel = None,
) -> None:
    """Run the viewer, the lab in the browser, alone."""
    values.server(twin)
    _together(tls_cert, tls_key)
    become(
        "flexdt.server.viewer_main",
        {
            "host": host,
            "port": port,
            "twin": twin,
            "data": data,
            "machine": machine,
            "profile": profile,
            "token-file": token_file,
            "twin-cert": twin_cert,
            "tls-cert": tls_cert,
            "tls-key": tls_key,
            "limit": limit,
            "http-port": http_port,
            "http-host": http_host,
            "log-level": log_level,
        },
    )


def gateway(
    bind: Annotated[
        str, typer.Option("--bind", metavar="HOST", help="Loopback only; else use a tunnel.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Events go out there; 0 is any free.")
    ] = 50000,
    inbound_port: Annotated[
        int | None,
        typer.Option("--inbound-port", min=0, max=65535, help="Events come in; default: the next."),
    ] = None,
    server: Annotated[
        str, typer.Option("--server", metavar="HOST:PORT", help="Where the twin listens.")
    ] = values.DEFAULT_SERVER,
    data: Annotated[
        str | None, typer.Option("--data", metavar="DIR", help="Images are saved there.")
    ] = None,
    machine: MachineName = None,
    profile: ProfileName = None,
    token_file: Annotated[
        str | None, typer.Option("--token-file", metavar="FILE", help="Shown to the twin.")
    ] = None,
    twin_cert: Annotated[
        str | None, typer.Option("--twin-cert", metavar="FILE", help="Trust it as the twin's.")
    ] = None,
) -> None:
    """Serve the scanner software's own ZeroMQ interface (Acquila) for a running twin.

    Programs written for the scanner connect to it as they do to the scanner.
    """
    values.server(server)
    become(
        "flexdt.server.gateway_main",
        {
            "bind": bind,
            "port": port,
            "inbound-port": inbound_port,
            "server": server,
            "data": data,
            "machine": machine,
            "profile": profile,
            "token-file": token_file,
            "twin-cert": twin_cert,
        },
    )


def _twin_options(
    data: str | None,
    machine: str | None,
    profile: str | None,
    truth: str | None,
    sample: str | None,
    speed_up: str | None,
    physics: str | None,
    token_file: str | None,
    tls_cert: str | None,
    tls_key: str | None,
) -> dict[str, object]:
    _together(tls_cert, tls_key)
    if speed_up is not None:
        values.speed_up(speed_up)
    return {
        "data": data,
        "machine": machine,
        "profile": profile,
        "truth": truth,
        "sample": sample,
        "speed-up": speed_up,
        "physics": physics,
        "token-file": token_file,
        "tls-cert": tls_cert,
        "tls-key": tls_key,
    }


def _together(tls_cert: str | None, tls_key: str | None) -> None:
    if (tls_cert is None) != (tls_key is None):
        raise typer.BadParameter("--tls-cert and --tls-key go together")


def arguments(options: Mapping[str, object]) -> list[str]:
    """Options to words; what is None is left out, True is a bare flag."""
    return [
        word
        for name, value in options.items()
        if value is not None and value is not False
        for word in _words(f"--{name}", value)
    ]


def _words(option: str, value: object) -> list[str]:
    if value is True:
        return [option]
    if isinstance(value, list):
        return [word for item in value for word in (option, str(item))]
    return [option, str(value)]


def become(module: str, options: Mapping[str, object], more: Sequence[str] = ()) -> None:
    """Replace this process by `python -m module` with `options` and `more` words."""
    sys.stdout.flush()
    sys.stderr.flush()
    words = [*arguments(options), *more]
    os.execv(sys.executable, [sys.executable, "-m", module, *words])
