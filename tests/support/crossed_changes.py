"""Drawn interleavings of up to four clients that change what lasts, on a slow disk, with kills.

One client has control, the others observe. Each request is begun at a drawn time beside those
that are under way, and the server is killed, or the power cut, at drawn moments and drawn
changes of the disk. The judge knows the requests and their answers alone: everything that
lasts is a register, whose value at a look is that of a write that no acknowledged later one has
replaced (linearizability, Herlihy and Wing 1990); what was under way at a kill may be there.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import random
import struct
from collections import Counter
from collections.abc import Coroutine, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest import mock

from estop_histories import SlowLoop
from in_process import script
from simulation import Client, Crashed, Fault, Simulation

from flexdt.protocol import RpcError

REFUSALS = {-32001, -32002, -32003, -32602}
"""Errors of a request that may not be met in a state: limits, contacts, control, names."""
ENDED = {"done", "failed", "aborted", "incomplete"}
GOING_ON = {"queued", "running", "done"}
GAPS_S = (0.0, 0.0, 0.001, 0.03, 0.03, 0.5, 3.0, 8.0)
"""Times between requests [virtual s]."""
SLOW_S = (0.0, 0.02, 0.02, 1.0)
"""Mean times of a thread's work, before and after it [virtual s]."""
NAMES = ("a", "b", "c")
TEXT = script(3)
URGENT = {"job.abort", "safety.estop"}
OPEN = {"sample.upload", *URGENT}
"""Methods that an observer may call."""


@dataclass(eq=False)
class Request:
    """One request and what came of it.

    Attributes:
        method, params, controls: what, and whether by the client with control.
        begun, ended: places in the order of all beginnings, answers and looks.
        answer: None without one (yet).
        refused: an error was the answer.
        bytes: of the upload that its chunk completes.
    """

    method: str
    params: dict[str, Any]
    controls: bool
    begun: int
    ended: float = float("inf")
    answer: Any = None
    refused: RpcError | None = None
    bytes: bytes | None = None


@dataclass(frozen=True)
class Write:
    """A register's value from some moment between two places of the order on.

    `sure`: it was acknowledged, so that what ended before it is replaced. `values` are those
    that may be seen after it without another write. `lasts`: it is none that a server only
    listed, and it was told to be on the disk.
    """

    begun: float
    ended: float
    values: frozenset[Any]
    sure: bool = True
    lasts: bool = True


@dataclass
class Outcome:
    """Of one history: requests by method and outcome, kills, and looks at what lasts."""

    requests: Counter[str] = field(default_factory=Counter)
    kills: int = 0
    looks: int = 0


def possible(writes: list[Write], begun: float, ended: float) -> frozenset[Any]:
    """Values that a look between two places may see."""
    found: set[Any] = set()
    for write in writes:
        replaced = any(
            w.sure and w.begun > write.ended and w.ended < begun for w in writes
        )
        if write.begun < ended and not replaced:
            found |= write.values
    return frozenset(found)


class Judge:
    """The registers, and the requests that write them."""

    def __init__(self) -> None:
        """Begin with an empty data directory and no E-stop."""
        self.order = itertools.count(1)
        self.requests: list[Request] = []
        """Those of the present server."""
        self.writes: dict[tuple[str, str], list[Write]] = {}
        self.contents: dict[int, bytes] = {}
        """Size -> bytes, of every upload that was begun; no two have one size."""
        self.acknowledged: set[str] = set()
        """Jobs that an answer named."""
        self.cut_off = 0
        """Submissions without an answer at the last kill."""

    def register(self, kind: str, name: str = "") -> list[Write]:
        """Every write of a register since the last kill, that of the start first."""
        start = {"sample": None, "correction": False, "estop": False, "stage": None,
                 "force": None, "job": None}[kind]  # fmt: skip
        known = self.writes.setdefault((kind, name), [Write(0, 0, frozenset({start}))])
        return known + [
            write for r in self.requests if r.refused is None
            for write in self._of(r, kind, name)
        ]  # fmt: skip

    def see(
        self, kind: str, name: str, value: Any, begun: float, ended: float, lasts: bool
    ) -> None:
        """Check a value that was seen, and know it from now on; beyond a kill if it `lasts`.

        Raises:
            AssertionError: it is none that may be seen.
        """
        allowed = possible(self.register(kind, name), begun, ended)
        if kind == "job" and self._may_be_stopped(name, ended):
            allowed |= {"paused"}
        assert value in allowed, (kind, name, value, sorted(map(str, allowed)))
        values = {value}
        if kind == "job" and value in ("queued", "running"):
            values |= GOING_ON
        self.writes[kind, name].append(
            Write(begun, ended, frozenset(values), lasts=lasts)
        )

    def _may_be_stopped(self, job: str, ended: float) -> bool:
        """Whether an E-stop may have been in force at some time since the job was queued: one
        that begins then is paused.
        """
        queued = min(
            (
                w.begun
                for w in self.register("job", job)
                if w.values >= GOING_ON and w.sure
            ),
            default=0,
        )
        return True in possible(self.register("estop"), queued, ended)

    def killed(self) -> None:
        """Take what may be on the disk: the next server knows nothing else."""
        now = next(self.order)
        keys = set(self.writes) | {key for r in self.requests for key in _touched(r)}
        submitted = [r for r in self.requests if r.method == "script.submit"]
        self.cut_off = sum(r.ended == float("inf") for r in submitted)
        after = {}
        for kind, name in sorted(keys):
            writes = [w if w.lasts else replace(w, sure=False)
                      for w in self.register(kind, name)]  # fmt: skip
            values = set(possible(writes, now, now))
            if kind == "job" and values & {"queued", "running", "paused"}:
                values = (values & {*ENDED, None}) | {"incomplete"}
            after[kind, name] = [Write(now, now, frozenset(values))]
        self.writes = after
        self.requests = []

    def _of(self, r: Request, kind: str, name: str) -> Iterator[Write]:
        """Writes of a register by a request that was not refused."""
        if (kind, name) in _touched(r) or kind == "job":
            values, sure = _written(r, kind, name)
            if values:
                lasts = kind != "estop" or not sure or r.answer["unsaved"] is None
                yield Write(r.begun, r.ended, frozenset(values), sure, lasts)


