"""kill -9 of twin and projector at random moments of scans: `python tests/studies/kills.py`.

Each round submits a scan at a random pace, kills the twin or the projector at a random moment,
starts it again, checks every file under a final name and every frame that was reported done,
lets the scan go on, and compares the result byte for byte with an undisturbed scan (dates and
durations in the texts apart). Exit code 1 when anything was lost. Options: --kills N, --seed N.
"""

from __future__ import annotations

import argparse
import json
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from lab import Process, Wire, digests, fly_script, machine, projector, timeless, twin

FRAMES = 61
SEED = 77


class Round:
    """Servers that are killed, and what was found."""

    def __init__(self, root: Path, rng: random.Random) -> None:
        """Start a projector and a twin in a folder, with nothing counted yet."""
        self.root, self.rng, self.data = root, rng, root / "data"
        self.rays = projector(log=root / "projector.log")
        self.ray_port = self.rays.port
        self.twin = self.start_twin()
        self.kills = {"twin": 0, "starting": 0, "projector": 0}
        self.lost = self.corrupt = self.different = self.unresumed = 0
        self.moments: list[float] = []
        self.down_s: list[float] = []
        self.known: dict[str, int] = {}

    def start_twin(self) -> Process:
        return twin(
            self.ray_port, self.data, "--speed-up", "max", log=self.root / "twin.log"
        )

    def kill_a_start(self) -> None:
        """A twin that is killed while it starts: before, while or after it reads what it
        knows."""
        self.kills["starting"] += 1
        longest = 1.2 * (max(self.down_s[-5:]) if self.down_s else 3.0)
        with (self.root / "twin.log").open("ab") as log:
            child = subprocess.Popen(
                [sys.executable, "-m", "flexdt.server.twin.main", "--port", "0", "--projector",
                 f"127.0.0.1:{self.ray_port}", "--data", str(self.data), "--speed-up", "max"],
                stdout=subprocess.DEVNULL, stderr=log,
            )  # fmt: skip
        time.sleep(self.rng.uniform(0.0, longest))
        child.kill()
        child.wait()

    def start_projector(self) -> Process:
        return Process("flexdt.server.projector.main", "--port", self.ray_port, "--threads", 1,
                       log=self.root / "projector.log")  # fmt: skip

    def scan(self, name: str, kills: int) -> None:
        """One scan, killed `kills` times on the way."""
        wire = Wire(self.twin.port)
        wire.call("clock.set", speed_up="max")
        ready(wire)
        pace: Any = self.rng.choice([10, 25, 60, "max"])
        job = wire.call("script.submit", text=fly_script(FRAMES), name=name, seed=SEED,
                        speed_up=pace)["job"]  # fmt: skip
        for _ in range(kills):
            longest = {10: 3.0, 25: 1.2, 60: 0.6, "max": 0.25}[pace]
            moment = self.rng.uniform(0.0, longest)
            self.moments.append(moment)
            time.sleep(moment)
            if self.rng.random() < 0.25:
                self.kills["projector"] += 1
                self.rays.kill()
                self.rays = self.start_projector()
                continue
            done = wire.call("job.status", job=job)["frames_done"]
            self.kills["twin"] += 1
            self.twin.kill()
            self.check_files(name, done)
            while self.rng.random() < 0.3:
                self.kill_a_start()
            begun = time.monotonic()
            self.twin = self.start_twin()
            self.down_s.append(time.monotonic() - begun)
            wire = Wire(self.twin.port)
            status = next(j for j in wire.call("job.list")["jobs"] if j["job"] == job)
            self.known[status["state"]] = self.known.get(status["state"], 0) + 1
            if status["state"] == "incomplete":
                wire.call("job.resume", job=job)
            elif status["state"] != "done":
                self.unresumed += 1
                print(f"{name}: {job} is {status['state']} after the restart", flush=True)
        until = time.monotonic() + 120.0
        while (status := wire.call("job.status", job=job))["state"] not in (
            "done",
            "failed",
        ):
            if time.monotonic() > until:
                break
            time.sleep(0.02)
        if status["state"] != "done":
            self.unresumed += 1
            print(f"{name}: {status}", flush=True)
            return
        self.compare(name)

    def check_files(self, name: str, done: int) -> None:
        """Every file under a final name is whole, and every frame reported done is there."""
        folder, whole = self.data / name, self.data / "whole"
        there = digests(folder) if folder.is_dir() else {}
        right = digests(whole)
        broken = [n for n, d in there.items() if right[n] != d]
        self.corrupt += len(broken)
        missing = [
            n for n in (f"scan_{i:06d}.tif" for i in range(done)) if n not in there
        ]
        # Batches may end out of order, so frames are counted, not named.
        if len([n for n in there if n.startswith("scan_")]) < done:
            self.lost += len(missing)
        for text in ("flexdt.json", "script.txt"):
            file = folder / text
            if file.exists():
                content = file.read_text()
                if text == "flexdt.json" and "frames" not in json.loads(content):
                    self.corrupt += 1
        if broken or len([n for n in there if n.startswith("scan_")]) < done:
            print(
                f"{name}: {done} done, broken {broken}, missing {missing[:3]}", flush=True
            )

    def compare(self, name: str) -> None:
        """The result is the undisturbed one's, dates and durations apart."""
        if digests(self.data / name) != digests(self.data / "whole"):
            self.different += 1
            print(f"{name}: images differ", flush=True)
        for text in (
            "scan settings.txt",
            "data settings XRE.txt",
            "flexdt.json",
            "script.txt",
        ):
            a, b = (
                timeless((self.data / n / text).read_bytes(), n) for n in (name, "whole")
            )
            if a != b:
                self.different += 1
                lines = [
                    (x, y)
                    for x, y in zip(a.split(b"\n"), b.split(b"\n"), strict=False)
                    if x != y
                ]
                print(f"{name}: {text} differs: {lines[:3]}", flush=True)
        if [f for f in (self.data / name).iterdir() if f.name.startswith(".")]:
            self.different += 1
            print(f"{name}: temporary files are left", flush=True)

    def end(self) -> None:
        self.twin.end()
        self.rays.end()


