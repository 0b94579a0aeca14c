"""`-q` shows no progress and keeps warnings; `-v` says what took time. Both go before or
after."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

from flexdt.clients.cli import console
from flexdt.clients.cli.command_tree import run
from flexdt.runtime.progress_lines import LOG

LISTING = str(Path(__file__).parents[2] / "examples" / "scripts" / "listing1.txt")


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    """Take back what a command line sets for its process."""
    level, root = LOG.level, [*logging.getLogger().handlers]
    yield
    LOG.setLevel(level)
    console.speak(quiet=False, verbose=False)
    logging.getLogger().handlers[:] = root


@pytest.mark.parametrize(
    "words", [["-q", "check", LISTING], ["check", LISTING, "--quiet"]]
)
def test_quiet_keeps_warnings_and_shows_no_progress(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(words) == 0
    assert "mag_det target 1060 mm is outside" in capsys.readouterr().err
    assert not LOG.isEnabledFor(logging.WARNING)
    with console.ProgressBar(
        "scanning", terminal=False, clock=iter(range(0, 900, 9)).__next__
    ) as bar:
        bar.update(1, 3)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "words", [["-v", "check", LISTING], ["check", LISTING, "--verbose"]]
)
def test_verbose_logs_how_long_works_took(words: list[str]) -> None:
    assert run(words) == 0
    assert LOG.isEnabledFor(logging.INFO)


def test_without_either_progress_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", LISTING]) == 0
    with console.ProgressBar(
        "scanning", terminal=False, clock=iter(range(0, 900, 9)).__next__
    ) as bar:
        bar.update(1, 3)
    assert "scanning: 1 of 3 frames" in capsys.readouterr().err
