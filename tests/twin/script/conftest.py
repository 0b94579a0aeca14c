from __future__ import annotations

import struct
from collections.abc import Callable

import pytest

from flexdt.twin.machine.description import (
    Machine,
    Profile,
    builtin_machine,
    builtin_profile,
)
from flexdt.twin.script import ScanPlan, parse_script, plan_script

Planner = Callable[..., ScanPlan]


@pytest.fixture(scope="session")
def flexray() -> Machine:
    return builtin_machine("flexray")


@pytest.fixture(scope="session")
def profile(flexray: Machine) -> Profile:
    return builtin_profile(flexray.default_profile)


@pytest.fixture(scope="session")
def planned(flexray: Machine, profile: Profile) -> Planner:
    """Lines of a script -> plan on the FleX-ray."""

    def make(*lines: str, **options: object) -> ScanPlan:
        script = parse_script("\n".join(lines))
        return plan_script(script, flexray, profile, **options)  # type: ignore[arg-type]

    return make


def blob(name: str, diameter: float = 12.5) -> bytes:
    """A sample-info argument made by hand, with the bytes of `name` length-prefixed."""
    text = name.encode("utf-8")
    return struct.pack(">d", diameter) + struct.pack(">I", len(text)) + text + bytes(30)


def tabbed(*fields: str | bytes) -> bytes:
    """One line of the scanner's own form; missing columns are empty."""
    parts = [f.encode("utf-8") if isinstance(f, str) else f for f in fields]
    return b"\t".join([*parts, *[b""] * (7 - len(parts))]) + b"\r\n"
