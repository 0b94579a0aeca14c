"""Fuzzed messages and scripts.

    python tests/studies/fuzz.py messages --count 1000000
    python tests/studies/fuzz.py scripts --count 200000

`messages` sends mutated requests, in JSON and in MessagePack, over three real connections at a time
to a real twin and watches: it lives, every batch is answered to its end, and no line of its log is
an unhandled exception. In every other round another client holds the scanner, so that no request of
that round may change where a motor is bound, however sound it is. `scripts`
checks mutated scripts (parse, plan, limits) in this process: every outcome but a report is a
failure, and so is a script that takes longer than 20 s. Both are repeatable by --seed; exit code 1
after a failure.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import random
import signal
import socket
import struct
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack
from lab import Plain, Wire, fly_script, machine, projector, twin

BATCH = 250
CODECS = ("json", "json", "msgpack")
TAKING: list[dict[str, Any]] = [
    {"jsonrpc": "2.0", "id": "o", "method": "session.control", "params": {"action": "force"}},
    {"jsonrpc": "2.0", "id": "o", "method": "safety.reset"},
]
ACTIVE = ("queued", "running", "paused")
SEEDS: list[dict[str, Any]] = [
    {"method": "session.hello", "params": {"protocol": "1.0", "client": "fuzz"}},
    {"method": "session.control", "params": {"action": "acquire"}},
    {"method": "session.ping"},
    {"method": "state.get", "params": {}},
    {"method": "state.subscribe", "params": {"topics": ["state", "job"], "max_rate_hz": 5.0}},
    {"method": "state.unsubscribe", "params": {"topics": ["state"]}},
    {"method": "axes.move", "params": {"targets": {"mag_obj": 500.0, "rot_obj": 90.0}}},
    {"method": "axes.move", "params": {"targets": {"ver_obj": 1.0}, "relative": True}},
    {"method": "axes.jog", "params": {"axis": "tra_obj", "velocity": 1.0, "lease_s": 0.1}},
    {"method": "axes.set", "params": {"axis": "rot_obj", "speed": 20.0}},
    {"method": "axes.stop", "params": {}},
    {"method": "safety.estop", "params": {}},
    {"method": "safety.reset", "params": {}},
    {"method": "clock.set", "params": {"speed_up": 2.0}},
    {"method": "tube.set", "params": {"kV": 60.0, "power_W": 10.0, "on": False}},
    {"method": "camera.set", "params": {"exposure_ms": 50.0, "roi": [900, 700, 1027, 827]}},
    {"method": "sample.set", "params": {"name": "empty", "offset": {"x": 0.0, "rz": 3.0}}},
    {"method": "sample.upload", "params": {"name": "m", "format": "stl", "total": 84,
                                           "start": 0, "data": "AAAA"}},
    {"method": "projection.get", "params": {"kind": "counts", "binning": 32}},
    {"method": "geometry.get"},
    {"method": "script.check", "params": {"text": "mag_obj\tmove absolute\t500\t\tACK\t\t"}},
    {"method": "script.submit", "params": {"text": "camera\tset exposure\t100\t\tACK\t\t"}},
    {"method": "trajectory.check", "params": {"poses": [{"rot_obj": 1.0}], "exposure_ms": 50.0}},
    {"method": "job.status", "params": {"job": "job-1"}},
    {"method": "job.pause", "params": {}},
    {"method": "job.abort", "params": {"job": "job-1"}},
    {"method": "job.list", "params": {}},
    {"method": "calibration.get", "params": {}},
    {"method": "calibration.list", "params": {}},
    {"method": "scene.save", "params": {"name": "s"}},
    {"method": "scene.load", "params": {"document": {"schema": 1, "machine": "flexray"}}},
]  # fmt: skip

COSTLY = ("projection.get", "script.submit", "trajectory.check", "sample.set", "scene.save")
"""Methods that are asked less often, so that a million messages end within hours."""

ODD: list[Any] = [
    None, True, False, 0, -1, 1, 2**31, -(2**63), 2**64, 1e308, -1e308, 1e-320, 0.1, -0.0, "", "x",
    "\x00", "../..", "é" * 40, "\u2028", "9" * 400, [], {}, [[]], [None] * 50, {"": 1},
    {"a": {"b": {}}},
    "mag_obj", "rot_obj", ["state"], 1e999, "NaN", b"\x00\xff",
]  # fmt: skip


def mutated(rng: random.Random, value: Any, depth: int = 0) -> Any:
    """A value a little or a lot like `value`."""
    if rng.random() < 0.12 + 0.1 * depth:
        return rng.choice(ODD)
    if isinstance(value, dict):
        out = {k: mutated(rng, v, depth + 1) if rng.random() < 0.5 else v for k, v in value.items()}
        if rng.random() < 0.15 and out:
            out.pop(rng.choice(list(out)))
        if rng.random() < 0.1:
            out[rng.choice(["x", "", "jsonrpc", "id", "params", "a" * 200])] = rng.choice(ODD)
        return out
    if isinstance(value, list):
        out_list = [mutated(rng, v, depth + 1) if rng.random() < 0.5 else v for v in value]
        return out_list * rng.choice([0, 1, 1, 1, 1, 2, 30])
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return rng.choice([value, -value, value * 1e6, value / 1e9, int(value), str(value)])
    return value


def message(rng: random.Random, number: int) -> Any:
    """One document."""
    seed = rng.choice(SEEDS)
    if seed["method"] in COSTLY and rng.random() < 0.95:
        seed = rng.choice(SEEDS)
    document: Any = {"jsonrpc": "2.0", "id": number, **seed}
    if rng.random() < 0.6:
        if "params" in document:
            document["params"] = mutated(rng, document["params"])
    else:
        document = mutated(rng, document)
    return document


def as_json(rng: random.Random, document: Any) -> bytes:
    text = json.dumps(document, default=lambda b: b.decode("latin-1")).encode()
    if rng.random() < 0.15:
        raw = bytearray(text)
        for _ in range(rng.randint(1, 4)):
            at = rng.randrange(len(raw))
            action = rng.randrange(3)
            if action == 0:
                raw[at] = rng.randrange(256)
            elif action == 1:
                del raw[at : at + rng.randint(1, 20)]
            else:
                raw[at:at] = rng.randbytes(rng.randint(1, 8))
            if not raw:
                break
        text = bytes(raw)
    return text.replace(b"\n", b" ") + b"\n"


def as_frame(rng: random.Random, document: Any) -> bytes:
    try:
        body = msgpack.packb(document)
    except (OverflowError, ValueError):
        body = b"\xc1"
    if rng.random() < 0.15 and body:
        raw = bytearray(body)
        raw[rng.randrange(len(raw))] = rng.randrange(256)
        body = bytes(raw)
    return struct.pack(">I", len(body)) + body


@dataclass
class Round:
    """Batches that are sent at the same time; in a still one the watcher keeps control."""

    still: bool
    size: int
    batches: list[bytes]


class Sender:
    """Makes batches, sends them over one connection after another, and counts answers."""

    def __init__(self, port: int, codec: str, seed: str) -> None:
        self.port, self.frames, self.rng = port, codec == "msgpack", random.Random(seed)
        self.tally: Counter[str] = Counter()

    def _encoded(self, document: Any) -> bytes:
        if self.frames:
            body = msgpack.packb(document)
            return struct.pack(">I", len(body)) + body
        return json.dumps(document).encode() + b"\n"

    def make(self, count: int, *, still: bool) -> bytes:
        """Messages; unless it is to stay still, the batch begins by taking control."""
        broken = as_frame if self.frames else as_json
        ping = self._encoded({"jsonrpc": "2.0", "id": "p", "method": "session.ping"})
        parts = [ping] if still else [self._encoded(d) for d in TAKING]
        for number in range(count):
            parts.append(broken(self.rng, message(self.rng, number)))
            if number % 40 == 39:  # so that the row of broken messages never gets long
                parts.append(ping)
        parts.append(self._encoded({"jsonrpc": "2.0", "id": "end", "method": "geometry.get"}))
        return b"".join(parts)

    def send(self, batch: bytes) -> bool:
        """Send a batch, read until its last answer; whether a move was accepted."""
        moved = False
        # A new connection each time: broken messages in a row may end one, which is right.
        with socket.create_connection(("127.0.0.1", self.port), timeout=60) as s:
            sending = threading.Thread(target=_send, args=(s, batch))
            sending.start()
            with s.makefile("rb", buffering=1 << 18) as file:
                while (answers := _read(file, self.frames)) is not None:
                    for one in answers:
                        if "error" in one:
                            self.tally[str(one["error"]["code"])] += 1
                        else:
                            self.tally["ok"] += 1
                            # By its shape: the request's id may have been mutated.
                            moved |= {"duration_s", "moves"} <= one["result"].keys()
                    if any(one.get("id") == "end" for one in answers):
                        break
                else:
                    self.tally["closed"] += 1
            sending.join()
        return moved


def _send(s: Plain, data: bytes) -> None:
    with contextlib.suppress(OSError):
        s.sendall(data)


def _read(file: Plain, frames: bool) -> list[dict[str, Any]] | None:
    """The next answers: several of a JSON-RPC batch, none of an event; None at the end."""
    if not frames:
        line = file.readline()
        if line.startswith(b'{"jsonrpc":"2.0","method":"event"'):
            return []
        answer = json.loads(line) if line else None
    else:
        head = file.read(4)
        whole = len(head) == 4
        answer = msgpack.unpackb(file.read(struct.unpack(">I", head)[0])) if whole else None
    if answer is None or isinstance(answer, list):
        return answer
    return [] if "method" in answer else [answer]


def rounds(senders: list[Sender], count: int) -> Iterator[Round]:
    """Rounds of at most `count` messages in all, every other one still."""
    for number in itertools.count():
        size = min(count, BATCH * len(senders))
        if not size:
            return
        count -= size
        still = number % 2 == 1
        shares = [size // len(senders) + (i < size % len(senders)) for i in range(len(senders))]
        batches = [s.make(n, still=still) for s, n in zip(senders, shares, strict=True)]
        yield Round(still, size, batches)


def hold(wire: Wire) -> None:
    """Take control and bring everything to rest: a stop from anyone cuts a braking way short."""
    wire.call("session.control", action="force")
    wire.call("safety.reset")
    wire.call("clock.set", speed_up=100.0)
    for job in wire.call("job.list")["jobs"]:
        if job["state"] in ACTIVE:
            wire.ask("job.abort", job=job["job"])  # an error if it has ended meanwhile
    until = time.monotonic() + 60.0
    while any(job["state"] in ACTIVE for job in wire.call("job.list")["jobs"]):
        if time.monotonic() > until:
            raise AssertionError("jobs did not end within 60 s of their abortion")
        time.sleep(0.01)
    wire.call("axes.stop")
    while any(axis["moving"] for axis in wire.call("state.get")["axes"].values()):
        time.sleep(0.01)


def fuzz_messages(count: int, seed: int) -> int:
    problems: list[str] = []
    begun, done, still = time.monotonic(), 0, 0
    with (
        tempfile.TemporaryDirectory() as folder,
        ThreadPoolExecutor(len(CODECS)) as pool,
    ):
        rays = projector()
        server = twin(rays.port, Path(folder) / "data", "--sample", "empty", "--speed-up", "max",
                      log=Path(folder) / "log")  # fmt: skip
        senders = [Sender(server.port, codec, f"{seed}-{i}") for i, codec in enumerate(CODECS)]
        try:
            watch = Wire(server.port)
            plan = rounds(senders, count)
            coming = next(plan, None)
            while coming is not None and not problems:
                now = coming
                if now.still:
                    hold(watch)
                before = bound(watch)
                sent = [pool.submit(s.send, b) for s, b in zip(senders, now.batches, strict=True)]
                coming = next(plan, None)  # made while the other is being served
                moved = sum(s.result() for s in sent) > 0  # all are waited for
                after = bound(watch)
                if now.still and (moved or after != before):
                    problems.append(f"motion from refused requests: {before} {after}")
                still += now.size if now.still else 0
                done += now.size
                if not server.alive():
                    problems.append("the twin has died")
                if sum_of(senders)["-32603"]:
                    problems.append("internal errors")
                if done % 50_000 < now.size:
                    print(f"{done} messages, {done / (time.monotonic() - begun):.0f}/s, twin "
                          f"{server.memory_mb():.0f} MB", flush=True)  # fmt: skip
            memory = server.memory_mb()
        finally:
            server.end()
            rays.end()
        bad = server.logged("error", "critical", "unstructured")
        problems += [str(entry)[-1500:] for entry in bad[:5]]
    codes = ", ".join(f"{code}: {n}" for code, n in sorted(sum_of(senders).items()))
    print(f"{done} fuzzed messages (seed {seed}) in {time.monotonic() - begun:.0f} s, {still} of "
          f"them to a scanner that another client held; answers: {codes}; twin {memory:.0f} MB; "
          f"{len(bad)} unhandled exceptions; {len(problems)} problems. {machine()}.")  # fmt: skip
    for problem in problems:
        print("PROBLEM:", problem)
    return 1 if problems else 0


def sum_of(senders: list[Sender]) -> Counter[str]:
    """Answers to all of them."""
    return sum((s.tally for s in senders), Counter())


def bound(wire: Wire) -> dict[str, float]:
    axes = wire.call("state.get")["axes"]
    return {name: axis["target"] for name, axis in axes.items()}


WORDS = ["mag_obj", "ver_obj", "rot_obj", "tra_obj", "ver_tube", "mag_det", "camera", "tube",
         "scanner",
         "move absolute", "move relative", "set speed", "set exposure", "set ROI", "take image",
         "save image", "take and save image sequence", "xrayon", "xrayoff", "set number of frames",
         "set number of averages", "set power", "set voltage", "write settings file", "ACK", "POS",
         "RCV", "no wait", "0", "-1", "1e9", "nan", "inf", "360", "0 0 1943 1535",
         "900 700 1027 827",
         "scan_", "..\\x", "E:\\a\\b_", "\t", "\r\n", "#", "//", "\x00", "é", " " * 50]  # fmt: skip


def bases() -> list[str]:
    """Scripts to begin from: shipped examples, and one of ours."""
    folder = Path(__file__).parents[2] / "examples" / "scripts"
    texts = [
        f.read_text(encoding="utf-8", errors="replace") for f in folder.glob("*") if f.is_file()
    ]
    return [t[:3000] for t in texts] + [fly_script(13)]


def scripted(rng: random.Random, texts: list[str]) -> bytes:
    """A mutated script."""
    lines = rng.choice(texts).splitlines()
    first = rng.randrange(len(lines))
    lines = lines[first : first + rng.randint(1, 25)]
    for _ in range(rng.randint(0, 6)):
        at = rng.randrange(len(lines))
        cells = lines[at].split("\t")
        action = rng.randrange(6)
        if action == 0:
            cells[rng.randrange(len(cells))] = rng.choice(WORDS)
        elif action == 1:
            cells.insert(rng.randrange(len(cells) + 1), rng.choice(WORDS))
        elif action == 2:
            cells[rng.randrange(len(cells))] = str(
                rng.choice([0, -1, 1e-300, 1e300, 7, 99999, 0.5])
            )
        elif action == 3:
            cells = cells[: rng.randrange(len(cells) + 1)]
        elif action == 4:
            rng.shuffle(cells)
        else:
            lines.insert(at, rng.choice(lines))
            continue
        lines[at] = "\t".join(cells)
    raw = bytearray("\r\n".join(lines).encode())
    if rng.random() < 0.2 and raw:
        for _ in range(rng.randint(1, 5)):
            raw[rng.randrange(len(raw))] = rng.randrange(256)
    return bytes(raw)


def fuzz_scripts(count: int, seed: int) -> int:
    from flexdt.twin.machine import builtin_machine, builtin_profile
    from flexdt.twin.script.check import check_script

    rng = random.Random(seed)
    flexray = builtin_machine("flexray")
    profile = builtin_profile(flexray.default_profile)
    texts = bases()
    signal.signal(signal.SIGALRM, lambda *_: (_ for _ in ()).throw(TimeoutError("20 s")))
    begun, sound, slowest, problems = time.monotonic(), 0, 0.0, []
    for number in range(count):
        text = scripted(rng, texts)
        at = time.monotonic()
        signal.alarm(20)
        try:
            report = check_script(text, flexray, profile)
            json.dumps(report.to_dict(), allow_nan=False)
            sound += report.ok
        except Exception as error:
            problems.append(f"{type(error).__name__}: {error}: {text!r}")
            if len(problems) > 5:
                break
        finally:
            signal.alarm(0)
        slowest = max(slowest, time.monotonic() - at)
        if number % 20_000 == 19_999:
            print(f"{number + 1} scripts, slowest {slowest:.2f} s", flush=True)
    print(f"{number + 1} fuzzed scripts (seed {seed}) in {time.monotonic() - begun:.0f} s: {sound} "
          f"sound, the others refused with their problems, slowest {slowest:.2f} s, "
          f"{len(problems)} unhandled exceptions or hangs. {machine()}.")  # fmt: skip
    for problem in problems:
        print("PROBLEM:", problem[:2000])
    return 1 if problems else 0


def main() -> int:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    p.add_argument("what", choices=["messages", "scripts"])
    p.add_argument("--count", type=int, default=20_000)
    p.add_argument("--seed", type=int, default=1)
    options = p.parse_args()
    run = fuzz_messages if options.what == "messages" else fuzz_scripts
    return run(options.count, options.seed)


if __name__ == "__main__":
    sys.exit(main())
