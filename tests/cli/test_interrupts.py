"""Ctrl-C ends a command at once, at whatever moment: `tests/studies/interrupts.py`, in
short."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from interrupts import COMMANDS, campaign

SILENCE_S = 60.0
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
}
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
    if "swallowing" not in {code!r}:
        print("begins", flush=True)
    exec({code!r})

console_script._command = command
console_script.main()
"""


@pytest.mark.parametrize("where", STUCK)
def test_the_main_thread_is_interrupted_wherever_it_is(
    where: str, tmp_path: Path
) -> None:
    (tmp_path / "swallowing.py").write_text(SWALLOWING)
    program = PROGRAM.format(code=STUCK[where])
    with subprocess.Popen(
        [sys.executable, "-c", program], cwd=tmp_path, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert process.stdout.readline() == "begins\n"
        process.send_signal(signal.SIGINT)
        try:
            _, said = process.communicate(timeout=SILENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
    assert (process.returncode, said) == (130, "flexdt: interrupted\n")


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_ends_without_a_traceback(name: str) -> None:
    for _, moment, end in campaign([name], 3, 3.0, seed=7):
        assert end.kind != "wrong", (moment, end)
        assert end.used_s < MOST_USED_S, (moment, end)
