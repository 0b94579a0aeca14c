"""The projector as a process: its ready line, its end, and what it refuses."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Sequence

import numpy as np
import pytest
import typer

from flexdt.runtime.process_settings import memory_size
from flexdt.runtime.wire_errors import ProjectorUnavailable
from flexdt.server.projector import compute, wire
from flexdt.server.projector.service import serve_projector
from flexdt.twin.projection import Volume, forward
from flexdt.twin.projection.analytic_solids import Scene, Solid, Sphere
from tests.support.projector_user import ProjectorUser

COMMAND = (sys.executable, "-m", "flexdt.server.projector.main")


def start(*options: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        (*COMMAND, *options), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def refused(options: Sequence[str], env: dict[str, str] | None = None) -> tuple[int, str]:
    done = subprocess.run(
        (*COMMAND, *options), capture_output=True, text=True, timeout=120, check=False,
        env={**os.environ, **(env or {})},
    )  # fmt: skip
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    return done.returncode, done.stderr


@pytest.mark.slow
def test_ready_line_service_and_sigterm() -> None:
    process = start("--port", "0", "--threads", "1", "--memory-limit", "64M")
    try:
        assert process.stdout is not None
        ready = json.loads(process.stdout.readline())
        assert ready["ready"] == "projector"
        assert ready["host"] == "127.0.0.1"
        assert (ready["threads"], ready["memory_limit"]) == (1, 64 * 2**20)

        async def talk() -> None:
            async with ProjectorUser(port=ready["port"]) as client:
                await client.put(
                    "s", Scene((Solid(Sphere((0, 0, 0), 2.0), "steel", 0.5),))
                )
                row = [0, -60, 0, 0, 40, 0, 0.4, 0, 0, 0, 0, -0.4]
                seen = await client.project("s", row, (31, 41))
                assert seen[0, 15, 20] == np.float32(2.0)
                assert (await client.health()).threads == 1

        asyncio.run(talk())
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=30)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == 0
    assert out == ""
    assert "Traceback" not in err


@pytest.mark.slow
def test_what_it_refuses_is_one_line_and_a_code() -> None:
    code, text = refused(["--host", "0.0.0.0", "--port", "0"], {"FLEXDT_TOKEN": ""})
    assert code == 2
    assert "needs a token" in text
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        code, text = refused(["--port", str(taken.getsockname()[1])])
    assert code == 4
    assert "cannot listen" in text
    code, text = refused(["--memory-limit", "lots"])
    assert code == 2


@pytest.mark.parametrize(
    ("text", "size"),
    [("1000", 1000), ("4GiB", 2**32), ("512M", 2**29), ("1.5k", 1536), ("2 TB", 2**41)],
)
def test_memory_sizes(text: str, size: int) -> None:
    assert memory_size(text) == size


@pytest.mark.parametrize("text", ["", "GiB", "12X", "-1G", "0", "nan"])
def test_memory_sizes_that_are_none(text: str) -> None:
    with pytest.raises(typer.BadParameter, match="not a size"):
        memory_size(text)


@pytest.mark.slow
def test_a_projector_that_hangs_is_given_up_and_used_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A stopped process keeps its connection, and the system goes on accepting for it."""
    monkeypatch.setattr(wire, "SILENT_S", 1.0)
    monkeypatch.setattr(wire, "ASK_AGAIN_S", 0.3)
    process = start("--port", "0", "--threads", "1")
    try:
        assert process.stdout is not None
        port = json.loads(process.stdout.readline())["port"]
        row = [0, -60, 0, 0, 40, 0, 0.4, 0, 0, 0, 0, -0.4]

        async def talk() -> None:
            async with ProjectorUser(port=port, patience_s=2.0) as client:
                await client.put(
                    "s", Scene((Solid(Sphere((0, 0, 0), 2.0), "steel", 0.5),))
                )
                first = await client.project("s", row, (31, 41))
                process.send_signal(signal.SIGSTOP)
                for _ in range(2):  # the connection that stood, and one that is opened
                    with pytest.raises(ProjectorUnavailable):
                        await asyncio.wait_for(client.project("s", row, (31, 41)), 20.0)
                process.send_signal(signal.SIGCONT)
                again = await asyncio.wait_for(client.project("s", row, (31, 41)), 20.0)
                np.testing.assert_array_equal(again, first)

        asyncio.run(talk())
    finally:
        process.kill()
        process.communicate(timeout=30)


@pytest.mark.slow
def test_a_projector_that_computes_for_long_is_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(wire, "SILENT_S", 2.0)
    monkeypatch.setattr(wire, "ASK_AGAIN_S", 0.3)
    computing = threading.Event()

    def slow(*given: object) -> np.ndarray:
        computing.set()
        time.sleep(6.0)  # three times as long as a silent one is believed
        return forward(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(compute, "project_body", slow)
    volume = Volume(np.ones((8, 8, 8), np.float32), 1.0)
    row = np.array([0, -60, 0, 0, 40, 0, 0.4, 0, 0, 0, 0, -0.4])

    async def talk() -> None:
        server = await serve_projector(memory_limit=1 << 24)
        async with ProjectorUser(port=server.port) as client:
            await client.put("v", volume)
            seen = await client.project("v", row, (31, 41))
            np.testing.assert_array_equal(seen, forward(volume, row, (31, 41)))
        await server.close()

    asyncio.run(talk())
    assert computing.is_set()
