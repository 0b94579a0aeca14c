"""Kernels compiled ahead serve what needs them, and are compiled by nobody else."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from flexdt.runtime.kernels import compile_ahead
from flexdt.twin import long_work
from flexdt.twin.projection.kernels import compiling
from flexdt.twin.projection.kernels.siddon_kernels import clip

USERS = """
import numba.core.event as event
import numpy as np
import flexdt as fx
from flexdt.phantoms import load_phantom
from flexdt.twin.calibration import detect_beads
from flexdt.twin.projection import warm_up
seen = []
class Watch(event.Listener):
    def on_start(self, event):
        seen.append(str(event.data["dispatcher"].py_func))
    def on_end(self, event):
        pass
event.register("numba:compile", Watch())
warm_up()
scan = fx.ConeVec.circular(sod=600, sdd=1059, angles=12, shape=(96, 120), pixel=1.0)
data = fx.simulate("lego", scan, noise=1)
detect_beads(data.line_integrals()[0])
data.reconstruct(voxel=4.0, shape=(4, 8, 8))
at = scan.project_points(load_phantom("lego").beads)
marks = [(i, str(k), *at[i, k].tolist(), None) for i, k in np.ndindex(at.shape[:2])]
fx.calibrate(None, "lego", geometry=scan, markers=marks)
assert not seen, seen
"""


@pytest.mark.slow  # half a minute of processor time: it begins with an empty cache
@pytest.mark.campaign
def test_nothing_compiles_after_it_was_compiled_ahead(tmp_path: Path) -> None:
    homes = dict.fromkeys(("FLEXDT_CACHE", "XDG_CACHE_HOME", "TMPDIR"), str(tmp_path))
    environment = os.environ | homes
    ahead = [sys.executable, "-P", "-m", "flexdt.runtime.kernels.compile_ahead"]
    groups = len(compile_ahead.GROUPS)
    for last in (f"flexdt: compiled {groups} of {groups} ", ""):
        done = subprocess.run(
            ahead, env=environment, capture_output=True, text=True, check=True
        )
        assert ["", *done.stdout.splitlines()][-1].startswith(last)
    assert done.stdout == ""
    users = [sys.executable, "-P", "-c", USERS]
    done = subprocess.run(users, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "compiling" not in done.stderr


@pytest.mark.parametrize("group", compile_ahead.GROUPS)
def test_a_group_names_a_kernel(group: str) -> None:
    module, _, name = compile_ahead.GROUPS[group][1].partition(":")
    kernel = getattr(importlib.import_module(f"flexdt.twin.{module}"), name, None)
    assert callable(getattr(kernel, "py_func", None))


def test_what_is_missing_is_named_and_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[str] = []
    monkeypatch.setattr(compile_ahead, "is_compiled", lambda group: group == "FDK")
    monkeypatch.setattr(
        compile_ahead, "elsewhere", lambda group: compiled.append(group) or ""
    )
    told: list[str] = []
    compile_ahead.compile_ahead(["FDK"], told.append)
    assert (compiled, told) == ([], [])
    compile_ahead.compile_ahead(["FDK", "calibration"], told.append)
    assert compiled == ["calibration"]
    assert "calibration" in told[0]
    assert "FDK" not in told[0]


def test_a_group_that_fails_is_told_with_its_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(compile_ahead, "is_compiled", lambda group: False)
    monkeypatch.setattr(compile_ahead, "start", lambda *groups: broken())
    told: list[str] = []
    compile_ahead.compile_ahead(["FDK"], told.append)
    assert [
        line for line in told if "ValueError: a kernel" in line and "first use" in line
    ]


def broken() -> subprocess.Popen[bytes]:
    program = "import sys; print('x', file=sys.stderr); raise ValueError('a kernel')"
    words = [sys.executable, "-c", program]
    return subprocess.Popen(words, stderr=subprocess.PIPE)


def test_who_waits_for_one_kernel_is_told_which(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def sum_of_squares(n: int) -> int:
        return sum([i * i for i in range(n)])

    monkeypatch.setattr(long_work, "LINE_INTERVALS_S", (0.01,))
    assert compiling.serial(sum_of_squares, keep=False)(4) == 14
    told = [record.getMessage() for record in caplog.records]
    assert any(
        line.startswith("flexdt: still compiling sum_of_squares (") for line in told
    ), told


def test_a_kernel_that_has_code_in_its_callers_only_is_refused_to_python() -> None:
    for _ in range(2):  # compiled, and compiled before
        with pytest.raises(TypeError):
            clip(0.5, 1.0, 3, 0.0, 1.0)
    assert clip.py_func(0.5, 1.0, 3, 0.0, 1.0) == (0.0, 1.0)
