"""A rule about settings of tube or camera that is added to `changed_tube` or `changed_camera` holds
at every door: requests, scenes, restarts, scripts, followed machines, forecasts, batches.

Motors have their own test (`tests/twin/test_limit_doors.py`).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import in_process
import pytest
from in_process import Lab, M, P, run
from pydantic import ValidationError
from scanner_traffic import event

import flexdt as fx
from flexdt.clients.following.hearing import heard
from flexdt.phantoms.scan_limits import check_distances, check_tube
from flexdt.protocol import RpcError
from flexdt.server.storage import memory, scene_document
from flexdt.server.storage.journal import content_of, record_of
from flexdt.twin.errors import LimitError
from flexdt.twin.following.follower import Follower
from flexdt.twin.following.mirror import Mirror
from flexdt.twin.machine.description import DetectorSpec, Machine, TubeSpec
from flexdt.twin.physics.exposure import ExposureSettings
from flexdt.twin.scanner import state
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import TubeSettings
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.planning.planner import plan_script
from flexdt.twin.script.scan_request import ScanRequest

BALL = {"kind": "sphere", "center": [0, 0, 0], "radius": 8, "material": "aluminium"}
WORDS = "a rule that was added"
Asked = dict[str, float]
SOFTEST = M.model_copy(update={"tube": M.tube.model_copy(update={"min_kV": 40.0})})
RULES: dict[str, tuple[Machine, Asked]] = {
    "min_kV": (SOFTEST, {"kV": 39.0}),
    "max_kV": (M, {"kV": M.tube.max_kV + 1.0}),
    "max_W": (M, {"power_W": M.tube.max_W + 1.0}),
    "min_exposure_ms": (M, {"exposure_ms": 0.5 * M.detector.min_exposure_ms}),
    "max_exposure_ms": (M, {"exposure_ms": M.detector.max_exposure_ms + 1.0}),
}
"""Figure of a machine -> a machine with it, and a setting beyond it."""
LINES = {"kV": ("tube", "set kV"), "power_W": ("tube", "set power"),
         "exposure_ms": ("camera", "set exposure")}  # fmt: skip


def part_of(asked: Asked) -> str:
    """Whose setting it is."""
    return "camera" if "exposure_ms" in asked else "tube"


def at_start(machine: Machine) -> Asked:
    tube = machine.tube
    return {"kV": tube.kV, "power_W": tube.power_W,
            "exposure_ms": machine.detector.exposure_ms}  # fmt: skip


def refused(call: Callable[[], object]) -> str:
    """The message of a LimitError; "" where it was done."""
    try:
        call()
    except LimitError as error:
        return error.message
    return ""


# Each door returns how a setting is refused; "" where it is not.


def by_request(machine: Machine, asked: Asked, _: Path) -> str:
    scanner = ScannerTwin(machine, P)
    done = {"camera": scanner.set_camera, "tube": scanner.set_tube}[part_of(asked)]
    return refused(lambda: done(**asked))  # type: ignore[operator]


def remembered(machine: Machine, asked: Asked) -> Any:
    """What a server has kept of a scanner that once had this setting."""
    scanner = ScannerTwin(machine, P)
    record = record_of(content_of(scanner, 0.0), 1)
    saved = memory.remember(scanner, 0.0, record, 0, [])
    kept: Any = saved.scene
    new = getattr(kept, part_of(asked)).model_copy(update=asked)
    return saved.model_copy(
        update={"scene": kept.model_copy(update={part_of(asked): new})}
    )


def by_scene(machine: Machine, asked: Asked, _: Path) -> str:
    scene = remembered(machine, asked).scene
    return refused(lambda: scene_document.require_fit(scene, ScannerTwin(machine, P)))


def by_restart(machine: Machine, asked: Asked, _: Path) -> str:
    """What is remembered is not set; the reason is in the log."""
    scanner, logged = ScannerTwin(machine, P), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(memory, "log", lambda *_, **facts: logged.append(facts["reason"]))
        memory.restore(remembered(machine, asked), scanner)
    [(name, value)] = asked.items()
    at = getattr(getattr(scanner, part_of(asked)), name)
    assert at == (at_start(machine)[name] if logged else value)
    return " ".join(logged)


def by_script(machine: Machine, asked: Asked, _: Path) -> str:
    [(name, value)] = asked.items()
    line = "\t".join((*LINES[name], repr(value), "", "ACK", "", ""))
    found = plan_script(line, machine, P).problems
    return " ".join(p.message for p in found if p.severity == "error")


def by_following(machine: Machine, asked: Asked, _: Path) -> str:
    [(name, value)] = asked.items()
    said = heard(event(1, (*LINES[name], repr(value))), machine.axes, "00:00:03.000")
    mirror = Follower(machine, P).hear(Mirror.of(machine), said, 3.0)
    return " ".join(alarm.message for alarm in mirror.alarms)


def by_composing(machine: Machine, asked: Asked, _: Path) -> str:
    request = ScanRequest("step", **asked)  # type: ignore[arg-type]
    return refused(lambda: compose_script(request, machine, P))


def by_forecast(machine: Machine, asked: Asked, _: Path) -> str:
    return refused(lambda: fx.expose(BALL, machine=machine, **asked))  # type: ignore[arg-type]


def by_batch(machine: Machine, asked: Asked, _: Path) -> str:
    exposure = ExposureSettings(**(at_start(machine) | asked))
    if part_of(asked) == "tube":
        return refused(lambda: check_tube(machine, exposure))
    camera = machine.detector.camera
    return refused(lambda: check_distances(machine, camera, exposure, 600, 1059))


def by_image(machine: Machine, asked: Asked, root: Path) -> str:
    """A request for an image with this setting, without setting it."""
    told: list[str] = []

    async def body(lab: Lab) -> None:
        try:
            await lab.client().call("projection.get", **{part_of(asked): asked})
        except (LimitError, RpcError) as error:
            told.append(error.message)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(in_process, "M", machine)
        run(root, body)
    return " ".join(told)


Door = Callable[[Machine, Asked, Path], str]
DOORS: tuple[Door, ...] = (by_request, by_scene, by_restart, by_script, by_following,
                           by_composing, by_forecast, by_batch, by_image)  # fmt: skip


@pytest.fixture
def rule(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tube may not have 70 kV or 33 W, the camera not 222 ms; in all modules of flexdt."""

    def no_tube(*args: Any, **named: Any) -> Any:
        new = tube(*args, **named)
        if new.kV == 70.0 or new.power_W == 33.0:
            raise LimitError(WORDS, {"setting": "kV"})
        return new

    def no_camera(*args: Any, **named: Any) -> Any:
        new = camera(*args, **named)
        if new.exposure_ms == 222.0:
            raise LimitError(WORDS, {"setting": "exposure_ms"})
        return new

    tube, camera = state.changed_tube, state.changed_camera
    for old, new in ((tube, no_tube), (camera, no_camera)):
        for title, module in [*sys.modules.items()]:
            if title.startswith("flexdt") and getattr(module, old.__name__, None) is old:
                monkeypatch.setattr(module, old.__name__, new)


