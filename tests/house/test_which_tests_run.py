"""Which cases of a test run in `make test`, in CI and in campaigns: `tests/support/suite.py`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import durations
import pytest
import suite

ROOT = Path(__file__).parents[2]


def cases(
    count: int, *marks: pytest.MarkDecorator, test: str = "test_drawn"
) -> list[Any]:
    """Cases of one test of this file."""

    def case(number: int) -> Any:
        own = {one.name: one.mark for one in marks}
        return SimpleNamespace(
            path=Path(__file__),
            originalname=test,
            name=f"{test}[{number}]",
            get_closest_marker=own.get,
            add_marker=lambda name: own.__setitem__(
                name, getattr(pytest.mark, name).mark
            ),
            marks=own,
        )

    return [case(number) for number in range(count)]


@pytest.fixture(autouse=True)
def stated_budgets(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rule is tested, not the budgets of the day."""
    monkeypatch.setattr(suite, "BUDGET_S", 0.5)
    monkeypatch.setattr(suite, "CI_BUDGET_S", 1.5)
    monkeypatch.setattr(suite, "MODULE_BUDGET_S", 3.0)


def runs(every: list[Any]) -> str:
    """A letter for each case: t in `make test`, s in `make studies`, n in campaigns."""
    suite.spread_out(every)
    return "".join(
        "n" if "night" in one.marks else "s" if "slow" in one.marks else "t"
        for one in every
    )


@pytest.mark.parametrize(
    ("mean_s", "marks", "wanted"),
    [
        (0.0, (), "tttttt"),
        (0.08, (), "tttttt"),
        (0.2, (), "tsstss"),
        (0.4, (), "tnsnsn"),
        (0.7, (), "snnsnn"),
        (1.4, (), "snnnnn"),
        (1.6, (), "snnnnn"),
        (9.0, (), "snnnnn"),
        (0.0, (pytest.mark.daily(2),), "tsstss"),
        (0.2, (pytest.mark.daily(3),), "tstsss"),
        (0.9, (pytest.mark.daily(2),), "snnnnn"),
        (0.0, (pytest.mark.daily(2), pytest.mark.campaign(3)), "tnstsn"),
        (9.0, (pytest.mark.campaign(2),), "snnnnn"),
        (0.0, (pytest.mark.slow, pytest.mark.campaign), "nnnnnn"),
        (9.0, (pytest.mark.slow, pytest.mark.campaign), "nnnnnn"),
    ],
)
def test_a_test_has_as_many_cases_as_its_budget_allows(
    mean_s: float,
    marks: tuple[pytest.MarkDecorator, ...],
    wanted: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    known = tmp_path / "means.json"
    place = Path(__file__).relative_to(ROOT).as_posix()
    known.write_text(json.dumps({f"{place}::test_drawn": mean_s}))
    monkeypatch.setattr(suite, "MEASURED", known)
    assert runs(cases(6, *marks)) == wanted


def test_a_module_has_as_many_slow_tests_in_ci_as_its_budget_allows(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The shortest first, and what is asked for by name."""
    seconds = {"test_long": 6.0, "test_first": 0.8, "test_second": 1.4, "test_third": 1.5}
    known = tmp_path / "means.json"
    place = Path(__file__).relative_to(ROOT).as_posix()
    known.write_text(json.dumps({f"{place}::{n}": s for n, s in seconds.items()}))
    monkeypatch.setattr(suite, "MEASURED", known)
    asked = [pytest.mark.campaign(1)]
    every = [
        case
        for name in seconds
        for case in cases(1, *(asked if name == "test_long" else ()), test=name)
    ]
    assert runs(every) == "sssn"
    assert runs(cases(1, test="test_long")) == "s"


def report(path: Path, **spent: list[float]) -> Path:
    """A report of a run, with the processor time of each case of tests of this file."""
    place = Path(__file__).relative_to(ROOT).with_suffix("").as_posix().replace("/", ".")
    lines = [
        f'<testcase classname="{place}" name="{name}[{number}]"><properties>'
        f'<property name="processor_s" value="{one}"/></properties></testcase>'
        for name, each in spent.items()
        for number, one in enumerate(each)
    ]
    path.write_text(f"<testsuites>{''.join(lines)}</testsuites>")
    return path


def test_what_no_report_has_is_kept_and_what_is_gone_is_not(tmp_path: Path) -> None:
    """A test that is slow is in no report of `make test`: without its mean it came back."""
    here = Path(__file__).relative_to(ROOT).as_posix() + "::"
    slow, fast, gone = "report", "runs", "test_of_another_name"
    first = report(tmp_path / "1.xml", **{slow: [2.0, 4.0], fast: [1.0, 1.0]})
    known = durations.merged({here + gone: 5.0}, durations.means([first]))
    assert known == {here + slow: 3.0, here + fast: 1.0}
    second = report(tmp_path / "2.xml", **{fast: [0.1, 0.1], gone: [3.0]})
    assert durations.merged(known, durations.means([second])) == {here + slow: 3.0}


def test_what_a_modules_tests_share_counts_for_each_of_them_alike(
    tmp_path: Path,
) -> None:
    here = Path(__file__).relative_to(ROOT).as_posix() + "::"
    made = report(tmp_path / "1.xml", runs=[1.0], report=[2.0])
    shared = (
        '<property name="shared_s" value="3.0"/></properties></testcase></testsuites>'
    )
    text = made.read_text()
    made.write_text(text.replace("</properties></testcase></testsuites>", shared))
    assert durations.means([made]) == {here + "runs": 2.5, here + "report": 3.5}


def test_measured_tests_exist() -> None:
    """A renamed test runs all its cases until it is measured: `durations.py --write`."""
    known = json.loads(suite.MEASURED.read_text())
    assert len(known) > 100
    assert [test for test in known if not durations.is_there(test)] == []


def test_ci_skips_what_it_may_lack_and_nothing_else(tmp_path: Path) -> None:
    hooks = "pytest_make_collect_report, pytest_runtest_makereport, pytest_runtest_setup"
    (tmp_path / "conftest.py").write_text(f"from suite import {hooks}\n")
    for name, reason in (
        ("lacks", "itk-rtk is not installed"),
        ("may", "no CUDA device"),
    ):
        skip = f"pytest.skip({reason!r}, allow_module_level=True)"
        (tmp_path / f"test_{name}.py").write_text(
            f"import pytest\ndef test_one(): {skip}\n"
        )
        (tmp_path / f"test_{name}_all.py").write_text(f"import pytest\n{skip}\n")

    def told(ci: str, *words: str) -> str:
        return subprocess.run(
            [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *words],
            cwd=tmp_path, capture_output=True, text=True, check=False,
            env=os.environ | {"CI": ci, "PYTHONPATH": os.pathsep.join(sys.path)},
        ).stdout  # fmt: skip

    in_ci = told("true", "--continue-on-collection-errors")
    assert "2 skipped" in in_ci
    assert "1 failed" in in_ci
    assert "1 error" in in_ci
    for name in ("test_lacks.py::test_one", "test_lacks_all.py"):
        assert f"CI must not skip {name}: Skipped: itk-rtk is not installed" in in_ci
    assert "4 skipped" in told("false")
