"""Well-formed messages with absurd values, for every field of every method of all four servers.

    python tests/studies/fuzz_schema.py --count 1000000
    python tests/studies/fuzz_schema.py --replay FILE

Twin, projector, viewer and gateway run as processes. What they publish of themselves
(`rpc.discover`, the models of the viewer's pages, the gateway's vocabulary) makes the messages:
valid ones, from names, jobs and positions of the live twin, in which one field (sometimes two)
is at, beyond or far beyond its bounds, of another kind, missing, or joined by others; a few
have their bytes changed. Several clients send at a time, in JSON and in MessagePack, in states
that matter: a job that runs, one that is paused, a sample or an upload on the stage, an E-stop,
a correction, a scanner that another client holds.

A run fails where a process ends, an answer is -32603, a log holds an error, a value that the
schema does not allow is accepted or refused without its field, a state cannot be had any more,
an answer does not come, a refused request moves something, or memory grows: after each 1000
messages it is within 10 % and 50 MB of its plateau. What failed is written to a file, which
--replay sends again one by one. Repeatable by --seed.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import copy
import itertools
import json
import math
import random
import re
import socket
import struct
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path as File
from statistics import median
from typing import Any

import msgpack
import numpy as np

sys.path.insert(0, str(File(__file__).parents[1] / "support"))

from lab import Process, Refused, Wire, fly_script, machine, projector, twin
from schemas import NUMBERS, TEXTS, Path, Schema, Schemas

BATCH = 400
QUIET_S = 1.0
"""Without an answer for so long, whatever keeps a batch (a slow clock, a long move) is
ended."""
HANGS_S = 90.0
BROKEN = 0.03
"""Share of messages whose bytes are changed."""
INTERNAL = -32603
COSTLY = {
    "projection.get": 60, "script.submit": 40, "trajectory.submit": 40, "script.check": 20,
    "trajectory.check": 20, "sample.upload": 20, "sample.set": 20, "scene.load": 10,
    "sample.mesh": 10, "rpc.discover": 40, "scene.save": 4, "calibration.list": 10,
    "calibration.apply": 10, "calibration.revert": 4, "job.list": 10, "job.resume": 60,
    "job.step": 60, "job.pause": 20, "job.abort": 20, "axes.move": 2, "axes.jog": 2,
    "viewer.export": 200, "viewer.plan": 40, "sample.list": 4,
    "dataset.list": 40, "dataset.get": 40, "dataset.frame": 20, "exposure.predict": 400,
    "calibration.fit": 400, "calibration.align": 400,
}  # fmt: skip
"""Methods that are asked so much less often, so that a million messages end within the hour."""
SCRIPT = "camera\tset exposure\t100\t\tACK\t\t"
ROI = [900, 700, 1027, 827]
STATES = (
    "idle",
    "sample",
    "upload",
    "estop",
    "corrected",
    "running",
    "paused",
    "held",
    "held",
)
HELD = ("session.control",)
"""Methods that are not asked of a scanner that another client holds."""
TAKING: list[dict[str, Any]] = [
    {"method": "session.control", "params": {"action": "force"}},
    {"method": "safety.reset", "params": {}},
]
STL = base64.b64encode(
    b"\0" * 80 + struct.pack("<I", 4) + b"".join(
        struct.pack("<12fH", 0, 0, 0, *(9.0 * c for v in face for c in v), 0)
        for p in [[(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]]
        for face in [(p[0], p[2], p[1]), (p[0], p[1], p[3]), (p[0], p[3], p[2]), (p[1], p[2], p[3])]
    )
).decode()  # fmt: skip


@dataclass(frozen=True)
class Said:
    """One message of the fuzzer's.

    Attributes:
        document: as it is sent.
        paths: of the values that were changed; none for one that is valid.
        allowed: whether the schema allows it.
        broken: what is sent instead, its bytes changed: it may say anything.
    """

    document: dict[str, Any]
    paths: tuple[Path, ...] = ()
    allowed: bool = True
    broken: bytes | None = None

    @property
    def unreadable(self) -> bool:
        """Whether a parser may refuse it, so that its answer names no request."""
        return self.broken is not None or not _readable(self.document, 0)


@dataclass
class Found:
    """What went wrong, once for each kind."""

    kept: dict[str, dict[str, Any]] = field(default_factory=dict)

    def add(
        self, server: str, kind: str, messages: list[Any], told: object = None
    ) -> None:
        """Keep a problem with its messages and print it; of each kind the first is kept.

        Args:
            server: by name.
            kind: what went wrong.
            messages: that led to it; one alone if it is known which.
            told: what the server said.
        """
        first = messages[0] if len(messages) == 1 else {}
        where = f"{first.get('method', '')}" if isinstance(first, dict) else ""
        key = f"{server} {kind} {where} {re.sub('[0-9]+', '#', str(told))[:80]}"
        if key not in self.kept:
            self.kept[key] = {"server": server, "problem": key, "messages": messages,
                              "answer": told}  # fmt: skip
            print("PROBLEM:", key, str(messages)[:600], str(told)[-1200:], flush=True)


class Maker:
    """Makes messages from the methods of one server.

    Args:
        schemas: what the methods' schemas refer to.
        methods: the schema of each one's parameters.
        valid: whole parameters that are in order, for methods whose fields depend on each
            other.
        names: valid values of fields by their names.
    """

    def __init__(
        self,
        schemas: Schemas,
        methods: dict[str, Schema],
        valid: dict[str, list[Callable[[], dict[str, Any]]]],
        names: dict[str, Callable[[], Any]],
        rng: random.Random,
    ) -> None:
        """Weigh methods by what they cost: the costly ones are drawn less often."""
        self._schemas, self.methods, self.rng = schemas, methods, rng
        self._valid, self._names = valid, names
        self._order = [m for m in methods for _ in range(max(1, 200 // COSTLY.get(m, 1)))]
        self.tried: Counter[str] = Counter()
        self.held = False

    def message(self, pack: bool) -> Said:
        """A message; in MessagePack (`pack`) with nothing that it cannot hold."""
        while True:
            said = self._message()
            if not pack:
                return said
            with contextlib.suppress(OverflowError, ValueError):
                _packed(said.document)
                return said

    def _message(self) -> Said:
        """Draw one message: a method with right parameters, of which most often something
        is changed.

        Returns:
            The message, the places changed, and whether the schema allows it.
        """
        rng = self.rng
        method = rng.choice(self._order)
        while self.held and method in HELD:
            method = rng.choice(self._order)
        params = self.valid(method)
        document = {"method": method, "params": params}
        schema = self.methods[method]
        fields = list(schema["properties"])
        sound = self._schemas.allows(schema, params)
        if rng.random() < 0.25 or not sound:  # what is wrong is no change of below
            return Said(document, (), sound)
        paths: list[Path] = []
        for _ in range(2 if rng.random() < 0.1 else 1):
            if not fields or rng.random() < 0.04:
                path = (rng.choice(["x", "", "id", "a" * 300, "\x00", "__class__"]),)
                params[path[0]] = rng.choice([1, "x", None, {}])
            else:
                path = self._change(method, schema, params, rng.choice(fields))
            self.tried[
                f"{method} {'.'.join(str(p) for p in path if isinstance(p, str))[:60]}"
            ] += 1
            paths.append(path)
        return Said(document, tuple(paths), self._schemas.allows(schema, params))

    def _change(
        self, method: str, schema: Schema, params: dict[str, Any], name: str
    ) -> Path:
        """Make one value below the field `name` absurd, remove it, or add a field to it.

        The field is drawn first if it is not there.

        Args:
            method: by name.
            schema: of its parameters.
            params: changed.
            name: of the field.

        Returns:
            The place changed.
        """
        rng = self.rng
        if name not in params:
            params[name] = self._one(name, schema["properties"][name])
        holder: Any = params
        key: str | int = name
        here: Schema = schema["properties"][name]
        path: list[str | int] = [name]
        while rng.random() < 0.75:
            inner = list(self._schemas.inner(here, holder[key]))
            if not inner:
                break
            holder = holder[key]
            key, here = rng.choice(inner)
            path.append(key)
        chance = rng.random()
        if chance < 0.05:
            del holder[key]
        elif chance < 0.1 and isinstance(holder[key], dict):
            holder[key][rng.choice(["x", "", "a" * 300])] = rng.choice([1, "x", None])
        else:
            holder[key] = self._schemas.absurd(rng, here)
        return tuple(path)

    def valid(self, method: str) -> dict[str, Any]:
        """Draw parameters that are in order; optional fields are left out more often than
        not.
        """
        made = self._valid.get(method)
        if made:
            return copy.deepcopy(
                self.rng.choice(made)()
            )  # parts of it are changed afterwards
        schema = self.methods[method]
        need = schema.get("required", ())
        return {
            name: self._one(name, one)
            for name, one in schema["properties"].items()
            if name in need or self.rng.random() < 0.4
        }

    def _one(self, name: str, schema: Schema) -> Any:
        """A value of a field: a known name if the schema allows it, else drawn from the
        schema.
        """
        if name in self._names and self._schemas.allows(
            schema, value := self._names[name]()
        ):
            return value
        return self._schemas.draw(self.rng, schema)


def fault(said: Said, answer: dict[str, Any]) -> str | None:
    """What is wrong with an answer, if anything.

    A message that the schema forbids has to be refused with -32602 and the place named;
    one that it allows may be refused otherwise, but not with an internal error.

    Returns:
        None if nothing is.
    """
    error = answer.get("error")
    if error is None:
        return None if said.allowed else "accepted what its schema does not allow"
    if error["code"] == INTERNAL:
        return "internal error"
    if not error.get("message"):
        return "refused without a word"
    if said.allowed or not said.paths or error["code"] in (-32700, -32600, -32008):
        return None
    if error["code"] != -32602:
        return f"{error['code']} for what the schema does not allow"
    problems = (error.get("data") or {}).get("problems") or [{}]
    named = any(
        _names(p.get("path", ""), said.paths) and p.get("message") for p in problems
    )
    return None if named else "refused without its field"


def _names(told: str, paths: tuple[Path, ...]) -> bool:
    return told == "params" or any(told.startswith(str(path[0])[:80]) for path in paths)


def _readable(value: Any, depth: int) -> bool:
    """Whether JSON can carry a value, and both ends read it: finite, without lone
    surrogates, not deep.
    """
    match value:
        case float():
            return math.isfinite(value)
        case str():
            return not re.search("[\ud800-\udfff]", value)
        case dict():
            return depth < 150 and all(
                _readable(k, 0) and _readable(v, depth + 1) for k, v in value.items()
            )
        case list():
            return depth < 150 and all(_readable(v, depth + 1) for v in value)
    return True


def _packed(document: Any) -> bytes:
    body = msgpack.packb(document, unicode_errors="surrogatepass")
    return struct.pack(">I", len(body)) + body


def _line(document: Any) -> bytes:
    """A document as a line of JSON, bytes as base64."""
    return (
        json.dumps(document, default=lambda b: base64.b64encode(b).decode()).encode()
        + b"\n"
    )


class Sender:
    """Sends batches over new connections to the twin or the projector, and judges the
    answers."""

    def __init__(
        self, server: str, port: int, maker: Maker, found: Found, *, frames: bool
    ) -> None:
        """Begin without answers.

        Args:
            server: by name.
            port: its port.
            maker: of messages.
            found: takes problems.
            frames: MessagePack frames; otherwise JSON lines.
        """
        self.server, self.port, self.maker, self.found = server, port, maker, found
        self.frames, self.tally = frames, Counter[str]()
        self.stuck: Callable[[], None] = lambda: None
        self.first: list[dict[str, Any]] = []
        self.last = "session.hello" if server == "projector" else "state.get"

    def batch(self, count: int) -> list[Said]:
        """Messages, among them some that ask whether all is well."""
        out: list[Said] = [Said(dict(d)) for d in self.first]
        check: dict[str, Any] = (
            {"method": "health", "params": {}} if self.server == "projector"
            else {"method": "state.get", "params": {}}
        )  # fmt: skip
        for i in range(count):
            said = self.maker.message(self.frames)
            out.append(self._broken(said) if self.maker.rng.random() < BROKEN else said)
            if i % 10 == 9:
                out.append(Said(dict(check)))
        return [*out, Said(dict(check))]

    def _broken(self, said: Said) -> Said:
        """The same with other bytes, in a frame (or line) of its own."""
        rng = self.maker.rng
        # Of the id's bytes any that are left over are text or a truth value: "broken" less its
        # head and first letters is n, which MessagePack reads as the id 110 of another message.
        document = {"jsonrpc": "2.0", "id": "\u00e9\u00e9", **said.document}
        raw = bytearray(_packed(document)[4:] if self.frames else _line(document))
        for _ in range(rng.randint(1, 4)):
            at = rng.randrange(len(raw))
            match rng.randrange(3):
                case 0:
                    raw[at] = rng.randrange(256)
                case 1:
                    del raw[at : at + rng.randint(1, 20)]
                    raw += b" " * (not raw)
                case 2:
                    raw[at:at] = rng.randbytes(rng.randint(1, 8))
        made = bytes(raw)
        sent = (
            struct.pack(">I", len(made)) + made
            if self.frames
            else made.replace(b"\n", b" ") + b"\n"
        )
        return Said(said.document, broken=sent)

    def send(self, batch: list[Said]) -> None:
        """Send a batch over a new connection, and read until each message is answered.

        What stays unanswered is kept as a problem. `stuck` is called where nothing comes
        for QUIET_S.
        """
        encode = _packed if self.frames else _line
        parts, waiting = [], {}
        for i, said in enumerate(batch):
            parts.append(
                said.broken or encode({"jsonrpc": "2.0", "id": i, **said.document})
            )
            if not said.unreadable:
                waiting[i] = said
        last = len(batch) - 1
        data = b"".join(parts)
        try:
            with socket.create_connection(("127.0.0.1", self.port), timeout=QUIET_S) as s:
                sending = threading.Thread(target=_send, args=(s, data), daemon=True)
                sending.start()
                buffer, answered, helped = bytearray(), time.monotonic(), time.monotonic()
                while waiting:
                    # Events of a subscription do not count: they come while others are waited
                    # for.
                    if time.monotonic() - answered > HANGS_S:
                        raise TimeoutError
                    if time.monotonic() - max(answered, helped) > QUIET_S:
                        self.stuck()
                        helped = time.monotonic()
                    with contextlib.suppress(TimeoutError):
                        part = s.recv(1 << 18)
                        if not part:
                            raise ConnectionError("the server has closed the connection")
                        buffer += part
                    for answer in _answers(buffer, self.frames):
                        if "method" not in answer:
                            answered = time.monotonic()
                            self._take(answer, batch, waiting, last)
                sending.join(10)
        except (OSError, TimeoutError) as error:
            left = [batch[i].document for i in waiting]
            self.found.add(
                self.server, f"no answer: {error!r}", left or [b.document for b in batch]
            )

    def _take(
        self,
        answer: dict[str, Any],
        batch: list[Said],
        waiting: dict[int, Said],
        last: int,
    ) -> None:
        """Count and judge an answer, and take its message off those that wait.

        An answer without a message of this batch counts only as an internal error.

        Args:
            answer: the whole one.
            batch: messages by their number.
            waiting: those not answered yet; changed.
            last: number of the question how the server is.
        """
        self.tally[str(answer["error"]["code"]) if "error" in answer else "ok"] += 1
        id = answer.get("id")
        if not isinstance(id, int) or isinstance(id, bool) or not 0 <= id < len(batch):
            if answer.get("error", {}).get("code") == INTERNAL:
                self.found.add(
                    self.server, "internal error", [b.document for b in batch], answer
                )
            return
        waiting.pop(id, None)
        wrong = fault(batch[id], answer)
        if wrong is None and id == last and "error" in answer:
            wrong = "it does not say how it is any more"
        if wrong is not None:
            kept = [batch[id].document] if id < last else [b.document for b in batch]
            self.found.add(self.server, wrong, kept, answer.get("error"))


def _send(s: socket.socket, data: bytes) -> None:
    """Send all bytes, whatever time it takes; a connection that is closed ends it without
    an error.
    """
    view = memoryview(data)
    while view:
        with contextlib.suppress(TimeoutError):
            try:
                view = view[s.send(view[: 1 << 18]) :]
            except OSError as error:
                if isinstance(error, TimeoutError):
                    raise
                return


def _answers(buffer: bytearray, frames: bool) -> Iterator[dict[str, Any]]:
    """Take whole answers out of the buffer; what is left waits for more bytes.

    Args:
        buffer: what has come; changed.
        frames: MessagePack frames; otherwise JSON lines, of which events are left out.
    """
    while True:
        if frames:
            size = (
                struct.unpack_from(">I", buffer)[0] if len(buffer) >= 4 else len(buffer)
            )
            if len(buffer) < 4 + size:
                return
            body = bytes(buffer[4 : 4 + size])
            del buffer[: 4 + size]
            yield msgpack.unpackb(body, strict_map_key=False)
        else:
            end = buffer.find(b"\n")
            if end < 0:
                return
            line = bytes(buffer[:end])
            del buffer[: end + 1]
            if not line.startswith(b'{"jsonrpc":"2.0","method":"event"'):
                yield json.loads(line)


class Pages:
    """A page of the viewer: requests over a WebSocket."""

    def __init__(self, port: int, maker: Maker, found: Found) -> None:
        """Begin without answers, for a viewer at a port."""
        self.port, self.maker, self.found = port, maker, found
        self.tally: Counter[str] = Counter()
        self.stuck: Callable[[], None] = lambda: None
        self.count = 0

    def batch(self, count: int) -> list[Said]:
        """Requests of a page; what no JSON holds (bytes) left out."""
        return [self.maker.message(False) for _ in range(count)]

    def send(self, batch: list[Said]) -> None:
        """Send them a few at a time, read until each is answered."""
        from websockets.sync.client import connect

        self.count += 1
        url = f"ws://127.0.0.1:{self.port}/ws/{self.count:012x}"
        waiting: dict[int, Said] = {}
        try:
            with connect(url, max_size=None, proxy=None, open_timeout=HANGS_S) as page:
                while '"session", "connected": true' not in str(page.recv(HANGS_S))[:60]:
                    pass
                left = list(enumerate(batch))[::-1]
                while left or waiting:
                    while left and len(waiting) < 50:
                        i, said = left.pop()
                        waiting[i] = said
                        page.send(json.dumps({"id": i, **said.document}))
                    self._hear(page, batch, waiting)
        except Exception as error:  # whatever a connection ends with
            documents = [s.document for s in waiting.values()]
            self.found.add("viewer", f"no answer: {error!r}", documents)

    def _hear(self, page: Any, batch: list[Said], waiting: dict[int, Said]) -> None:
        """Take one message of the page's, and judge it if it is an answer.

        Raises:
            TimeoutError: there is none for HANGS_S.
        """
        begun = time.monotonic()
        while True:
            try:
                text = page.recv(QUIET_S)
                break
            except TimeoutError:
                if time.monotonic() - begun > HANGS_S:
                    raise
                self.stuck()
        if not isinstance(text, str) or '"type": "answer"' not in text[:40]:
            if time.monotonic() - begun > HANGS_S:
                raise TimeoutError
            return
        answer = json.loads(text)
        said = waiting.pop(answer["id"], None)
        if said is None:
            return
        self.tally[str(answer["error"]["code"]) if "error" in answer else "ok"] += 1
        wrong = fault(said, answer)
        if wrong is not None:
            self.found.add("viewer", wrong, [said.document], answer.get("error"))


class Events:
    """A program at the gateway's sockets."""

    def __init__(self, ready: dict[str, Any], found: Found, rng: random.Random) -> None:
        """Connect to the gateway and wait until it answers.

        Raises:
            RuntimeError: it does not for 30 s.
        """
        import zmq

        from flexdt.clients.gateway.vocabulary import known_commands

        self.found, self.rng, self.tally = found, rng, Counter[str]()
        self.stuck: Callable[[], None] = lambda: None
        self.asked = 0
        context = zmq.Context.instance()
        self._out, self._in = context.socket(zmq.PUB), context.socket(zmq.SUB)
        for one in (self._out, self._in):
            one.setsockopt(zmq.LINGER, 0)
            one.set_hwm(0)
        self._in.subscribe(b"")
        self._out.connect(f"tcp://127.0.0.1:{ready['inbound']}")
        self._in.connect(f"tcp://127.0.0.1:{ready['port']}")
        parts = ("tube", "camera", "scanner", "mag_obj", "rot_obj", "ver_obj")
        self._known = [
            (part, command) for part in parts for command in known_commands(part)
        ]
        self._known = [k for k in self._known if "take" not in k[1]] * 20 + self._known
        deadline = time.monotonic() + 30
        while not self._ask_state(0.5):  # connections of ZeroMQ come about by themselves
            if time.monotonic() > deadline:
                raise RuntimeError("the gateway does not answer")

    def _ask_state(self, patience_s: float) -> bool:
        """Whether it answers a question."""
        self.asked += 1
        number = 10**9 + self.asked
        self._out.send(
            json.dumps(event("tube", "status_XReady_get", UUID=number)).encode()
        )
        until = time.monotonic() + patience_s
        while (left := until - time.monotonic()) > 0 and self._in.poll(1000 * left):
            told = json.loads(self._in.recv())
            if "internal error" in str(told.get("reply")):
                self.found.add("gateway", "internal error", [told])
            if told.get("UUID") == number and told.get("reply type") in ("ACK", "ERR"):
                return True
        return False

    def batch(self, count: int) -> list[Said]:
        """Events, most with one odd field."""
        out = []
        for _ in range(count):
            part, command = self.rng.choice(self._known)
            args = {
                "arg1": self.rng.choice(
                    ["", "1", "500", "FALSE", "20.0", "900 700 1027 827"]
                )
            }
            made: dict[str, Any] = event(
                part, command, UUID=self.rng.randrange(1, 2**40), **args
            )
            if self.rng.random() < 0.85:
                name = self.rng.choice(
                    [*made, "arg1", "arg1", "arg2", "component", "extra"]
                )
                odd = self.rng.choice(
                    [*NUMBERS, *TEXTS, *map(str, NUMBERS), None, [], {}, True]
                )
                made[name] = "x" * 10**6 if self.rng.random() < 0.001 else odd
                if self.rng.random() < 0.03:
                    del made[name]
            out.append(Said(made))
        return out

    def send(self, batch: list[Said]) -> None:
        """Send them, then ask how it is; what a command ends with is looked at on the way."""
        for i, said in enumerate(batch):
            self._out.send(json.dumps(said.document).encode())
            self.tally["sent"] += 1
            if i % 20 == 19 and not self._answers_at_last():
                documents = [s.document for s in batch[: i + 1]]
                self.found.add("gateway", "no answer", documents)
                return

    def _answers_at_last(self) -> bool:
        """Whether the gateway answers within HANGS_S; `stuck` is called each time that it
        does not.
        """
        for _ in range(int(HANGS_S / QUIET_S)):
            if self._ask_state(QUIET_S):
                return True
            self.stuck()
        return False


