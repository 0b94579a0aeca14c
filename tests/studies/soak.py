"""A day of mixed use, accelerated: `python tests/studies/soak.py [--hours 24]`.

One twin and one projector, left running while clients come and go: moves, jogs, projections,
scans (finished, aborted, paused), uploads, corrections, scenes, subscriptions, clients that
vanish, stops and E-stops. Memory and descriptors of both are read after every simulated hour;
the first quarter counts as warming up. Prints a line an hour and fails when memory grows by
more than 5 % or a descriptor is left after that.
"""

from __future__ import annotations

import argparse
import base64
import random
import sys
import tempfile
import time
from pathlib import Path

from attacks import stl

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from lab import Refused, Wire, fly_script, machine, percentile, projector, twin

USES_AN_HOUR = 40


def use(port: int, rng: random.Random, number: int) -> None:
    """Somebody does something."""
    wire = Wire(port)
    try:
        wire.call("session.hello", protocol="1.0", client=f"soak {number}")
        wire.call("session.control", action="force")
        wire.call("safety.reset")
        match rng.randrange(9):
            case 0:
                wire.call("state.subscribe", topics=["state", "projection", "job", "log"],
                          projection_binning=8)  # fmt: skip
                wire.call(
                    "axes.move", targets={"rot_obj": rng.uniform(-180, 180)}, wait=True
                )
            case 1:
                wire.call(
                    "axes.jog", axis="tra_obj", velocity=rng.uniform(-2, 2), lease_s=0.5
                )
                wire.call("axes.stop")
            case 2:
                wire.call("projection.get", kind="counts", binning=rng.choice([1, 4, 16]))
            case 3:
                job = wire.call("script.submit", text=fly_script(31), speed_up="max")[
                    "job"
                ]
                if rng.random() < 0.5:
                    wire.wait(job, "done", "failed")
                else:
                    wire.call("job.abort", job=job)
            case 4:
                data = base64.b64encode(stl(12)).decode()
                wire.call("sample.upload", name=f"mesh{number % 3}", format="stl",
                          total=len(stl(12)), data=data)  # fmt: skip
                wire.call("sample.set", file=f"mesh{number % 3}")
            case 5:
                wire.call("sample.set", name=rng.choice(["lego", "normal", "wide", "empty"]),
                          offset={"x": rng.uniform(-2, 2)})  # fmt: skip
            case 6:
                wire.call("calibration.apply", parameters={"dD_x": rng.uniform(-1, 1)})
                wire.call("calibration.revert")
            case 7:
                document = wire.call("scene.save")["document"]
                wire.call("scene.load", document=document)
                wire.call("safety.estop")
            case 8:
                wire.socket.sendall(
                    b'{"jsonrpc":"2.0","id":1,"method":"projection.get"}\n{"half'
                )
    except Refused:
        pass  # refused for a reason (an E-stop, a contact): also a use
    finally:
        wire.close()


def main() -> int:
    """Use a twin for many simulated hours, and compare its memory early and late.

    Returns:
        1 where memory or descriptors grew, or an error was not handled.
    """
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--hours", type=float, default=24.0)
    p.add_argument("--uses", type=int, default=USES_AN_HOUR, help="an hour")
    options = p.parse_args()
    rng = random.Random(5)
    begun, hours, number = time.monotonic(), 0, 0
    rows: list[tuple[float, int, float, int]] = []
    with tempfile.TemporaryDirectory() as folder:
        rays = projector()
        server = twin(rays.port, Path(folder) / "data", "--speed-up", "max")
        try:
            watch = Wire(server.port)
            start = watch.call("session.ping")["time"]
            while hours < options.hours:
                hours += 1
                while True:
                    use(server.port, rng, number)
                    number += 1
                    if number % options.uses == 0:
                        break
                # What is left of the hour passes in motion.
                until = start + 3600.0 * hours
                watch.call("session.control", action="force")
                for job in watch.call("job.list")["jobs"]:
                    if job["state"] in ("queued", "running", "paused"):
                        watch.ask("job.abort", job=job["job"])
                        watch.wait(job["job"], "aborted", "done", "incomplete", "failed")
                watch.call("safety.reset")
                watch.call("axes.set", axis="rot_obj", speed=1.0)
                while (now := watch.call("session.ping")["time"]) < until:
                    far = min(7000.0, max(2.0, until - now))
                    here = watch.call("state.get")["axes"]["rot_obj"]["position"]
                    watch.call(
                        "axes.move",
                        targets={"rot_obj": -far if here > 0 else far},
                        wait=True,
                    )
                watch.call("axes.set", axis="rot_obj", speed=22.5)
                watch.call("session.control", action="release")
                time.sleep(0.2)
                row = (
                    server.memory_mb(),
                    server.descriptors(),
                    rays.memory_mb(),
                    rays.descriptors(),
                )
                rows.append(row)
                print(
                    f"hour {hours}: twin {row[0]:.0f} MB, {row[1]} descriptors; projector "
                    f"{row[2]:.0f} MB, {row[3]} descriptors; {number} clients so far",
                    flush=True,
                )
        finally:
            server.end()
            rays.end()
        bad = server.logged("error", "critical", "unstructured")
        bad += rays.logged("error", "critical", "unstructured")
        for entry in bad[:3]:
            print("LOG:", str(entry)[-800:])
    warm = rows[len(rows) // 4 :]
    half = len(warm) // 2
    failed = bool(bad)
    for name, column in (("twin", 0), ("projector", 2)):
        early = percentile([r[column] for r in warm[:half] or warm], 0.5)
        late = percentile([r[column] for r in warm[half:]], 0.5)
        few = min(r[column + 1] for r in warm), max(r[column + 1] for r in warm)
        print(f"{name}: {early:.0f} MB in the first half, {late:.0f} MB in the second; {few[0]} to "
              f"{few[1]} descriptors")  # fmt: skip
        failed |= late > 1.05 * early + 2.0 or few[1] - few[0] > 4
    print(
        f"{options.hours:g} simulated hours, {number} clients, in "
        f"{time.monotonic() - begun:.0f} s;"
        f" {len(bad)} unhandled exceptions. {machine()}."
    )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
