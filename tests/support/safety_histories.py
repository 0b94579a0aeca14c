"""Histories of a whole twin, and what must be answered at every state that they reach.

Machine, correction, pose, clock, job and control are drawn and crossed; after each step every
method that is safe or urgent, and the reset, is called in a drawn legal spelling, through the
codec on both ways.
"""

from __future__ import annotations

import asyncio
import json
import random
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from in_process import Client, PointProjector, script
from motion_histories import Judge, drawn_machine
from motion_oracle import MachineModel, Placed, Prism, Stage, machine_file
from motor_units import RATES, UNITS, in_units

from flexdt.protocol import METHODS, Codec, Connection, RpcError, parse_params
from flexdt.protocol.messages import Request, Response
from flexdt.runtime.files.directory import open_data
from flexdt.server.twin.core import TwinServer
from flexdt.testing.in_process import SimulatedLoop
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.description import (
    Machine,
    builtin_machine,
    builtin_profile,
    parse_machine,
)
from flexdt.twin.scanner.state import Sample, least_before_source

Call = tuple[str, dict[str, Any]]
MUST_ANSWER: list[Call] = [
    ("session.hello", {"protocol": "1.0", "client": "drawn"}),
    ("session.ping", {}),
    ("state.get", {}),
    ("state.unsubscribe", {"topics": ["state", "log"]}),
    ("state.subscribe", {"topics": ["state", "job", "log"]}),
    ("axes.stop", {}),
    ("safety.estop", {}),
    ("sample.list", {}),
    ("geometry.get", {}),
    ("job.list", {}),
    ("dataset.list", {}),
    ("calibration.get", {}),
    ("calibration.list", {}),
    ("scene.save", {}),
]
"""Methods that give their result at every state."""
NAMED = {-32001, -32002, -32003, -32006, -32007, -32008}
"""Errors that SPEC.md names for a state."""
MAY_REFUSE: dict[str, tuple[dict[str, Any], set[int]]] = {
    "safety.reset": ({}, {-32003}),
    "job.status": ({}, {-32602}),
    "job.abort": ({"reason": "drawn"}, {-32602, -32003}),
    "sample.mesh": ({}, NAMED | {-32602}),
    "projection.get": ({"binning": 8}, NAMED | {-32602}),
    "projection.ray": ({"pixel": [3, 3]}, NAMED | {-32602}),
    "dataset.get": ({"name": "none"}, {-32602}),
    "dataset.frame": ({"name": "none", "index": 0}, {-32602}),
    "calibration.fit": ({"datasets": ["none"], "phantom": "none"}, {-32602, -32007}),
    "calibration.align": ({"name": "none"}, {-32602, -32007}),
}
"""Methods that may refuse, as without control, a job or a sample, and the codes with which."""
QUICK = {"safety.reset", "job.status", "job.abort"}
"""Those of them that compute nothing."""
ENDING = {"axes.stop", "safety.estop", "safety.reset", "job.abort"}
"""Those that end motion and jobs."""
DEAR = {"rpc.discover", "exposure.predict", "script.check", "trajectory.check"}
"""Methods that say nothing of the state, or compute a scan for a second: with tests of their
own."""


ROUNDING = 1e-6
"""Of a position at an end of its travel [mm, deg]."""
MOST_RATE = 1e6
"""Largest speed and acceleration of a machine file."""


def all_are_called() -> set[str]:
    """Names of the safe and urgent methods that no table here has."""
    marked = {m.name for m in METHODS.values() if m.safe or m.urgent}
    return marked - {name for name, _ in MUST_ANSWER} - set(MAY_REFUSE) - DEAR


