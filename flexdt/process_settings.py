"""The options of each server process, declared once.

Each process has a frozen dataclass of settings. The options of `python -m flexdt....main`, those of
`flexdt twin` and its like, and the words that `flexdt up` starts its processes with are all derived
from it. Command line and servers both import this module, so it stands above their two packages.
"""

# ruff: noqa: RUF009  (the calls make fields; they are not values shared by all instances)

from __future__ import annotations

import argparse
import inspect
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NoReturn, TypeVar, get_args, get_type_hints

import typer
from typer.main import get_command

LOOPBACK = "127.0.0.1"
LARGEST_PORT = 65535
UNITS = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40}
LogLevel = Literal["debug", "info", "warning", "error"]
Physics = Literal["ideal", "mono", "poly"]
Scatter = Literal["off", "mc"]


@dataclass(frozen=True)
class Address:
    """Where a service listens; as text `HOST:PORT`, an IPv6 address in brackets."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def address(text: str) -> Address:
    """Read HOST:PORT or [IPv6]:PORT.

    Raises:
        typer.BadParameter: the text has another form, or the port is none.
    """
    host, _, port = text.strip().rpartition(":")
    closed = host.startswith("[") == host.endswith("]")
    if not host or not closed or not (port.isascii() and port.isdigit()):
        raise typer.BadParameter(f"{text!r} is not HOST:PORT, such as {LOOPBACK}:55000")
    if not 1 <= int(port) <= LARGEST_PORT:
        raise typer.BadParameter(f"{text!r}: the port must be a number from 1 to {LARGEST_PORT}")
    return Address(host.strip("[]"), int(port))


def addresses(text: str | None) -> tuple[Address, ...]:
    """Read HOST:PORT,HOST:PORT...; none of None.

    Raises:
        typer.BadParameter: as `address`.
    """
    return () if text is None else tuple(address(word) for word in text.split(","))


def several(text: str) -> str:
    """The same text, once `addresses` has read it; errors as there."""
    addresses(text)
    return text


def memory_size(text: str) -> int:
    """Bytes of "4GiB", "512M" or "1000000".

    Raises:
        typer.BadParameter: not a size.
    """
    match = re.fullmatch(r"(\d+\.?\d*)\s*([kmgt]?)i?b?", text.strip().lower())
    size = 0 if match is None else int(float(match[1]) * UNITS[match[2]])
    if size <= 0:
        raise typer.BadParameter(f"{text!r} is not a size such as 512M or 4GiB")
    return size


def scatter_method(text: str) -> str:
    """Read a method of simulating scatter: off or mc.

    Raises:
        typer.BadParameter: another one.
    """
    if text not in get_args(Scatter):
        gone = "; 'first' has been removed, use 'mc'" if text == "first" else ""
        raise typer.BadParameter(f"{text!r} is not one of {', '.join(get_args(Scatter))}{gone}")
    return text


def option(default: object, help: str, *flags: str, public: bool = True, **details: Any) -> Any:
    """A field of settings that is an option.

    Args:
        default: where the option is left out.
        help: one line.
        flags: as typed; they follow from the field's name.
        public: whether the `flexdt` command offers it too.
        details: of `typer.Option`, such as metavar, min, max and parser.
    """
    return field(default=default, metadata={"public": public, "flags": flags,
                                            "details": {"help": help, **details}})  # fmt: skip


def tcp_port(default: int | None, help: str, *flags: str, most: int = LARGEST_PORT) -> Any:
    """A field for a TCP port."""
    return option(default, help, *flags, min=0, max=most)


def some_file(help: str) -> Any:
    """A field for a file that may be left out."""
    return option(None, help, metavar="FILE")


def further_projectors() -> Any:
    """A field for projectors beside the first."""
    return option(
        None, "Further ones; views are dealt among all.", metavar="HOST:PORT,...", parser=several
    )


def where_the_twin_is() -> Any:
    """A field for the twin's address."""
    twin = Address(LOOPBACK, 55000)
    return option(twin, "Where the twin listens.", metavar="HOST:PORT", parser=address)


@dataclass(frozen=True, kw_only=True)
class ProcessSettings:
    """What every process has.

    Attributes:
        command: name of its `flexdt` command.
    """

    command: ClassVar[str]
    host: str = option(LOOPBACK, "Address to listen on.")
    port: int = tcp_port(0, "0 is any free.")


