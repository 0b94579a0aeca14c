"""One `progress=` for every long call: a bar after a while, silence, or the caller's
function."""

from __future__ import annotations

import inspect
import io
import logging
import sys
import time
import types
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import flexdt as fx
from flexdt.clients.cli import console
from flexdt.runtime import progress_bars, progress_lines
from flexdt.twin import long_work
from flexdt.twin.long_work import Pace

LONG = (
    fx.sirt, fx.tv, fx.cgls, fx.fdk, fx.calibrate, fx.align, fx.project, fx.reconstruct,
    fx.simulate, fx.LocalTwin, fx.TwinClient.move, fx.TwinClient.wait_job, fx.DataSet.calibrate,
    fx.DataSet.align, fx.DataSet.reconstruct,
)  # fmt: skip


class Terminal(io.StringIO):
    """Standard error that says it is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """A terminal; nobody handles the log; what takes 50 ms is long."""
    shown = Terminal()
    seen = types.SimpleNamespace(stderr=shown, modules=sys.modules)
    monkeypatch.setattr(
        progress_bars, "sys", seen
    )  # pytest sets its own in `sys` once more
    monkeypatch.setattr(progress_lines, "SILENT_S", 0.05)
    monkeypatch.setattr(progress_lines, "DRAWN_S", 0.02)
    monkeypatch.setattr(progress_lines, "_last", {})
    monkeypatch.setattr(progress_bars, "in_notebook", lambda: False)
    monkeypatch.setattr(progress_lines.LOG, "hasHandlers", lambda: False)
    return shown


def until(happened: Callable[[], object]) -> None:
    """Wait for what another thread does."""
    end = time.monotonic() + 30.0
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.005)


@pytest.mark.parametrize("call", LONG, ids=lambda call: call.__qualname__)
def test_every_long_call_takes_progress(call: Any) -> None:
    given = inspect.signature(call).parameters["progress"]
    assert given.default is None
    assert "progress: " in (call.__doc__ or "") or call in (fx.cgls, fx.tv, *LONG[12:])


def test_a_bar_is_drawn_after_a_while_and_goes(screen: Terminal) -> None:
    with long_work.during("measuring") as advance:
        assert screen.getvalue() == ""
        advance(0.25)
        until(lambda: "25 %" in screen.getvalue())
        with long_work.during("compiling a kernel"):
            until(lambda: "measuring: compiling a kernel" in screen.getvalue())
        with long_work.during("measuring") as same:
            same(0.75)
        until(lambda: "[##################......] 75 %" in screen.getvalue())
    assert screen.getvalue().endswith("\r\x1b[2K")
    drawn = screen.getvalue()
    time.sleep(0.1)
    assert screen.getvalue() == drawn


def test_a_program_is_shown_until_its_first_words(screen: Terminal) -> None:
    """Imports and plans of a command are no silence; its own work is shown in its place."""
    with progress_lines.silence_shown("at flexdt check") as first_words:
        until(lambda: "at flexdt check" in screen.getvalue())
        with long_work.during("measuring") as advance:
            advance(0.25)
            until(lambda: "25 %" in screen.getvalue())
            drawn = screen.getvalue().rindex("measuring")
            time.sleep(0.1)
            assert "at flexdt check" not in screen.getvalue()[drawn:]
        first_words()
        drawn = len(screen.getvalue())
        time.sleep(0.1)
        assert screen.getvalue()[drawn:] == ""
        first_words()


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        ("check a.txt", True),
        ("", False),
        ("--help", False),
        ("up", False),
        ("check a.txt -q", False),
        ("twin --port 1", False),
    ],
)
def test_commands_show_their_silence_but_for_servers_help_and_quiet_ones(
    words: str, shown: bool, screen: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stderr", screen)
    with console.waited_for(words.split()):
        if shown:
            until(lambda: "at flexdt check" in screen.getvalue())
            console.note("words")
            drawn = len(screen.getvalue())
        time.sleep(0.1)
    assert screen.getvalue()[drawn if shown else 0 :] == ""


def test_short_work_shows_nothing(
    screen: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress_lines, "SILENT_S", 30.0)
    with long_work.during("measuring") as advance:
        advance(0.5)
        time.sleep(0.1)
    assert screen.getvalue() == ""


@pytest.mark.parametrize("progress", [False, "function", "level"])
def test_silence(
    screen: Terminal, progress: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[float] = []
    if progress == "level":
        monkeypatch.setattr(progress_lines.LOG, "level", logging.ERROR)
        progress_lines.LOG.manager._clear_cache()  # type: ignore[attr-defined]
        progress = None
    chosen = told.append if progress == "function" else progress
    with long_work.during("measuring", chosen) as advance, long_work.during("compiling"):
        advance(0.5)
        time.sleep(0.2)
    assert screen.getvalue() == ""
    assert told == ([0.5, 1.0] if progress == "function" else [])
    progress_lines.LOG.manager._clear_cache()  # type: ignore[attr-defined]


def test_a_program_that_handles_the_log_gets_lines(
    screen: Terminal, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.undo()
    monkeypatch.setattr(progress_lines, "SILENT_S", 0.05)
    with long_work.during("measuring") as advance:
        advance(0.25)
        advance(0.5)
        until(lambda: caplog.messages)
    assert caplog.messages[0].startswith("flexdt: still measuring (50 %, 0 s, about ")
    assert caplog.records[0].name == "flexdt.progress"


def test_works_that_follow_each_other_are_one_wait(
    screen: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Thirty kernels of a second each are half a minute; other work begins at 0 s."""
    monkeypatch.setattr(progress_lines, "SILENT_S", 0.3)
    for _ in range(6):
        with long_work.during("compiling one of many"):
            time.sleep(0.1)
    assert "compiling one of many" in screen.getvalue()
    before = len(screen.getvalue())
    with long_work.during("making a preview"):
        time.sleep(0.1)
    assert "preview" not in screen.getvalue()[before:]


