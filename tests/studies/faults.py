"""Disks that fail, files that are damaged: `python tests/studies/faults.py disk | flips | writes`.

disk:   in one process, on a virtual clock and disk: every change of the disk in a whole run fails
        in each of six ways (no room, an error, a power cut, ...). --seeds N
flips:  in one process: one bit of one kept file is another one (or the file is cut, or missing);
        a server starts on it and answers everything, and a scan can be made. --count N
writes: over real servers, whose file operations fail at drawn moments: what they answered well
    is
        there after a kill -9, and the data sets are whole. --count N

Exit code 1 when anything was half done or did not start. Options: --seed N.
"""

from __future__ import annotations

import argparse
import errno
import json
import os
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from in_process import script
from lab import Process, Refused, Wire, digests, fly_script, machine, projector
from simulation import Simulation
from whole_run import PARTS, WAYS, Part

from flexdt.protocol import RpcError

READS = ["state.get", "sample.list", "calibration.list", "calibration.get", "job.list",
         "scene.save", "geometry.get", "safety.reset"]  # fmt: skip


def undisturbed(root: Path) -> dict[str, tuple[Path | None, Part]]:
    """Every part of the whole run, and the data directory it began with."""
    before, parts = None, {}
    for name in PARTS:
        part = Part(name, root / name, before)
        with part.sim:
            part.go()
        parts[name] = (before, part)
        before = part.sim.data
    return parts


def disk(root: Path, seeds: int) -> int:
    """Let each change of each part's files fail, in every way of WAYS.

    Args:
        root: an empty folder.
        seeds: how many runs of each.

    Returns:
        How many runs went wrong; each is printed.
    """
    parts = undisturbed(root / "right")
    runs, wrong, told = 0, 0, 0
    for seed in range(seeds):
        for name, (before, right) in parts.items():
            for n in range(len(right.sim.disk.ops)):
                for way, fault in enumerate(WAYS):
                    folder = root / "now"
                    part = Part(name, folder, before, seed)
                    try:
                        with part.sim:
                            part.go(fault(n), right)
                    except Exception as error:
                        wrong += 1
                        print(
                            f"seed {seed} {name} way {way} n {n}: {error!r}"[:300],
                            flush=True,
                        )
                    runs, told = runs + 1, told + bool(part.answers)
                    shutil.rmtree(folder)
    print(f"{runs} runs with a disk that fails once or from then on, {told} of which clients were "
          f"told of: {wrong} left something half done.")  # fmt: skip
    return wrong


def damaged(file: Path, rng: random.Random) -> str:
    """Damage a file; says how."""
    data = bytearray(file.read_bytes())
    draw = rng.random()
    if draw < 0.04:
        file.unlink()
        return "missing"
    if draw < 0.1 or not data:
        file.write_bytes(data[: rng.randint(0, len(data))])
        return "cut"
    at = rng.randrange(len(data))
    data[at] ^= 1 << rng.randrange(8)
    file.write_bytes(data)
    return "one bit"


def flips(root: Path, count: int, rng: random.Random) -> int:
    """Damage files of a data directory, one at a time, and start a server on it.

    Args:
        root: an empty folder.
        count: how many.
        rng: draws file and damage.

    Returns:
        How many servers did not start or answer; each is printed.
    """
    parts = undisturbed(root / "right")
    # At the end of the run, and in the middle of a scan.
    whole = parts["abort"][1].sim.data
    cut = root / "cut"
    part = Part("abort", root / "cut", parts["abort"][0])
    with part.sim:
        part.start()
        for step in part.steps[:2]:
            step(part)
        part.sim.projector.limit = None
        part.sim.advance(1.0)
        part.sim.kill()
    sources = [whole, cut / "data"]
    wrong, aside, kinds = 0, 0, Counter[str]()
    for number in range(count):
        source = rng.choice(sources)
        folder = root / "now"
        shutil.copytree(source, folder / "data")
        kept = [
            f
            for f in sorted((folder / "data").rglob("*"))
            if f.is_file() and f.suffix != ".tif"
        ]
        file = rng.choice(kept)
        kinds[how := damaged(file, rng)] += 1
        try:
            aside += starts(folder, number)
        except Exception as error:
            wrong += 1
            where = file.relative_to(folder / "data")
            print(f"{number}: {where} ({how}): {error!r}"[:400], flush=True)
            if os.environ.get("KEEP"):
                raise
        shutil.rmtree(folder)
    print(f"{count} damaged files ({', '.join(f'{n} {k}' for k, n in kinds.items())}): a server "
          f"started on all but {wrong}, and answered; {aside} files were set aside.")  # fmt: skip
    return wrong


