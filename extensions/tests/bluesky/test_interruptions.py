"""Plans that are paused and suspended make valid documents; the whole study is a command.

`python tests/studies/bluesky_interruptions.py` draws a hundred runs.
"""

from __future__ import annotations

import copy
import random
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import bluesky.plans as bp
import pytest
from bluesky.run_engine import call_in_bluesky_event_loop as drive
from bluesky.simulators import summarize_plan
from bluesky.utils import IllegalMessageSequence, RunEngineInterrupted
from bluesky_interruptions import (
    PLANS,
    Documents,
    Drawn,
    Interruption,
    Study,
    begin,
    draw,
    problems_of,
)
from ophyd_async.core import StaticPathProvider, UUIDFilenameProvider, init_devices

from flexdt.clients.launch.processes import Servers

pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def study(servers: Servers, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Study]:
    study = begin(servers.address, tmp_path_factory.mktemp("camera"))
    yield study
    drive(study.lab.close())


@pytest.mark.parametrize("plan", PLANS)
def test_a_plan_interrupted_at_drawn_moments_makes_valid_documents(
    study: Study, plan: str
) -> None:
    assert study.learn(plan) == []
    for number in range(5):
        drawn = draw(random.Random(f"{plan} {number}"), plan, study.messages[plan])
        found, met = study.try_(drawn)
        assert found == [], met
        if met:
            return
    pytest.fail("no interruption came before the plan's end")


def test_a_suspension_before_each_message_in_turn(study: Study) -> None:
    """All of the first point: checkpoint, trigger, wait, create, read, save, and what
    follows."""
    study.learn("count")
    for message in range(1, 3 + study.messages["count"] // 4):
        drawn = Drawn("count", "max", [Interruption("suspender", message, 0.0, 0.0)])
        found, met = study.try_(drawn)
        assert (found, len(met)) == ([], 1), met


def test_a_pause_after_a_runs_end(study: Study) -> None:
    """Between `close_run` and `unstage`; without the preprocessor the RunEngine measures
    again."""
    engine = study.engine

    def pause(name: str, document: dict[str, Any]) -> None:
        if name == "stop":  # this is the engine's loop, which waits for no other thread
            engine.loop.create_task(engine._request_pause_coro())

    def run() -> None:
        with pytest.raises(RunEngineInterrupted):
            engine(PLANS["count"].make(study.lab), pause)
        engine.resume()

    run()
    left = engine.preprocessors.pop()
    try:
        with pytest.raises(IllegalMessageSequence, match="without an open run"):
            run()
    finally:
        engine.preprocessors.append(left)


def test_the_validator_sees_what_is_wrong(study: Study) -> None:
    study.learn("rel_scan")
    plan, documents = PLANS["rel_scan"], study.documents["rel_scan"]
    assert problems_of(documents, plan, study.reference["rel_scan"]) == []

    def without(kind: str, number: int = -1) -> Callable[[Documents], None]:
        def change(changed: Documents) -> None:
            del changed[[i for i, (k, _) in enumerate(changed) if k == kind][number]]

        return change

    def setting(kind: str, *path: str, value: object) -> Callable[[Documents], None]:
        def change(changed: Documents) -> None:
            inner: Any = [document for k, document in changed if k == kind][-1]
            for key in path[:-1]:
                inner = inner[key]
            inner[path[-1]] = value

        return change

    def doubled(changed: Documents) -> None:
        changed.insert(-1, [c for c in changed if c[0] == "stream_datum"][-1])

    wrong = {
        "frames for the events [1, 2, 4]": without("stream_datum", 2),
        "frames [2, 3) come after 1": without("stream_datum", 1),
        "frames [3, 4) come after 4": doubled,
        "3 events of 4 points": without("event"),
        "0 series of images": without("stream_resource"),
        "frames [3, 5) stand for events": setting(
            "stream_datum", "indices", "stop", value=5
        ),
        "sequence numbers [1, 2, 3, 7]": setting("event", "seq_num", value=7),
        "point 4: lab-rot_obj is 26.0": setting(
            "event", "data", "lab-rot_obj", value=26.0
        ),
        "mean of another image": setting("event", "data", "lab-camera-mean", value=1.0),
        "it ended fail": setting("stop", "exit_status", value="fail"),
        "unknown descriptor": setting("event", "descriptor", value="none"),
        "fails its schema": setting("event", "time", value="late"),
        "stop counts": setting("stop", "num_events", value={"primary": 5}),
    }
    for expected, change in wrong.items():
        changed = copy.deepcopy(documents)
        change(changed)
        try:
            found = problems_of(changed, plan)
        except KeyError as error:
            found = [f"unknown descriptor {error}"]
        assert any(expected in problem for problem in found), (expected, found)
    swapped = dict(study.reference["rel_scan"])
    swapped[1], swapped[2] = swapped[2], swapped[1]
    assert any("shows the pose of" in p for p in problems_of(documents, plan, swapped))


def test_upstreams_own_detector_does_not_survive_a_suspension(
    study: Study, tmp_path: Path
) -> None:
    """What `TwinCamera` works around: when this fails, the workaround may go."""
    from ophyd_async.sim import SimBlobDetector

    with init_devices():
        blob = SimBlobDetector(
            StaticPathProvider(UUIDFilenameProvider(), tmp_path), name="blob"
        )
    seen: list[str] = []

    def trip(message: Any) -> None:
        seen.append(message.command)
        if seen.count("create") == 1 and message.command == "create":
            study.beam.put(True)
            threading.Timer(0.05, study.beam.put, [False]).start()

    study.engine.msg_hook = trip
    with pytest.raises(RuntimeError, match="multiple indices"):
        study.engine(bp.count([blob], num=2))
    study.engine.msg_hook = None


def test_an_axis_that_is_stopped_before_it_moves_stays(study: Study) -> None:
    """A target is checked first, some 50 ms: a pause in that time finds no motion to stop."""
    turn = study.lab.axis("rot_obj")

    async def main() -> tuple[float, float]:
        before = (await turn.locate())["readback"]
        status = turn.set(before + 90.0)
        await turn.stop(success=True)
        await status
        return before, (await study.lab.link.fresh()).axes["rot_obj"].position

    before, after = drive(main())
    assert after == before


def test_a_fly_scan_can_be_read_without_running_it(
    study: Study, capsys: pytest.CaptureFixture[str]
) -> None:
    summarize_plan(PLANS["fly_scan"].make(study.lab))
    assert "fly_scan" not in capsys.readouterr().err
