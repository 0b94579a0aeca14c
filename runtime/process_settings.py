"""The settings of each server process, and the parsers of their words.

Each process has a frozen dataclass of settings; `flexdt.runtime.settings` derives options,
keys and help from it. The docstring of one with a `command` says what the command does.
"""

# ruff: noqa: RUF009  (the calls make fields; they are not values shared by all instances)

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, get_args
from urllib.parse import urlsplit

import typer

from flexdt.runtime.access import PublicAddress
from flexdt.runtime.settings import Settings, option

if TYPE_CHECKING:
    from flexdt.twin.rays_a_pixel import Rays

LOOPBACK: Final = "127.0.0.1"
TWIN_PORT: Final = 55000
PROJECTOR_PORT: Final = 55001
VIEWER_PORT: Final = 8080
GATEWAY_PORT: Final = 50000
MAX_PORT: Final = 65535
BYTES_OF_UNIT: Final = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40}
"""Prefix of a unit -> bytes."""
LogLevel = Literal["debug", "info", "warning", "error"]
Physics = Literal["ideal", "mono", "poly"]
Scatter = Literal["off", "mc"]


@dataclass(frozen=True)
class Address:
    """Where a service listens; as text `HOST:PORT`, an IPv6 address in brackets."""

    host: str
    port: int

    def __str__(self) -> str:
        """Format as HOST:PORT, an IPv6 host in brackets."""
        if ":" in self.host:
            return f"[{self.host}]:{self.port}"
        return f"{self.host}:{self.port}"


def public_address(text: str) -> PublicAddress:
    """Parse an URL, such as https://hub.example/user/me/proxy/8080/.

    Raises:
        typer.BadParameter: it has no scheme of the web or no host, or a query.
    """
    try:
        url = urlsplit(text.strip())
        readable = url.scheme in ("http", "https") and bool(url.hostname)
    except ValueError:
        readable = False
    if not readable or url.query or url.fragment or url.username is not None:
        raise typer.BadParameter(
            f"{text!r} is no address of a page, such as https://hub.example/user/me/proxy/8080/"
        )
    path = url.path.strip("/")
    return PublicAddress(
        url.netloc.lower(), f"/{path}/" if path else "/", url.scheme == "https"
    )


def address(text: str) -> Address:
    """Parse HOST:PORT or [IPv6]:PORT.

    The host is not looked up and may be any text; brackets around it and spaces around
    the whole are removed.

    Raises:
        typer.BadParameter: the text has another form, or the port is not from 1 to
            `MAX_PORT`.
    """
    host, _, port = text.strip().rpartition(":")
    closed = host.startswith("[") == host.endswith("]")
    if not host or not closed or not (port.isascii() and port.isdigit()):
        raise typer.BadParameter(
            f"{text!r} is not HOST:PORT, such as {LOOPBACK}:{TWIN_PORT}"
        )
    if not 1 <= int(port) <= MAX_PORT:
        raise typer.BadParameter(
            f"{text!r}: the port must be a number from 1 to {MAX_PORT}"
        )
    return Address(host.strip("[]"), int(port))


def addresses(text: str | None) -> tuple[Address, ...]:
    """Parse HOST:PORT,HOST:PORT...; none of None.

    Raises typer.BadParameter: as `address`."""
    if text is None:
        return ()
    return tuple(address(word) for word in text.split(","))


def several(text: str) -> str:
    """Check a text by `addresses`, which may raise, and return it unchanged."""
    addresses(text)
    return text


def memory_size(text: str) -> int:
    """Parse a size such as "4GiB", "512M" or "1000000", and return it rounded down to whole
    bytes.

    Units are powers of 1024 whatever their spelling (K, KB, KiB, up to T; case does not count).

    Raises typer.BadParameter: not a size of at least one byte.
    """
    match = re.fullmatch(r"(\d+\.?\d*)\s*([kmgt]?)i?b?", text.strip().lower())
    size = 0
    if match is not None:
        size = int(float(match[1]) * BYTES_OF_UNIT[match[2]])
    if size <= 0:
        raise typer.BadParameter(f"{text!r} is not a size such as 512M or 4GiB")
    return size


def speed_up(text: str | float) -> float | Literal["max"]:
    """Parse the speed-up of the twin's time: a finite number above 0, or "max".

    Case and surrounding spaces do not count. The twin's upper limit is not checked here.

    Raises:
        typer.BadParameter: neither.
    """
    word = str(text).strip().lower()
    if word == "max":
        return "max"
    try:
        factor = float(word)
    except ValueError:
        factor = math.nan
    if not 0 < factor < math.inf:
        raise typer.BadParameter(f"the speed-up {text} must be positive, or 'max'")
    return factor


def scatter_method(text: str) -> str:
    """Check a method of simulating scatter, "off" or "mc", and return it.

    Raises:
        typer.BadParameter: another one; "first", which has been removed, has a hint.
    """
    if text not in get_args(Scatter):
        removed = ""
        if text == "first":
            removed = "; 'first' has been removed, use 'mc'"
        raise typer.BadParameter(
            f"{text!r} is not one of {', '.join(get_args(Scatter))}{removed}"
        )
    return text