@pytest.mark.parametrize("name", LINES)
@pytest.mark.parametrize("door", DOORS)
def test_a_rule_that_is_added_holds_at_every_door(
    door: Door, name: str, rule: None, tmp_path: Path
) -> None:
    value = {"kV": 70.0, "power_W": 33.0, "exposure_ms": 222.0}[name]
    assert WORDS in door(M, {name: value}, tmp_path)
    (tmp_path / "other").mkdir()
    assert not door(M, {name: value + 1.0}, tmp_path / "other")


@pytest.mark.parametrize("figure", RULES)
@pytest.mark.parametrize("door", DOORS)
def test_the_rule_of_a_figure_holds_at_every_door(
    door: Door, figure: str, tmp_path: Path
) -> None:
    machine, asked = RULES[figure]
    assert door(machine, asked, tmp_path)


def test_every_figure_that_limits_settings_has_a_case() -> None:
    figures = [*TubeSpec.model_fields, *DetectorSpec.model_fields]
    assert {f for f in figures if f.startswith(("min_", "max_"))} <= set(RULES)


@pytest.mark.parametrize(
    ("spec", "start"),
    [
        (
            M.tube,
            lambda s: state.changed_tube(s, TubeSettings(s.kV, s.power_W), None, None),
        ),
        (M.detector, lambda s: state.changed_camera(s, s.camera, {})),
    ],
    ids=["tube", "detector"],
)
def test_a_machine_starts_with_settings_that_it_allows(
    spec: TubeSpec | DetectorSpec, start: Callable[[Any], object]
) -> None:
    """Each number of the machine file in turn has another value, or is refused there."""
    tried = 0
    for name in type(spec).model_fields:
        for value in (0.0, 1e-3, 0.1, 1, 2, 50.0, 200.0, 1e3, 1e5, 1e7):
            try:
                other = type(spec).model_validate(spec.model_dump() | {name: value})
            except ValidationError:
                continue
            tried += 1
            assert not refused(lambda other=other: start(other)), (name, value)  # type: ignore[misc]
    assert tried > 30


def test_what_may_not_be_is_not_proposed(rule: None) -> None:
    proposed = {setting.kV for setting in fx.expose(BALL, machine=M, images=10).best}
    assert {60.0, 80.0} <= proposed
    assert 70.0 not in proposed
