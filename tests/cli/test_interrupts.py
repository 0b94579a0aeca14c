"""Ctrl-C ends a command at once, at whatever moment: `tests/studies/interrupts.py`, in
short."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from interrupts import COMMANDS, campaign

SILENCE_S = 60.0
STUCK_END_S = 1.5
"""After so long without work an end counts as stuck here [s]."""
MOST_USED_S = 1.5
"""Processor time from the signal to the end; servers stop their children in order."""

STUCK = {
    "Python": "while True: pass",
    "compiled code": "import hashlib; hashlib.pbkdf2_hmac('sha256', b'a', b'b', 10**9)",
    "an import that swallows it": "import swallowing",
    "a finaliser": """
import time
class Waits:
    def __del__(self):
        __import__('time').sleep(30)
one = Waits()
del one
while True: pass
""",
    "an exception that a library swallows": """
import time
try:
    time.sleep(30)
except BaseException:
    pass
time.sleep(30)
""",
    "a server's end that never comes": """
import asyncio
from flexdt.runtime.process import stop_signal
async def serve():
    stop = stop_signal()
    print("ready", flush=True)
    await stop.wait()
    while True:
        await asyncio.sleep(0.1)
asyncio.run(serve())
""",
    "a server's start": """
import asyncio
from types import SimpleNamespace
from flexdt.runtime.process import run_process
def work():
    sum(range(10**8))
    print("went on", flush=True)
async def serve(settings):
    print("ready", flush=True)
    await asyncio.to_thread(work)
run_process(SimpleNamespace(command="twin", host="", port=0), serve)
""",
}
WORKING = """
import asyncio, time
from flexdt.runtime.process import stop_signal
def work(until):
    while time.monotonic() < until:
        sum(range(1000))
async def serve():
    stop = stop_signal()
    print("ready", flush=True)
    await stop.wait()
    await asyncio.to_thread(work, time.monotonic() + {work_s})
    print("written", flush=True)
asyncio.run(serve())
"""
SWALLOWING = """
import time
print("begins", flush=True)
while True:
    try:
        time.sleep(0.01)
    except BaseException:
        pass
"""
PROGRAM = """
import sys
from flexdt.clients.cli import console_script

def command():
    if "swallowing" not in {code!r} and "ready" not in {code!r}:
        print("begins", flush=True)
    exec({code!r}, {{}})

console_script.SILENCE_S = {stuck_s}
console_script.CHECK_S = 0.2
console_script._command = command
console_script.main()
"""

IN_KERNELS = """
import os, signal, sys, threading, time
import numpy as np
import flexdt as fx
from flexdt.clients.cli import console_script
from flexdt.library.reconstruction import memory_plan, reconstruct, slab_fdk

folder = sys.argv[1]
N = 256
scan = fx.ConeVec.circular(sod=600, sdd=900, angles=360, shape=(N, N), pixel=0.8)
volume = fx.Volume(np.ones((N, N, N), np.float32), 0.5)
fx.forward(volume, fx.ConeVec(scan.rows[:1]), (N, N))  # compiled or loaded

used = []
def press():
    used.append(time.process_time())
    os.kill(os.getpid(), signal.SIGINT)

threading.Timer(0.1, press).start()
try:
    fx.forward(volume, scan, (N, N))
    print("ended")
except KeyboardInterrupt:
    print(time.process_time() - used[0])

# FDK in slabs, of which the first is in the file when somebody presses Ctrl-C.
few = fx.ConeVec.circular(sod=600, sdd=900, angles=40, shape=(32, 32), pixel=6.4)
counts = np.full((40, 32, 32), 9000, np.uint16)
fx.DataSet.from_arrays(counts, few, flat=np.full((32, 32), 10000)).save(folder + "/scan")
memory_plan.WORKING_IMAGES = 0
reconstruct.free_memory_bytes = lambda: 2 * 40_000
parts, slabs = slab_fdk.fdk_parts, []
def second(*args, **options):
    slabs.append(os.listdir(folder + "/out"))
    if len(slabs) == 2:
        print(slabs[1], flush=True)
        press()
    return parts(*args, **options)
slab_fdk.fdk_parts = second
os.mkdir(folder + "/out")
sys.argv = ["flexdt", "-q", "reconstruct", folder + "/scan", "--out", folder + "/out/v.mha"]
console_script.main()
"""
"""Interrupts a projection in its kernel, and then the command that reconstructs. Prints the
processor time of all threads from the signal to KeyboardInterrupt [s], and the files of which
the command had begun to write one."""
MOST_IN_KERNEL_S = 1.2
"""Processor time from the signal to KeyboardInterrupt: a portion of two threads takes 0.5 s by
estimate; the projection as a whole would go on for 2.5 s."""


@pytest.mark.parametrize("where", STUCK)
def test_the_main_thread_is_interrupted_wherever_it_is(
    where: str, tmp_path: Path
) -> None:
    (tmp_path / "swallowing.py").write_text(SWALLOWING)
    assert interrupted_end(STUCK[where], tmp_path) == (130, "", "flexdt: interrupted\n")


def test_an_end_that_works_is_waited_for(tmp_path: Path) -> None:
    code = WORKING.format(work_s=2 * STUCK_END_S)
    assert interrupted_end(code, tmp_path) == (0, "written\n", "")


def test_work_in_kernels_ends_at_once_and_leaves_no_file(
    tmp_path: Path,
) -> None:  # numba#2324, #5551
    done = subprocess.run(
        [sys.executable, "-c", IN_KERNELS, str(tmp_path)],
        env={**os.environ, "NUMBA_NUM_THREADS": "2"}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    used, written = done.stdout.splitlines()
    assert float(used) < MOST_IN_KERNEL_S
    assert written == "['.v.mha.part.mha']"
    assert done.returncode == 130
    assert done.stderr.endswith("flexdt: interrupted\n")
    assert "Traceback" not in done.stderr
    assert not list((tmp_path / "out").iterdir())


def interrupted_end(code: str, folder: Path) -> tuple[int, str, str]:
    """Interrupt a command after its first line, and return its exit code, further output
    and errors.

    Args:
        code: of the command; it prints `ready`, or `begins` is printed before it.
        folder: where it runs.
    """
    program = PROGRAM.format(code=code, stuck_s=STUCK_END_S)
    with subprocess.Popen(
        [sys.executable, "-c", program], cwd=folder, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert process.stdout.readline() in ("begins\n", "ready\n")
        process.send_signal(signal.SIGINT)
        try:
            further, said = process.communicate(timeout=SILENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
    return process.returncode, further, said


@pytest.mark.slow
@pytest.mark.campaign(10)
@pytest.mark.parametrize("seed", [7, 8])
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_ends_without_a_traceback(name: str, seed: int) -> None:
    for _, moment, end in campaign([name], 1, 3.0, seed):
        assert end.kind != "wrong", (moment, end)
        assert end.used_s < MOST_USED_S, (moment, end)
