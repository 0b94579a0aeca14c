"""Real processes on free ports, plain sockets, and small scripts for the journeys."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pytest

from flexdt.clients.launch.processes import Servers

FINAL = ("done", "failed", "aborted", "incomplete")


class Plain:
    """What `nc` does: lines out, lines in. Knows JSON-RPC, nothing of flexdt."""

    def __init__(self, address: tuple[str, int], timeout: float = 60.0) -> None:
        self.socket = socket.create_connection(address, timeout=timeout)
        self.file = self.socket.makefile("rb")
        self.id = 0

    def send(self, text: str) -> None:
        self.socket.sendall(text.encode() + b"\n")

    def receive(self) -> Any:
        line = self.file.readline()
        assert line, "the server closed the connection"
        return json.loads(line)

    def ask(self, method: str, **params: Any) -> dict[str, Any]:
        """Send a request; returns the whole answer, passing over events."""
        self.id += 1
        self.send(
            json.dumps(
                {"jsonrpc": "2.0", "id": self.id, "method": method, "params": params}
            )
        )
        while True:
            answer = self.receive()
            if answer.get("id") == self.id:
                return answer  # type: ignore[no-any-return]

    def call(self, method: str, **params: Any) -> Any:
        answer = self.ask(method, **params)
        assert "error" not in answer, answer
        return answer["result"]

    def wait(self, job: str, seconds: float = 120.0) -> dict[str, Any]:
        """The last status of a job."""
        return self.until(job, lambda s: s["state"] in FINAL, seconds)

    def until(
        self,
        job: str,
        condition: Callable[[Mapping[str, Any]], bool],
        seconds: float = 120.0,
    ) -> dict[str, Any]:
        deadline = time.monotonic() + seconds
        while True:
            status = self.call("job.status", job=job)
            if condition(status):
                return status  # type: ignore[no-any-return]
            assert time.monotonic() < deadline, json.dumps(status)
            time.sleep(0.05)

    def close(self) -> None:
        self.file.close()
        self.socket.close()


@pytest.fixture
def plain(servers: Servers) -> Iterator[Plain]:
    client = Plain(servers.address)
    yield client
    client.close()


@pytest.fixture
def connect() -> Iterator[Callable[[tuple[str, int]], Plain]]:
    """More plain clients, closed at the end."""
    made: list[Plain] = []

    def new(address: tuple[str, int]) -> Plain:
        made.append(Plain(address))
        return made[-1]

    yield new
    for client in made:
        client.close()


@pytest.fixture(scope="session")
def fly_script() -> Callable[..., str]:
    """A small fly scan: N images of 200 x 160 pixels about the middle of the sensor."""

    def make(
        frames: int = 12,
        exposure_ms: float = 50.0,
        roi: str = "800 620 1199 939",
        **moves: float,
    ) -> str:
        period = exposure_ms / 1000.0
        speed = 360.0 / (frames - 1) / period
        speed_limit = 90.0
        averages = 1
        while speed > speed_limit:
            averages += 1
            speed = 360.0 / (frames - 1) / (averages * period)
        run_up = speed**2 / (2 * 22.5) + 4 * averages * period * speed
        at = {"ver_tube": 26.2917, "ver_det": 20.0, "tra_det": 24.1215, "mag_det": 1000.0,
              "mag_obj": 585.0, "tra_obj": 0.5405} | moves  # fmt: skip
        lines = [
            "tube\tset kV\t90.0\t\tACK\t\t",
            "tube\tset power\t50.0\t\tACK\t\t",
            "camera\tset mode\tHW2SW1High\t\tACK\t\t",
            f"camera\tset exposure\t{exposure_ms}\t\tACK\t\t",
            f"camera\tset ROI\t{roi}\t\tACK\t\t",
            *(f"{axis}\tmove absolute\t{value}\t\tACK\t\t" for axis, value in at.items()),
            "tra_obj\tmove absolute\t-140.0\t\tACK\t\t",
            "camera\tset number of frames\t1\t\tACK\t\t",
            "camera\tset number of averages\t1\t\tACK\t\t",
            "tube\txrayoff\t\t\tACK\t\t",
            "camera\ttake image\t\t\tACK\t\t",
            "camera\tsave image\tE:\\x\\di000000.tif\t\tACK\t\t",
            "tube\txrayon\t\t\tACK\t\t",
            "camera\ttake image\t\t\tACK\t\t",
            "camera\tsave image\tE:\\x\\io000000.tif\t\tACK\t\t",
            f"tra_obj\tmove absolute\t{at['tra_obj']}\t\tACK\t\t",
            "rot_obj\tset speed\t45.0\t\tACK\t\t",
            "rot_obj\tset acceleration\t22.5\t\tACK\t\t",
            f"rot_obj\tmove absolute\t{-run_up:.6f}\t\tACK\t\t",
            f"rot_obj\tset speed\t{speed:.10f}\t\tACK\t\t",
            f"camera\tset number of frames\t{frames}\t\tACK\t\t",
            f"camera\tset number of averages\t{averages}\t\tACK\t\t",
            "scanner\twrite settings file\t\t\tACK\t\t",
            f"rot_obj\tmove absolute\t{360.0 + run_up:.6f}\t0.000000\tPOS\t\t",
            "camera\ttake and save image sequence\tE:\\x\\scan_\t0\tACK\t\t",
            "tube\txrayoff\t\t\tACK\t\t",
        ]
        return "\r\n".join(lines) + "\r\n"

    return make
