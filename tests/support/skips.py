"""Which tests CI may skip: those for one of the reasons listed here. Elsewhere any may be skipped.

`make test` installs no peers, and the tests that need one are skipped with a reason. CI installs
them, and there a skip with a reason that is not listed is a failure.
"""

from __future__ import annotations

import os
import re
from typing import TypeVar

import pytest

CI_MAY_LACK = (
    r"astra-toolbox is",
    r"\btorch\b|PyTorch",
    r"the extra `odl`",
    r"CIL is not installed",
    r"flexdata is not installed",
    r"gvxr does not load",
    r"'spekpy'",
    r"\btiled\b",
    r"none of .*\bASTRA\b.* is installed",
    r"(diffdrr|embreex) is not installed",
    r"FLEXDT_REAL_DATA names no folder",
    r"no CUDA device",
    r"numba-cuda or ptxas is not installed",
    r"one core: there is no other number",
    r"no g\+\+ here",
    r"there is a sbatch here",
    r"needs the whole history of a git clone",
    r"the travel is shorter than the walk",
    r"needs root, to",
    r"no other user can reach",
)
"""Patterns of reasons: packages of hundreds of megabytes or of conda alone, devices, compilers,
and cases in which there is nothing to test."""

Report = TypeVar("Report", pytest.TestReport, pytest.CollectReport)


def judged(report: Report) -> Report:
    """A report of a test or a module; failed where CI must not skip it."""
    if (
        os.environ.get("CI") != "true"
        or not report.skipped
        or hasattr(report, "wasxfail")
    ):
        return report
    reason = str(report.longrepr[2] if isinstance(report.longrepr, tuple) else "")
    if not any(re.search(pattern, reason) for pattern in CI_MAY_LACK):
        report.outcome = "failed"
        report.longrepr = f"CI must not skip {report.nodeid}: {reason}"
    return report
