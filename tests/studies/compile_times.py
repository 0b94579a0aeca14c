"""Processor time that compiling kernels takes from an empty cache: `compile_times.py [CASE
...]`.

Each case runs in processes of its own with an empty NUMBA_CACHE_DIR. What each of its processes
compiles is written down there by an event of numba's, with the thread's processor time, which
other work on the machine does not change. A function that another one's compilation compiles
counts for itself. `--keep FOLDER` takes that folder for the cache: a second run with it shows a
warm start.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

HOOK = """
import os, json, time, sys, importlib.abc
class Late(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "numba.np" or name == "numba.core.dispatcher":
            sys.meta_path.remove(self)
            listen()
def listen():
    from numba.core import event
    inside = []
    class Listener(event.Listener):
        def on_start(self, event):
            inside.append([time.thread_time(), 0.0])
        def on_end(self, event):
            begun, inner = inside.pop()
            whole = time.thread_time() - begun
            if inside:
                inside[-1][1] += whole
            d = event.data["dispatcher"].py_func
            row = [d.__module__ + "." + d.__qualname__, whole - inner, str(event.data["args"])]
            with open(os.environ["COMPILE_TIMES"], "a") as file:
                file.write(json.dumps(row) + chr(10))
    event.register("numba:compile", Listener())
sys.meta_path.insert(0, Late())
"""
STL = """
import sys, numpy as np
from pathlib import Path
corners = np.array([[x, y, z] for x in (-4, 4) for y in (-4, 4) for z in (-4, 4)], float)
faces = [(0,2,3),(0,3,1),(4,5,7),(4,7,6),(0,1,5),(0,5,4),
         (2,6,7),(2,7,3),(0,4,6),(0,6,2),(1,3,7),(1,7,5)]
lines = ["solid cube"]
for face in faces:
    lines += ["facet normal 0 0 0", "outer loop"]
    lines += ["vertex %g %g %g" % tuple(corners[i]) for i in face[::-1]]
    lines += ["endloop", "endfacet"]
path = Path(sys.argv[1]) / "cube.stl"
path.write_text("\\n".join([*lines, "endsolid cube", ""]))
import flexdt as fx
scan = fx.ConeVec.circular(sod=100, sdd=300, angles=12, shape=(40, 48), pixel=0.8)
fx.simulate(str(path), scan, noise=1)
"""
FDK = """
import flexdt as fx, numpy as np
scan = fx.ConeVec.circular(sod=100, sdd=300, angles=12, shape=(40, 48), pixel=0.8)
fx.fdk(np.ones((12, 40, 48), np.float32), scan, fx.Grid((8, 16, 16), 0.5).blank())
"""
FORWARD = """
import flexdt as fx, numpy as np
scan = fx.ConeVec.circular(sod=100, sdd=300, angles=12, shape=(40, 48), pixel=0.8)
fx.forward(fx.Volume(np.ones((8, 16, 16), np.float32), 0.5), scan)
"""
CALIBRATE = """
import flexdt as fx
scan = fx.ConeVec.circular(sod=600, sdd=1059, angles=30, shape=(380, 480), pixel=0.3)
fx.simulate("lego", scan, noise=1).calibrate("lego")
"""
TV = """
import flexdt as fx, numpy as np
scan = fx.ConeVec.circular(sod=100, sdd=300, angles=12, shape=(40, 48), pixel=0.8)
fx.tv(np.ones((12, 40, 48), np.float32), scan, fx.Grid((8, 16, 16), 0.5).blank(), iterations=2)
"""
CLI = ["-m", "flexdt.clients.cli"]
CASES = {
    "demo": [*CLI, "demo", "--no-viewer", "--out", "{}"],
    "up": ["-m", "flexdt.clients.launch.up", "--port", "0", "--projector-port", "0",
           "--viewer-port", "0", "--data", "{}"],
    "simulate": ["-c", STL, "{}"],
    "forward": ["-c", FORWARD],
    "fdk": ["-c", FDK],
    "tv": ["-c", TV],
    "calibrate": ["-c", CALIBRATE],
}  # fmt: skip


def used_s() -> float:
    """Processor time of all processes of this one that have ended [s]."""
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def run(case: str, cache: Path | None) -> None:
    """Run a case and print what it compiled."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "hook").mkdir()
        (folder / "hook" / "sitecustomize.py").write_text(HOOK)
        report = folder / "report"
        report.touch()
        paths = [str(folder / "hook"), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(paths),
            "NUMBA_CACHE_DIR": str(cache or folder / "cache"),
            "COMPILE_TIMES": str(report),
        }
        command = [part.replace("{}", name) for part in CASES[case]]
        before, begun = used_s(), time.monotonic()
        process = subprocess.Popen(
            [sys.executable, "-P", *command],
            env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        assert process.stdout is not None
        lines = []
        for line in process.stdout:
            lines.append(line)
            if line.startswith('{"ready"'):
                ready = time.monotonic() - begun
                print(f"{case}: ready after {ready:.1f} s")
                process.send_signal(signal.SIGTERM)
        if process.wait() != 0:
            print("".join(lines[-15:]), end="")
        wall = time.monotonic() - begun
        rows = [json.loads(line) for line in report.read_text().splitlines()]
    spent, kinds = defaultdict(float), defaultdict(list)
    for function, seconds, signature in rows:
        spent[function] += seconds
        kinds[function].append(signature)
    print(
        f"{case}: {sum(spent.values()):.1f} s "
        f"of {used_s() - before:.1f} s processor time compile, {wall:.1f} s in all"
    )
    for function in sorted(spent, key=lambda f: -spent[f]):
        if spent[function] >= 0.05:
            times, different = len(kinds[function]), len(set(kinds[function]))
            print(f"{spent[function]:8.2f} s {times:3} x {different}  {function}")


def main() -> None:
    """Time the cases named on the command line, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", choices=[*CASES, []], default=list(CASES))
    parser.add_argument("--keep", type=Path, help="the cache's folder, kept")
    chosen = parser.parse_args()
    for case in chosen.cases:
        run(case, chosen.keep)


if __name__ == "__main__":
    main()
