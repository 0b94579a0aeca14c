"""What the reliability studies share: servers as processes, a plain wire, scripts, figures.

Nothing of flexdt is imported here, so what a study finds it finds from outside.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import json
import os
import platform
import re
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

Plain = Any
STARTED_WITHIN_S = 240.0


class Process:
    """A server module with its `ready` line; its log goes to a file."""

    def __init__(
        self, module: str, *options: object, log: Path | None = None, env: Plain = None
    ) -> None:
        """Start a server module and wait for its `ready` line.

        Args:
            module: run with -m.
            options: of its command line.
            log: takes what it writes to stderr; None for a file that goes with this
                process.
            env: added to the environment.

        Raises:
            RuntimeError: there is no line within STARTED_WITHIN_S, or it has ended.
        """
        if log is None:
            number, name = tempfile.mkstemp(prefix="flexdt-", suffix=".log")
            os.close(number)
            log = Path(name)
            atexit.register(log.unlink, missing_ok=True)
        self.log = log
        with self.log.open("ab") as err:
            self.child = subprocess.Popen(
                # `child` ends it should this program be killed: a study leaves no orphans.
                [
                    sys.executable,
                    "-m",
                    "flexdt.runtime.child",
                    module,
                    *map(str, options),
                ],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=err,
                env={**os.environ, **(env or {})},
            )
        assert self.child.stdout is not None
        there, _, _ = select.select([self.child.stdout], [], [], STARTED_WITHIN_S)
        line = self.child.stdout.readline() if there else b""
        if not line:
            self.kill()
            raise RuntimeError(f"{module} did not start: {self.log.read_text()[-2000:]}")
        self.ready: dict[str, Any] = json.loads(line)

    @property
    def port(self) -> int:
        return int(self.ready["port"])

    @property
    def pid(self) -> int:
        return self.child.pid

    def alive(self) -> bool:
        return self.child.poll() is None

    def kill(self) -> None:
        """kill -9: nothing is said, nothing is flushed."""
        with contextlib.suppress(ProcessLookupError):
            self.child.send_signal(signal.SIGKILL)
        self.child.wait()

    def end(self) -> int:
        """End it by SIGTERM, after 30 s by SIGKILL; the exit code."""
        if self.alive():
            self.child.terminate()
            try:
                self.child.wait(30)
            except subprocess.TimeoutExpired:
                self.kill()
        return self.child.returncode

    def logged(self, *levels: str) -> list[dict[str, Any]]:
        """Lines of the log of these levels (all without any), as documents."""
        out = []
        for line in self.log.read_text(errors="replace").splitlines():
            try:
                entry = json.loads(line)
            except ValueError:
                entry = {"level": "unstructured", "event": line}
            if not levels or entry.get("level") in levels:
                out.append(entry)
        return out

    def memory_mb(self) -> float:
        """Its resident memory [MiB], without children."""
        status = Path(f"/proc/{self.pid}/status").read_text()
        return (
            int(next(x for x in status.splitlines() if x.startswith("VmRSS")).split()[1])
            / 1024
        )

    def processor_s(self) -> float:
        """Processor time so far [s]."""
        words = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")

    def children_mb(self) -> float:
        """Most memory that a child of it has taken so far [MB]; 0 without children."""
        most = 0.0
        for task in Path(f"/proc/{self.pid}/task").iterdir():
            with contextlib.suppress(OSError):
                for child in (task / "children").read_text().split():
                    with contextlib.suppress(OSError, StopIteration):
                        lines = Path(f"/proc/{child}/status").read_text().splitlines()
                        peak = next(x for x in lines if x.startswith("VmHWM"))
                        most = max(most, int(peak.split()[1]) / 1024)
        return most

    def descriptors(self) -> int:
        return len(os.listdir(f"/proc/{self.pid}/fd"))


def projector(*options: object, **kept: Plain) -> Process:
    return Process(
        "flexdt.server.projector.main", "--port", 0, "--threads", 1, *options, **kept
    )


def twin(projector_port: int, data: Path, *options: object, **kept: Plain) -> Process:
    """Start a twin on a data directory.

    Args:
        projector_port: on this machine.
        data: the directory.
        options: more of its command line.
        kept: of `Process`.
    """
    return Process(
        "flexdt.server.twin.main", "--port", 0, "--projector", f"127.0.0.1:{projector_port}",
        "--data", data, *options, **kept,
    )  # fmt: skip


class Refused(Exception):
    """The server's answer was an error."""

    def __init__(self, error: dict[str, Any]) -> None:
        """Keep code, message and data of an answer's error."""
        super().__init__(f"{error['code']}: {error['message']}")
        self.code, self.message, self.data = (
            error["code"],
            error["message"],
            error.get("data"),
        )