def starts(folder: Path, seed: int) -> int:
    """Start a server on a directory, ask it everything, resume what can be, scan, and
    start again.

    Returns:
        How many files were set aside.

    Raises:
        AssertionError: the new scan is not done, or a traceback was logged.
        Exception: a question was not answered.
    """
    with Simulation(folder, seed, speed_up="max") as sim:
        sim.start()
        client = sim.client()
        for method in READS:
            sim.call(client, method)
        for job in sim.call(client, "job.list")["jobs"]:
            try_it(sim, client, "job.resume", job=job["job"])
        sim.advance(10.0)
        for upload in [
            s for s in sim.call(client, "sample.list")["samples"] if s["uploaded"]
        ]:
            try_it(sim, client, "sample.set", name=upload["name"])
        try_it(sim, client, "sample.set", name="empty")
        try_it(sim, client, "calibration.revert")
        sim.call(client, "script.submit", text=script(3), name=f"new-{seed}")
        for _ in range(400):
            status = sim.call(client, "job.list")["jobs"][-1]
            if status["state"] == "done":
                break
            sim.advance(0.1)
        assert status["state"] == "done", status
        sim.stop()
        sim.start()
        for method in READS:
            sim.call(sim.client(), method)
        assert not [r for r in sim.log if r.exc_info and r.exc_info[0]], (
            "a traceback in the log"
        )
        return len(list(sim.data.rglob("*unreadable*")))


def try_it(sim: Simulation, client: Any, method: str, **params: Any) -> None:
    """Ask for what may be refused, but not without a reason."""
    try:
        sim.call(client, method, **params)
    except RpcError as error:
        if error.code == -32603:
            raise