def event(component: str, command: str, **more: Any) -> dict[str, Any]:
    """One event of the scanner software's interface."""
    return {"component": component, "comp_phys": "", "command": command, "arg1": "", "arg2": "",
            "reply": "", "reply type": "", "comp_type": "other", "tick count": 1, "UUID": 1,
            **more}  # fmt: skip


class Lab:
    """Four servers and what is known of them.

    Args:
        folder: for data and logs.
        seed: of everything random.
        which: servers to attack; all of them run.
    """

    def __init__(self, folder: File, seed: str, which: list[str]) -> None:
        """Start the servers and make what attacks them; a failure ends those that have
        started.
        """
        self.found, self.rng = Found(), random.Random(seed)
        self.servers: dict[str, Process] = {}
        self.held = False
        self._lock = threading.Lock()
        try:
            rays = self.servers["projector"] = projector(log=folder / "projector.log")
            self.servers["twin"] = twin(
                rays.port, folder / "data", "--sample", "empty", "--speed-up", "max",
                log=folder / "twin.log",
            )  # fmt: skip
            at = f"127.0.0.1:{self.servers['twin'].port}"
            if "viewer" in which:
                self.servers["viewer"] = Process(
                    "flexdt.clients.viewer.main", "--port", 0, "--twin", at, "--data",
                    folder / "data", log=folder / "viewer.log",
                )  # fmt: skip
            if "gateway" in which:
                self.servers["gateway"] = Process(
                    "flexdt.clients.gateway.main", "--port", 0, "--server", at, "--data",
                    folder / "gateway", log=folder / "gateway.log",
                )  # fmt: skip
            self.pids = {name: server.pid for name, server in self.servers.items()}
            self.watch = Wire(self.servers["twin"].port, timeout_s=HANGS_S)
            self.senders = self._senders(which)
        except BaseException:
            self.close()
            raise

    def _senders(self, which: list[str]) -> list[Any]:
        """Make the attackers of the servers named in `which`, from what the twin says of
        its methods.
        """
        port = self.servers["twin"].port
        document = self.watch.call("rpc.discover")
        scene = self.watch.call("scene.save")["document"]
        out: list[Any] = []
        if "twin" in which:
            for i, frames in enumerate((False, False, True)):
                maker = twin_maker(
                    document, scene, random.Random(f"{self.rng.random()}{i}")
                )
                out.append(Sender("twin", port, maker, self.found, frames=frames))
        if "projector" in which:
            maker = projector_maker(self.servers["projector"].port, self.rng)
            rays = self.servers["projector"].port
            out.append(Sender("projector", rays, maker, self.found, frames=True))
        if "viewer" in which:
            maker = page_maker(document, scene, random.Random(self.rng.random()))
            out.append(Pages(self.servers["viewer"].port, maker, self.found))
        if "gateway" in which:
            rng = random.Random(self.rng.random())
            out.append(Events(self.servers["gateway"].ready, self.found, rng))
        for sender in out:
            sender.stuck = self.unstick
        return out

    def unstick(self) -> None:
        """End what may last: a slow clock, jobs, motion."""
        with self._lock, contextlib.suppress(Refused):
            try:
                self._end_all()
            except OSError as error:
                self.found.add("twin", f"another client waits in vain: {error!r}", [])
                self.watch = Wire(self.servers["twin"].port, timeout_s=HANGS_S)

    def _end_all(self) -> None:
        """Take control, end all jobs and motion, and release it again unless it is held."""
        call = self.watch.call
        call("session.control", action="force")
        call("clock.set", speed_up="max")
        for job in call("job.list")["jobs"]:
            if job["state"] in ("queued", "running", "paused"):
                self.watch.ask("job.abort", job=job["job"])
        call("axes.stop")
        call("safety.reset")
        if not self.held:
            call("session.control", action="release")

    def enter(self, state: str) -> None:
        """Bring the twin into a state in which messages may matter more."""
        call = self.watch.call
        self.held = state == "held"
        for sender in self.senders:
            if hasattr(sender, "maker"):
                sender.maker.held = self.held
        self.unstick()
        call("session.control", action="force")
        with contextlib.suppress(Refused):
            call(
                "camera.set",
                roi=ROI,
                exposure_ms=100.0,
                mode="HW2SW1High",
                averages=1,
                frames=1,
            )
            call("sample.set", name="empty")
            call("axes.move", targets={"mag_obj": 650.0, "mag_det": 1059.0}, wait=True)
            call("calibration.apply", parameters={}, name="nominal")
        with contextlib.suppress(Refused):
            match state:
                case "sample":
                    call("sample.set", name="lego")
                case "upload":
                    call("sample.upload", name="m", format="stl", data=STL,
                         total=len(base64.b64decode(STL)))  # fmt: skip
                    call("sample.set", file="m", offset={"x": 1.0})
                case "estop":
                    call("safety.estop")
                case "corrected":
                    call("calibration.apply", parameters={"dO_x": 0.5}, name="half")
                case "running" | "paused":
                    call("clock.set", speed_up=0.01)
                    job = call("script.submit", text=fly_script(13))["job"]
                    self.watch.wait(job, "running", timeout_s=10)
                    if state == "paused":
                        call("job.pause", job=job)
        if self.held:  # a stop from anyone would cut a braking way short: all rests first
            while any(axis["moving"] for axis in call("state.get")["axes"].values()):
                time.sleep(0.01)
            self._before = self._bound()
        else:
            call("session.control", action="release")

    def leave(self, batches: list[list[Said]]) -> None:
        """After a round: where another client held the scanner, nothing has moved."""
        if self.held and (after := self._bound()) != self._before:
            sent = [s.document for batch in batches for s in batch]
            self.found.add("twin", "a refused request has moved something", sent,
                           [self._before, after])  # fmt: skip

    def _bound(self) -> dict[str, float]:
        axes = self.watch.call("state.get")["axes"]
        return {name: axis["target"] for name, axis in axes.items()}

    def check(self) -> None:
        """Processes and logs."""
        for name, server in self.servers.items():
            if not server.alive():
                self.found.add(
                    name, "the process has ended", [], server.log.read_text()[-1500:]
                )
            for entry in server.logged("error", "critical", "unstructured")[:5]:
                self.found.add(name, "logged", [], entry)

    def memory(self) -> dict[str, float]:
        """Resident memory of each server [MB]."""
        return {n: s.memory_mb() for n, s in self.servers.items() if s.alive()}

    def close(self) -> None:
        for server in reversed(list(self.servers.values())):
            server.end()


