"""Options that several servers' processes share. It refuses to know what the servers do."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NoReturn

from flexdt.server.log import LEVELS
from flexdt.server.supervisor import Address
from flexdt.twin.machine import Machine, Profile, parse_machine, parse_profile


class OneLine(argparse.ArgumentParser):
    """Tells a wrong option in one line, without the page of all options."""

    def error(self, message: str) -> NoReturn:
        """Leave with exit code 2."""
        self.exit(2, f"{self.prog}: {message}\n")


def address(text: str) -> Address:
    """The address of HOST:PORT or [IPv6]:PORT.

    Raises:
        argparse.ArgumentTypeError: it is none.
    """
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not HOST:PORT")
    return Address(host.strip("[]"), int(port))


def machine_of(file: Path | None) -> Machine | None:
    """The machine of a TOML file; None (the twin names it) where there is none."""
    return None if file is None or not file.exists() else parse_machine(file.read_text(), str(file))


def profile_of(file: Path | None) -> Profile | None:
    """The profile of a TOML file; None where there is none."""
    return None if file is None or not file.exists() else parse_profile(file.read_text(), str(file))


def watching_options(p: argparse.ArgumentParser) -> None:
    """Add what concerns logs, `/healthz` and `/metrics`."""
    p.add_argument("--http-port", type=int, help="serve /healthz and /metrics there; 0: any free")
    p.add_argument("--http-host", default="127.0.0.1", help="beyond the loopback with a token only")
    p.add_argument("--log-level", choices=tuple(LEVELS), default="info",
                   help="debug: every request with its id")  # fmt: skip
