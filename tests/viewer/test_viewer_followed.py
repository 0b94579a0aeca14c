"""The window of a followed machine: `flexdt follow --port` and a viewer, in a real browser."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zmq

from tests.support.scanner_traffic import event
from tests.viewer.conftest import PATIENCE_S, Process
from tests.viewer.looking import until

pytestmark = pytest.mark.browser

MOVE = ("tra_obj", "move absolute", "50.0")
REFUSED = """
flexdt.call('axes.move', {targets: {tra_obj: 1}}).then(() => '', (error) => error.message)
"""


def free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


def test_the_window_shows_the_scanner_as_heard_and_commands_nothing(
    chromium: Any, tmp_path: Path
) -> None:
    port = free_port()
    context = zmq.Context()
    out = context.socket(zmq.XPUB)
    scanner = out.bind_to_random_port("tcp://127.0.0.1")
    words = ("follow", f"tcp://127.0.0.1:{scanner}", "--port", str(port))
    follower = subprocess.Popen(
        [sys.executable, "-m", "flexdt.clients.cli", *words], stdout=subprocess.DEVNULL
    )
    viewer = None
    try:
        assert out.poll(60_000)
        assert out.recv() == b"\x01"
        viewer = Process(
            "flexdt.clients.viewer.main", "--port", "0", "--twin", f"127.0.0.1:{port}",
            "--data", str(tmp_path / "data"), log=tmp_path / "log",
        )  # fmt: skip
        page = chromium.new_page()
        page.set_default_timeout(120_000)
        page.goto(f"{viewer.ready['url']}?view=none&patience={PATIENCE_S}")
        page.wait_for_function("window.flexdt?.store.state && window.flexdt.store.session")
        for data in (event(1, MOVE), event(1, MOVE, "ACK", "50.3000000000")):
            out.send(data)
        where = "flexdt.store.state.axes.tra_obj.position"
        until(lambda: page.evaluate(where) == 50.3, "the position that was heard")
        said: Callable[[], str] = lambda: str(page.locator("#warnings").inner_text())  # noqa: E731
        until(lambda: "tra_obj stands at 50.3 mm after a move to 50" in said(), "the alarm")
        assert "connected, last message" in said()
        assert page.evaluate("flexdt.store.near.mm") > 0.0
        assert "nothing commands it" in page.evaluate(REFUSED)
        assert page.evaluate(where) == 50.3
        assert not out.poll(50), "nothing is ever sent to the scanner"
        out.close(linger=0)
        until(lambda: "the link is lost" in said(), "a lost link")
        page.close()
    finally:
        if viewer is not None:
            viewer.stop()
        follower.terminate()
        follower.wait(60)
        out.close(linger=0)
        context.term()
