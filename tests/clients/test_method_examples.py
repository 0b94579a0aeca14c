"""Each method of the wire that the clients have shows an example, and what it shows holds."""

from __future__ import annotations

import doctest
import inspect
from contextlib import ExitStack

import pytest

import flexdt as fx
from flexdt import testing
from flexdt.clients import TwinClient
from flexdt.clients.client import twin_methods

METHODS = {
    name: found
    for name, found in inspect.getmembers(twin_methods, inspect.isfunction)
    if hasattr(TwinClient, name) and found.__module__ == twin_methods.__name__
}


def test_each_method_has_an_example() -> None:
    assert len(METHODS) > 35
    assert [
        name for name, found in METHODS.items() if ">>>" not in (found.__doc__ or "")
    ] == []


@pytest.mark.slow
@pytest.mark.parametrize("place", ["server", "process"])
@pytest.mark.campaign(1)
def test_the_examples_hold(place: str, request: pytest.FixtureRequest) -> None:
    """Of a server, and of a twin in this process."""
    finder, runner = (
        doctest.DocTestFinder(recurse=False),
        doctest.DocTestRunner(verbose=False),
    )
    with ExitStack() as stack:
        if place == "server":
            address = request.getfixturevalue("servers").address
            twin = stack.enter_context(TwinClient(*address))
        else:
            twin = stack.enter_context(testing.twin(sample="lego", speed_up="max")).client
        # In the order of the page: an example finds the twin as those before it left it.
        for name, found in sorted(
            METHODS.items(), key=lambda m: m[1].__code__.co_firstlineno
        ):
            given = {**vars(twin_methods), "fx": fx, "twin": twin}
            for test in finder.find(found, name, globs=given):
                runner.run(test)
    assert runner.summarize(verbose=False).failed == 0
