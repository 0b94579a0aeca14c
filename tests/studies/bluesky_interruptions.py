"""Bluesky plans paused and suspended at drawn moments, and a check of every document they made.

    python tests/studies/bluesky_interruptions.py [--runs 100] [--seed 1]

A real RunEngine, a real twin. Each run is one of five plans with one to four interruptions:
pauses at once, pauses at the next checkpoint, and trips of a suspender, before or while a drawn
message is processed. `problems_of` reads the documents and the files on disk alone; it knows
event-model's schemas and what the plan should have measured, and nothing of the devices. Prints
how many runs were valid, and what is wrong with the others.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import io
import random
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import bluesky.plan_stubs as bps
import bluesky.plans as bp
import numpy as np
import tifffile
from bluesky import RunEngine
from bluesky.run_engine import call_in_bluesky_event_loop as drive
from bluesky.suspenders import SuspendBoolHigh
from bluesky.utils import RunEngineInterrupted
from event_model import DocumentNames, schema_validators
from ophyd_async.core import StaticPathProvider, UUIDFilenameProvider, init_devices

from flexdt.clients import TwinClient
from flexdt.clients.launch.processes import Servers
from flexdt.twin.machine.camera import Roi
from flexdt.twin.script.scan_request import ScanRequest
from flexdt_extensions.bluesky import FlyScan, TwinLab
from flexdt_extensions.bluesky.flyer import checkpoint_before_close, fly_scan

START = {"tra_obj": 0.0, "mag_obj": 600.0, "rot_obj": 5.0, "mag_det": 1000.0}
TURN = ScanRequest(
    kind="fly", frames=9, exposure_ms=50.0, averages=10, roi=Roi(800, 620, 1199, 939), darks=1,
    flats=1,
)  # fmt: skip
KINDS = ("immediate", "deferred", "suspender")
PATIENCE_S = 120.0

Point = Mapping[str, float]
Images = Mapping[int, np.ndarray]


@dataclass(frozen=True)
class Plan:
    """One plan, and the points that it should measure."""

    make: Callable[[TwinLab], Iterator[Any]]
    image: str
    points: Sequence[Point]
    """What the event of each point holds."""
    stream: str = "primary"
    """Where these events are."""


def _turned(angles: Sequence[float]) -> list[Point]:
    return [{"lab-rot_obj": a} for a in angles]


PLANS: Mapping[str, Plan] = {
    "count": Plan(lambda lab: bp.count([lab.camera], num=4), "lab-camera", [{}] * 4),
    "scan": Plan(
        lambda lab: bp.scan([lab.camera, lab.tube], lab.axis("rot_obj"), 0.0, 40.0, 5),
        "lab-camera", _turned([0.0, 10.0, 20.0, 30.0, 40.0]),
    ),
    "grid_scan": Plan(
        lambda lab: bp.grid_scan([lab.camera], lab.axis("mag_obj"), 580.0, 600.0, 2,
                                 lab.axis("rot_obj"), 10.0, 30.0, 3),
        "lab-camera",
        [{"lab-mag_obj": m, "lab-rot_obj": r} for m in (580.0, 600.0) for r in (10.0, 20.0, 30.0)],
    ),
    "rel_scan": Plan(
        lambda lab: bp.rel_scan([lab.camera], lab.axis("rot_obj"), -10.0, 20.0, 4),
        "lab-camera", _turned([-5.0, 5.0, 15.0, 25.0]),
    ),
    "fly_scan": Plan(
        lambda lab: fly_scan(lab.scan, FlyScan(TURN, seed=1, speed_up=20.0), flush_s=0.05),
        "lab-scan", [{"lab-scan-angle_deg": 45.0 * i} for i in range(9)], "frames",
    ),
}  # fmt: skip


# -- interruptions -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Interruption:
    """When to interrupt, and for how long."""

    kind: str
    message: int
    """Number of the message, counted from the end of the last interruption."""
    delay_s: float
    """From the beginning of that message."""
    hold_s: float


@dataclass(frozen=True)
class Drawn:
    """One run of the study."""

    plan: str
    speed_up: float | str
    interruptions: Sequence[Interruption]


def draw(random_: random.Random, plan: str, messages: int) -> Drawn:
    """A run of a plan that has so many messages where nothing interrupts it."""
    count = random_.randint(1, 4)
    return Drawn(
        plan,
        random_.choice(["max", 20.0]),
        [
            Interruption(
                random_.choice(KINDS),
                random_.randint(1, max(1, messages // count)),
                random_.choice(
                    [0.0, random_.uniform(0.0, 0.005), random_.uniform(0.0, 0.1)]
                ),
                random_.choice([0.0, random_.uniform(0.0, 0.2)]),
            )
            for _ in range(count)
        ],
    )


class Beam:
    """What a suspender watches, as ophyd's signals look to it: high when the beam is lost."""

    name = "beam"

    def __init__(self) -> None:
        self.watchers: list[Callable[..., None]] = []

    def subscribe(self, watcher: Callable[..., None], **_: object) -> None:
        self.watchers.append(watcher)

    def clear_sub(self, watcher: Callable[..., None]) -> None:
        self.watchers.remove(watcher)

    def put(self, lost: bool) -> None:
        for watcher in self.watchers:
            watcher(lost)


