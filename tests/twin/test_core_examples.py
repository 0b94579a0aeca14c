"""The examples in the docstrings of the core's rooms give what they show."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import pytest

ROOMS = ("collision", "dataset", "exchange", "geometry", "machine", "motion",
         "plausibility", "scanner", "script")  # fmt: skip


@pytest.mark.parametrize("room", ROOMS)
def test_examples(room: str) -> None:
    package = importlib.import_module(f"flexdt.twin.{room}")
    attempted = 0
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        result = doctest.testmod(importlib.import_module(found.name))
        assert result.failed == 0, found.name
        attempted += result.attempted
    assert attempted or room not in ("geometry", "script"), "the examples were not found"
