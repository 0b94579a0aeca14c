"""Findings of all rooms are of one type, their codes members of one enum a room; the cases are
the members themselves."""

from __future__ import annotations

import ast
import json
import pickle
import re
from functools import cache
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexdt.protocol.methods.calibration_messages import CalibrationProblem
from flexdt.protocol.methods.job_messages import Problem
from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.commissioning import CommissionCode
from flexdt.twin.findings import (
    ERROR,
    Advice,
    Finding,
    FindingCode,
    Findings,
    Place,
    Severity,
    error,
    warning,
)
from flexdt.twin.plausibility import PlausibilityCode
from flexdt.twin.script.problems import ScriptCode
from tests.support.codes_as_text import ROOMS as FOLDERS
from tests.support.codes_as_text import found_in
from tests.support.loaded_script import load

ROOT = Path(__file__).parents[2]
ROOMS: tuple[type[FindingCode], ...] = (
    ScriptCode,
    PlausibilityCode,
    CommissionCode,
    CalibrationCode,
)
ROOM_NAMED = {room.__name__: room for room in ROOMS}
CODES = [code for room in ROOMS for code in room]
RANK = [Severity.NOTE, Severity.WARNING, Severity.ERROR]
MADE_BY = {"error": ERROR, "warn": Severity.WARNING, "warning": Severity.WARNING}
"""Function or method that makes a finding -> its severity."""

findings = st.builds(
    Finding,
    st.sampled_from(CODES),
    st.sampled_from(Severity),
    st.text(min_size=1, max_size=5),
    st.sampled_from(["", "do this"]),
    st.none() | st.builds(Place, st.integers(0, 3), st.integers(1, 2)),
)
collections = st.lists(findings, max_size=12).map(Findings)


@cache
def sources() -> tuple[ast.Module, ...]:
    """Return the syntax trees of the program's modules that have a code's name in them."""
    texts = (
        file.read_text(encoding="utf-8")
        for folder in FOLDERS
        for file in sorted((ROOT / folder).rglob("*.py"))
    )
    return tuple(ast.parse(text) for text in texts if "Code" in text)


def member(node: ast.Attribute) -> FindingCode | None:
    """Return the code that an expression such as `ScriptCode.LIMIT` names; None for others."""
    match node:
        case ast.Attribute(
            value=ast.Name(id=room) | ast.Attribute(attr=room), attr=name
        ) if room in ROOM_NAMED:
            return ROOM_NAMED[room][name]
    return None


@pytest.mark.parametrize("code", CODES, ids=lambda code: f"{type(code).__name__}-{code}")
def test_each_code_has_a_text_a_severity_and_a_meaning(code: FindingCode) -> None:
    assert re.fullmatch(r"[A-Za-z][A-Za-z_ ]*", code.value)
    assert code == code.value == str(code) == f"{code}" == json.loads(json.dumps(code))
    assert code.name == code.value.upper().replace(" ", "_")
    assert code.gravest in RANK
    assert len(code.meaning.split()) >= 2
    assert code not in code.explains
    assert pickle.loads(pickle.dumps(code)) is code


@pytest.mark.parametrize("room", ROOMS)
def test_codes_of_a_room_differ_and_explain_in_no_circle(room: type[FindingCode]) -> None:
    assert len({code.value for code in room}) == len({code.meaning for code in room})
    assert len(room.__members__) == len(list(room)), "two names for one code"
    order = list(room)
    for code in room:
        assert all(order.index(other) < order.index(code) for other in code.explains)


def test_every_enum_of_codes_is_tested_here() -> None:
    defined = {
        node.name
        for tree in sources()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
        and any(isinstance(b, ast.Name) and b.id == "FindingCode" for b in node.bases)
    }
    assert defined == {room.__name__ for room in ROOMS}


def test_each_code_is_used_and_no_finding_is_graver_than_its_code() -> None:
    used: set[FindingCode] = set()
    for tree in sources():
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and (code := member(node)) is not None:
                used.add(code)
            match node:
                case ast.Call(
                    func=ast.Name(id=made) | ast.Attribute(attr=made),
                    args=[ast.Attribute() as first, *_],
                ) if made in MADE_BY and (code := member(first)) is not None:
                    assert RANK.index(MADE_BY[made]) <= RANK.index(code.gravest), code
    assert not set(CODES) - used, "no check finds these"


@pytest.mark.parametrize("room", ROOMS)
def test_the_generated_list_has_each_code_of_a_room_once(
    room: type[FindingCode],
) -> None:
    page = load(ROOT / "docs" / "_ext" / "list_pages.py").findings()
    parts = [part for part in page.split("\n## ") if f"`{next(iter(room))}`" in part]
    rows = [row.strip("| ").split(" | ") for part in parts for row in part.splitlines()]
    told = {row[0].strip("`"): row[1:] for row in rows if row[0].startswith("`")}
    assert told == {code.value: [code.gravest.value, code.meaning] for code in room}


