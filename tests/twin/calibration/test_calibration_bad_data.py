"""Spoilt scans: each named for what it is, none a confident wrong answer (short form)."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from robustness import SURVIVABLE, run_case
from spoilt_scans import Outcome, corrupt, judge

from flexdt.phantoms import load_phantom
from flexdt.twin.calibration.bead_model import bead_model
from flexdt.twin.calibration.diagnose.data import judge_frames
from flexdt.twin.calibration.frame_source import FrameState

LEGO = load_phantom("lego")
OTHER = load_phantom("compact-4").scene


def outcome(kind: str, seed: int = 0) -> Outcome:
    return judge(kind, seed, corrupt(kind, seed, bead_model(LEGO), LEGO.scene, OTHER))[0]


@pytest.mark.parametrize(
    ("kind", "code"),
    [
        # Named in drawn scans in test_calibration_causes.py, and by its volume in
        # test_chiral.py.
        pytest.param("mirrored_phantom", "mirrored_phantom", marks=pytest.mark.slow),
        pytest.param("wrong_phantom", "wrong_phantom", marks=pytest.mark.slow),
        pytest.param("no_beads", "no_beads", marks=pytest.mark.slow),
        pytest.param("one_bead", "one_bead", marks=pytest.mark.slow),
        ("scaled_phantom", "bead_size"),
        pytest.param("image_mirrored", "image_mirrored", marks=pytest.mark.slow),
        # Named from annotated markers in test_calibrate_anybody.py.
        pytest.param("not_turning", "not_turning", marks=pytest.mark.slow),
    ],
)
@pytest.mark.campaign
def test_refused_and_named(kind: str, code: str) -> None:
    found = outcome(kind, 3)
    assert found.refused
    assert code in found.findings


SURVIVED = (
    ("control", None),
    ("half_dark", "frames_dark"),
    ("frames_missing", "frames_missing"),
    ("bead_lost", None),
    ("extra_beads", None),
    ("bead_tolerance", "bead_tolerance"),
    ("low_dose", None),
    ("gradient", None),
)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "code"), SURVIVED)
@pytest.mark.campaign(1)
def test_survived_within_its_own_sigmas(kind: str, code: str | None) -> None:
    found = outcome(kind, 5)
    assert not found.refused
    assert found.worst < 4.0
    if code is not None:
        assert code in found.findings


@pytest.mark.slow
def test_a_blur_of_two_pixels_is_seen_and_allowed_for() -> None:
    """Estimated as 1.7 px at most, it left a bead that touches a face 0.01 px off: 8 sigmas."""
    _, found = run_case(("blurred", 109, "normal-4"))
    assert not found.refused
    assert found.worst < 4.0


@pytest.mark.slow
def test_dead_columns_and_pixels_are_no_shadows() -> None:
    """They were taken for a body and for beads elsewhere: the magnification was 5 sigmas
    off."""
    _, found = run_case(("dead_pixels", 325, "normal-5"))
    assert not found.refused
    assert not {"body_differs", "bead_displaced"} & set(found.findings)
    assert found.worst < 4.0


DRAWN = ("frames_repeated", "vibration", "angle_slip", "angle_jitter", "angle_scale")
"""Of times and angles, not of images: drawn from spots in test_calibration_causes.py."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", [k for k in SURVIVABLE if k not in (*dict(SURVIVED), *DRAWN)]
)
@pytest.mark.campaign(1)
def test_never_confidently_wrong(kind: str) -> None:
    assert not outcome(kind, 1001).wrong


def test_frames_that_nobody_uses_are_an_error_whatever_is_wrong_with_each() -> None:
    scan: Any = SimpleNamespace(name="scan")
    looks: Any = [
        SimpleNamespace(state=state, unusable=None, detections=())
        for state in [FrameState.MISSING] * 5 + [FrameState.DARK] * 5
    ]
    found = judge_frames(scan, looks, None)  # type: ignore[arg-type]
    assert [f.forbids for f in found] == [True, True]
    assert not any("the others are used" in f.text for f in found)
    looks[0].state, looks[0].detections = FrameState.USABLE, (1,)
    found = judge_frames(scan, looks, None)  # type: ignore[arg-type]
    assert [f.forbids for f in found] == [False, False]
    assert all("the others are used" in f.text for f in found)