@dataclass
class Interrupter:
    """Interrupts a RunEngine as drawn; `hook` sees each message before it is processed."""

    engine: RunEngine
    beam: Beam
    left: list[Interruption] = field(default_factory=list)
    met: list[tuple[str, str]] = field(default_factory=list)
    """Kind of each interruption that happened, and the message that it met."""
    seen: int = 0
    current: Interruption | None = None
    last: str = ""
    total: int = 0
    error: str | None = None

    def hook(self, message: Any) -> None:
        self.last = message.command
        self.total += 1
        if self.current is not None or not self.left:
            return
        self.seen += 1
        if self.seen >= self.left[0].message:
            self.current = self.left.pop(0)
            self.seen = 0
            if self.current.kind == "suspender" and not self.current.delay_s:
                self.fire(
                    self.current
                )  # in the engine's own loop, before anything else happens
            else:
                threading.Timer(self.current.delay_s, self.fire, [self.current]).start()

    def fire(self, now: Interruption) -> None:
        met = self.last
        try:
            if now.kind == "suspender":
                self.beam.put(True)
                threading.Timer(now.hold_s, self.release).start()
            else:
                self.engine.request_pause(defer=now.kind == "deferred")
        except Exception:  # the plan has ended meanwhile
            self.current = None
            return
        self.met.append((now.kind, met))

    def release(self) -> None:
        self.beam.put(False)
        self.current = None

    def run(
        self, plan: Iterator[Any], watcher: Callable[[str, dict[str, Any]], None]
    ) -> None:
        """Run a plan to its end, resumed after each pause."""
        call: Callable[[], object] = lambda: self.engine(plan, watcher)  # noqa: E731
        while True:
            try:
                call()
                return
            except RunEngineInterrupted:
                if self.engine.state != "paused":
                    return  # the pause came when the plan had just ended
                time.sleep(self.current.hold_s if self.current else 0.0)
                self.current = None
                call = self.engine.resume


# -- the validator -----------------------------------------------------------------------------

Documents = list[tuple[str, dict[str, Any]]]


