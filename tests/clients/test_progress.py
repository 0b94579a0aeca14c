"""One `progress=` for every long call: a bar after a while, silence, or the caller's
function."""

from __future__ import annotations

import inspect
import io
import logging
import re
import sys
import threading
import time
import types
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import flexdt as fx
from flexdt.clients.cli import console
from flexdt.runtime import progress as sink
from flexdt.twin import long_work

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
    # pytest sets its own in `sys` once more
    monkeypatch.setattr(sink, "standard_error", lambda: shown)
    monkeypatch.setattr(long_work, "LINE_INTERVALS_S", (0.05,))
    monkeypatch.setattr(sink, "DRAWN_S", 0.02)
    monkeypatch.setattr(sink, "_past", {})
    monkeypatch.setattr(sink, "in_notebook", lambda: False)
    monkeypatch.setattr(sink.LOG, "hasHandlers", lambda: False)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    return shown


def on_screen(text: str) -> str:
    """What a terminal shows in the end after this output, its empty lines left out."""
    rows, at = [""], 0
    for control, printed in re.findall(
        r"(\x1b\[[0-9;?]*[A-Za-z]|[\r\n])|([^\x1b\r\n]+)", text
    ):
        if printed:
            rows[at] += printed
        elif control == "\n":
            at += 1
            rows += [""] * (at == len(rows))
        elif control == "\x1b[2K":
            rows[at] = ""
        elif control.endswith("A"):
            at -= int(control[2:-1])
    return "\n".join(filter(None, rows))


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
        until(lambda: "75 %" in screen.getvalue())
    assert on_screen(screen.getvalue()) == ""
    drawn = screen.getvalue()
    time.sleep(0.1)
    assert screen.getvalue() == drawn


def test_works_of_two_threads_have_a_row_each(screen: Terminal) -> None:
    go_on = threading.Event()

    def other() -> None:
        with long_work.during("searching [b]"):
            go_on.wait(30.0)

    beside = threading.Thread(target=other)
    with long_work.during("measuring") as advance:
        beside.start()
        advance(0.5, "1 of 2 images")
        until(lambda: len(on_screen(screen.getvalue()).splitlines()) == 2)
        until(lambda: "1 of 2 images, 50 %" in on_screen(screen.getvalue()))
        assert "searching [b]" in on_screen(screen.getvalue())
        go_on.set()
        beside.join()
        until(lambda: len(on_screen(screen.getvalue()).splitlines()) == 1)
        assert "measuring" in on_screen(screen.getvalue())
    assert on_screen(screen.getvalue()) == ""


