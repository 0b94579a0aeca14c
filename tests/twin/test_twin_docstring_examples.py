"""The examples in the docstrings of projection and reconstruction give what they print."""

from __future__ import annotations

import doctest
from importlib import import_module

import pytest

MODULES = (
    "flexdt.twin.projection.analytic",
    "flexdt.twin.projection.operators",
    "flexdt.twin.projection.analytic",
    "flexdt.twin.projection.operators",
    "flexdt.twin.projection.volume",
    "flexdt.twin.reconstruction.checked_fdk",
    "flexdt.twin.reconstruction.iterative",
    "flexdt.twin.reconstruction.acquisition.rectify",
)


@pytest.mark.parametrize("name", MODULES)
def test_examples(name: str) -> None:
    result = doctest.testmod(import_module(name))
    assert result.attempted > 0
    assert result.failed == 0
