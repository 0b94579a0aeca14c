"""Structured logs: every line is one JSON object, with a traceback only where something
failed."""

from __future__ import annotations

import io
import json
import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

from flexdt.runtime.log import LOGGER, log, set_up


@pytest.fixture
def lines() -> Iterator[io.StringIO]:
    before = (LOGGER.handlers[:], LOGGER.level, LOGGER.propagate)
    stream = io.StringIO()
    set_up(stream)
    yield stream
    LOGGER.handlers[:], LOGGER.level, LOGGER.propagate = before


def test_facts_and_levels(lines: io.StringIO) -> None:
    log("job started", job="job-1", file=Path("x"), frames=3)
    log("slow", logging.WARNING)
    log("not shown", logging.DEBUG)
    first, second = (json.loads(line) for line in lines.getvalue().splitlines())
    assert first.pop("time").endswith("Z")
    assert first == {
        "level": "info", "event": "job started", "job": "job-1", "file": "x", "frames": 3,
    }  # fmt: skip
    assert second["level"] == "warning"
    assert "traceback" not in second


def test_a_failure_brings_its_traceback_on_one_line(lines: io.StringIO) -> None:
    try:
        raise KeyError("lost\nkey")
    except KeyError:
        log("handler failed", logging.ERROR, error=True, method="x")
    [line] = lines.getvalue().splitlines()
    document = json.loads(line)
    assert document["method"] == "x"
    assert document["traceback"].splitlines()[-1].startswith("KeyError")


def test_an_event_with_percent_signs_is_text(lines: io.StringIO) -> None:
    log("100 %s done", done="%d")
    assert json.loads(lines.getvalue())["event"] == "100 %s done"