@given(collections, st.sets(st.sampled_from(CODES), max_size=4))
def test_parts_of_a_collection_keep_its_order(
    found: Findings, some: set[FindingCode]
) -> None:
    kept, left = found.of(*some), found.without(*some)
    assert {one.code for one in kept} <= some
    assert not {one.code for one in left} & some
    assert sorted([*kept, *left], key=found.index) == sorted(found, key=found.index)
    for part in (kept, left, found.errors, found.warnings, found.notes, found.reduced()):
        rest = iter(found)
        assert all(one in rest for one in part)
        assert isinstance(part, Findings)
    assert kept.of(*some) == kept
    assert left.without(*some) == left
    assert len(found.errors) + len(found.warnings) + len(found.notes) == len(found)
    assert all(one.forbids for one in found.errors)


@given(collections)
def test_reduced_leaves_out_what_another_one_at_the_same_place_explains(
    found: Findings,
) -> None:
    left = found.reduced()
    assert left.reduced() == left
    for one in found:
        causes = [
            other
            for other in found
            if one.code in other.code.explains and other.place == one.place
        ]
        assert (one in left) == (not causes)


def test_an_open_beam_explains_the_pixels_of_its_line_alone() -> None:
    beam = warning(ScriptCode.STARVED_OPEN_BEAM, "dark", place=Place(3))
    here = warning(ScriptCode.STARVED_PIXELS, "few", place=Place(3))
    there = warning(ScriptCode.STARVED_PIXELS, "few", place=Place(4))
    other = warning(ScriptCode.SATURATED_PIXELS, "many", place=Place(3))
    found = Findings((here, beam, there, other))
    assert found.reduced() == (beam, there, other)
    assert Findings((here, there)).unexplained_by([beam]) == (there,)


@given(collections, collections)
def test_collections_sort_join_and_compare_as_tuples(a: Findings, b: Findings) -> None:
    assert a.and_also(b) == (*a, *b)
    assert a == tuple(a)
    assert a.texts == [one.text for one in a]
    placed = a.by_place()
    assert placed == tuple(sorted(a, key=lambda one: (one.line, one.column)))
    worst = a.worst_first()
    assert worst == (*a.errors, *(one for one in a if not one.forbids))
    assert pickle.loads(pickle.dumps(a)) == a
    assert type(pickle.loads(pickle.dumps(a))) is Findings
    assert "\n" not in repr(a)
    assert all(one.code in repr(a) for one in a)


def test_a_finding_reads_as_a_sentence_with_its_place() -> None:
    placed = error(ScriptCode.LIMIT, "too far", "go less far", place=Place(3, 7))
    assert placed.text == "too far; go less far"
    assert str(placed) == "line 3, column 7: error: too far; go less far"
    assert placed.placed_text == "line 3, column 7: too far; go less far"
    bare = warning(ScriptCode.MOVING, "moves")
    assert str(bare) == "warning: moves"
    assert (bare.line, bare.column, bare.placed_text) == (0, 1, "moves")
    assert str(Place(name="machine.toml")) == "machine.toml"


def test_a_code_that_is_no_member_is_refused() -> None:
    with pytest.raises(TypeError, match=r"'limt'.*allowed: members"):
        error("limt", "too far")  # type: ignore[arg-type]


@pytest.mark.parametrize("code", CalibrationCode)
def test_findings_of_a_calibration_are_documents_of_the_wire(
    code: CalibrationCode,
) -> None:
    found = Finding(code, code.gravest, "said", advice=Advice(("dO_x",), ("dO_y",)))
    document = {"code": code.value, "severity": code.gravest.value, "text": "said"}
    assert list(found.to_dict().items()) == list(document.items())
    assert {type(value) for value in found.to_dict().values()} == {str}
    assert CalibrationProblem.model_validate(found.to_dict()).model_dump() == document


@pytest.mark.parametrize("code", ScriptCode)
def test_problems_of_scripts_are_documents_of_the_wire(code: ScriptCode) -> None:
    found = Finding(code, code.gravest, "said", place=Place(2, 5))
    document = {
        "severity": code.gravest.value,
        "code": code.value,
        "line": 2,
        "column": 5,
        "message": "said",
    }
    assert list(found.to_dict().items()) == list(document.items())
    assert {type(value) for value in found.to_dict().values()} == {str, int}
    assert Problem.model_validate(found.to_dict()).model_dump() == document


PLANTED = """
from flexdt.twin.script.names import FAR
NEAR: Final = ("limit", "mode")
TABLE = {"limit": 3}
a = [p for p in found if p.code == "limit"]
b = any(p.code in NEAR for p in found)
c = TABLE[finding.code]
d = [p for p in document["problems"] if p["code"] != "limit"]
codes = {p.code for p in found}
e = codes <= frozenset(NEAR)
f = "limit" in codes
g = [p for p in found if p.code in FAR]
h = [p for p in found if f"{name}_open" != p.code]
i = codes - {"limit"}
fine = [p for p in found if p.code is ScriptCode.LIMIT], error.code == -32005, found.of(*FAR)
"""


def test_no_module_compares_a_code_with_text(tmp_path: Path) -> None:
    for folder in FOLDERS:
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "twin" / "script").mkdir()
    (tmp_path / "twin" / "script" / "names.py").write_text(
        "FAR = frozenset(('limit',))\n"
    )
    (tmp_path / "server" / "planted.py").write_text(PLANTED)
    lines = [n for n, line in enumerate(PLANTED.splitlines(), 1) if line[1:4] == " = "]
    assert found_in(tmp_path) == [f"server/planted.py:{n}" for n in lines]
    assert found_in(ROOT) == []
