"""Beads of known places tell the direction of rotation: images need not tell it again."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import pytest

import flexdt as fx
from flexdt.twin.scanner.state import NamedCorrection

SCAN = fx.ConeVec.circular(sod=600, sdd=1059, angles=90, shape=(380, 478), pixel=0.2992)
OTHER_WAY = "the rotation runs the other way"


@pytest.fixture(scope="module")
def data() -> Any:
    return fx.simulate("lego", SCAN, tube=fx.Tube(kV=90), noise=1, progress=False)


@pytest.fixture(scope="module")
def correction(data: Any) -> Any:
    return data.calibrate("lego", progress=False).correction


def told(data: Any) -> list[str]:
    """List the warnings of a reconstruction, but for those about sizes of errors."""
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        data.reconstruct("fdk", voxel=1.0, progress=False)
    said = [str(one.message) for one in given]
    return [one for one in said if not one.startswith("values may be off")]


@pytest.mark.slow
def test_a_right_scan_is_told_of_no_other_direction(data: Any, correction: Any) -> None:
    """Its coarse copy hardly decides; with and without beads that do."""
    assert correction.sides_known
    assert told(data.with_correction(correction)) == []
    unknown = replace(correction, sides_known=False)
    assert told(data.with_correction(unknown)) == []


@pytest.mark.slow
def test_images_that_clearly_run_the_other_way_are_told_all_the_same() -> None:
    """A wrong claim that beads have told the direction hides no contradiction."""
    cone = fx.ConeVec.circular(sod=150, sdd=400, angles=120, shape=(200, 200), pixel=1.0)
    seen = fx.simulate("normal", cone, tube=fx.Tube(kV=90), noise=1, progress=False)
    turned = cone[[0, *range(119, 0, -1)]]
    wrong = replace(seen, cone_vec=turned)
    claimed = NamedCorrection("claimed", "", sides_known=True)
    sentences = told(wrong.with_correction(claimed))
    assert any("contradict" in one and OTHER_WAY in one for one in sentences), sentences
