"""E-stop beside the dearest writes: `python tests/studies/estop_beside_writes.py [--mb 200]
[--jobs 20000]`.

A twin's E-stop is pressed while the last chunk of an upload is being written, and right after a
start with the files of many ended jobs; `axes.set` is timed beside the latter. Prints when the
E-stop was answered, what `unsaved` said, when it was on the disk, and whether it is in force
after a kill at the moment of the answer. Exits with 1 where an E-stop that was answered without
`unsaved` is lost, or where one of them takes more than `--most` seconds to the disk.
"""

from __future__ import annotations

import argparse
import base64
import json
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from lab import Wire, machine, projector, twin

CHUNK = 3 << 20
SIDE_BYTES = 4
PATIENCE_S = 600.0


def on_disk(data: Path) -> bool:
    """Whether an E-stop is on the disk: in the journal, or in the state without one."""
    journal = data / "journal"
    if journal.exists():
        slots = [journal.read_bytes()[i : i + 16384] for i in (0, 16384)]
        texts = [slot[33:].split(b"\0")[0].split(b"}}")[0] for slot in slots]
        found = [t for t in texts if t]
        newest = max(
            found, key=lambda text: int(text.split(b'"version":')[1].split(b",")[0])
        )
        return b'"estop":true' in newest
    state = data / "state.json"
    return state.exists() and json.loads(state.read_text())["estop"] is True


def seconds_until(holds: Callable[[], bool], began: float) -> float:
    """Seconds from `began` until `holds`; PATIENCE_S at most."""
    while not holds() and time.monotonic() - began < PATIENCE_S:
        time.sleep(0.002)
    return time.monotonic() - began


def press(port: int, data: Path) -> dict[str, Any]:
    """Press E-stop and time its answer and its way to the disk."""
    wire = Wire(port, PATIENCE_S)
    began = time.monotonic()
    answer = wire.call("safety.estop")
    answered = time.monotonic() - began
    return {
        "answered_s": round(answered, 4),
        "unsaved": answer["unsaved"],
        "on_disk_s": round(seconds_until(lambda: on_disk(data), began), 4),
    }


def survives(rays: int, data: Path) -> bool:
    """Whether a twin that starts on the directory of a killed one is in E-stop."""
    process = twin(rays, data, "--sample", "empty")
    try:
        return bool(Wire(process.port).call("state.get")["safety"]["estop"])
    finally:
        process.kill()


def beside_upload(rays: int, root: Path, megabytes: int, *, kill: bool) -> dict[str, Any]:
    """Press E-stop while the last chunk of an upload is written; with `kill` end the twin at
    the answer."""
    data = root / f"upload-{kill}"
    process = twin(rays, data, "--sample", "empty")
    side = round((megabytes * 1e6 / SIDE_BYTES) ** (1 / 3))
    total = SIDE_BYTES * side**3
    head = {"name": "big", "kind": "voxels", "format": "raw", "shape": [side] * 3,
            "voxel_mm": [0.1] * 3, "total": total}  # fmt: skip
    sender = Wire(process.port, PATIENCE_S)
    chunk = base64.b64encode(bytes(CHUNK)).decode()
    places = range(0, total, CHUNK)
    for start in places[:-1]:
        sender.call("sample.upload", **head, start=start, data=chunk)
    last = base64.b64encode(bytes(total - places[-1])).decode()

    def send() -> None:
        try:
            sender.call("sample.upload", **head, start=places[-1], data=last)
        except ConnectionError:
            return

    thread = threading.Thread(target=send)
    thread.start()

    def begun() -> bool:
        """Whether the bytes are on their way."""
        return any(f.stat().st_size > 1 << 20 for f in (data / "samples").glob(".part-*"))

    seconds_until(begun, time.monotonic())
    return outcome(process, rays, data, kill=kill)


def outcome(process: Any, rays: int, data: Path, *, kill: bool) -> dict[str, Any]:
    """Press E-stop; with `kill` end the twin at its answer and look whether it is in force."""
    if not kill:
        found = press(process.port, data)
        process.kill()
        return found
    answer = Wire(process.port, PATIENCE_S).call("safety.estop")
    process.kill()
    return {"unsaved": answer["unsaved"], "in force after a kill": survives(rays, data)}


def with_jobs(rays: int, root: Path, count: int, *, kill: bool) -> dict[str, Any]:
    """Press E-stop right after a start with the files of many ended jobs, and time `axes.set`."""
    data = root / f"jobs-{kill}"
    folder = data / "jobs" / "status"
    folder.mkdir(parents=True)
    for n in range(1, count + 1):
        job = {"schema": 1, "id": f"job-{n}", "name": f"n{n}", "folder": f"n{n}",
               "phase": "done", "frames_total": 3, "frames_done": 3, "duration_s": 9.0,
               "ended": "2026-11-01T00:00:00Z"}  # fmt: skip
        (folder / f"job-{n}.json").write_text(json.dumps(job))
    process = twin(rays, data, "--sample", "empty")
    if kill:
        return outcome(process, rays, data, kill=True)
    took: list[float] = []

    def change() -> None:
        began = time.monotonic()
        Wire(process.port, PATIENCE_S).call("axes.set", axis="tra_obj", speed=3.0)
        took.append(time.monotonic() - began)

    thread = threading.Thread(target=change)
    thread.start()
    found = press(process.port, data)
    thread.join()
    process.kill()
    return {**found, "axes_set_s": round(took[0], 3)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mb", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=20_000)
    parser.add_argument("--most", type=float, default=1.0)
    options = parser.parse_args()
    rays = projector()
    bad = 0
    print(machine())
    with tempfile.TemporaryDirectory() as folder:
        for what, count, case in (
            (f"last chunk of {options.mb} MB", options.mb, beside_upload),
            (f"{options.jobs} job files", options.jobs, with_jobs),
        ):
            for kill in (False, True):
                found = case(rays.port, Path(folder), count, kill=kill)
                print(what, json.dumps(found), flush=True)
                lost = found.get("in force after a kill") is False
                bad += lost and found["unsaved"] is None
                bad += found.get("on_disk_s", 0.0) > options.most
    rays.end()
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
