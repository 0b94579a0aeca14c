"""The clients' methods are the public functions of `twin_methods`.

`python tests/clients/test_shared_methods.py` writes the list of them anew.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from flexdt.clients.client import client, twin_methods
from flexdt.clients.client import twin_methods as m
from flexdt.protocol.methods.job_messages import SubmitResult

FILE = Path(client.__file__)
HEAD = '    """The methods of the wire; how they wait is the client\'s. Written by `make web`."""\n\n'  # noqa: E501


def lines() -> str:
    functions = inspect.getmembers(twin_methods, inspect.isfunction)
    own = [
        f
        for _, f in functions
        if f.__module__ == twin_methods.__name__ and f.__name__[0] != "_"
    ]
    own.sort(key=lambda f: f.__code__.co_firstlineno)
    return "".join(f"    {f.__name__} = ClientMethod(m.{f.__name__})\n" for f in own)


def parts() -> tuple[str, str, str]:
    """The text before the list, the list, and the text after it."""
    before, head, rest = FILE.read_text("utf-8").partition(HEAD)
    own, end, after = rest.partition("\n\n\n")
    return before + head, own + "\n", end[1:] + after


def test_the_list_of_methods_is_current() -> None:
    _, now, _ = parts()
    assert now == lines(), "run `make web`, or this file"


@pytest.mark.parametrize(
    "method",
    [
        m.job_status,
        m.pause_job,
        m.resume_job,
        m.step_job,
        m.abort_job,
        m.forget_job,
        m.wait_job,
    ],
)
def test_a_job_is_named_or_is_what_submitted_it(method: Callable[..., Any]) -> None:
    """`wait_job(submit_script(...))` is the natural first try."""
    for job in ("job-7", SubmitResult(job="job-7", dataset="d")):
        assert next(method(job)).params["job"] == "job-7"
    assert "job" not in next(method()).params


if __name__ == "__main__":
    before, _, after = parts()
    FILE.write_text(before + lines() + after, "utf-8")