@dataclass(frozen=True, kw_only=True)
class ServerSettings(ProcessSettings):
    """What twin, projector and viewer share."""

    token_file: Path | None = some_file("Clients must show this file's token.")
    tls_cert: Path | None = some_file("Certificate.")
    tls_key: Path | None = some_file("Private key.")
    limit: tuple[str, ...] = option((), "May be given several times.", metavar="NAME=VALUE")
    http_port: int | None = tcp_port(None, "Serve /healthz and /metrics there.")
    http_host: str = option(LOOPBACK, "Of these pages; beyond the loopback with a token only.")
    log_level: LogLevel = option("info", "debug: every request.")


@dataclass(frozen=True, kw_only=True)
class ProjectorSettings(ServerSettings):
    """`flexdt projector`."""

    command = "projector"
    port: int = tcp_port(55001, "0 is any free.", "--port", "--projector-port")
    threads: int | None = option(None, "Of the kernels; all cores if left out.", min=1)
    memory_limit: int | None = option(
        None, "E.g. 4GiB; half of the memory if left out.", metavar="SIZE", parser=memory_size
    )


@dataclass(frozen=True, kw_only=True)
class ScannerSettings(ServerSettings):
    """What `flexdt twin` and `flexdt up` share; None leaves the choice to the twin."""

    port: int = tcp_port(55000, "Of the twin; 0 is any free.")
    data: Path | None = option(None, "Data directory: all that is written.", metavar="DIR")
    machine: str | None = option(None, "Machine description (TOML).", metavar="FILE or NAME")
    profile: str | None = option(None, "Calibration profile: zero offsets.", metavar="NAME")
    truth: Path | None = some_file("Hidden misalignment (TOML, parameter = value).")
    sample: str | None = option(None, "On the stage at start, or 'empty'.", metavar="NAME")
    speed_up: str = option("1", "Twin seconds per second of yours.", metavar="X or max")
    physics: Physics = option("ideal", "How images are made, see docs/physics.md.")
    scatter: Scatter = option(
        "off", "Scattered radiation, for physics mono and poly.", metavar="off or mc",
        parser=scatter_method,
    )  # fmt: skip
    fresh: bool = option(False, "Forget where the last twin left off.")


@dataclass(frozen=True, kw_only=True)
class TwinSettings(ScannerSettings):
    """`flexdt twin`."""

    command = "twin"
    data: Path = option(Path("data"), "Data directory: all that is written.", metavar="DIR")
    machine: str = option("flexray", "Machine description (TOML).", metavar="FILE or NAME")
    projector: Address = option(
        Address(LOOPBACK, 55001),
        "Where the projector listens.",
        metavar="HOST:PORT",
        parser=address,
    )
    projectors: str | None = further_projectors()
    projector_token_file: Path | None = some_file("Shown to the projectors.")
    projector_tls_ca: Path | None = some_file("Speak TLS with it; trust this.")
    no_noise: bool = option(False, "Counts are expectations.", public=False)


@dataclass(frozen=True, kw_only=True)
class TwinClientSettings(ProcessSettings):
    """What viewer and gateway share: where the twin is and what they know of it."""

    data: Path | None = option(None, "The twin's data directory.", metavar="DIR")
    machine: Path | None = option(None, "The twin's, where it is a file.", metavar="FILE or NAME")
    profile: Path | None = option(None, "The twin's, where it is a file.", metavar="NAME")
    token_file: Path | None = some_file("Shown to the twin.")
    twin_cert: Path | None = some_file("Trust it as the twin's.")


@dataclass(frozen=True, kw_only=True)
class ViewerSettings(TwinClientSettings, ServerSettings):
    """`flexdt viewer`."""

    command = "viewer"
    port: int = tcp_port(8080, "0 is any free.", "--port", "--viewer-port")
    twin: Address = where_the_twin_is()
    token_file: Path | None = some_file("Shown to the twin; browsers must show its token.")


