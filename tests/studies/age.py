"""An old twin beside a young one: `age.py --jobs 100000 --samples 10000`.

A directory is aged in two steps, a tenth and the whole: jobs as an earlier version left them (a
list in `state.json`), uploads of 16^3 voxels, corrections and small real scans by the wire.
Before and after each step the same requests are measured: processor time and bytes written a
request, the size of the state, memory of twin and projector, processor time of a start. Figures
that a machine's other work hardly changes decide: ends with 1 where one of them has grown by
more than `--allowed`. Nothing of flexdt is imported.
"""

from __future__ import annotations

import argparse
import base64
import json
import struct
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from lab import Process, Wire, fly_script, machine, percentile, projector, twin

SIDE = 16
ROI = "970 766 985 781"
PROJECTOR_MB = 300
SHOWN_EACH = 10
"""Of so many uploads one is put on the stage and projected."""
START_S = 2.0
"""By which a start may take longer [s of processor time]."""
SMALL_MB = 20.0
SMALL_BYTES = 2048
SMALL_MS = 0.5
"""Allowed beside a part of the young figure: memory for names (1 kB each), bytes and processor
time a request below what is measured."""


@dataclass
class Figures:
    """What an age costs; processor times are the twin's.

    Attributes:
        set_ms, upload_ms, submit_ms, correct_ms: processor time of a request [ms].
        set_bytes, upload_bytes: written to the disk for a request.
        state_bytes: of `state.json`.
        twin_mb, projector_mb: memory.
        start_s: processor time of a start [s].
        ping_ms, set_wall_ms: 99th percentiles of latencies, which other work disturbs [ms].
    """

    set_ms: float
    upload_ms: float
    submit_ms: float
    correct_ms: float
    set_bytes: float
    upload_bytes: float
    state_bytes: float
    twin_mb: float
    projector_mb: float
    start_s: float
    ping_ms: float
    set_wall_ms: float

    def grown(self, young: Figures, allowed: float, *, times: bool) -> list[str]:
        """Names of figures that have grown by more than a part, or the start by more than 2 s.

        Args:
            young: those of a young directory.
            allowed: the part.
            times: whether processor times decide, too.
        """
        small = {"ms": SMALL_MS, "bytes": SMALL_BYTES, "mb": SMALL_MB}
        found = []
        for field in fields(self):
            before, now = getattr(young, field.name), getattr(self, field.name)
            unit = field.name.rpartition("_")[2]
            if field.name in ("ping_ms", "set_wall_ms") or (
                unit in ("s", "ms") and not times
            ):
                continue
            most = (
                before + START_S if unit == "s" else before * (1 + allowed) + small[unit]
            )
            if now > most:
                found.append(f"{field.name} {before:.2f} became {now:.2f}")
        return found