def spelt(rng: random.Random, name: str, params: dict[str, Any]) -> tuple[Codec, bytes]:
    """A request's bytes in one of its legal spellings: codec, escapes, order, blanks,
    parameters by name, by position or left out, the kind of its id.
    """
    id_ = rng.choice([7, "seven", -1, "0"])
    fields = list(METHODS[name].params.model_fields)
    by_place = list(params) == fields[: len(params)] and rng.random() < 0.4
    given: object = list(params.values()) if by_place else params
    members: list[tuple[str, object]] = [
        ("jsonrpc", "2.0"),
        ("id", id_),
        ("method", name),
    ]
    if params or rng.random() < 0.6:
        members.append(("params", given))
    rng.shuffle(members)
    if rng.random() < 0.4:
        body = msgpack.packb(dict(members))
        return Codec.MSGPACK, len(body).to_bytes(4, "big") + body
    text = json.dumps(dict(members), separators=rng.choice([(",", ":"), (" , ", " : ")]))
    if rng.random() < 0.5:
        at = rng.randrange(len(name))
        escaped = f"{name[:at]}\\u{ord(name[at]):04x}{name[at + 1 :]}"
        text = text.replace(f'"{name}"', f'"{escaped}"')
    return Codec.JSON, text.encode() + b"\n"


async def ask(rng: random.Random, client: Client, call: Call) -> object:
    """Ask by bytes and answer by bytes; the answer's result, decoded.

    Raises:
        RpcError: the method's error.
    """
    name, params = call
    codec, sent = spelt(rng, name, params)
    wire = Connection(codec)
    (message,) = wire.receive_data(sent)
    assert isinstance(message, Request), (sent, message)
    method = METHODS[message.method]
    result = await client.session.handle(method, parse_params(method, message.params))
    back = wire.send(Response(message.id, result))
    assert back
    return result


def drawn(
    rng: np.random.Generator,
) -> tuple[Machine, MachineModel, dict[str, float]]:
    """The shipped scanner or a machine drawn anew, in mm or other units.

    Returns:
        The machine; as the oracle reads it, in mm and deg; motor -> mm or deg of its unit.
    """
    if rng.random() < 0.6:
        machine, model = builtin_machine(), MachineModel(machine_file("flexray"))
    else:
        text = drawn_machine(rng)
        machine = parse_machine(text, "drawn.toml")
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "drawn.toml"
            file.write_text(text, encoding="utf-8")
            model = MachineModel(file)
    mm, deg = 1.0, 1.0
    if rng.random() < 0.3:
        mm, deg = UNITS[str(rng.choice(list(UNITS)))]
        machine = in_units(machine, mm, deg)
    sizes = {n: deg if a.unit == "deg" else mm for n, a in machine.axes.items()}
    rates = {  # as a machine file may state them
        n: a.model_copy(update={f: min(getattr(a, f), MOST_RATE) for f in RATES})
        for n, a in machine.axes.items()
    }
    return machine.model_copy(update={"axes": rates}), model, sizes


BOXES = {"normal-3": Prism.box((20.0, 40.0, 60.0))}
"""Samples whose shape the oracle knows; beside others it judges the parts alone."""
CREEPS_MM = (1.0, 0.02, 0.01, *[0.004] * 4, *[0.002] * 3, *[0.00095] * 24)
"""Requests beyond a place before a contact: to the margin, and then as small as passes for
rounding, so many that they add up to more than the oracle allows."""