def test_a_bar_makes_room_for_a_line_and_comes_back(
    screen: Terminal, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The line goes where its stream goes: standard output has no bar."""
    with long_work.during("measuring"):
        until(lambda: "measuring" in screen.getvalue())
        monkeypatch.setattr(sink, "DRAWN_S", 30.0)
        time.sleep(0.1)
        console.say("a result")
        assert on_screen(screen.getvalue()) == ""
    assert capsys.readouterr().out == "a result\n"


def test_the_whole_is_shown_at_the_end_only(screen: Terminal) -> None:
    with long_work.during("measuring") as advance:
        advance(1.0)
        until(lambda: "99 %" in screen.getvalue())
    assert "100" not in screen.getvalue()


def test_a_terminal_that_cannot_draw_gets_lines(
    screen: Terminal, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("TERM", "dumb")
    with long_work.during("measuring"):
        until(lambda: caplog.messages)
    assert caplog.messages[0] == "flexdt: still measuring (0 s)"
    assert screen.getvalue() == ""


def test_a_terminal_that_went_away_ends_no_work(
    screen: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    with long_work.during("measuring"):
        until(lambda: "measuring" in screen.getvalue())
        screen.close()
        time.sleep(0.1)


def test_no_estimate_while_another_thread_compiles(
    screen: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(long_work, "LEAST_LEFT_S", 0.0)
    with long_work.during("measuring") as advance:
        for done in (0.1, 0.2, 0.3):
            time.sleep(0.2)
            advance(done)
        until(lambda: "30 %, 1 s, about 1 s left" in screen.getvalue())
        compiles = threading.Event()

        def other() -> None:
            with long_work.during("compiling a kernel"):
                compiles.wait(30.0)

        beside = threading.Thread(target=other)
        beside.start()
        until(lambda: "compiling a kernel" in screen.getvalue())
        drawn = len(screen.getvalue())
        time.sleep(0.2)
        assert "30 %" in screen.getvalue()[drawn:]
        assert "left" not in screen.getvalue()[drawn:]
        compiles.set()
        beside.join()


def test_work_that_fails_is_taken_off(screen: Terminal) -> None:
    told: list[float] = []

    def fail(progress: Any) -> None:
        with long_work.during("measuring", progress) as report:
            report(1.0)
            until(lambda: "measuring" in screen.getvalue())
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail(None)
    assert on_screen(screen.getvalue()) == ""
    with pytest.raises(ZeroDivisionError):
        fail(told.append)
    assert told == []


def test_a_program_is_shown_until_its_first_words(screen: Terminal) -> None:
    """Imports and plans of a command are no silence; its own work is shown in its place."""
    with sink.silence_shown("at flexdt check") as first_words:
        until(lambda: "at flexdt check" in screen.getvalue())
        with long_work.during("measuring") as advance:
            advance(0.25)
            until(lambda: "25 %" in screen.getvalue())
            until(lambda: "at flexdt check" not in on_screen(screen.getvalue()))
            drawn = len(screen.getvalue())
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
    monkeypatch.setattr(long_work, "LINE_INTERVALS_S", (30.0,))
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
        monkeypatch.setattr(sink.LOG, "level", logging.ERROR)
        sink.LOG.manager._clear_cache()  # type: ignore[attr-defined]
        progress = None
    chosen = told.append if progress == "function" else progress
    with long_work.during("measuring", chosen) as advance, long_work.during("compiling"):
        advance(0.5)
        time.sleep(0.2)
    assert screen.getvalue() == ""
    assert told == ([0.5, 1.0] if progress == "function" else [])
    sink.LOG.manager._clear_cache()  # type: ignore[attr-defined]


def test_a_program_that_handles_the_log_gets_lines(
    screen: Terminal, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.undo()
    monkeypatch.setattr(long_work, "LINE_INTERVALS_S", (0.05,))
    with long_work.during("measuring") as advance:
        advance(0.25)
        advance(0.5)
        until(lambda: caplog.messages)
    assert caplog.messages[0] == "flexdt: still measuring (50 %, 0 s)"
    assert caplog.records[0].name == "flexdt.progress"


def test_works_that_follow_each_other_are_one_wait(
    screen: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Thirty kernels of a second each are half a minute; other work begins at 0 s."""
    monkeypatch.setattr(long_work, "LINE_INTERVALS_S", (0.3,))
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
    monkeypatch.setattr(long_work, "LINE_INTERVALS_S", (0.3,))
    for _ in range(4):
        with long_work.during("calibrating"):
            time.sleep(0.1)
    assert screen.getvalue() == ""


def test_a_notebook_s_bar_is_one_display(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []

    def display(what: str, display_id: bool) -> Any:
        assert display_id
        shown.append(what)
        return types.SimpleNamespace(update=shown.append)

    fake = types.SimpleNamespace(HTML=str, display=display)
    monkeypatch.setitem(sys.modules, "IPython.display", fake)  # type: ignore[arg-type]
    bar = sink.NotebookBar()
    bar.show("a < b", 0.5, "50 %, 3 s, about 3 s left")
    bar.show("a < b", None, "4 s")
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


def test_a_calibration_names_its_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    entered: list[str] = []
    shown = long_work.during

    def during(what: str, progress: long_work.Progress = None) -> Any:
        entered.append(what)
        return shown(what, progress)

    monkeypatch.setattr(long_work, "during", during)
    scan = fx.ConeVec.circular(
        sod=600, sdd=1059, angles=16, shape=(304, 382), pixel=0.374
    )
    fx.calibrate(fx.simulate("lego", scan, noise=1), "lego")
    stages = [what for what in dict.fromkeys(entered) if "compiling" not in what]
    assert stages[stages.index("calibrating") :] == [
        "calibrating",
        "finding the beads",
        "fitting",
        "measuring the beads again",
        "looking for causes of the residuals",
    ]
