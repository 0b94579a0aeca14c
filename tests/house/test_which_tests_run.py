"""Which cases of a test run in `make test`, in CI and in campaigns: `tests/support/suite.py`."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import suite

ROOT = Path(__file__).parents[2]


def cases(count: int, *marks: pytest.MarkDecorator) -> list[Any]:
    """Cases of one test of this file."""

    def case(number: int) -> Any:
        own = {one.name: one.mark for one in marks}
        return SimpleNamespace(
            path=Path(__file__),
            originalname="test_drawn",
            name=f"test_drawn[{number}]",
            get_closest_marker=own.get,
            add_marker=lambda name: own.__setitem__(
                name, getattr(pytest.mark, name).mark
            ),
            marks=own,
        )

    return [case(number) for number in range(count)]


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
        (0.2, (), "tttttt"),
        (0.4, (), "tststs"),
        (1.4, (), "tnnsnn"),
        (1.6, (), "snnnnn"),
        (9.0, (), "snnnnn"),
        (0.0, (pytest.mark.daily(2),), "tsstss"),
        (0.9, (pytest.mark.daily(2),), "tnsnsn"),
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


def test_measured_tests_exist() -> None:
    """A test with another name runs all its cases until it is measured again."""
    known = json.loads(suite.MEASURED.read_text())
    assert len(known) > 100
    texts = {
        path: (ROOT / path).read_text() for path in {n.partition("::")[0] for n in known}
    }
    gone = [
        name
        for name in known
        if f"def {name.partition('::')[2]}(" not in texts[name.partition("::")[0]]
    ]
    assert gone == []