ODD_CELLS = [
    "mag_obj", "rot_obj", "camera", "tube", "scanner", "move absolute", "set speed", "set exposure",
    "set ROI", "take image", "save image", "take and save image sequence", "xrayon", "set power",
    "set number of frames", "write settings file", "ACK", "POS", "no wait", "0", "-1", "1e9", "nan",
    "inf", "360", "0 0 1943 1535", "scan_", "..\\x", "E:\\a\\b_", "\t", "\r\n", "#", "//", "\x00",
    "é", " " * 50, "1e300", "1e-300", "99999",
]  # fmt: skip


def scripted(rng: random.Random, texts: list[str]) -> str:
    """Some lines of a script, with up to six changes: strange, missing, mixed cells,
    repeated lines.

    Args:
        rng: draws all.
        texts: scripts.
    """
    lines = rng.choice(texts).splitlines()
    first = rng.randrange(len(lines))
    lines = lines[first : first + rng.randint(1, 25)]
    for _ in range(rng.randint(0, 6)):
        at = rng.randrange(len(lines))
        cells = lines[at].split("\t")
        match rng.randrange(5):
            case 0:
                cells[rng.randrange(len(cells))] = rng.choice(ODD_CELLS)
            case 1:
                cells.insert(rng.randrange(len(cells) + 1), rng.choice(ODD_CELLS))
            case 2:
                del cells[rng.randrange(len(cells)) :]
            case 3:
                rng.shuffle(cells)
            case 4:
                lines.insert(at, rng.choice(lines))
                continue
        lines[at] = "\t".join(cells)
    return "\r\n".join(lines)


