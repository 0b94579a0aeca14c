"""A whole run of a twin, part by part, beside the same run with a disk that fails once.

Each part goes on from where the undisturbed run was at its beginning. `Part` compares what
clients see with the undisturbed run, whatever the disk did meanwhile: what answered an error
has changed nothing, what answered well is there after a kill, and the data sets are the same
byte for byte.
"""

from __future__ import annotations

import errno
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from in_process import Client, script
from lab import timeless
from simulation import Crashed, Fault, Simulation

from flexdt.protocol import RpcError
from flexdt.server.storage.memory import FAR_S
from flexdt.twin.errors import TwinError

Step = Callable[["Part"], Any]
Seen = dict[str, Any]
WAYS: list[Callable[[int], Fault]] = [
    lambda n: Fault(n, errno.ENOSPC),
    lambda n: Fault(n, error=None),
    lambda n: Fault(n, errno.EIO),
    lambda n: Fault(n, errno.ENOSPC, lasting=True),
    lambda n: Fault(n, errno.EDQUOT),
    lambda n: Fault(n, short=True),
]
"""How the n-th change of the disk may fail: no room once, a power cut, an error, ..."""
TRIES = 40
"""A job that the disk has paused or ended is told to go on so often."""


def voxels(value: float) -> dict[str, Any]:
    """A small upload."""
    raw = np.full((2, 2, 2), value, dtype="<f4").tobytes()
    return {"name": "cube", "kind": "voxels", "format": "raw", "total": len(raw), "data": raw,
            "shape": [2, 2, 2], "voxel_mm": [4.0, 4.0, 4.0]}  # fmt: skip


def ask(method: str, **params: Any) -> Step:
    """A request; a job that it submits may have begun when it is answered."""

    def step(run: Part) -> None:
        run.sim.call(run.client, method, **params)

    if method.endswith(".submit"):
        step.begins = True  # type: ignore[attr-defined]
    return step


def job(name: str) -> Step:
    """A step that waits for a job; one that has ended early, or waits for somebody, is
    told to go on.

    The disk has room again before that. AssertionError after TRIES times.

    Args:
        name: of the job.
    """

    def step(run: Part) -> None:
        """Wait for the job to be done, and let it go on where it waits or has ended
        early.
        """
        for _ in range(TRIES):
            for _ in range(2000):
                jobs = run.sim.call(run.client, "job.list")["jobs"]
                status = next(j for j in jobs if j["name"] == name)
                if (
                    status["state"] not in ("running", "queued")
                    and status["retry_s"] is None
                ):
                    break
                run.sim.advance(0.05)
            if status["state"] == "done":
                run.sim.advance(1.0)  # what a scan sets is written a moment later
                return
            run.sim.disk.set(None)  # somebody makes room
            run.sim.call(run.client, "job.resume", job=status["job"])
        raise AssertionError(status)

    step.scans = True  # type: ignore[attr-defined]
    return step


def some_frames(run: Part) -> None:
    """Until the job that runs has made some, and no more."""
    rays = run.sim.projector
    rays.limit = rays.views + 1
    for _ in range(300):
        status = run.sim.call(run.client, "job.status")
        if status["state"] not in ("queued", "running") or status["frames_done"]:
            return
        run.sim.advance(0.01)


def abort(run: Part) -> None:
    """Abort the last job."""
    run.sim.projector.limit = None
    run.sim.call(run.client, "job.abort")
    run.sim.advance(1.0)


def load(run: Part) -> None:
    """Load the scene as it is, with another sample, correction, settings and positions."""
    document = run.sim.call(run.client, "scene.save")["document"]
    document["sample"] = {"name": "chiral"}
    document["correction"] = {
        "name": "scenic", "date": "2026-01-01", "parameters": {"dS_x": 0.25}, "comment": "",
    }  # fmt: skip
    document["tube"]["kV"] = 60.0
    document["speeds"]["mag_obj"] = 7.0
    document["positions"] = {"mag_obj": 420.0, "rot_obj": 12.0}
    run.sim.call(run.client, "scene.load", document=document)
    run.sim.advance(1.0)