def test_the_same_call_once_more_begins_at_0_s(
    screen: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second call of four neither shows what the first took nor is shown sooner."""
    monkeypatch.setattr(progress_lines, "SILENT_S", 0.3)
    for _ in range(4):
        with long_work.during("calibrating"):
            time.sleep(0.1)
    assert screen.getvalue() == ""


@pytest.mark.parametrize("seed", range(4))
def test_the_time_left_follows_the_pace_and_not_the_preparation(seed: int) -> None:
    """A kernel compiles for a drawn time, then each percent takes as long as the others."""
    rng = np.random.default_rng(6400 + seed)
    prepared, percent_s = rng.uniform(5.0, 60.0), rng.uniform(0.05, 2.0)
    pace = Pace()
    pace.advance(0.0, 0.0)
    assert pace.left_s(0.0, 0.0) is None
    for percent in range(1, 101):
        now = prepared + percent * percent_s
        pace.advance(percent / 100.0, now)
        left = pace.left_s(percent / 100.0, now)
        if percent <= 10 or percent == 100:
            assert left is None
        else:
            assert left == pytest.approx((100 - percent) * percent_s)


def test_a_notebook_s_bar_is_one_display(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []

    def display(what: str, display_id: bool) -> Any:
        assert display_id
        shown.append(what)
        return types.SimpleNamespace(update=shown.append)

    fake = types.SimpleNamespace(HTML=str, display=display)
    monkeypatch.setitem(sys.modules, "IPython.display", fake)  # type: ignore[arg-type]
    bar = progress_bars.NotebookBar()
    bar.show("a < b", 0.5, 3.0, 3.0)
    bar.show("a < b", None, 4.0, None)
    bar.close()
    assert shown == [
        '<progress max="1" value="0.500" aria-label="a &lt; b"></progress> '
        "a &lt; b 50 %, 3 s, about 3 s left",
        '<progress max="1" aria-label="a &lt; b"></progress> a &lt; b 4 s',
        "",
    ]


def test_functions_are_told_fractions_that_grow_to_one() -> None:
    scan = fx.ConeVec.circular(sod=60, sdd=100, angles=12, shape=(8, 8), pixel=1)
    grid = fx.Grid((8, 8, 8), 0.5)
    body = fx.Volume(np.full((8, 8, 8), 0.02, np.float32), 0.5)
    images = fx.project(body, scan, progress=False)
    calls: dict[str, Callable[[Any], object]] = {
        "sirt": lambda told: fx.sirt(images, scan, grid, iterations=4, progress=told),
        "cgls": lambda told: fx.cgls(images, scan, grid, iterations=4, progress=told),
        "tv": lambda told: fx.tv(images, scan, grid, iterations=4, progress=told),
        "project": lambda told: fx.project(body, scan, progress=told),
    }
    for name, call in calls.items():
        told: list[float] = []
        call(told.append)
        assert told == sorted(told), name
        assert told[-1] == 1.0, name
        assert name == "project" or len(told) >= 2, name
    with pytest.raises(fx.TwinError, match="progress"):
        fx.sirt(images, scan, grid, progress="yes")  # type: ignore[arg-type]
