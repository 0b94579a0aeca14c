"""What goes wrong in a lab: a killed process, a client that leaves, a full disk. The scan
survives or is marked incomplete, nothing half-written stands under a final name, and nobody is
orphaned."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import tifffile

from flexdt.clients.launch.processes import Servers

pytestmark = pytest.mark.slow

Plain = Any
LINUX = pytest.mark.skipif(
    not Path("/proc/self/task").is_dir(), reason="needs Linux's /proc"
)


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Servers, Path]]:
    """Servers that these tests may harm, and their data directory; the last one kills them."""
    data = tmp_path_factory.mktemp("data")
    with Servers(
        {"data": data, "speed-up": "max"}, data.parent / "failures.log"
    ) as servers:
        yield servers, data


def children(pid: int) -> list[int]:
    return [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def process_of(servers: Servers, module: str) -> int:
    """Process id of a server, found by the module it runs."""
    for pid in children(servers.pid):
        if module in Path(f"/proc/{pid}/cmdline").read_text().split("\0"):
            return pid
    raise AssertionError(f"no process runs {module}")


def gone(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return True
    return state == "Z"


def whole(folder: Path, shape: tuple[int, int]) -> int:
    """Number of images under final names; every one must be whole."""
    files = sorted(folder.glob("*.tif"))
    for file in files:
        assert tifffile.imread(file).shape == shape, file
    return len(files)


def started(
    own: tuple[Servers, Path],
    connect: Callable[..., Plain],
    script: str,
    frames: int,
    name: str,
) -> tuple[Plain, str]:
    """A scan in progress, `frames` of it done."""
    client = connect(own[0].address)
    client.call("sample.set", name="normal-5")
    job = client.call("script.submit", text=script, name=name)["job"]
    client.until(job, lambda s: s["frames_done"] >= frames)
    return client, job


@LINUX
def test_projector_killed_in_mid_scan(
    own: tuple[Servers, Path],
    connect: Callable[..., Plain],
    fly_script: Callable[..., str],
) -> None:
    client, job = started(own, connect, fly_script(181, exposure_ms=100), 5, "killed")
    os.kill(process_of(own[0], "flexdt.server.projector.main"), signal.SIGKILL)
    status = client.until(job, lambda s: s["state"] not in ("queued", "running"))
    if (
        status["state"] == "paused"
    ):  # the projector was away for longer than the twin waits
        assert "projector" in status["error"]["message"]
        client.call("job.resume", job=job)
        status = client.wait(job)
    assert (status["state"], status["frames_done"]) == ("done", 181)
    assert whole(own[1] / "killed", (160, 200)) == 183
    assert client.call("projection.get", binning=8)["shape"]


def test_client_gone_in_mid_scan(
    own: tuple[Servers, Path],
    connect: Callable[..., Plain],
    fly_script: Callable[..., str],
) -> None:
    client, job = started(own, connect, fly_script(121, exposure_ms=100), 3, "left")
    client.close()
    other = connect(own[0].address)
    assert other.wait(job)["state"] == "done"
    assert whole(own[1] / "left", (160, 200)) == 123
    other.call("axes.move", targets={"tra_obj": 1}, wait=True)


@LINUX
def test_disk_full_in_mid_scan(
    own: tuple[Servers, Path],
    connect: Callable[..., Plain],
    fly_script: Callable[..., str],
) -> None:
    """Files beyond a size cannot be written: what a write error looks like to the twin."""
    import resource

    client, job = started(own, connect, fly_script(121, exposure_ms=100), 3, "full")
    twin = process_of(own[0], "flexdt.server.twin.main")
    resource.prlimit(twin, resource.RLIMIT_FSIZE, (40_000, resource.RLIM_INFINITY))
    status = client.until(job, lambda s: s["state"] not in ("queued", "running"))
    assert (status["state"], status["error"]["code"]) == ("paused", -32001)
    assert status["error"]["message"]
    assert status["retry_s"] is not None
    folder = own[1] / "full"
    # Every frame that counts is there; of the batch that failed some may be, and are kept.
    assert status["frames_done"] + 2 <= whole(folder, (160, 200)) < 123
    assert json.loads((folder / "flexdt.json").read_text())["complete"] is False
    # With room again it goes on by itself.
    resource.prlimit(twin, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
    assert client.wait(job)["state"] == "done"
    assert whole(folder, (160, 200)) == 123


def test_abort_marks_the_data_set_incomplete(
    own: tuple[Servers, Path],
    connect: Callable[..., Plain],
    fly_script: Callable[..., str],
) -> None:
    client, job = started(own, connect, fly_script(361, exposure_ms=100), 3, "aborted")
    client.call("job.abort", job=job)
    status = client.wait(job)
    assert status["state"] == "aborted"
    folder = own[1] / "aborted"
    assert whole(folder, (160, 200)) < 363
    assert "SCRIPT CANCELLED!" in (folder / "scan settings.txt").read_text(
        errors="replace"
    )
    assert not [p for p in folder.rglob("*") if p.suffix in (".part", ".tmp")]


@LINUX
@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
@pytest.mark.campaign(1)
def test_up_stops_cleanly(number: signal.Signals, tmp_path: Path) -> None:
    words = ["up", "--port", "0", "--projector-port", "0", "--viewer-port", "0",
             "--data", str(tmp_path)]  # fmt: skip
    with subprocess.Popen(
        [sys.executable, "-m", "flexdt.clients.cli", *words],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
    ) as up:  # fmt: skip
        assert up.stdout is not None
        ready = json.loads(up.stdout.readline())
        assert ready["ready"] == "up"
        pids = children(up.pid)
        assert len(pids) == 3
        assert urllib.request.urlopen(ready["viewer"]["url"], timeout=30).status == 200
        address = (ready["host"], ready["port"])
        socket.create_connection(address).close()
        # Ctrl-C reaches the whole foreground group, SIGTERM only the process itself.
        os.killpg(up.pid, number) if number is signal.SIGINT else up.send_signal(number)
        out, err = up.communicate(timeout=120)
    assert up.returncode == 0, err
    assert out == b""
    assert b"Traceback" not in err
    assert all(gone(pid) for pid in pids)
    with socket.socket() as probe:
        assert probe.connect_ex(address) != 0


@LINUX
def test_nobody_is_orphaned_when_the_supervisor_is_killed(
    own: tuple[Servers, Path],
) -> None:
    pids = children(own[0].pid)
    assert len(pids) == 2
    os.kill(own[0].pid, signal.SIGKILL)
    deadline = time.monotonic() + 60
    while not all(gone(pid) for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert all(gone(pid) for pid in pids)


FOUR = ("flexdt.server.projector.main", "flexdt.server.twin.main",
        "flexdt.clients.viewer.main", "flexdt.clients.gateway.main")  # fmt: skip


@LINUX
@pytest.mark.campaign
def test_servers_killed_while_they_start_come_back_on_their_ports(tmp_path: Path) -> None:
    """Each of the four twice before it is ready, and twice more once the lab stands."""
    words = ("--port", "0", "--projector-port", "0", "--viewer-port", "0", "--gateway-port", "0",
             "--data", str(tmp_path / "data"))  # fmt: skip
    log = (tmp_path / "log").open("wb")
    up = subprocess.Popen([sys.executable, "-m", "flexdt.clients.launch.up", *words],
                          stdout=subprocess.PIPE, stderr=log)  # fmt: skip
    assert up.stdout is not None
    os.set_blocking(up.stdout.fileno(), False)
    line, left = b"", dict.fromkeys(FOUR, 2)
    killed: list[int] = []

    def kill_those_that_start() -> None:
        for pid in children(up.pid):
            try:
                words = Path(f"/proc/{pid}/cmdline").read_text().split("\0")
                module = words[words.index("-m") + 2]
            except (
                OSError,
                IndexError,
                ValueError,
            ):  # it is only being made, or has gone
                continue
            if left.get(module, 0) and pid not in killed:
                left[module] -= 1
                killed.append(pid)
                time.sleep(0.15 * left[module])  # once at once, once into its imports
                os.kill(pid, signal.SIGKILL)

    deadline = time.monotonic() + 240
    try:
        while not line:
            assert up.poll() is None, (tmp_path / "log").read_text()
            assert time.monotonic() < deadline
            kill_those_that_start()
            line = up.stdout.readline() or b""
        ready = json.loads(line)
        assert not any(left.values())
        left.update(dict.fromkeys(FOUR, 2))
        killed += children(up.pid)
        for pid in killed[-4:]:
            os.kill(pid, signal.SIGKILL)
        while any(left.values()):
            assert time.monotonic() < deadline
            kill_those_that_start()
        names = ("projector", "twin", "viewer", "gateway")
        while any(refused(ready[name]) for name in names):
            assert time.monotonic() < deadline, [n for n in names if refused(ready[n])]
            time.sleep(0.1)
        assert up.poll() is None
        pids = children(up.pid)
        assert len(pids) == 4
        assert not {*pids} & {*killed}
    finally:
        up.terminate()
        assert up.wait(60) == 0
        up.stdout.close()
        log.close()
    assert all(gone(pid) for pid in (*pids, *killed))


def refused(address: dict[str, Any]) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((address["host"], address["port"])) != 0


def test_up_with_bad_files_says_what_is_wrong(tmp_path: Path) -> None:
    machine = tmp_path / "mine.toml"
    machine.write_text("schema = 1\nname = 3\n")
    words = ["up", "--port", "0", "--projector-port", "0", "--no-viewer",
             "--data", str(tmp_path), "--machine", str(machine)]  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-m", "flexdt.clients.cli", *words],
        capture_output=True, text=True, timeout=200, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stdout == ""
    assert "name" in done.stderr
    assert "Traceback" not in done.stderr
