"""Measures of the source code: each finds what is planted in a small sample, and nothing
else."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from house import circles, copied_lists, density, glue, lookups, prose, rooms
from house.__main__ import findings, last_release, measured, save, table
from house.sources import Measure, Module, read_modules

ROOT = Path(__file__).resolve().parents[2]


def tree(**sources: str) -> list[Module]:
    """Modules by name: `twin__a` is twin/a.py."""
    return [
        Module(name.replace("__", "/") + ".py", text) for name, text in sources.items()
    ]


def values(found: Sequence[Measure]) -> dict[str, float]:
    return {measure.name: measure.value for measure in found}


def test_modules_have_the_names_under_which_they_are_imported(tmp_path: Path) -> None:
    for path in (
        "flexdt/__init__.py",
        "flexdt/library/open.py",
        "twin/motion/__init__.py",
    ):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text("")
    (tmp_path / "flexdt" / "twin").symlink_to(tmp_path / "twin")
    assert [m.name for m in read_modules(tmp_path)] == [
        "flexdt", "flexdt.library.open", "flexdt.twin.motion",
    ]  # fmt: skip


def test_code_lines_are_summed_by_folder() -> None:
    found = values(
        rooms.measure(tree(twin__a="x = 1\n", twin__b='"""No code."""\n\ny = 2\n'))
    )
    assert found == {"twin": 2, "modules": 2, "code lines": 2}


@pytest.mark.parametrize(
    "line",
    [
        "from flexdt.twin.b import x",
        "import flexdt.twin.b",
        "from flexdt.twin import b",
        "from .b import x",
        "from . import b",
        "def f():\n    from flexdt.twin.b import x",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from flexdt.twin.b import x",
    ],
)
def test_a_circle_of_two_modules_is_found_however_they_import(line: str) -> None:
    found = circles.measure(tree(twin__a=line, twin__b="from flexdt.twin.a import y"))
    assert found[0].findings == ("flexdt.twin.a flexdt.twin.b",)
    assert found[1].value == 0


def test_a_neighbours_import_is_no_circle_with_the_package() -> None:
    found = circles.measure(
        tree(twin____init__="from flexdt.twin.a import x", twin__a="import os")
    )
    assert [m.value for m in found] == [0, 0]


def test_folders_that_import_each_other_are_a_circle_without_one_of_modules() -> None:
    found = circles.measure(
        tree(
            twin__a="import flexdt.server.a",
            server__a="",
            server__b="import flexdt.twin.a",
        )
    )
    assert [m.findings for m in found] == [(), ("server twin",)]


@pytest.mark.parametrize("seed", range(20))
def test_circles_are_those_of_a_drawn_graph(seed: int) -> None:
    """Two nodes share a circle exactly if a power of the adjacency matrix leads both ways."""
    draw = random.Random(seed)
    nodes = [f"n{i}" for i in range(draw.randint(1, 9))]
    graph = {n: {m for m in nodes if m != n and draw.random() < 0.2} for n in nodes}
    leads = {(n, m) for n in nodes for m in graph[n]}
    for k in nodes:  # Warshall
        leads |= {
            (n, m) for n in nodes for m in nodes if (n, k) in leads and (k, m) in leads
        }
    together = {
        (n, m) for n in nodes for m in nodes if n != m and {(n, m), (m, n)} <= leads
    }
    found = circles.circles(graph)
    assert {(n, m) for c in found for n in c for m in c if n != m} == together


LOOKUPS = '''
"""Strings that stand alone are documentation."""
from importlib import import_module
import_module("torch")
import_module("flexdt.twin.a")
import_module(f"flexdt.{name}")
KERNEL = "twin.a:run"
HOME = {"x": "flexdt.twin.a", "y": "flexdt.nowhere"}
TIME = "12:30"
def f():
    "flexdt.twin.a"
def g():
    "flexdt.twin.a:name"
'''


def test_lookups_by_text_are_found_and_other_packages_are_not() -> None:
    found = lookups.measure(tree(clients__b=LOOKUPS, twin__a=""))
    at = [
        [finding.split()[0].rpartition(":")[2] for finding in m.findings] for m in found
    ]
    assert at == [["5", "6"], ["7"], ["5", "8"]]


def test_a_list_in_two_modules_is_found_in_any_form_and_order() -> None:
    one = 'AXES = ("x", "y", "z")\nSHORT = ("x", "y")\nTWICE = ["u", "v", "w"]\nB = ["u", "v", "w"]\n'  # noqa: E501
    two = 'from typing import Literal\nA = Literal["z", "x", "y"]\nSHORT = ("x", "y")\n'
    (found,) = copied_lists.measure(
        tree(twin__a=one, server__b=two, clients__c='D = {"x": 1}\n')
    )
    assert found.findings == ("twin/a.py:1 server/b.py:2 x, y, z",)


def part(name: str, lines: int, uses: str = "") -> str:
    return f"def {name}():\n" + f"    {uses or 'pass'}\n" * (lines - 1)


@pytest.mark.parametrize(
    ("source", "sizes"),
    [
        (part("one", 60) + part("two", 61), [61, 60]),
        (part("one", 60) + part("two", 59), [60]),
        (part("one", 60, "two()") + part("two", 60), [120]),
        (part("one", 60, "LIMIT") + part("two", 60, "LIMIT") + "LIMIT = 1\n", [121]),
        (part("one", 60) + part("two", 60) + 'TABLE = {"a": one, "b": two}\n', [121]),
        (part("one", 60) + part("two", 60) + '__all__ = ["one", "two"]\n', [60, 60]),
    ],
)
def test_parts_that_do_not_use_each_other_are_told_apart(
    source: str, sizes: list[int]
) -> None:
    (module,) = tree(twin__a=source)
    assert glue.large_parts(module) == sizes


def test_a_constant_below_the_first_function_is_found() -> None:
    source = "TOP_MM = 1\ndef f(): ...\nLOW_MM: int = 2\n__all__ = ['f']\nA, B = 3, 4\n"
    assert glue.measure(tree(twin__a=source))[1].findings == (
        "twin/a.py:3 LOW_MM", "twin/a.py:5 A", "twin/a.py:5 B",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("docstring", "verb"),
    [
        ("Return the mean of each row.", True),
        ("Wait.", True),
        ("Plan a motion to the target.", True),
        ("Plan of the motion.", False),
        ("The mean of each row.", False),
        ("What the mean is.", False),
        ("Whether rows are even.", False),
        ("Mean of each row.", False),
    ],
)
def test_docstrings_begin_with_a_verb_or_do_not(docstring: str, verb: bool) -> None:
    assert prose.begins_with_a_verb(docstring) is verb
    source = f'def f():\n    """{docstring}"""\n@property\ndef g(self):\n    """The width."""\n'
    (share, *_) = prose.measure(tree(twin__a=source))
    assert share.value == (100 if verb else 0)


def test_words_to_replace_are_counted_in_docstrings_and_comments_alone() -> None:
    source = (
        '"""What is left is told to who asks.\n\n>>> what is left\n"""\n'
        "# It stands here, what if.  # noqa\n"
        'TEXT = "what is said"  # type: ignore[what]\n'
    )
    found = {m.name: len(m.findings) for m in prose.measure(tree(twin__a=source))[1:]}
    assert found == {'"what" as a noun': 1, "told, say, ask": 2, "stands, lies": 1}


def test_dense_lines_are_found() -> None:
    source = (
        "a, b = 1, 2\nc, d = pair()\ne = 1 if a else 2\nf = [1, 2]  # fmt: skip\n"
        f"g = '{'x' * 90}'\n"
    )
    at = {
        m.name: [f.split()[0] for f in m.findings]
        for m in density.measure(tree(twin__a=source))
    }
    assert at == {
        "stacked assignments": ["twin/a.py:1"],
        "conditional expressions": ["twin/a.py:3"],
        "fmt: skip": ["twin/a.py:4"],
        "lines above 90 characters": ["twin/a.py:5"],
    }
    assert density.measure(tree(twin__a=source))[0].value == 1000 / 5


def test_the_table_sets_figures_beside_those_of_the_newest_release(
    tmp_path: Path,
) -> None:
    save([Measure("modules", 9)], tmp_path / "0.9.0.json")
    save([Measure("modules", 10), Measure("gone", 2.25, "%")], tmp_path / "0.10.0.json")
    version, before = last_release(tmp_path)
    assert version == "0.10.0"
    assert last_release(tmp_path, before="0.10.0") == ("0.9.0", {"modules": 9})
    lines = table([Measure("modules", 12), Measure("new", 1)], version, before)
    assert [line.split() for line in lines] == [
        ["0.10.0", "now"], ["modules", "10", "12"], ["new", "-", "1"], ["gone", "2.2", "0"],
    ]  # fmt: skip
    assert last_release(tmp_path / "nothing") == ("", {})


def test_findings_are_listed_by_a_word_of_the_measures_name() -> None:
    found = [Measure("late constants", 1, "", ("twin/a.py:3 X",)), Measure("modules", 2)]
    assert findings(found, "LATE") == ["# late constants: 1", "twin/a.py:3 X"]
    assert findings(found, "absent")[1:] == ["late constants", "modules"]


def test_every_measure_has_a_name_of_its_own_and_a_kept_figure_is_known() -> None:
    names = [m.name for m in measured(tree(twin__a="x = 1\n"))]
    assert len(names) == len(set(names))
    for path in (ROOT / "docs" / "house").glob("*.json"):
        kept = json.loads(path.read_text())
        assert set(names) - {"twin"} <= set(kept), path.name


@pytest.mark.slow
@pytest.mark.campaign
def test_the_programme_reads_the_repository_and_does_not_fail() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "house"], cwd=ROOT / "tests" / "studies",
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    counted = {line.split()[0]: line.split() for line in done.stdout.splitlines()[1:]}
    assert int(counted["twin/motion"][-2]) > 100