@dataclass(frozen=True, kw_only=True)
class GatewaySettings(TwinClientSettings):
    """`flexdt gateway`."""

    command = "gateway"
    host: str = option(
        LOOPBACK, "Loopback only; else use a tunnel.", "--bind", "--host", metavar="HOST"
    )
    port: int = tcp_port(50000, "Events go out there; 0 is any free.")
    inbound_port: int | None = tcp_port(None, "Events come in; default: the next.")
    server: Address = where_the_twin_is()
    data: Path = option(Path("data"), "Images are saved there.", metavar="DIR")


@dataclass(frozen=True, kw_only=True)
class UpSettings(ScannerSettings):
    """`flexdt up`: those of the twin, and what the other processes need."""

    command = "up"
    projector_port: int = tcp_port(55001, "0 is any free.")
    projector_memory: str | None = option(
        None, "Of the projector's volumes; e.g. 4GiB.", metavar="SIZE"
    )
    projectors: str | None = further_projectors()
    projector_token_file: Path | None = some_file("Shown to the projectors.")
    viewer_port: int = tcp_port(8080, "0 is any free.")
    no_viewer: bool = option(False, "Without the browser.")
    gateway_port: int | None = tcp_port(
        None, "Acquila's interface there and on the next; see gateway.", most=LARGEST_PORT - 1
    )


S = TypeVar("S", bound=ProcessSettings)


def parameters(settings: type[ProcessSettings]) -> dict[str, inspect.Parameter]:
    """The options of a process, as parameters of a function that typer reads."""
    hints, found = get_type_hints(settings), {}
    for f in fields(settings):
        flags = f.metadata["flags"] or (f"--{f.name.replace('_', '-')}",)
        default = str(f.default) if isinstance(f.default, Address) else f.default
        kind: Any = list[str] if isinstance(default, tuple) else hints[f.name]
        found[f.name] = inspect.Parameter(
            f.name, inspect.Parameter.KEYWORD_ONLY,
            default=[*default] if isinstance(default, tuple) else default,
            annotation=Annotated[kind, typer.Option(*flags, **f.metadata["details"])],
        )  # fmt: skip
    return found


def has_parameters(command: Callable[..., Any], shown: Iterable[inspect.Parameter]) -> None:
    """Have typer see these parameters as those of a command, by name alone."""
    named = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in shown]
    command.__signature__ = inspect.Signature(named)  # type: ignore[attr-defined]
    command.__annotations__ = {p.name: p.annotation for p in named}


def parse(settings: type[S], words: Sequence[str] | None = None) -> S:
    """The settings that a process was started with; exits with code 2 where they are wrong.

    Args:
        settings: class of the process.
        words: of the command line, `sys.argv`'s where left out.
    """
    found: dict[str, Any] = {}

    def take(**given: Any) -> None:
        found.update({n: tuple(v) if isinstance(v, list) else v for n, v in given.items()})

    has_parameters(take, parameters(settings).values())
    app = typer.Typer(add_completion=False, rich_markup_mode=None)
    app.command()(take)
    prog = f"flexdt {settings.command}"
    try:
        get_command(app).main(words, prog, standalone_mode=False)
    except Exception as error:
        if not hasattr(error, "format_message"):  # that of typer's usage errors, any version
            raise
        print(f"{prog}: {error.format_message()}", file=sys.stderr)
        sys.exit(2)
    if not found:  # the help was shown
        sys.exit(0)
    return settings(**found)


def words(given: Mapping[str, object]) -> list[str]:
    """Options as words of a command line.

    Args:
        given: name -> value; None and False are left out, True is a bare flag, a list or tuple is
            given once for each item.
    """
    out = []
    for name, value in given.items():
        flag = f"--{name.replace('_', '-')}"
        if value is True:
            out.append(flag)
        elif value is not None and value is not False:
            each: Iterable[object] = value if isinstance(value, list | tuple) else [value]
            out += [word for item in each for word in (flag, str(item))]
    return out


def shared(settings: ProcessSettings, other: type[ProcessSettings]) -> dict[str, object]:
    """The values of `settings` that a process with settings `other` takes too, by name."""
    mine = {f.name for f in fields(settings)}
    return {f.name: getattr(settings, f.name) for f in fields(other) if f.name in mine}


class OneLine(argparse.ArgumentParser):
    """Reports a wrong option in one line, without the page of all options."""

    def error(self, message: str) -> NoReturn:
        """Exit with code 2."""
        self.exit(2, f"{self.prog}: {message}\n")
