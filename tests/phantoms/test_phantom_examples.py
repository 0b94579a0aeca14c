"""The examples in the docstrings of the phantoms give what they show."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import flexdt.phantoms


def test_examples() -> None:
    attempted = 0
    for found in pkgutil.walk_packages(flexdt.phantoms.__path__, "flexdt.phantoms."):
        result = doctest.testmod(importlib.import_module(found.name))
        assert result.failed == 0, found.name
        attempted += result.attempted
    assert attempted > 20