def methods_of(document: dict[str, Any]) -> dict[str, Schema]:
    """Methods of an OpenRPC document, each as the schema of its parameters."""
    return {
        m["name"]: {
            "type": "object",
            "properties": {p["name"]: p["schema"] for p in m["params"]},
            "required": [p["name"] for p in m["params"] if p["required"]],
            "additionalProperties": False,
        }
        for m in document["methods"]
    }


def twin_maker(
    document: dict[str, Any], scene: dict[str, Any], rng: random.Random
) -> Maker:
    """Make what draws messages to the twin.

    Args:
        document: the twin's OpenRPC document.
        scene: a saved one, for axes and positions.
        rng: draws all.
    """
    axes = list(scene["positions"])
    small = base64.b64encode(np.ones(8, "<f4").tobytes()).decode()

    def targets() -> dict[str, float]:
        """Draw targets of one or two axes within 20 mm or deg of where they stand in the
        scene.
        """
        chosen = rng.sample(axes, rng.choice([1, 1, 2]))
        return {
            axis: round(scene["positions"][axis] + rng.uniform(-20, 20), 3)
            for axis in chosen
        }

    def mesh() -> dict[str, Any]:
        """Parameters that upload a small STL under one of three names."""
        size = len(base64.b64decode(STL))
        return {
            "name": rng.choice("mno"),
            "format": "stl",
            "total": size,
            "start": 0,
            "data": STL,
        }

    def voxels() -> dict[str, Any]:
        return {"name": rng.choice("vw"), "kind": "voxels", "format": "raw", "total": 32,
                "data": small, "shape": [2, 2, 2], "voxel_mm": [1.0, 1.0, 1.0]}  # fmt: skip

    def begun() -> dict[str, Any]:
        return {**mesh(), "name": f"open{rng.randrange(20)}", "total": 10**6}

    folder = File(__file__).parents[2] / "examples" / "scripts"
    texts = [
        f.read_text(encoding="utf-8", errors="replace")[:3000]
        for f in folder.glob("*.txt")
    ]
    texts.append(fly_script(13))
    job = lambda: f"job-{rng.randrange(1, 30)}"  # noqa: E731
    valid: dict[str, list[Callable[[], dict[str, Any]]]] = {
        "session.hello": [lambda: {"protocol": "1.0", "client": "fuzz"}],
        "sample.set": [lambda: {"name": rng.choice(["lego", "empty", "normal-1"])},
                       lambda: {"name": "empty"},
                       lambda: {"file": rng.choice("mnv"), "offset": {"x": 1.0, "rz": 3.0}}],
        "sample.upload": [mesh, voxels, begun],
        "script.check": [lambda: {"text": scripted(rng, texts)}, lambda: {"text": SCRIPT},
                         lambda: {"data_base64": base64.b64encode(SCRIPT.encode()).decode()}],
        "script.submit": [lambda: {"text": SCRIPT}, lambda: {"text": fly_script(3)}],
        "trajectory.check": [lambda: {"poses": [targets(), targets()], "exposure_ms": 50.0}],
        "trajectory.submit": [lambda: {"poses": [targets()], "exposure_ms": 50.0}],
        "projection.get": [lambda: {"kind": rng.choice(["line_integral", "counts"]),
                                    "binning": 8}],
        "scene.load": [lambda: {"document": json.loads(json.dumps(scene))}],
        "calibration.apply": [lambda: {"parameters": {"dO_x": 0.1, "alpha": 0.2},
                                       "name": f"c{rng.randrange(20)}"}],
        "clock.set": [lambda: {"speed_up": rng.choice(["max", 100.0, 1e6])}],
        "axes.move": [lambda: {"targets": targets()}, lambda: {"targets": targets()},
                      lambda: {"targets": {"rot_obj": 5.0}, "relative": True, "wait": True},
                      lambda: {"targets": targets(), "shortest": True}],
        "session.control": [lambda: {"action": "acquire"}, lambda: {"action": "force"}],
    }  # fmt: skip
    names: dict[str, Callable[[], Any]] = {
        "axis": lambda: rng.choice(axes), "targets": targets, "job": job,
        "velocity": lambda: rng.uniform(-10, 10), "lease_s": lambda: 0.1,
        "speed": lambda: rng.uniform(1, 40), "acceleration": lambda: rng.uniform(1, 20),
        "kV": lambda: rng.uniform(20, 90), "power_W": lambda: rng.uniform(1, 50),
        "exposure_ms": lambda: rng.uniform(10, 200), "mode": lambda: "HW2SW1High",
        "roi": lambda: list(ROI), "max_rate_hz": lambda: 1.0, "speed_up": lambda: "max",
        "poses": lambda: [targets()], "material": lambda: "abs", "voxel_mm": lambda: [1.0] * 3,
        "shape": lambda: [2, 2, 2], "token": lambda: "x", "seed": lambda: rng.randrange(99),
        "text": lambda: SCRIPT, "data": lambda: small, "name": lambda: f"n{rng.randrange(50)}",
        "offset": lambda: {"x": 1.0, "y": 0.0, "z": -1.0, "rx": 0.0, "ry": 0.0, "rz": 5.0},
        "document": lambda: json.loads(json.dumps(scene)), "count": lambda: 1000,
        "start": lambda: 0, "frames": lambda: 3, "averages": lambda: 1,
    }  # fmt: skip
    schemas = Schemas(document["components"]["schemas"])
    return Maker(schemas, methods_of(document), valid, names, rng)