def ready(wire: Wire) -> None:
    """The same start for every scan."""
    wire.call("sample.set", name="normal")
    wire.call("tube.set", kV=90.0, power_W=20.0, on=False)
    wire.call("camera.set", exposure_ms=100.0)
    wire.call("axes.set", axis="rot_obj", speed=20.0)
    wire.call("axes.move", targets={"rot_obj": 0.0, "mag_obj": 400.0, "ver_tube": 40.0,
                                    "ver_det": 40.0}, wait=True)  # fmt: skip


def main() -> int:
    """Kill servers during scans until there were so many kills, and print what was lost.

    Returns:
        1 where anything was lost, corrupt or different, or an error was not handled.
    """
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--kills", type=int, default=200)
    p.add_argument("--seed", type=int, default=1)
    options = p.parse_args()
    rng = random.Random(options.seed)
    print(
        f"{options.kills} kills at random moments, seed {options.seed}. {machine()}.",
        flush=True,
    )
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        r = Round(Path(folder), rng)
        try:
            r.scan("whole", 0)
            left, scans = options.kills, 0
            while left:
                now = min(left, rng.choice([1, 1, 2, 3]))
                left -= now
                scans += 1
                r.scan(f"scan-{scans}", now)
        except KeyboardInterrupt:
            print("interrupted: figures so far", flush=True)
        finally:
            r.end()
        bad = r.twin.logged("error", "critical", "unstructured")
        for entry in bad[:3]:
            print("LOG:", str(entry)[-1200:])
    print(
        f"{r.kills['twin']} twins, {r.kills['starting']} more while they started, "
        f"and {r.kills['projector']} projectors killed in {scans} scans of {FRAMES} frames "
        f"within {time.monotonic() - begun:.0f} s: {r.lost} completed frames lost, {r.corrupt} "
        f"corrupt files, {r.unresumed} scans not resumed, {r.different} results that differ; "
        f"a twin was back after {sum(r.down_s) / max(1, len(r.down_s)):.1f} s on average."
    )
    return 1 if r.lost or r.corrupt or r.unresumed or r.different or bad else 0


if __name__ == "__main__":
    sys.exit(main())
