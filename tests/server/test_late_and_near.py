"""What a late subscriber hears of the log; what is said of a correction that brings parts
near."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import pytest
from lab import Process, Wire, twin


@pytest.fixture(scope="module")
def server(rays: Process, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Process]:
    process = twin(rays.port, tmp_path_factory.mktemp("data"), "--speed-up", "max")
    yield process
    process.end()


def logged(wire: Wire, count: int) -> list[dict[str, Any]]:
    """Entries of the log, once there are `count`; they go out in slices between the
    requests."""
    until = time.monotonic() + 60.0
    while True:
        wire.call("session.ping")
        heard = [e for e in wire.events if e["topic"] == "log"]
        if len(heard) >= count:
            return heard
        assert time.monotonic() < until, f"{len(heard)} of {count}"


@pytest.mark.slow
def test_who_comes_late_gets_the_last_entries_of_the_log_once(server: Process) -> None:
    early, late = Wire(server.port), Wire(server.port)
    early.call("state.subscribe", topics=["log"])
    for number in range(60):
        early.call("calibration.apply", parameters={"dO_x": 0.01}, name=f"c{number}")
    heard = logged(early, 60)
    late.call("state.subscribe", topics=["state", "log"])
    assert logged(late, 50) == heard[-50:]  # sequence numbers and times included
    late.call("state.subscribe", topics=["log"], max_rate_hz=5.0)
    late.call("state.unsubscribe", topics=["log"])
    early.call("calibration.revert")
    late.call("state.subscribe", topics=["log"])
    seqs = [e["seq"] for e in logged(late, 51)]
    assert seqs == [e["seq"] for e in logged(early, 61)[-51:]], (
        "nothing twice, nothing missed"
    )
    for _ in range(59):
        early.call("calibration.revert")
    assert early.call("calibration.get")["correction"] is None
    early.close()
    late.close()


@pytest.mark.slow
def test_a_correction_that_would_bring_parts_too_close_is_refused(
    server: Process,
) -> None:
    wire = Wire(server.port)
    refused = wire.ask("axes.move", targets={"mag_det": 100.0})["error"]
    assert refused["code"] == -32002
    nearest = refused["data"]["last_free"]["mag_det"]
    wire.call("axes.move", targets={"mag_det": nearest + 2.0}, wait=True)
    before = wire.call("calibration.apply", parameters={"dD_z": 1.0})
    assert before["warnings"] == []
    said = wire.ask("calibration.apply", parameters={"dD_z": -5.0})["error"]
    assert said["code"] == -32002
    assert "would be too close; nothing changes" in said["message"]
    assert any("detector" in part for part in said["data"]["pair"])
    assert wire.call("calibration.get")["correction"] == before["correction"]
    assert wire.call("calibration.list")["current"] == before["correction"]["name"]
    assert wire.call("calibration.revert")["warnings"] == []
    wire.close()