def problems_of(
    documents: Documents, plan: Plan, reference: Images | None = None
) -> list[str]:
    """What is wrong with a run's documents and the files they name; nothing, if it is valid.

    Args:
        documents: in their order.
        plan: what should have been measured.
        reference: an image of each point, taken undisturbed: each frame must resemble that of
            its own point more than that of another pose.
    """
    found: list[str] = []
    by_kind: dict[str, list[dict[str, Any]]] = {}
    for kind, document in documents:
        try:
            schema_validators[DocumentNames[kind]].validate(document)
        except Exception as error:
            found.append(f"{kind} fails its schema: {error!s:.80}")
        by_kind.setdefault(kind, []).append(document)
    names = [kind for kind, _ in documents]
    if names.count("start") != 1 or names.count("stop") != 1:
        return [*found, f"{names.count('start')} starts and {names.count('stop')} stops"]
    if names[0] != "start" or names[-1] != "stop":
        found.append("documents before the start or after the stop")
    start, stop = by_kind["start"][0], by_kind["stop"][0]
    if stop["exit_status"] != "success" or stop["run_start"] != start["uid"]:
        found.append(f"it ended {stop['exit_status']}: {stop.get('reason', '')!s:.120}")
    found += _unresolved(documents, start["uid"])

    descriptors = {d["uid"]: d for d in by_kind.get("descriptor", [])}
    for stream in {d["name"] for d in descriptors.values()}:
        if sum(d["name"] == stream for d in descriptors.values()) > 1:
            found.append(f"stream {stream} is described twice")
    rows = _rows(by_kind, descriptors)
    for stream, events in rows.items():
        if sorted(events) != list(range(1, len(events) + 1)):
            found.append(f"stream {stream}: sequence numbers {sorted(events)}")
        if stop.get("num_events", {}).get(stream) != len(events):
            found.append(
                f"stop counts {stop.get('num_events')}, {stream} has {len(events)}"
            )
    events = rows.get(plan.stream, {})
    for number, point in enumerate(plan.points, 1):
        data = events.get(number, {})
        for key, value in point.items():
            if key not in data or abs(data[key] - value) > 1e-5:
                found.append(f"point {number}: {key} is {data.get(key)}, not {value}")
    if len(events) != len(plan.points):
        found.append(f"{len(events)} events of {len(plan.points)} points")
    return [*found, *_wrong_frames(by_kind, descriptors, plan, events, reference)]


def _unresolved(documents: Documents, run: str) -> Iterator[str]:
    """References to what has not been emitted before."""
    known: set[str] = set()
    refers = {"event": ["descriptor"], "event_page": ["descriptor"],
              "stream_datum": ["descriptor", "stream_resource"],
              "descriptor": ["run_start"], "stream_resource": ["run_start"]}  # fmt: skip
    for kind, document in documents:
        for key in refers.get(kind, []):
            if document[key] not in known | {run}:
                yield f"{kind} refers to an unknown {key} {document[key]!r}"
        uids = document["uid"] if kind == "event_page" else [document["uid"]]
        if known & set(uids):
            yield f"{kind} {document['uid']} twice"
        known.update(uids)


def _rows(
    by_kind: Mapping[str, Sequence[Mapping[str, Any]]],
    descriptors: Mapping[str, Mapping[str, Any]],
) -> dict[str, dict[int, Mapping[str, Any]]]:
    """The data of each stream's events by sequence number; a measurement taken again
    replaces."""
    rows: dict[str, dict[int, Mapping[str, Any]]] = {}
    for event in by_kind.get("event", []):
        stream = descriptors[event["descriptor"]]["name"]
        rows.setdefault(stream, {})[event["seq_num"]] = event["data"]
    for page in by_kind.get("event_page", []):
        stream = descriptors[page["descriptor"]]["name"]
        for i, number in enumerate(page["seq_num"]):
            data = {key: values[i] for key, values in page["data"].items()}
            rows.setdefault(stream, {})[number] = data
    return rows