def _touched(r: Request) -> set[tuple[str, str]]:
    """Registers but jobs that a request writes; jobs are all known by their submission."""
    p = r.params
    match r.method:
        case "sample.upload":
            return {("sample", p["name"])} if r.bytes is not None else set()
        case "sample.delete":
            return {("sample", p["name"])}
        case "sample.set":
            return {("stage", "")}
        case "calibration.apply":
            return {("correction", p["name"]), ("force", "")}
        case "calibration.delete":
            return {("correction", p["name"])}
        case "safety.estop" | "safety.reset":
            return {("estop", "")}
        case "script.submit" if r.answer is not None:
            return {("job", r.answer["job"])}
    return set()


def _written(r: Request, kind: str, name: str) -> tuple[set[Any], bool]:
    """What a request writes into a register of its own, and whether that is sure."""
    there = r.answer is not None
    match r.method, kind:
        case "sample.upload", "sample":
            assert r.bytes is not None
            return {len(r.bytes)}, there
        case "sample.delete", "sample":
            return {None}, there
        case "sample.set", "stage":
            file = r.params.get("file")
            return {
                file if file else r.params["name"].replace("empty", "") or None
            }, there
        case "calibration.apply", "correction":
            return {True}, there
        case "calibration.apply", "force":
            return {r.params["name"]}, there
        case "calibration.delete", "correction":
            return {False}, there
        case "safety.estop", "estop":
            return {True}, there
        case "safety.reset", "estop":
            return {False}, there
        case _, "job":
            return _written_to_job(r, name)
    return set(), False


def _written_to_job(r: Request, job: str) -> tuple[set[Any], bool]:
    """States that a request may leave a job in."""
    said, there = r.answer, r.answer is not None
    if r.method == "script.submit":
        return (set(GOING_ON), True) if said and said["job"] == job else (set(), False)
    if r.method == "job.forget":
        mine = r.params.get("job", job) == job
        if said is None:
            return ({None} if mine else set()), False
        return ({None}, True) if job in said["jobs"] else (set(), False)
    if r.method == "safety.estop":
        return {"paused"}, False  # what was no job under way stays as it is
    if r.params.get("job") != job:
        return set(), False
    state = None if said is None else said["state"]
    match r.method:
        case "job.resume":
            return GOING_ON | ({state} & {"paused"}), there
        case "job.pause" if state in (None, "paused"):
            return {"paused"}, there
        case "job.pause":
            return GOING_ON | {"paused"}, there
        case "job.abort" if state in ENDED:
            return {state}, True
        case "job.abort":
            return {"aborted"}, False
    return set(), False


def _places(state: Any) -> dict[str, float]:
    """Where the axes of a state are [mm, deg]."""
    return {name: round(axis["position"], 9) for name, axis in state["axes"].items()}