class Writes:
    """Real servers whose file operations fail, and what came of it."""

    FRAMES = 9
    CHANGES: tuple[tuple[str, dict[str, Any]], ...] = (
        ("calibration.apply", {"parameters": {"dD_x": 0.5}, "name": "one"}),
        ("tube.set", {"kV": 70.0}),
        ("camera.set", {"exposure_ms": 80.0}),
        ("axes.set", {"axis": "tra_obj", "speed": 3.0}),
        ("sample.set", {"name": "normal", "offset": {"z": 1.0}}),
        ("calibration.apply", {"parameters": {"dD_x": 0.25}, "name": "two"}),
        ("calibration.revert", {}),
    )

    def __init__(self, root: Path) -> None:
        """Start a projector; the twins are started for each round."""
        self.root = root
        self.rays = projector(log=root / "projector.log")
        self.wrong = self.refused = self.unstarted = self.failed = 0
        self.right: dict[str, str] = {}

    def twin(self, data: Path, fault: dict[str, Any] | None = None) -> Process:
        """A server on `data`; one that is told to fails."""
        options = ["--speed-up", "max"]
        if not (data / "state.json").exists():
            options += ["--sample", "empty"]
        env = {}
        if fault is not None:
            here = str(Path(__file__).parent / "failing_disk")
            paths = [here, *filter(None, [os.environ.get("PYTHONPATH")])]
            env = {"PYTHONPATH": os.pathsep.join(paths),
                   "FLEXDT_TEST_FAULT": json.dumps({"root": str(data), **fault})}  # fmt: skip
        return Process(
            "flexdt.server.twin.main", "--port", 0, "--projector", f"127.0.0.1:{self.rays.port}",
            "--data", data, *options, log=self.root / "twin.log", env=env,
        )  # fmt: skip

    def scan(self, wire: Wire, *, full: bool = False) -> None:
        """Submit the scan, or go on with it, to its end.

        Args:
            wire: to the twin.
            full: the disk will stay full: wait only until the scan waits for room.

        Raises:
            AssertionError: it does not come to that in 200 s.
        """
        jobs = [j for j in wire.call("job.list")["jobs"] if j["name"] == "scan"]
        if not jobs:
            wire.call("script.submit", text=fly_script(self.FRAMES), name="scan", seed=7)
        for _ in range(4000):  # attempts of a job whose disk is full are up to 30 s apart
            job = next(j for j in wire.call("job.list")["jobs"] if j["name"] == "scan")
            if job["state"] == "done" or (full and job["retry_s"] is not None):
                return
            if job["state"] not in ("queued", "running") and job["retry_s"] is None:
                wire.call("job.resume", job=job["job"])
            time.sleep(0.05)
        raise AssertionError(job)

    def round(self, number: int, fault: dict[str, Any] | None) -> None:
        """One data directory, one fault, one kill."""
        data = self.root / f"data-{number}"
        data.mkdir()
        try:
            process = self.twin(data, fault)
        except RuntimeError as error:
            self.unstarted += 1
            if "Traceback" in str(error):
                self.bad(number, "start", str(error))
            process = self.twin(data)
        told = 0
        try:
            wire = Wire(process.port)
            for _ in range(3):
                try:
                    self.scan(wire, full=fault is not None and fault["lasting"])
                    break
                except Refused as refused:
                    told += 1
                    if refused.code == -32603:
                        self.bad(number, "scan", refused)
            seen = self.look(wire)
            for method, params in self.CHANGES:
                try:
                    wire.call(method, **params)
                except Refused as refused:
                    told += 1
                    if refused.code == -32603 or self.look(wire) != seen:
                        self.bad(number, method, refused)
                seen = self.look(wire)
        finally:
            process.kill()
        self.refused += told
        process = self.twin(data)
        try:
            wire = Wire(process.port)
            if (now := self.look(wire)) != seen:
                self.bad(
                    number,
                    "kept",
                    [(k, now[k], seen[k]) for k in now if now[k] != seen[k]],
                )
            self.scan(wire)
            images = digests(data / "scan")
            if fault is None:
                self.right = images
            elif images != self.right:
                self.bad(
                    number,
                    "images",
                    sorted(set(images.items()) ^ set(self.right.items())),
                )
        finally:
            process.end()
        if list(data.rglob("*unreadable*")) or list(data.rglob(".part-*")):
            self.bad(number, "left", [str(f) for f in data.rglob("*")])
        self.failed += (self.root / f".{data.name}-failed").exists()
        shutil.rmtree(data)
        shutil.rmtree(self.root / f".{data.name}-before", ignore_errors=True)

    def bad(self, number: int, what: str, why: object) -> None:
        self.wrong += 1
        print(f"{number}: {what}: {why}"[:600], flush=True)

    @staticmethod
    def look(wire: Wire) -> dict[str, Any]:
        """What is to survive, as clients see it, by short names."""
        state, correction = (
            wire.call("state.get"),
            wire.call("calibration.get")["correction"],
        )
        return {
            "sample": state["sample"]["name"], "offset": state["sample"]["offset"],
            "tube": state["tube"]["kV"], "camera": state["camera"]["exposure_ms"],
            "speed": state["axes"]["tra_obj"]["speed"],
            "correction": None if correction is None else correction["name"],
            "corrections": [c["name"] for c in wire.call("calibration.list")["corrections"]],
            "jobs": [(j["job"], j["name"]) for j in wire.call("job.list")["jobs"]],
        }  # fmt: skip


CHANGES_OF_A_ROUND = 110
"""About so many changes of the disk are there in a round of `writes`."""


def writes(root: Path, count: int, rng: random.Random) -> int:
    """Let drawn file operations of real servers fail, and kill them.

    Returns:
        How many things were wrong afterwards.
    """
    w = Writes(root)
    try:
        w.round(0, None)
        for number in range(1, count + 1):
            error = rng.choice([errno.ENOSPC, errno.ENOSPC, errno.EIO, errno.EDQUOT])
            lasting = error == errno.ENOSPC and rng.random() < 0.3
            at = rng.randrange(CHANGES_OF_A_ROUND)
            w.round(number, {"at": at, "error": error, "lasting": lasting})
    finally:
        w.rays.end()
    print(
        f"{count} servers with a file operation to fail at a drawn moment "
        f"(or all that take room from then on): it came to that in {w.failed}; "
        f"{w.unstarted} said so and did not start, {w.refused} requests were refused; "
        f"{w.wrong} things were wrong after a kill -9."
    )
    return w.wrong


def main() -> int:
    """Run the campaign named on the command line in a folder of its own; 1 where
    something was wrong.
    """
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("what", choices=["disk", "flips", "writes"])
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--seeds", type=int, default=1)
    p.add_argument("--count", type=int, default=500)
    o = p.parse_args()
    print(f"{o.what}, seed {o.seed}. {machine()}.", flush=True)
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        match o.what:
            case "disk":
                wrong = disk(root, o.seeds)
            case "flips":
                wrong = flips(root, o.count, random.Random(o.seed))
            case _:
                wrong = writes(root, o.count, random.Random(o.seed))
    print(f"{time.monotonic() - begun:.0f} s")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
