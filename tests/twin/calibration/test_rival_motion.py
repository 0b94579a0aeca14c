"""What moves beside what else may move, in drawn scans whose shadows are `faults_drawn`'s."""

from __future__ import annotations

import pytest
from causes_named import calibrated, worst_error
from faults_drawn import drawn

from flexdt.twin.calibration.pipeline import Calibration

OBJECT = ("dO_x", "dO_y", "dO_z", "alpha")


def moving(result: Calibration) -> set[str]:
    (motion,) = result.motions
    return {n for n, v in zip(motion.names, motion.values.T, strict=True) if v.any()}


def codes(result: Calibration) -> list[str]:
    return [f.code for f in result.findings]


@pytest.mark.parametrize("asked", [OBJECT, ("dO_x",), ("dO_y", "dO_z")])
def test_a_source_that_jumps_is_not_followed_as_an_object(asked: tuple[str, ...]) -> None:
    """It was followed as the object, 5.8 sigmas off; asked for another axis it was refused."""
    scan = drawn("source_jumps", 9304)
    result = calibrated(scan, asked)
    assert result.identifiable, result.findings
    assert moving(result) == {"dS_x"}
    assert worst_error(result, scan)[0] < 4.0
    assert codes(result) == ["other_motion"]
    (said,) = (f.text for f in result.findings)
    assert "the source moves aside (dS_x)" in said


def test_an_unasked_jump_of_the_source_is_named_with_its_frame() -> None:
    (said,) = calibrated(drawn("source_jumps", 9304)).errors
    assert said.text.startswith("dS_x by 0.2")
    assert "at frame 44" in said.text
    assert "dS_x follows it" in said.text


@pytest.mark.parametrize(
    ("kind", "seed", "asked", "moves"),
    [
        ("object_jumps", 40002, ("dS_x",), {"dO_x"}),
        ("panel_jumps", 40001, ("dO_x",), {"dD_x"}),
        ("object_jumps_along", 40001, ("dS_x", "dS_y"), {"dO_z"}),
        ("object_jumps_up", 40002, ("dS_x",), {"dO_y"}),
        ("slip", 40003, ("dS_x", "dO_z"), {"alpha"}),
    ],
)
def test_what_jumps_is_followed_and_not_what_was_asked_for(
    kind: str, seed: int, asked: tuple[str, ...], moves: set[str]
) -> None:
    scan = drawn(kind, seed)
    result = calibrated(scan, asked)
    assert result.identifiable, result.findings
    assert moving(result) == moves
    assert worst_error(result, scan)[0] < 4.0
