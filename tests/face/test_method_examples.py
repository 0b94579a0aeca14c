"""Each method of a value that `import flexdt as fx` gives has an example, and the example
holds."""

from __future__ import annotations

import doctest
import inspect
import sys
from collections.abc import Iterator
from typing import Any

import pytest

import flexdt as fx

CLIENTS = ("AsyncTwinClient", "TwinClient", "LocalTwin")
"""Need a running twin: see tests/clients/test_method_examples.py."""
WITHOUT = {
    "ConeVec.to_tomosipo": "tomosipo is not a test's dependency",
    "ConeVec.to_cil": "nor is CIL, which has no wheels",
    "ConeVec.to_leap": "nor is LEAP",
    "ConeVec.to_tigre": "nor is TIGRE",
    "Operator.cil": "nor is CIL",
    "Operator.odl": "nor is ODL",
    "Operator.torch": "nor is PyTorch",
    "DataSet.align": "of seconds; flexdt.align shows it",
    "DataSet.calibrate": "of seconds; flexdt.calibrate shows it",
}


def classes() -> Iterator[type]:
    for name in fx.__all__:
        found = getattr(fx, name)
        if inspect.isclass(found) and name not in CLIENTS:
            yield found


def methods(of: type) -> Iterator[tuple[str, Any]]:
    for name, found in inspect.getmembers(of, inspect.isroutine):
        if not name.startswith("_") and str(getattr(found, "__module__", "")).startswith(
            "flexdt"
        ):
            yield f"{of.__name__}.{name}", found


def test_each_method_has_an_example_but_those_that_say_why_not() -> None:
    every = dict(pair for of in classes() for pair in methods(of))
    assert len(every) > 50
    without = {
        name for name, found in every.items() if ">>>" not in (found.__doc__ or "")
    }
    assert without == set(WITHOUT)


@pytest.mark.parametrize("home", sorted({of.__module__ for of in classes()}))
def test_the_examples_hold(home: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    result = doctest.testmod(sys.modules[home])
    assert result.attempted > 0
    assert result.failed == 0
