"""/healthz, /metrics, logs that stop nobody, and one request followed through both servers."""

from __future__ import annotations

import contextlib
import fcntl
import io
import json
import logging
import os
import socket
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from lab import Process, Wire, fly_script, projector, twin

from flexdt.runtime.http_pages import Requests, gauge, render
from flexdt.runtime.log import Apart, JsonLines

pytestmark = [pytest.mark.timeout(240), pytest.mark.slow]
WATCHED = ("--http-port", "0", "--log-level", "debug")


@pytest.fixture(scope="module")
def rays() -> Iterator[Process]:
    process = projector(*WATCHED)
    yield process
    process.end()


@pytest.fixture(scope="module")
def server(rays: Process, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Process]:
    data = tmp_path_factory.mktemp("watched")
    process = twin(rays.port, data, "--speed-up", "max", *WATCHED)
    yield process
    assert process.end() == 0


def get(process: Process, path: str) -> tuple[int, str, str]:
    url = f"http://127.0.0.1:{process.ready['http_port']}{path}"
    try:
        with urllib.request.urlopen(url, timeout=20) as answer:
            return answer.status, answer.headers["Content-Type"], answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, "", error.read().decode()


def samples(text: str) -> dict[str, float]:
    """A reader of the text format, written from its description."""
    out = {}
    for line in text.splitlines():
        if line and not line.startswith("#"):
            name, _, value = line.rpartition(" ")
            assert name not in out, f"{name} twice"
            out[name] = float(value)
    return out


def test_health_and_metrics_of_both(server: Process, rays: Process) -> None:
    wire = Wire(server.port)
    wire.call("axes.move", targets={"mag_obj": 444}, wait=True)
    wire.ask("axes.move", targets={"mag_obj": -1})
    wire.ask('no.such\nmethod"')
    job = wire.call("script.submit", text=fly_script(13), name="watched")["job"]
    wire.wait(job, "done")
    status, _, text = get(server, "/healthz")
    health = json.loads(text)
    assert (status, health["status"], health["projector"]) == (200, "ok", "connected")
    status, kind, text = get(server, "/metrics")
    assert (status, kind.split(";")[0]) == (200, "text/plain")
    found = samples(text)
    assert found['flexdt_requests_total{code="ok",method="axes.move"}'] == 1.0
    assert found['flexdt_requests_total{code="-32001",method="axes.move"}'] == 1.0
    assert found['flexdt_requests_total{code="-32601",method="unknown"}'] == 1.0
    assert found['flexdt_request_seconds_count{method="axes.move"}'] == 2.0
    assert found['flexdt_request_seconds_bucket{le="+Inf",method="axes.move"}'] == 2.0
    assert found['flexdt_jobs{state="done"}'] == 1.0
    assert found["flexdt_frames_total"] == 13.0
    assert found["flexdt_connections"] == 1.0
    assert found["process_resident_memory_bytes"] > 1e7
    assert samples(get(rays, "/metrics")[2])["flexdt_views_total"] >= 14.0
    assert json.loads(get(rays, "/healthz")[2])["status"] == "ok"
    assert get(server, "/")[0] == get(server, "/metrics/../x")[0] == 404


def _under(trace: object, of: str) -> bool:
    return str(trace).startswith(f"{of}/")


def test_one_request_bears_one_id_in_both_logs(server: Process, rays: Process) -> None:
    wire = Wire(server.port)
    wire.call("axes.move", targets={"rot_obj": 12}, wait=True)
    wire.call("projection.get", binning=8)
    until = time.monotonic() + 60.0  # lines are written by a thread of their own
    while True:
        mine = [
            e["trace"]
            for e in server.logged("debug")
            if e.get("method") == "projection.get"
        ]
        theirs = [
            e for e in rays.logged("debug") if mine and _under(e.get("trace"), mine[-1])
        ]
        if theirs and theirs[-1]["method"] == "project":
            break
        assert time.monotonic() < until, (mine, theirs)
        time.sleep(0.05)
    frames = [
        e["trace"]
        for e in rays.logged("debug")
        if str(e["trace"]).startswith("job-1.scan_")
    ]
    assert frames  # a scan's frames are named by job and file


@pytest.mark.parametrize(
    ("sent", "status"),
    [
        (b"POST /healthz HTTP/1.1\r\nContent-Length: 0\r\n\r\n", b"405"),
        (b"GET /" + b"x" * 100_000 + b" HTTP/1.1\r\n\r\n", b"414"),
        (b"HEAD /healthz HTTP/1.0\r\n\r\n", b"200"),
    ],
)
def test_http_takes_little(server: Process, sent: bytes, status: bytes) -> None:
    with socket.create_connection(
        ("127.0.0.1", server.ready["http_port"]), timeout=20
    ) as s:
        s.sendall(sent)
        got = b""
        while part := s.recv(65536):
            got += part
    head, _, body = got.partition(b"\r\n\r\n")
    assert head.split(b" ")[1] == status
    assert body in (b"", b"{}") or status == b"414"