def projector_maker(port: int, rng: random.Random) -> Maker:
    """Make what draws messages to a projector; it is asked for its methods."""
    body = _packed({"jsonrpc": "2.0", "id": 1, "method": "rpc.discover"})
    with socket.create_connection(("127.0.0.1", port), timeout=HANGS_S) as s:
        s.sendall(body)
        (size,) = struct.unpack(">I", s.recv(4, socket.MSG_WAITALL))
        document = msgpack.unpackb(s.recv(size, socket.MSG_WAITALL))["result"]
    row = [0.0, -600.0, 0.0, 0.0, 400.0, 0.0, 0.15, 0.0, 0.0, 0.0, 0.0, -0.15]
    ball = {"kind": "sphere", "center": [0.0, 0.0, 0.0], "radius": 3.0}

    def image(*shape: int) -> dict[str, Any]:
        return {"dtype": "float32", "shape": list(shape),
                "data": np.ones(shape, "<f4").tobytes()}  # fmt: skip

    def grid() -> dict[str, Any]:
        """Parameters of a grid that is in order."""
        return {
            "shape": [4, 4, 4],
            "voxel_mm": [1.0, 1.0, 1.0],
            "center_mm": [0.0, 0.0, 0.0],
        }

    def name() -> str:
        return rng.choice(["a", "b", "s"])

    def scene() -> dict[str, Any]:
        return {"solids": [{"shape": dict(ball), "material": "abs", "mu_per_mm": 0.02}]}

    valid: dict[str, list[Callable[[], dict[str, Any]]]] = {
        "session.hello": [lambda: {"protocol": "1.0", "client": "fuzz"}],
        "volume.put": [lambda: {"name": name(), "grid": grid(), "data": b"\0\0\0\0" * 64},
                       lambda: {"name": name(), "grid": grid(), "data": b"\0\0\0\0" * 8},
                       lambda: {"name": "s", "scene": scene()}],
        "project": [lambda: {"volume": name(), "cone_vec": [list(row), list(row)],
                             "detector": [8, 8], "key": "k"},
                    lambda: {"volume": name(), "detector": [8, 8],
                             "cone_vec": {"dtype": "float64", "shape": [1, 12],
                                          "data": np.array(row).tobytes()}}],
        "rays": [lambda: {"volume": name(), "cone_vec": [list(row)], "detector": [8, 8],
                          "error": 0.01}],
        "backproject": [lambda: {"cone_vec": [list(row)], "grid": grid(),
                                 "projections": image(1, 8, 8)},
                        lambda: {"cone_vec": [list(row)], "grid": grid(), "into": "b",
                                 "projections": image(1, 8, 8)}],
        "cancel": [lambda: {"request": rng.randrange(300)}],
    }  # fmt: skip
    schemas = Schemas(document["components"]["schemas"])
    methods = methods_of(document)
    return Maker(schemas, methods, valid, {"name": name}, rng)