class Episode:
    """One twin under drawn requests of two clients.

    Args:
        seed: draws all.
        steps: requests that change something; after each all answers are asked for.
        dear: also those that may refuse.
    """

    def __init__(self, seed: int, steps: int, *, dear: bool) -> None:
        self.rng, self.words = np.random.default_rng(seed), random.Random(seed)
        self.seed, self.steps, self.dear = seed, steps, dear
        self.machine, self.model, self.sizes = drawn(self.rng)
        self.judge = Judge(self.model.margin)
        self.creeping: list[Call] = []
        """Requests of a micrometre each, towards a contact that was refused."""
        self.asked = self.accepted = 0
        self.found: list[str] = []
        self.following: Call | None = None
        """The next request, where it is not drawn."""

    def request(self) -> Call:
        """Draw a request that changes machine, correction, pose, clock, job or control."""
        rng, axes = self.rng, self.machine.axes
        if self.creeping:
            return self.creeping.pop(0)
        if self.following is not None:
            call, self.following = self.following, None
            return call
        kind = int(rng.integers(14))
        if kind < 6:  # far: corners are where a geometry ends
            some = rng.choice(list(axes), int(rng.integers(1, 4)), replace=False)
            ends = {n: (axes[n].lower, axes[n].upper) for n in some.tolist()}
            return "axes.move", {
                "targets": {
                    n: float(rng.choice([low, high, low, high, rng.uniform(low, high)]))
                    for n, (low, high) in ends.items()
                },
                "wait": bool(rng.random() < 0.8),
            }
        if kind < 9:
            tilts = ["det_yaw", "det_pitch", "axis_tilt_x", "det_roll", "axis_tilt_z"]
            if rng.random() < 0.6:
                name, size = (
                    str(rng.choice(["det_yaw", *tilts[:3]])),
                    float(rng.uniform(6.5, 9.5)),
                )
                size *= float(rng.choice([-1.0, 1.0]))
                return "calibration.apply", {"parameters": {name: size}}
            shifts = ["dO_x", "dO_z", "dD_z", "dS_y", "tau_x", "alpha"]
            some = rng.choice([*tilts, *shifts], 3, replace=False).tolist()
            values = {n: float(rng.uniform(-3.0, 3.0)) for n in some}
            return "calibration.apply", {"parameters": values}
        match kind:
            case 9:
                pace = rng.choice(["max", "1", "1000000"])
                return "clock.set", {"speed_up": "max" if pace == "max" else float(pace)}
            case 10:
                corner = int(rng.integers(0, 1500))
                low = min(corner, 1400)
                return "camera.set", {"roi": [low, low, low + 63, low + 63]}
            case 11:
                return "script.submit", {
                    "text": script(2),
                    "name": f"s{rng.integers(99)}",
                }
            case 12:
                return "session.control", {"action": "force"}
            case _:
                name = str(
                    rng.choice(["chiral", "empty", "lego", "normal-3", "normal-3"])
                )
                return "sample.set", {"name": name}

    def to_worst_corner(self, parameters: dict[str, float]) -> Call | None:
        """A move to where these offsets bring the axis, or the panel, nearest to the source; None
        where no motor matters.
        """
        corners = least_before_source(
            self.machine,
            builtin_profile(self.machine.default_profile),
            self.machine.detector.camera,
            Offsets.from_edge(parameters),
        )
        _, pose, _ = list(corners)[int(self.rng.choice([0, 0, 2]))]
        return ("axes.move", {"targets": pose, "wait": True}) if pose else None

    async def step(self, client: Client) -> str:
        """Make one drawn request, mostly after what would have it refused is put away;
        refusals are fine, failures are not. Returns the method.
        """
        for name, params in (("session.control", {"action": "force"}), ("job.abort", {}),
                             ("safety.reset", {})):  # fmt: skip
            if self.rng.random() < 0.8:
                with suppress(RpcError):
                    await client.call(name, **params)
        name, params = self.request()
        if name == "calibration.apply":
            self.following = self.to_worst_corner(params["parameters"])
        try:
            await asyncio.wait_for(client.call(name, **params), 600.0)
            self.accepted += 1
        except RpcError as error:
            if error.code == -32603:
                self.found.append(f"{name} {params}: {error}")
            if error.code == -32002 and name == "axes.move" and not self.creeping:
                self.creep(error.data, params["targets"])
        except TimeoutError:
            pass
        return name

    def creep(self, refusal: Mapping[str, Any], targets: Mapping[str, float]) -> None:
        """Go to the last free place before a contact, and on by a micrometre a request."""
        halts = refusal.get("halts_at") or {}
        if not halts or self.rng.random() < 0.3:
            return
        stopped = [n for n in halts if n in targets]
        if not stopped:
            return
        name = max(stopped, key=lambda n: abs(targets[n] - halts[n]) * self.sizes[n])
        place = halts[name]
        way = float(np.sign(targets[name] - place) or 1.0) / self.sizes[name]
        self.creeping = [("axes.move", {"targets": {name: place}, "wait": True})] + [
            ("axes.move", {"targets": {name: way * mm}, "relative": True, "wait": True})
            for mm in CREEPS_MM
        ]

    async def judged(self, client: Client, done: str) -> None:
        """Let the oracle judge where the parts are: its own kinematics and distances."""
        state = await client.call("state.get")
        if not any(axis["moving"] for axis in state["axes"].values()):
            reading = {n: state["axes"][n]["position"] * s for n, s in self.sizes.items()}
            applied = (state["correction"] or {}).get("parameters", {})
            sample = Placed(BOXES.get(state["sample"]["name"] or ""))
            stage = Stage(self.model, sample, applied)
            said = "ready" if state["safety"]["state"] == "ok" else "stopped"
            pose = self.model.vector(reading)
            self.judge.look(stage, pose, said, done, forget=done != "axes.move")
            low, high = self.model.lower - ROUNDING, self.model.upper + ROUNDING
            if not ((low <= pose) & (pose <= high)).all():
                self.judge.found.append(f"{done}: {reading} beyond the travel")
            self.found += [f"oracle: {what}" for what in self.judge.found]
            self.judge.found.clear()

    async def look(self, client: Client) -> None:
        """Ask for all answers; what does not come is found."""
        calls = [(call, set[int]()) for call in MUST_ANSWER]
        for name, (params, codes) in MAY_REFUSE.items():
            if self.dear or name in QUICK:
                calls.append(((name, params), codes))
        if self.words.random() < 0.5:  # else jobs and motion would never last
            calls = [(call, codes) for call, codes in calls if call[0] not in ENDING]
        for call, codes in calls:
            self.asked += 1
            try:
                await ask(self.words, client, call)
            except RpcError as error:
                if error.code not in codes:
                    self.found.append(f"{call[0]}: {error}")
            except Exception as error:  # a defect, and the campaign goes on
                self.found.append(f"{call[0]}: {type(error).__name__}: {error}")

    async def run(self, root: Path) -> None:
        """The whole history on a twin of its own."""
        machine = self.machine
        twin = TwinServer(
            machine,
            builtin_profile(machine.default_profile),
            PointProjector(),
            open_data(root),
            speed_up="max",
            wall=asyncio.get_running_loop().time,
        )
        await twin.start(Sample(""))
        try:
            mover, other = Client(twin, "mover"), Client(twin, "other")
            for client in (mover, other):
                await client.call("session.hello", protocol="1.0", client="test")
            steps = self.steps
            while steps > 0 or self.creeping:
                steps -= not self.creeping
                done = await self.step(mover if self.rng.random() < 0.8 else other)
                await self.judged(mover, done)
                if self.creeping:
                    continue
                await self.look(mover if self.rng.random() < 0.5 else other)
                states = [
                    c.of("state")[-1]["data"] for c in (mover, other) if c.of("state")
                ]
                self.found += [
                    f"no geometry: {state['missing']}"
                    for state in states
                    if state["missing"]
                ]
        finally:
            await twin.stop()


def episode(seed: int, steps: int, *, dear: bool = False) -> Episode:
    """Run a history on virtual time in a folder of its own, and give what it found."""
    one = Episode(seed, steps, dear=dear)
    with (
        tempfile.TemporaryDirectory() as folder,
        asyncio.Runner(
            loop_factory=partial(SimulatedLoop, random.Random(seed))
        ) as runner,
    ):
        runner.run(one.run(Path(folder)))
    return one