class Wire:
    """JSON lines over a socket; events are kept apart from answers."""

    def __init__(self, port: int, timeout_s: float = 60.0) -> None:
        """Connect to a port of this machine; each read waits `timeout_s` at most."""
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=timeout_s)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.file = self.socket.makefile("rb")
        self.count = 0
        self.events: list[dict[str, Any]] = []

    def ask(self, method: str, **params: object) -> dict[str, Any]:
        """Send a request and return the whole answer, an error too; events before it are
        kept.
        """
        self.count += 1
        request = {"jsonrpc": "2.0", "id": self.count, "method": method, "params": params}
        self.socket.sendall(json.dumps(request).encode() + b"\n")
        while True:
            answer = self.read()
            if answer.get("method") == "event":
                self.events.append(answer["params"])
            elif answer.get("id") == self.count:
                return answer

    def read(self) -> dict[str, Any]:
        """Read the next message.

        Raises:
            ConnectionError: the server has closed the connection.
        """
        line = self.file.readline()
        if not line:
            raise ConnectionError("the server has closed the connection")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def call(self, method: str, **params: object) -> Any:
        """Send a request and return its result.

        Raises:
            Refused: the answer is an error.
        """
        answer = self.ask(method, **params)
        if "error" in answer:
            raise Refused(answer["error"])
        return answer["result"]

    def wait(self, job: str, *states: str, timeout_s: float = 120.0) -> dict[str, Any]:
        """Ask for a job's status until it has one of the states, and return it.

        Raises:
            AssertionError: it has not within `timeout_s`.
        """
        until = time.monotonic() + timeout_s
        while time.monotonic() < until:
            status: dict[str, Any] = self.call("job.status", job=job)
            if status["state"] in states:
                return status
            time.sleep(0.02)
        raise AssertionError(f"{job} did not become {states}: {status}")

    def close(self) -> None:
        self.file.close()
        self.socket.close()


def fly_script(
    frames: int, exposure_ms: float = 100.0, roi: str = "900 700 1027 827", steps: int = 0
) -> str:
    """The text of a fly scan of small images; speed and run-up follow the smooth-scan
    rule.

    Args:
        frames: at least two, over 360 deg.
        exposure_ms: of each.
        roi: left, top, right and bottom of the panel's region.
        steps: not used.
    """
    speed = 360.0 / (frames - 1) / (exposure_ms / 1000.0)
    run_up = speed * speed / (2 * 22.5) + 0.4 * speed
    rows = [
        "tube\tset power\t20.0\t\tACK\t\t",
        f"camera\tset ROI\t{roi}\t\tACK\t\t",
        f"camera\tset exposure\t{exposure_ms}\t\tACK\t\t",
        "camera\tset number of averages\t1\t\tACK\t\t",
        f"camera\tset number of frames\t{frames}\t\tACK\t\t",
        "ver_tube\tmove absolute\t26.0\t\tno wait\t\t",
        "ver_det\tmove absolute\t20.0\t\tACK\t\t",
        f"rot_obj\tset speed\t{speed}\t\tACK\t\t",
        f"rot_obj\tmove absolute\t{-run_up}\t\tACK\t\t",
        "tube\txrayoff\t\t\tACK\t\t",
        "camera\ttake image\t\t\tACK\t\t",
        "camera\tsave image\tdi000000.tif\t\tACK\t\t",
        "tube\txrayon\t\t\tACK\t\t",
        "camera\ttake image\t\t\tACK\t\t",
        "camera\tsave image\tio000000.tif\t\tACK\t\t",
        f"rot_obj\tmove absolute\t{360.0 + run_up}\t0.0\tPOS\t\t",
        "camera\ttake and save image sequence\tscan_\t0\tACK\t\t",
        "",
    ]
    return "\r\n".join(rows)


def digests(folder: Path, pattern: str = "*.tif") -> dict[str, str]:
    """SHA-256 of each file under its final name."""
    return {
        f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in folder.glob(pattern)
    }


DATES = re.compile(
    rb"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\.\d+)?)?(Z|[+-]\d\d:\d\d)?|\d{1,2}:\d\d:\d\d( [AP]M)?|"
    rb"\d{1,2}[-/.]\d{1,2}[-/.]\d{2,4}|\d{1,2} \w{3} \d{4}"
)


def timeless(text: bytes, name: str) -> bytes:
    """A text without its dates, durations and the data set's name."""
    text = DATES.sub(b"<date>", text.replace(name.encode(), b"<name>"))
    text = re.sub(rb'("duration_s": )[0-9.e+-]+', rb"\1<s>", text)
    return re.sub(
        rb"(?im)^(.*(?:duration|elapsed|scan time|total time).*?)[0-9.]+.*$",
        rb"\1<s>",
        text,
    )


def percentile(values: list[float], q: float) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(q * len(ordered)))]


def machine() -> str:
    """What these figures were measured on."""
    load = ", ".join(f"{x:.1f}" for x in os.getloadavg())
    return (
        f"{os.cpu_count()} cores, Python {platform.python_version()}, load average {load}"
    )
