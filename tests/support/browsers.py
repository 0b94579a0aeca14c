"""The browser of the tests, and ports that servers keep over a restart."""

from __future__ import annotations

import os
import random
import socket
from typing import Any

import pytest

SHELL, WHOLE = "/usr/bin/chromium-headless-shell", "/usr/bin/chromium"
CHROMIUM = SHELL if os.access(SHELL, os.X_OK) else WHOLE
"""Chromium without a window's own pages, where it is installed: each of those costs .8 s of
processor time a page, seven times what the page itself takes to open."""
FLAGS = [
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic",
    "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--disable-gpu-compositing",
]  # fmt: skip
"""WebGL by SwiftShader; what lies around the scenes is put together without it, at an eighth of
the processor time."""

LEAST_PORT, MOST_PORT = 15_000, 30_000
"""Ports that Linux gives nobody by itself (net.ipv4.ip_local_port_range)."""


def kept_port() -> int:
    """Find a free port on which a server that was ended can start again: while it is away no
    other process gets that port as any free one.
    """
    while True:
        port = random.SystemRandom().randint(LEAST_PORT, MOST_PORT)
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port


def need_browser() -> Any:
    """playwright's entry, or a skip with a reason."""
    reason = None
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        reason = "playwright is not installed"
    if not os.access(CHROMIUM, os.X_OK):
        reason = f"{CHROMIUM} is missing (Debian's package chromium)"
    if reason is not None:
        pytest.skip(reason)
    return sync_playwright