def test_clients_that_send_half_a_request_hold_up_nobody(
    rays: Process, tmp_path: Path
) -> None:
    """Neither the pages, nor the loop, nor the end of the process."""
    process = twin(rays.port, tmp_path / "data", "--http-port", 0)
    address = "127.0.0.1", process.ready["http_port"]
    with contextlib.ExitStack() as stack:
        for said in (b"", b"GET /metrics HTTP/1.1\r\nHost:", b"\x00\xff\xfe") * 10:
            stack.enter_context(socket.create_connection(address, timeout=20)).sendall(
                said
            )
        assert get(process, "/healthz")[0] == 200
        assert Wire(process.port).call("state.get")["time"] >= 0.0
        begun = time.monotonic()
        assert process.end() == 0
        assert time.monotonic() - begun < 60.0


def test_beyond_the_loopback_metrics_want_the_token(
    rays: Process, tmp_path: Path
) -> None:
    token = tmp_path / "token"
    token.write_text("a-token-of-some-length\n")
    process = twin(rays.port, tmp_path / "data", "--http-port", 0, "--http-host", "0.0.0.0",
                   "--token-file", token)  # fmt: skip
    try:
        assert get(process, "/healthz")[0] == 200
        assert get(process, "/metrics")[0] == 401
        url = f"http://127.0.0.1:{process.ready['http_port']}/metrics"
        request = urllib.request.Request(
            url, headers={"Authorization": "Bearer a-token-of-some-length"}
        )
        with urllib.request.urlopen(request, timeout=20) as answer:
            assert answer.status == 200
    finally:
        process.end()
    with pytest.raises(RuntimeError, match="token"):
        twin(rays.port, tmp_path / "open", "--http-port", 0, "--http-host", "0.0.0.0",
             env={"FLEXDT_TOKEN": ""})  # fmt: skip


def test_metrics_escape_and_buckets_add_up() -> None:
    requests = Requests()
    for seconds in (0.0005, 0.003, 0.003, 99.0):
        requests.observe("m", seconds, None)
    odd = gauge("g", "A gauge.", {'a"b\\c\nd': 1.0}, "label")
    found = samples(render([*requests.figures(), odd]))
    assert found['flexdt_request_seconds_bucket{le="0.001",method="m"}'] == 1.0
    assert found['flexdt_request_seconds_bucket{le="0.005",method="m"}'] == 3.0
    assert found['flexdt_request_seconds_bucket{le="5.0",method="m"}'] == 3.0
    assert found['flexdt_request_seconds_bucket{le="+Inf",method="m"}'] == 4.0
    assert found['flexdt_request_seconds_sum{method="m"}'] == pytest.approx(99.0065)
    assert found['g{label="a\\"b\\\\c\\nd"}'] == 1.0


def test_a_reader_of_the_log_that_is_stuck_stops_nobody() -> None:
    gate = threading.Event()

    class Stuck(io.StringIO):
        def write(self, text: str) -> int:
            gate.wait(30.0)
            return super().write(text)

    stream = Stuck()
    target = logging.StreamHandler(stream)
    target.setFormatter(JsonLines())
    handler = Apart(target, room=5)
    for i in range(50):
        record = logging.LogRecord("flexdt", logging.INFO, "", 0, f"line {i}", (), None)
        handler.emit(record)  # returns at once, or this test would hang
    assert handler.dropped >= 44
    gate.set()
    handler.close()
    written = [json.loads(line)["event"] for line in stream.getvalue().splitlines()]
    assert written == [f"line {i}" for i in range(len(written))]
    assert 5 <= len(written) <= 6


def test_a_twin_whose_log_nobody_reads_goes_on(rays: Process, tmp_path: Path) -> None:
    read, write = os.pipe()
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, 4096)
    process = None
    try:
        import subprocess

        process = subprocess.Popen(
            [sys.executable, "-m", "flexdt.server.twin.main", "--port", "0", "--data",
             str(tmp_path), "--projector", f"127.0.0.1:{rays.port}", "--log-level", "debug"],
            stdout=subprocess.PIPE, stderr=write,
        )  # fmt: skip
        assert process.stdout is not None
        port = json.loads(process.stdout.readline())["port"]
        wire = Wire(port)
        for _ in range(200):  # each writes a line
            wire.call("session.ping")
        assert wire.call("state.get")["time"] > 0.0
    finally:
        if process is not None:
            process.kill()
            process.communicate()
        os.close(read)
        os.close(write)
