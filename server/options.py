"""Options that several servers' processes share. It refuses to know what the servers do."""

from __future__ import annotations

import argparse

from flexdt.server.log import LEVELS


def watching_options(p: argparse.ArgumentParser) -> None:
    """Add what concerns logs, `/healthz` and `/metrics`."""
    p.add_argument("--http-port", type=int, help="serve /healthz and /metrics there; 0: any free")
    p.add_argument("--http-host", default="127.0.0.1", help="beyond the loopback with a token only")
    p.add_argument("--log-level", choices=tuple(LEVELS), default="info",
                   help="debug: every request with its id")  # fmt: skip