def _wrong_frames(
    by_kind: Mapping[str, Sequence[Mapping[str, Any]]],
    descriptors: Mapping[str, Mapping[str, Any]],
    plan: Plan,
    events: Mapping[int, Mapping[str, Any]],
    reference: Images | None,
) -> Iterator[str]:
    resources = {d["uid"]: d for d in by_kind.get("stream_resource", [])}
    expected: Counter[str] = Counter()
    of_point: dict[int, Path] = {}
    for datum in by_kind.get("stream_datum", []):
        resource = resources.get(datum["stream_resource"])
        if resource is None:
            continue
        first, last = datum["indices"]["start"], datum["indices"]["stop"]
        numbers = range(datum["seq_nums"]["start"], datum["seq_nums"]["stop"])
        if first != expected[resource["uid"]] or last <= first:
            yield f"frames [{first}, {last}) come after {expected[resource['uid']]}"
        if len(numbers) != last - first:
            yield f"frames [{first}, {last}) stand for events {numbers}"
        if resource["data_key"] not in descriptors[datum["descriptor"]]["data_keys"]:
            yield f"a datum of {resource['data_key']} in a stream without it"
        expected[resource["uid"]] = last
        for index, number in zip(range(first, last), numbers, strict=False):
            folder = Path(unquote(urlsplit(resource["uri"]).path))
            file = folder / resource["parameters"]["template"].format(index)
            if plan.stream != "primary" and number in of_point:
                yield f"frames for event {number} twice, in a scan that is not taken again"
            of_point[number] = file  # one that was taken again replaces
    if len(resources) != 1:
        yield f"{len(resources)} series of images"
        return
    (resource,) = resources.values()
    folder = Path(unquote(urlsplit(resource["uri"]).path))
    named = {
        resource["parameters"]["template"].format(i)
        for i in range(max(expected.values()))
    }
    series = resource["parameters"]["template"].split("{")[0]
    there = {f.name for f in folder.glob(f"{series}*")}
    if there != named:
        yield f"files not named {sorted(there - named)}, missing {sorted(named - there)}"
        return
    if sorted(of_point) != list(range(1, len(plan.points) + 1)):
        yield f"frames for the events {sorted(of_point)}, not for {len(plan.points)}"
        return
    for number, file in of_point.items():
        image = tifffile.imread(file)
        mean = events.get(number, {}).get(f"{plan.image}-mean")
        if mean is not None and mean != float(image.mean(dtype=np.float64)):
            yield f"event {number} has the mean of another image than {file.name}"
        if reference is not None and plan.points[0]:
            apart = {
                i: float(np.mean((image - other) ** 2)) for i, other in reference.items()
            }
            nearest = min(apart, key=apart.__getitem__)
            if plan.points[nearest - 1] != plan.points[number - 1]:
                yield f"event {number}'s image shows the pose of event {nearest}"


def images_of(documents: Documents) -> Images:
    """The image of each event, as floats."""
    resources = {d["uid"]: d for kind, d in documents if kind == "stream_resource"}
    found: dict[int, np.ndarray] = {}
    for datum in (d for kind, d in documents if kind == "stream_datum"):
        resource = resources[datum["stream_resource"]]
        folder = Path(unquote(urlsplit(resource["uri"]).path))
        span = range(datum["indices"]["start"], datum["indices"]["stop"])
        for number, i in enumerate(span, datum["seq_nums"]["start"]):
            file = folder / resource["parameters"]["template"].format(i)
            found[number] = tifffile.imread(file).astype(np.float64)
    return found


# -- the study ---------------------------------------------------------------------------------