def public_url() -> Any:
    """Declare the viewer's address behind a proxy; help leaves it to the settings file."""
    return option(None, public=False, hidden=True, metavar="URL", parser=public_address)


def rays_a_side(text: str | int) -> Rays:
    """Parse the rays along each side of a pixel: "auto", or a whole number from 1 to 16.

    Raises:
        typer.BadParameter: neither.
    """
    from flexdt.twin.errors import LimitError
    from flexdt.twin.rays_a_pixel import check_rays

    word = str(text).strip().lower()
    try:
        return check_rays(int(word) if word.isdigit() else word)
    except LimitError as error:
        raise typer.BadParameter(error.message) from None


def tcp_port(
    default: int | None, *flags: str, most: int = MAX_PORT, public: bool = True
) -> Any:
    """Declare a field for a TCP port."""
    return option(default, *flags, public=public, min=0, max=most)


@dataclass(frozen=True, kw_only=True)
class ProcessSettings(Settings):
    """Settings of every process.

    Attributes:
        host: Listen on this address.
        port: Listen on this port; 0 is any free one.
    """

    host: str = option(LOOPBACK, public=False)
    port: int = tcp_port(0)


@dataclass(frozen=True, kw_only=True)
class ServerSettings(ProcessSettings):
    """Settings of twin, projector and viewer.

    Attributes:
        token_file: Require the token in this file of every client.
        tls_cert: Speak TLS with this certificate.
        tls_key: Use the private key of the certificate in this file.
        limit: Set a limit of docs/reliability.md; may be repeated.
        http_port: Serve the pages /healthz and /metrics on this port.
        http_host: Serve these pages on this address; beyond the loopback they need the token.
        log_level: Log from this level on; debug logs every request.
    """

    token_file: Path | None = option(None, metavar="FILE")
    tls_cert: Path | None = option(None, public=False, metavar="FILE")
    tls_key: Path | None = option(None, public=False, metavar="FILE")
    limit: tuple[str, ...] = option((), public=False, metavar="NAME=VALUE")
    http_port: int | None = tcp_port(None, public=False)
    http_host: str = option(LOOPBACK, public=False)
    log_level: LogLevel = option("info", public=False)


@dataclass(frozen=True, kw_only=True)
class ProjectorSettings(ServerSettings):
    """Run the projector server alone.

    Attributes:
        port: Listen on this port; 0 is any free one.
        threads: Compute with so many threads; default: all cores.
        memory_limit: Hold volumes of at most this size, e.g. 4GiB; default: half of the memory.
    """

    command = "projector"
    port: int = tcp_port(PROJECTOR_PORT, "--port", "--projector-port")
    threads: int | None = option(None, min=1)
    memory_limit: int | None = option(None, metavar="SIZE", parser=memory_size)


@dataclass(frozen=True, kw_only=True)
class ScannerSettings(ServerSettings):
    """Settings of `flexdt twin` and `flexdt up`; None leaves the choice to the twin.

    Attributes:
        port: Listen on this port as the twin; 0 is any free one.
        data: Write all to this data directory; default: data, or configured.
        machine: Simulate this machine: a shipped name or a TOML file.
        profile: Use the zero offsets of this calibration profile.
        truth: Hide this misalignment in the images (TOML).
        sample: Put this sample on the stage at the start, or 'empty'.
        speed_up: Let the twin's time run X times as fast as yours.
        physics: Make images this way (docs/physics.md).
        scatter: Simulate scattered radiation, with physics mono and poly.
        rays: Sample pixels at the sample's edges by X by X rays, or as many as the noise asks.
        fresh: Start anew instead of where the last twin left off.
    """

    port: int = tcp_port(TWIN_PORT)
    data: Path | None = option(None, metavar="DIR")
    machine: str | None = option(None, metavar="FILE or NAME")
    profile: str | None = option(None, metavar="NAME")
    truth: Path | None = option(None, metavar="FILE")
    sample: str | None = option(None, metavar="NAME")
    speed_up: Any = option(1.0, metavar="X or max", parser=speed_up)
    physics: Physics = option("ideal")
    scatter: Scatter = option("off", metavar="off or mc", parser=scatter_method)
    rays: Any = option("auto", hidden=True, metavar="X or auto", parser=rays_a_side)
    fresh: bool = option(False, public=False)


@dataclass(frozen=True, kw_only=True)
class FarProjectorSettings(Settings):
    """Settings of `flexdt twin` and `flexdt up` about projectors on other machines.

    Attributes:
        projectors: Deal the views among these projectors, too.
        projector_token_file: Show this file's token to the projectors.
    """

    projectors: str | None = option(
        None, public=False, metavar="HOST:PORT,...", parser=several
    )
    projector_token_file: Path | None = option(None, public=False, metavar="FILE")