def page_maker(
    document: dict[str, Any], scene: dict[str, Any], rng: random.Random
) -> Maker:
    """Make what draws requests of pages: the viewer's own methods, and the twin's that
    pages may use.

    Args:
        document: the twin's OpenRPC document.
        scene: a saved one.
        rng: draws all.
    """
    from pydantic.json_schema import models_json_schema

    from flexdt.clients.viewer.page import HIDDEN
    from flexdt.clients.viewer.page_methods import METHODS

    models = {name: model for name, (model, _) in METHODS.items()}
    refs, defined = models_json_schema(
        [(m, "validation") for m in dict.fromkeys(models.values())]
    )
    definitions = {**document["components"]["schemas"], **defined["$defs"]}
    schemas = Schemas(definitions)
    own = {
        name: {
            "properties": {},
            "type": "object",
            **schemas.plain(refs[model, "validation"]),
        }
        for name, model in models.items()
    }
    base = twin_maker(document, scene, rng)
    methods = {k: v for k, v in base.methods.items() if k not in HIDDEN} | own
    names = {**base._names, "dataset": lambda: "261120_001", "datasets": lambda: ["261120_001"],
             "phantom": lambda: "lego", "time_s": lambda: 1.0}  # fmt: skip
    valid: dict[str, list[Callable[[], dict[str, Any]]]] = {
        **base._valid,
        "viewer.scrub": [lambda: {"time_s": 1.0}],
        "viewer.window": [lambda: {"low": 0.0, "high": 1.0}],
        "viewer.plan": [lambda: {"text": SCRIPT}, lambda: {"text": fly_script(3)}],
        "viewer.compose": [lambda: {"kind": "fly", "frames": 10, "exposure_ms": 100.0}],
    }
    return Maker(schemas, methods, valid, names, rng)


