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


@pytest.mark.parametrize("name", ["kernels", "gpu", "listening", "disk"])
def test_a_check_that_fails_is_told_by_the_name_that_it_has(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fail(*_: object) -> doctor.CheckOutcome:
        raise OSError("no such device")

    ports = [("twin", 0)]
    right = [outcome.what for outcome in doctor.examine(tmp_path, ports)]
    monkeypatch.setattr(doctor, name, fail)
    outcomes = list(doctor.examine(tmp_path, ports))
    assert [outcome.what for outcome in outcomes] == right
    failed = [one for one in outcomes if one.found == "OSError: no such device"]
    assert [one.verdict for one in failed] == ["error"]