@dataclass(frozen=True, kw_only=True)
class TwinSettings(FarProjectorSettings, ScannerSettings):
    """Run the twin server alone.

    Attributes:
        data: Write everything to this directory.
        machine: Simulate this machine: a shipped name or a TOML file.
        projector: Connect to the projector that listens there; default: 127.0.0.1:55001.
        projector_port: Connect to the projector on this port of 127.0.0.1 instead.
        projector_tls_ca: Speak TLS with the projectors and trust this certificate.
        no_noise: Make images of expected counts, without noise.
        memory_limit: Hold samples of at most this size; default: a quarter of the memory.
    """

    command = "twin"
    data: Path = option(Path("data"), metavar="DIR")
    machine: str = option("flexray", metavar="FILE or NAME")
    projector: Address | None = option(None, metavar="HOST:PORT", parser=address)
    projector_port: int | None = tcp_port(None)
    projector_tls_ca: Path | None = option(None, metavar="FILE")
    no_noise: bool = option(False, public=False)
    memory_limit: int | None = option(
        None, public=False, metavar="SIZE", parser=memory_size
    )

    @property
    def places(self) -> tuple[Address, ...]:
        """Addresses of the projectors, each once: first `projector`, or else
        `projector_port` on this machine, then `projectors`.

        Without any it is `PROJECTOR_PORT` on this machine.
        """
        port = None
        if self.projector_port is not None:
            port = Address(LOOPBACK, self.projector_port)
        named = [place for place in (self.projector or port,) if place is not None]
        found = tuple(dict.fromkeys((*named, *addresses(self.projectors))))
        return found or (Address(LOOPBACK, PROJECTOR_PORT),)


@dataclass(frozen=True, kw_only=True)
class TwinClientSettings(ProcessSettings):
    """Settings of viewer and gateway: where the twin is, and copies of its files.

    Attributes:
        data: Read the twin's data directory here.
        machine: Read the twin's machine from this file, where it is one.
        profile: Read the twin's profile from this file, where it is one.
        token_file: Show this file's token to the twin.
        twin_cert: Speak TLS with the twin and trust this certificate.
    """

    data: Path | None = option(None, metavar="DIR")
    machine: Path | None = option(None, metavar="FILE or NAME")
    profile: Path | None = option(None, metavar="NAME")
    token_file: Path | None = option(None, metavar="FILE")
    twin_cert: Path | None = option(None, metavar="FILE")


@dataclass(frozen=True, kw_only=True)
class ViewerSettings(TwinClientSettings, ServerSettings):
    """Run the viewer, the lab in the browser, alone.

    Attributes:
        port: Listen on this port; 0: any free one.
        twin: Connect to the twin there.
        token_file: Show this file's token to the twin; browsers must show it here.
        public_url: Admit browsers that find it at this URL, behind a proxy.
    """

    command = "viewer"
    port: int = tcp_port(VIEWER_PORT, "--port", "--viewer-port")
    twin: Address = option(
        Address(LOOPBACK, TWIN_PORT), metavar="HOST:PORT", parser=address
    )
    token_file: Path | None = option(None, metavar="FILE")
    public_url: PublicAddress | None = public_url()


@dataclass(frozen=True, kw_only=True)
class GatewaySettings(TwinClientSettings):
    """Serve the scanner software's own ZeroMQ interface (Acquila) for a running twin.

    Programs written for the scanner connect to it as they do to the scanner.

    Attributes:
        host: Listen on this address of the loopback; use a tunnel beyond.
        port: Publish events on this port; 0 is any free one.
        inbound_port: Take events on this port; default: the next.
        server: Connect to the twin there.
        data: Save images in this directory.
    """

    command = "gateway"
    host: str = option(LOOPBACK, "--bind", "--host", metavar="HOST")
    port: int = tcp_port(GATEWAY_PORT)
    inbound_port: int | None = tcp_port(None)
    server: Address = option(
        Address(LOOPBACK, TWIN_PORT), metavar="HOST:PORT", parser=address
    )
    data: Path = option(Path("data"), metavar="DIR")


@dataclass(frozen=True, kw_only=True)
class UpSettings(FarProjectorSettings, ScannerSettings):
    """Start projector, twin and viewer; Ctrl-C stops all.

    They run as processes under one supervisor, which restarts a dead one. Prints one
    JSON `ready` line with the addresses once everything listens. `flexdt twin --help` and its
    like list further options, which `up` takes, too.

    Attributes:
        projector_port: Give the projector this port; 0 is any free one.
        projector_memory: Let the projector hold volumes of this size, e.g. 4GiB.
        viewer_port: Give the viewer this port; 0 is any free one.
        public_url: Admit browsers that find the viewer at this URL, behind a proxy.
        no_viewer: Start no viewer.
        gateway_port: Serve Acquila's interface on this port and the next (see gateway).
    """

    command = "up"
    projector_port: int = tcp_port(PROJECTOR_PORT)
    projector_memory: str | None = option(None, public=False, metavar="SIZE")
    viewer_port: int = tcp_port(VIEWER_PORT)
    public_url: PublicAddress | None = public_url()
    no_viewer: bool = option(False)
    gateway_port: int | None = tcp_port(None, most=MAX_PORT - 1)
