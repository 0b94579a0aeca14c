"""`flexdt doctor`: what it looks at follows from the installation, not from a list of its
own."""

from __future__ import annotations

import tomllib
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from flexdt.clients.launch import doctor


def test_it_looks_for_every_package_that_flexdt_declares_and_for_no_extra() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())[
        "project"
    ]
    assert set(doctor.needed()) == {Requirement(r).name for r in project["dependencies"]}
    finding = doctor.packages()
    assert finding.verdict == "ok"
    assert "websockets" in finding.found


def test_a_package_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        if name == "websockets":
            raise PackageNotFoundError(name)
        return "1"

    monkeypatch.setattr(doctor, "version", version)
    finding = doctor.packages()
    assert (finding.verdict, finding.found) == ("error", "missing: websockets")


def test_lines_of_metadata_with_markers(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = [
        "a-b>=1",
        "c_d[extra]<3 ; python_version < '4'",
        "e ; extra == 'lab'",
        "f.g(>=1)",
    ]
    monkeypatch.setattr(doctor, "requires", lambda name: lines)
    assert doctor.needed() == ("a-b", "c_d", "f.g")
    monkeypatch.setattr(doctor, "requires", lambda name: None)
    assert doctor.needed() == ()