class History:
    """One data directory, its servers one after the other, and their clients."""

    def __init__(self, sim: Simulation, seed: int) -> None:
        """Begin without a server."""
        self.sim, self.rng = sim, random.Random(f"crossed {seed}")
        self.judge, self.outcome = Judge(), Outcome()
        self.sizes = itertools.count(2)
        self.clients: list[Client] = []
        self.tasks: list[asyncio.Task[Any]] = []

    def live(self, kills: int) -> Outcome:
        """Start, let clients ask, kill, and look at what is left, again and again."""
        self._start()
        for _ in range(kills):
            with suppress(Crashed):
                self._ask_all()
            rest: dict[str, float] | None = None
            with suppress(Crashed):
                rest = self._rest()
            self._kill()
            self._start()
            self._look(files=True)
            if rest is not None:
                assert _places(self.sim.call(self.clients[-1], "state.get")) == rest
        return self.outcome

    def _start(self) -> None:
        """Start a server, with clients of which the first takes control."""
        self.sim.disk.set(None)
        self.sim.start()
        self.clients = [self.sim.client() for _ in range(self.rng.randint(2, 4))]
        self.sim.call(self.clients[0], "session.control", action="acquire")
        loop: Any = self.sim._loop
        loop.others_s = self.rng.choice(SLOW_S)
        loop.journal_s = self.rng.choice((0.0, 0.002))

    def _rest(self) -> dict[str, float] | None:
        """Where the axes are, if they rest there and that is told to be on the disk."""
        state = self.sim.call(self.clients[-1], "state.get")
        moving = any(axis["moving"] for axis in state["axes"].values())
        if moving or state["job"] is not None or state["unsaved"] is not None:
            return None
        return _places(state)

    def _kill(self) -> None:
        """End the server at once; what was under way may be on the disk or not."""
        if self.rng.random() < 0.5 and not self.sim.disk.off:
            self.sim.kill()
        else:
            self.sim.cut()
        for r in self.judge.requests:
            end = "cut off" if r.answer is None else "answered"
            self.outcome.requests[f"{r.method} {'refused' if r.refused else end}"] += 1
        self.judge.killed()
        self.outcome.kills += 1

    def _ask_all(self) -> None:
        """Begin requests, with looks between them; the last ones may be under way at the
        end, and the power may go at a drawn change of the disk.
        """
        rng = self.rng
        count = rng.randint(6, 18)
        fatal = rng.randrange(count) if rng.random() < 0.4 else None
        for number in range(count):
            if number == fatal:
                self.sim.disk.set(Fault(rng.randint(0, 30), error=None))
            who = rng.choice((0, 0, rng.randrange(len(self.clients))))
            self._begin(who)
            self.sim.call(self.clients[0], "session.ping")
            self.sim.advance(rng.choice(GAPS_S))
            if rng.random() < 0.2:
                self._look()
        if rng.random() < 0.4:
            self.sim.advance(rng.choice((0.1, 5.0, 40.0)))
            self._look()

    def _begin(self, who: int) -> None:
        """Begin one drawn request, or a whole upload."""
        rng = self.rng
        job = rng.choice(sorted(self.judge.acknowledged) or ["job-1"])
        name = rng.choice(NAMES)
        kind = rng.choice(
            ["upload"] * 4 + ["delete", "set", "empty", "forget", "forget", "old", "resume"]
            + ["resume", "pause", "abort", "submit", "submit", "apply", "drop", "estop"]
            + ["reset", "reset", "move", "move"]
        )  # fmt: skip
        requests: dict[str, tuple[str, dict[str, Any]]] = {
            "delete": ("sample.delete", {"name": name}),
            "set": ("sample.set", {"file": name}),
            "empty": ("sample.set", {"name": "empty"}),
            "forget": ("job.forget", {"job": job}),
            "old": ("job.forget", {"days": 0.0}),
            "resume": ("job.resume", {"job": job}),
            "pause": ("job.pause", {"job": job}),
            "abort": ("job.abort", {"job": job}),
            "submit": ("script.submit", {"text": TEXT, "name": f"s{rng.randint(0, 5)}"}),
            "apply": ("calibration.apply", {"parameters": {"dD_x": rng.random()},
                                            "name": f"c{next(self.sizes)}"}),
            "drop": ("calibration.delete", {"name": f"c{rng.randint(2, 30)}"}),
            "estop": ("safety.estop", {}),
            "reset": ("safety.reset", {}),
            "move": ("axes.move", {"targets": {"rot_obj": rng.uniform(-9.0, 9.0)}}),
        }  # fmt: skip
        if kind == "upload":
            self._task(self._upload(who, name))
        else:
            method, params = requests[kind]
            self._task(self._ask(who, method, params))

    def _task(self, work: Coroutine[Any, Any, Any]) -> None:
        """Let it run beside all else; what it finds wrong is raised at the next look."""
        assert self.sim._loop is not None
        self.tasks.append(self.sim._loop.create_task(work))

    async def _upload(self, who: int, name: str) -> None:
        """Send voxels of a size of their own, in drawn pieces."""
        size = next(self.sizes)
        data = struct.pack(
            f"<{size}f", *(self.rng.uniform(0.1, 1.0) for _ in range(size))
        )
        self.judge.contents[len(data)] = data
        cuts = sorted(
            self.rng.randint(1, len(data) - 1) for _ in range(self.rng.randint(0, 2))
        )
        for start, end in itertools.pairwise([0, *cuts, len(data)]):
            params = {"name": name, "kind": "voxels", "format": "raw", "total": len(data),
                      "shape": [1, 1, size], "voxel_mm": [1.0] * 3, "start": start,
                      "data": data[start:end]}  # fmt: skip
            whole = data if end == len(data) else None
            if (await self._ask(who, "sample.upload", params, whole)).answer is None:
                return
            await asyncio.sleep(self.rng.choice(GAPS_S[:5]))

    async def _ask(
        self, who: int, method: str, params: dict[str, Any], whole: bytes | None = None
    ) -> Request:
        """Ask, and keep the answer, unless the server is dead by then.

        Raises:
            AssertionError: an answer that no state gives, or an observer's that needs
                control.
        """
        r = Request(method, params, who == 0, next(self.judge.order), bytes=whole)
        self.judge.requests.append(r)
        answer, refused = None, None
        try:
            answer = await self.clients[who].call(method, **params)
        except RpcError as error:
            refused = error
        if self.sim.disk.off:
            return r
        r.ended, r.answer, r.refused = next(self.judge.order), answer, refused
        if refused is not None:
            assert refused.code in REFUSALS, (method, refused)
            assert method != "safety.estop", refused
        else:
            assert r.controls or method in OPEN, (method, params, answer)
        if answer is not None and method == "script.submit":
            assert answer["job"] not in self.judge.acknowledged, answer
            self.judge.acknowledged.add(answer["job"])
        return r

    def _look(self, *, files: bool = False) -> None:
        """Compare what the server lists with what its answers promised.

        Args:
            files: also the bytes on the disk, as after a start.
        """
        for task in (t for t in self.tasks if t.done()):
            if not task.cancelled() and (error := task.exception()) is not None:
                raise error
        client, judge = self.clients[-1], self.judge
        self.outcome.looks += 1

        def asked(method: str) -> tuple[Any, int, int]:
            begun = next(judge.order)
            return self.sim.call(client, method), begun, next(judge.order)

        state, *when = asked("state.get")
        judge.see("estop", "", state["safety"]["estop"], *when, files)
        judge.see("stage", "", state["sample"]["name"] or None, *when, files)
        correction = state["correction"]
        judge.see("force", "", correction and correction["name"], *when, files)
        listed, *when = asked("sample.list")
        uploads = [s for s in listed["samples"] if s["uploaded"]]
        sizes = {s["name"]: int(s["description"].split()[-2]) for s in uploads}
        for name in NAMES:
            judge.see("sample", name, sizes.get(name), *when, files)
        listed, *when = asked("calibration.list")
        names = {c["name"] for c in listed["corrections"]}
        for name in {n for k, n in judge.writes if k == "correction"} | names:
            judge.see("correction", name, name in names, *when, files)
        listed, *when = asked("job.list")
        jobs = {j["job"]: j for j in listed["jobs"]}
        for name in sorted(judge.acknowledged):
            judge.see(
                "job", name, jobs[name]["state"] if name in jobs else None, *when, files
            )
        if files:
            self._look_at_files(sizes, jobs)
            # Of a submission that was cut off, the job may be there.
            new = {*jobs} - judge.acknowledged
            assert len(new) <= judge.cut_off, (new, judge.cut_off)
            judge.acknowledged |= new
            for name in new:
                state = frozenset({jobs[name]["state"]})
                judge.writes["job", name] = [Write(when[0], when[1], state)]

    def _look_at_files(self, sizes: dict[str, int], jobs: dict[str, Any]) -> None:
        """Compare the bytes on the disk with those that were sent, and finished data sets
        with what the list says.
        """
        for name, size in sizes.items():
            kept = [
                f.read_bytes() for f in (self.sim.data / "samples").glob(f"{name}.*.bin")
            ]
            assert kept == [self.judge.contents[size]], (name, size, len(kept))
        for job in jobs.values():
            about = Path(job["dataset"]) / "flexdt.json"
            if job["state"] == "done":
                assert (
                    json.loads(about.read_text(encoding="utf-8"))["complete"] is True
                ), job


def run_crossed(root: Path, seed: int, kills: int = 3) -> Outcome:
    """Live one history.

    Args:
        root: an empty directory.
        seed: of all that is drawn.
        kills: number of kills with a restart.

    Returns:
        What was asked, killed and looked at.

    Raises:
        AssertionError: something acknowledged was lost, changed by one who may not, or
            half made; or an error that no state gives.
    """
    with mock.patch("simulation.SimulatedLoop", SlowLoop), Simulation(root, seed) as sim:
        return History(sim, seed).live(kills)