def fuzz(count: int, seed: str, which: list[str], out: File, most: int) -> int:
    """Send messages to all servers until there are so many, or too many problems.

    Args:
        count: of messages.
        seed: of all that is drawn.
        which: servers.
        out: file for the problems.
        most: kinds of problems after which to end.

    Returns:
        How many kinds of problems there were.
    """
    begun, done, next_look = time.monotonic(), 0, 0
    series: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        lab = Lab(File(folder), seed, which)
        try:
            clients = [
                s for s in lab.senders if isinstance(s, Sender) and s.server == "twin"
            ]
            with ThreadPoolExecutor(len(lab.senders)) as pool:
                for number in itertools.count():
                    if done >= count or len(lab.found.kept) >= most:
                        break
                    lab.enter(STATES[lab.rng.randrange(len(STATES))])
                    # One client commands, the others are refused what only the controller may.
                    for i, client in enumerate(clients):
                        chosen = i == number % len(clients) and not lab.held
                        client.first = TAKING if chosen else []
                    size = min(BATCH, max(1, (count - done) // len(lab.senders)))
                    batches = [s.batch(size) for s in lab.senders]
                    sent = [
                        pool.submit(s.send, b)
                        for s, b in zip(lab.senders, batches, strict=True)
                    ]
                    for one in sent:
                        one.result()
                    lab.leave(batches)
                    done += size * len(sent)
                    if done >= next_look:
                        next_look = done + 1000
                        lab.check()
                        for name, mb in lab.memory().items():
                            series.setdefault(name, []).append(mb)
                        if not all(s.alive() for s in lab.servers.values()):
                            break
                    if number % 20 == 0:
                        rate = done / (time.monotonic() - begun)
                        told = ", ".join(f"{n} {v[-1]:.0f} MB" for n, v in series.items())
                        print(f"{done} messages, {rate:.0f}/s, {told}", flush=True)
            lab.check()
            for name, pid in lab.pids.items():
                if lab.servers[name].alive() and lab.servers[name].pid != pid:
                    lab.found.add(name, "another process", [])
        finally:
            lab.close()
    for name, values in series.items():
        beyond = over_plateau(values)
        if beyond is not None:
            lab.found.add(name, "memory", [], beyond)
    tally: dict[str, Counter[str]] = {}
    fields: set[str] = set()
    for sender in lab.senders:
        kind = getattr(sender, "server", type(sender).__name__.lower())
        tally.setdefault(kind, Counter()).update(sender.tally)
        if hasattr(sender, "maker"):
            fields |= {f"{kind} {field}" for field in sender.maker.tried}
    if lab.found.kept:
        out.write_text(
            "".join(json.dumps(f, default=repr) + "\n" for f in lab.found.kept.values())
        )
        print(f"what failed is in {out}; --replay {out} sends it again")
    for kind, codes in tally.items():
        print(
            f"{kind}: " + ", ".join(f"{code}: {n}" for code, n in sorted(codes.items()))
        )
    memory = ", ".join(f"{n} {min(v):.0f} to {max(v):.0f} MB" for n, v in series.items())
    print(
        f"{done} messages with {len(fields)} fields (seed {seed}) "
        f"in {time.monotonic() - begun:.0f} s; {memory}; "
        f"{len(lab.found.kept)} problems. {machine()}."
    )
    return len(lab.found.kept)


def over_plateau(values: list[float]) -> str | None:
    """What is beyond 10 % and 50 MB of the plateau, the median after the first fifth.

    Args:
        values: memory over time [MB].

    Returns:
        None if nothing is, or fewer than five values are left.
    """
    after = values[len(values) // 5 :]
    if len(after) < 5:
        return None
    plateau = median(after)
    beyond = [v for v in after if abs(v - plateau) > 0.1 * plateau + 50.0]
    return f"plateau {plateau:.0f} MB, {beyond[:5]}" if beyond else None


def replay(file: File) -> int:
    """Send the messages of a file one by one, and say what comes of each."""
    with tempfile.TemporaryDirectory() as folder:
        lab = Lab(File(folder), "0", ["twin", "projector", "viewer", "gateway"])
        twin_, *_, rays, pages, events = lab.senders
        by_name = {"gateway": events, "viewer": pages, "projector": rays, "twin": twin_}
        try:
            for line in file.read_text().splitlines():
                kept = json.loads(line)
                print(kept["problem"])
                for document in kept["messages"]:
                    before = len(lab.found.kept)
                    sender = by_name[kept["server"]]
                    sender.send([Said(document)])
                    lab.check()
                    if len(lab.found.kept) > before:
                        print("AGAIN:", str(document)[:1000])
        finally:
            lab.close()
    return len(lab.found.kept)


def main() -> int:
    """Fuzz or replay as the command line asks; 1 where a problem was found."""
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    p.add_argument("--count", type=int, default=20_000)
    p.add_argument("--seed", default="1")
    p.add_argument("--servers", default="twin,projector,viewer,gateway")
    p.add_argument(
        "--most", type=int, default=40, help="kinds of problems after which to end"
    )
    p.add_argument("--out", type=File, default=File("fuzz-failures.jsonl"))
    p.add_argument("--replay", type=File)
    options = p.parse_args()
    if options.replay:
        return 1 if replay(options.replay) else 0
    which = options.servers.split(",")
    return 1 if fuzz(options.count, options.seed, which, options.out, options.most) else 0


if __name__ == "__main__":
    sys.exit(main())
