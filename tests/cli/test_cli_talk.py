"""`-q` shows no progress and keeps warnings; `-v` says what took time. Both go before or
after."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from flexdt.clients.cli import console
from flexdt.clients.cli.command_tree import run
from flexdt.runtime.progress import LOG, shown_work
from flexdt.twin import long_work

LISTING = str(Path(__file__).parents[2] / "examples" / "scripts" / "listing1.txt")


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    """Take back what a command line sets for its process."""
    level, root = LOG.level, [*logging.getLogger().handlers]
    yield
    LOG.setLevel(level)
    console.speak(quiet=False, verbose=False)
    logging.getLogger().handlers[:] = root


def work_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in units, with lines after 20 ms where lines are written."""
    monkeypatch.setattr(long_work, "LINE_INTERVALS_S", (0.02, 60.0))
    # As in a program that handles no records: they go to standard error.
    monkeypatch.setattr(LOG, "hasHandlers", lambda: False)
    monkeypatch.setattr(LOG, "propagate", False)
    with shown_work("scanning") as report:
        long_work.in_units(report, "frames")(1, 3)
        time.sleep(0.3)


@pytest.mark.parametrize(
    "words", [["-q", "check", LISTING], ["check", LISTING, "--quiet"]]
)
def test_quiet_keeps_warnings_and_shows_no_progress(
    words: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert run(words) == 0
    assert "mag_det target 1060 mm is outside" in capsys.readouterr().err
    assert not LOG.isEnabledFor(logging.WARNING)
    work_for_a_while(monkeypatch)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "words", [["-v", "check", LISTING], ["check", LISTING, "--verbose"]]
)
def test_verbose_logs_how_long_works_took(words: list[str]) -> None:
    assert run(words) == 0
    assert LOG.isEnabledFor(logging.INFO)


def test_without_either_progress_is_shown(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(["check", LISTING]) == 0
    work_for_a_while(monkeypatch)
    err = capsys.readouterr().err
    assert "flexdt: still scanning (1 of 3 frames, 33 %, 0 s)\n" in err