class Old:
    """A twin, its projector and its directory.

    Args:
        data: the directory.
        requests: of each kind that are measured.
    """

    def __init__(self, data: Path, requests: int) -> None:
        """Start a projector with limited memory and a twin on the directory."""
        self.data, self.requests = data, requests
        self.rays = projector("--memory-limit", f"{PROJECTOR_MB}M")
        self.jobs = self.uploads = self.corrections = self.scans = self.probes = 0
        self.start()

    def start(self) -> None:
        """Start the twin with room for many samples and corrections; `start_s` is what it
        cost.
        """
        room = [f"--limit={name}=30000" for name in ("max_samples", "max_corrections")]
        self.twin = twin(
            self.rays.port, self.data, "--sample", "empty", "--speed-up", "max", *room
        )
        self.start_s = self.twin.processor_s()
        self.wire = Wire(self.twin.port)

    def end(self) -> None:
        self.twin.end()

    def upload(self, name: str, grey: int) -> None:
        """Upload a small cube of one grey value under a name."""
        voxels = base64.b64encode(
            struct.pack("<f", 1e-3 * (1 + grey % 50)) * SIDE**3
        ).decode()
        self.wire.call("sample.upload", name=name, kind="voxels", format="raw", data=voxels,
                       shape=[SIDE] * 3, voxel_mm=[0.5] * 3, total=4 * SIDE**3)  # fmt: skip

    def scan(self, name: str, frames: int) -> str:
        text = fly_script(frames, roi=ROI)
        return str(self.wire.call("script.submit", text=text, name=name, seed=1)["job"])

    def age(self, jobs: int, uploads: int, corrections: int, scans: int) -> None:
        """Add to the directory until it has so many of each, and start the twin twice on
        it.

        The second start is the one whose time stays in `start_s`.

        Args:
            jobs, uploads, corrections, scans: how many there are to be; what there is
                more stays.
        """
        for i in range(self.uploads, uploads):
            self.upload(f"upload-{i}", i)
            if i % SHOWN_EACH == 0:
                self.wire.call("sample.set", file=f"upload-{i}")
                self.wire.call("projection.get")
        self.wire.call("sample.set", name="empty")
        for i in range(self.corrections, corrections):
            self.wire.call(
                "calibration.apply", parameters={"dD_x": 1e-5 * i}, name=f"c{i}"
            )
        for i in range(self.scans, scans):
            self.wire.wait(self.scan(f"scan-{i}", 3), "done")
        self.end()
        self._add_jobs(jobs - self.jobs)
        self.jobs, self.uploads, self.corrections = jobs, uploads, corrections
        self.scans = max(scans, self.scans)
        begun = time.monotonic()
        self.start()
        print(f"first start with {jobs} jobs: {self.start_s:.1f} s of processor time, "
              f"{time.monotonic() - begun:.1f} s", flush=True)  # fmt: skip
        self.end()
        self.start()

    def _add_jobs(self, count: int) -> None:
        """Add finished jobs to the state file, as an earlier version wrote them; no twin
        may run.
        """
        file = self.data / "state.json"
        state: dict[str, Any] = json.loads(file.read_text())
        made = state["jobs_made"]
        state["jobs"] = [
            {"id": f"job-{i}", "name": f"old-{i}", "folder": f"old-{i}", "phase": "done",
             "frames_total": 601, "frames_done": 601, "duration_s": 99.0, "elapsed_s": 99.0,
             "speed_up": None, "warnings": [], "error": None}
            for i in range(made + 1, made + 1 + count)
        ]  # fmt: skip
        state["jobs_made"] = made + count
        file.write_text(json.dumps(state))

    def _each(
        self, ask: Callable[[int], object], count: int
    ) -> tuple[float, float, list[float]]:
        """Make requests one after the other, from rest to rest.

        Args:
            ask: makes the i-th.
            count: how many.

        Returns:
            Processor time [ms] and bytes written a request, and all latencies [ms].
        """
        self._settle()
        used, written, times = self.twin.processor_s(), written_bytes(self.twin), []
        for i in range(count):
            begun = time.monotonic()
            ask(i)
            times.append(1e3 * (time.monotonic() - begun))
        self._settle()
        spent = 1e3 * (self.twin.processor_s() - used) / count
        return spent, (written_bytes(self.twin) - written) / count, times

    def _settle(self) -> None:
        time.sleep(0.5)  # what is written later is written

    def measured(self) -> Figures:
        """Measure what requests cost now; each call uploads, scans and stores more."""
        call, n = self.wire.call, self.requests
        self.probes += 1
        new = f"probe-{self.probes}"
        call("tube.set", kV=60.0)
        _, _, pings = self._each(lambda i: call("session.ping"), n)
        sets = self._each(lambda i: call("tube.set", kV=50.0 + i % 30), n)
        uploads = self._each(lambda i: self.upload(f"{new}-{i:06}", i), n)
        corrections = self._each(
            lambda i: call(
                "calibration.apply", parameters={"dD_x": 1e-6 * i}, name=f"{new}-{i}"
            ),
            max(1, n // 4),
        )
        scans = self._each(
            lambda i: self.wire.wait(self.scan(f"{new}-{i}", 3), "done"), max(1, n // 3)
        )
        return Figures(
            sets[0], uploads[0], scans[0], corrections[0], sets[1], uploads[1],
            (self.data / "state.json").stat().st_size, self.twin.memory_mb(),
            self.rays.memory_mb(), self.start_s, percentile(pings, 0.99), percentile(sets[2], 0.99),
        )  # fmt: skip


def written_bytes(process: Process) -> int:
    """Bytes that a process has handed to the system so far."""
    lines = Path(f"/proc/{process.pid}/io").read_text().splitlines()
    return int(next(x for x in lines if x.startswith("wchar")).split()[1])


def main() -> int:
    """Measure a young directory and twice an aged one; 1 if a figure grew by more than is
    allowed.
    """
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--jobs", type=int, default=100_000)
    p.add_argument("--samples", type=int, default=10_000)
    p.add_argument("--corrections", type=int, default=10_000)
    p.add_argument("--scans", type=int, default=1000)
    p.add_argument("--requests", type=int, default=100, help="measured at each age")
    p.add_argument("--allowed", type=float, default=0.2, help="growth, as a part")
    p.add_argument(
        "--no-times", action="store_true", help="let bytes and memory decide alone"
    )
    options = p.parse_args()
    print(f"{machine()}; Python's own time in ms of processor time a request", flush=True)
    wrong = []
    with tempfile.TemporaryDirectory() as folder:
        old = Old(Path(folder) / "data", options.requests)
        try:
            old.measured()  # what is loaded once
            young = old.measured()
            print(f"young: {young}", flush=True)
            for part in (10, 1):
                old.age(options.jobs // part, options.samples // part,
                        options.corrections // part, options.scans // part)  # fmt: skip
                old.measured()
                now = old.measured()
                grown = now.grown(young, options.allowed, times=not options.no_times)
                wrong += [f"aged by 1/{part}: {words}" for words in grown]
                print(f"aged by 1/{part}: {now}", flush=True)
        finally:
            old.end()
            old.rays.end()
    print(
        f"{len(wrong)} figures have grown by more than {options.allowed:.0%}",
        *wrong,
        sep="\n",
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