for _step in (some_frames, abort):
    _step.scans = True  # type: ignore[attr-defined]

PARTS: dict[str, list[Step]] = {
    "upload": [ask("sample.upload", **voxels(0.01)), ask("sample.set", name="cube")],
    "settings": [
        ask("axes.set", axis="tra_obj", speed=3.0, acceleration=2.0),
        ask("tube.set", kV=70.0, power_W=15.0),
        ask("camera.set", exposure_ms=90.0),
        ask("axes.move", targets={"mag_obj": 400.0}, wait=True),
    ],
    "scan": [ask("script.submit", text=script(3), name="first", seed=3), job("first")],
    "correct": [
        ask("calibration.apply", parameters={"dD_x": 0.5}, name="one", source="a scan"),
        ask("calibration.apply", parameters={"dD_x": 0.75}, name="two"),
        ask("calibration.revert"),
    ],
    "scene": [load],
    "upload again": [
        ask("sample.upload", **voxels(0.02)),
        ask("sample.set", name="cube", offset={"z": 1.0}),
        ask("sample.upload", **voxels(0.03)),
    ],
    "poses": [
        ask(
            "trajectory.submit",
            poses=[{"rot_obj": 5.0}],
            exposure_ms=50.0,
            name="second",
            seed=4,
        ),
        job("second"),
    ],
    "abort": [
        ask("script.submit", text=script(9), name="third", seed=3),
        some_frames,
        abort,
        job("third"),
    ],
}