@dataclass
class Study:
    """An engine, a laboratory, and what undisturbed runs of each plan look like."""

    engine: RunEngine
    lab: TwinLab
    beam: Beam
    scene: Any
    """Where everything stands before each run."""
    messages: dict[str, int] = field(default_factory=dict)
    reference: dict[str, Images] = field(default_factory=dict)
    documents: dict[str, Documents] = field(default_factory=dict)

    def learn(self, plan: str) -> list[str]:
        """Run a plan undisturbed, once; what is wrong even then."""
        if plan in self.messages:
            return []
        interrupter, documents = self._run(Drawn(plan, "max", []))
        self.messages[plan], self.documents[plan] = interrupter.total, documents
        self.reference[plan] = images_of(documents)
        return problems_of(documents, PLANS[plan])

    def try_(self, drawn: Drawn) -> tuple[list[str], list[tuple[str, str]]]:
        """What is wrong after a disturbed run, and which interruptions it met."""
        self.learn(drawn.plan)
        interrupter, documents = self._run(drawn)
        found = problems_of(documents, PLANS[drawn.plan], self.reference[drawn.plan])
        return [e for e in [interrupter.error] if e] + found, interrupter.met

    def _run(self, drawn: Drawn) -> tuple[Interrupter, Documents]:
        documents: Documents = []

        def watch(name: str, document: dict[str, Any]) -> None:
            documents.append((name, copy.deepcopy(document)))

        drive(self.lab.link.client.set_clock("max"))
        drive(self.lab.link.client.load_scene(self.scene))
        tube = self.lab.tube
        self.engine(bps.mv(tube.kV, 90.0, tube.power_W, 20.0, tube.on, True))
        drive(self.lab.link.client.set_clock(drawn.speed_up))
        interrupter = Interrupter(self.engine, self.beam, list(drawn.interruptions))
        self.engine.msg_hook = interrupter.hook
        hung = threading.Timer(PATIENCE_S, lambda: self.engine.abort("it hung"))
        hung.start()
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                interrupter.run(PLANS[drawn.plan].make(self.lab), watch)
        except Exception as error:  # the stop document says it too, where there is one
            interrupter.error = f"{type(error).__name__}: {error!s:.200}"
        finally:
            hung.cancel()
            interrupter.left.clear()
            deadline = time.monotonic() + 1.0
            while interrupter.current is not None and time.monotonic() < deadline:
                time.sleep(0.01)
            self.engine.msg_hook = None
            self.beam.put(False)
        return interrupter, documents


def begin(address: tuple[str, int], images: Path) -> Study:
    """Devices of a running twin, X-rays on, a suspender installed."""
    with TwinClient(*address) as client:
        client.set_clock("max")
        client.set_sample("normal-5")
        client.move(START, wait=True)
        client.set_camera(mode="HW2SW1High", roi=(800, 620, 1199, 939), exposure_ms=50.0)
        scene = client.save_scene()
        client.control("release")
    engine, beam = RunEngine({}), Beam()
    with init_devices():
        lab = TwinLab(
            StaticPathProvider(UUIDFilenameProvider(), images), *address, name="lab"
        )
    engine.install_suspender(SuspendBoolHigh(beam))
    engine.preprocessors.append(checkpoint_before_close)
    return Study(engine, lab, beam, scene)


def main(runs: int, seed: int, plans: Sequence[str]) -> None:
    met: Counter[tuple[str, str]] = Counter()
    valid: Counter[str] = Counter()
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        options = {"data": folder / "data", "speed-up": "max"}
        with Servers(options, folder / "servers.log") as servers:
            study = begin(servers.address, folder / "camera")
            for plan in plans:
                for problem in study.learn(plan):
                    print(f"{plan}, undisturbed: {problem}")
            for i in range(runs):
                plan = plans[i % len(plans)]
                drawn = draw(random.Random(f"{seed} {i}"), plan, study.messages[plan])
                found, reached = study.try_(drawn)
                met.update(reached)
                valid[plan] += not found
                for problem in found[:3]:
                    print(
                        f"run {i} ({plan}, {drawn.speed_up}, {reached}): {problem}",
                        flush=True,
                    )
            drive(study.lab.close())
    kinds = Counter(kind for kind, _ in met.elements())
    where = Counter(message for _, message in met.elements())
    print(f"valid: {sum(valid.values())} of {runs}  {dict(valid)}")
    print(f"interruptions: {dict(kinds)}; while: {dict(where.most_common())}")
    print(f"{time.monotonic() - began:.0f} s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--plans", nargs="+", choices=list(PLANS), default=list(PLANS))
    given = parser.parse_args()
    main(given.runs, given.seed, given.plans)
