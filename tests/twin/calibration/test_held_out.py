"""Blocks of frames are predicted by the others in right scans, and not in those of causes that no
table has: point tracks of drawn scanners, by the rays of `faults_drawn`."""

from __future__ import annotations

import outside_kinds
import pytest

from flexdt.twin.calibration.diagnose.table import explained, verdict
from flexdt.twin.calibration.diagnose.table.group import Family, Known
from flexdt.twin.calibration.diagnose.table.groups import every_family, strain
from flexdt.twin.calibration.diagnose.table.held_out import HeldOut, held_out
from flexdt.twin.calibration.diagnose.table.linearised import Linearised
from flexdt.twin.calibration.pipeline import Calibration

STRANGE = (
    "relaxing", "breathing", "growing", "focal_walk", "encoder", "walking", "swinging", "jump",
    "fifth_degree", "gap", "loose", "bowed",
)  # fmt: skip
"""Not what differs from frame to frame alone, which no neighbour shares."""


def judged(
    monkeypatch: pytest.MonkeyPatch, kind: str, seed: int
) -> tuple[Calibration, HeldOut]:
    """A calibration, and what its last table has of blocks left out."""
    seen = []

    def kept(*arguments: object) -> HeldOut:
        seen.append(held_out(*arguments))  # type: ignore[arg-type]
        return seen[-1]

    monkeypatch.setattr(verdict, "held_out", kept)
    found = outside_kinds.calibrated(outside_kinds.drawn(kind, seed))
    return found, seen[-1]


@pytest.mark.parametrize("seed", range(60))
@pytest.mark.slow
@pytest.mark.campaign(2)
def test_right_scans_predict_their_frames(
    monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    found, held = judged(monkeypatch, "right", 5000 + seed)
    assert held.chance > 1e-3 / 6.0  # of 60 scans one in a hundred campaigns
    assert not any("predict" in f.text for f in found.findings)


@pytest.mark.parametrize("kind", sorted(STRANGE))
@pytest.mark.parametrize("seed", [5300, 5301])
@pytest.mark.slow
@pytest.mark.campaign(3)
def test_what_no_table_describes_is_told(
    monkeypatch: pytest.MonkeyPatch, kind: str, seed: int
) -> None:
    """The table has no group but the phantom's own shape and errors of positions."""

    def no_dictionary(table: Linearised, known: Known) -> tuple[Family, ...]:
        return tuple(
            f for f in every_family(table, known) if f.always or f.cause == strain.NAME
        )

    monkeypatch.setattr(explained, "every_family", no_dictionary)
    found, held = judged(monkeypatch, kind, seed)
    assert held.chance < 1e-3
    told = any("predict" in f.text for f in found.findings)
    assert told or found.errors, found.findings