class Part:
    """One part of the run on a simulated machine.

    Args:
        name: which one.
        root: for the data directory.
        before: the data directory to begin with; None for an empty one.
        seed: of the simulation.
    """

    def __init__(
        self, name: str, root: Path, before: Path | None = None, seed: int = 0
    ) -> None:
        """Copy the data directory to begin with, and make a simulation in which no server
        runs yet.
        """
        if before is not None:
            shutil.copytree(before, root / "data")
        self.steps = PARTS[name]
        self.sim = Simulation(root, seed, speed_up="max")
        self.seen: list[Seen] = []
        """What clients saw after each step."""
        self.answers: list[str] = []
        """Errors, of those that were disturbed."""
        self.cut = False
        """Whether the power was: then what a scan had set may be forgotten."""

    def start(self) -> None:
        """Start a server; one that the disk keeps from it is started again."""
        try:
            self.sim.start()
        except (OSError, TwinError, Crashed) as error:
            assert self.sim.disk.fault is not None, "nothing disturbed it"
            self.answers.append(f"start: {error!r}")
            self.sim.disk.set(None)
            self.sim.start()
        self.client: Client = self.sim.client()

    def again(self) -> None:
        """kill -9, or what the power cut left, and a new server."""
        cut = self.sim.disk.off
        self.sim.disk.set(None)
        if cut:
            self.sim.cut()
        else:
            self.sim.kill()
        self.sim.start()
        self.client = self.sim.client()

    def look(self) -> Seen:
        """What is to survive, as clients see it, by short names."""
        call = lambda method: self.sim.call(self.client, method)  # noqa: E731
        state = call("state.get")
        correction = state["correction"]
        return {
            "sample": state["sample"],
            "paces": {
                n: (a["speed"], a["acceleration"]) for n, a in state["axes"].items()
            },
            "tube": (state["tube"]["kV"], state["tube"]["power_W"]),
            "camera": state["camera"],
            "correction": None if correction is None else correction["name"],
            "parameters": None if correction is None else correction["parameters"],
            "source": None if correction is None else correction["source"],
            "uploads": [s for s in call("sample.list")["samples"] if s["uploaded"]],
            "jobs": [(j["job"], j["name"]) for j in call("job.list")["jobs"]],
            "corrections": [c["name"] for c in call("calibration.list")["corrections"]],
        }

    def go(self, fault: Fault | None = None, right: Part | None = None) -> None:
        """All steps.

        Args:
            fault: set before the server starts.
            right: the undisturbed part.
        """
        self.sim.disk.set(fault)
        self.start()
        before = self.look()
        for number, step in enumerate(self.steps):
            before = self._step(
                number, step, before, None if right is None else right.seen[number]
            )
        try:
            self.sim.stop()
        except Crashed:
            self.sim.cut()
        self.sim.disk.set(None)
        self.start()
        assert self.look() == before
        if right is not None:
            assert self.files() == right.files()
        self.sim.stop()
        left = [str(f) for f in self.sim.data.rglob(".part-*")]
        assert not left
        assert not list(self.sim.data.rglob("*unreadable*"))

    def _step(self, number: int, step: Step, before: Seen, right: Seen | None) -> Seen:
        """Make one step, again where it crashed, and check what is left at each point.

        A step that fails must have met the disk's fault, change nothing, also after a
        restart, and then succeed; one that crashed was done or not done. What was
        answered well is there after a kill.

        Args:
            number: of the step.
            step: what to do.
            before: what clients saw before it.
            right: what they are to see after it; None if that is not known.

        Returns:
            What they see after it.

        Raises:
            AssertionError: something of that does not hold, or three tries did not do.
        """
        was = self.sim.disk.failed
        for _ in range(3):
            try:
                step(self)
            except Crashed:
                self.again()
                now = self.look()
                # A correction that nobody was told of may be there, but is not in force.
                known, now_known = set(before["corrections"]), set(now["corrections"])
                assert known <= now_known
                assert len(now_known - known) <= 1
                after = before if right is None else right
                assert any(
                    self._same(step, now, seen, "corrections") for seen in (before, after)
                )
                self.answers.append(f"{number}: crashed")
                self.cut = True
                if now == after and now != before:
                    break
                continue
            except RpcError as error:
                answer = error
            else:
                break
            assert self.sim.disk.failed > was, answer
            self.answers.append(f"{number}: {answer.code} {answer.message}")
            assert answer.code != -32603
            assert self._same(step, self.look(), before), number
            self.again()
            assert self._same(step, self.look(), before), number
        else:
            raise AssertionError(f"step {number}: {self.answers}")
        now = self.look()
        if right is not None:
            # The job may have ended early, or begun already.
            loose = self.cut or step in (some_frames, abort) or hasattr(step, "begins")
            assert self._same(step, now, right) if loose else now == right, number
        if self.sim.disk.failed > was:  # what was answered well is there after a kill
            self.sim.disk.set(None)
            if getattr(step, "scans", False):
                self.sim.advance(FAR_S + 1.0)  # after a failure it is not tried at once
            self.again()
            begins = hasattr(step, "begins")  # the job goes on meanwhile
            assert self._same(step, self.look(), now) if begins else self.look() == now, (
                number
            )
        self.seen.append(now)
        return now

    def _same(self, step: Step, one: Seen, other: Seen, *but: str) -> bool:
        """Whether two sights agree, but for `but`; what a scan sets need not have been
        written yet.
        """
        apart = {
            *but,
            *(
                ("paces", "tube", "camera")
                if hasattr(step, "scans") or hasattr(step, "begins")
                else ()
            ),
        }
        return all(one[key] == other[key] for key in one if key not in apart)

    def files(self) -> dict[str, bytes]:
        """Every file of every data set, dates and durations apart."""
        return {
            f"{folder}/{f.name}": f.read_bytes() if f.suffix == ".tif"
            else timeless(f.read_bytes(), folder)
            for folder in ("first", "second", "third")
            if (self.sim.data / folder).exists()
            for f in sorted((self.sim.data / folder).iterdir())
        }  # fmt: skip
