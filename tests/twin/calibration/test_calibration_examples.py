"""The examples in the docstrings of calibration's and the phantoms' public functions."""

from __future__ import annotations

import doctest
import importlib

import pytest


@pytest.mark.parametrize(
    ("module", "examples"),
    [
        ("flexdt.twin.calibration.detect.detection", 4),
        ("flexdt.twin.calibration.identify", 13),
        ("flexdt.twin.calibration.fit.fit", 10),
        ("flexdt.twin.calibration.diagnose.identifiability", 8),
        ("flexdt.phantoms.beads", 5),
        ("flexdt.phantoms.samples", 5),
        ("flexdt.phantoms.bricks", 1),
    ],
)
def test_examples_hold(module: str, examples: int) -> None:
    result = doctest.testmod(importlib.import_module(module))
    assert result.failed == 0
    assert result.attempted == examples
