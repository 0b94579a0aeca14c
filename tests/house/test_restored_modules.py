"""What a test replaces in the package stands again after it: later tests of the process would
be told another result.

Assignments to attributes of imported modules and classes of flexdt are read from the source;
`monkeypatch` and `patch.object` restore what they replace.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

ROOT: Final = Path(__file__).resolve().parents[2]
FOLDERS: Final = ("tests", "extensions/tests")
OWN_PROCESS: Final = {
    "tests/studies/device_check.py",
    "tests/support/device_simulator.py",
    "tests/support/device_stand_in.py",
    "tests/support/driver_stand_in.py",
}
"""Programmes, and stand-ins of a device, that have a process to themselves."""
RESTORED: Final = {"LOGGER.level", "LOGGER.propagate"}
"""What tests that empty the log set back by hand."""
SETS: Final = re.compile(
    r"^[ \t]*(\w+, )*(?!self\.|s\.)\w+\.\w[^=()#\n]*=[^=]|\b(set|del)attr\(|^[ \t]*del ",
    re.MULTILINE,
)
"""Lines without which a file sets no attribute of a module (`self` and `s` are none); files
with them are parsed."""


def imported(tree: ast.Module) -> set[str]:
    """Names that a module imports from flexdt, at any depth."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("flexdt"):
            names |= {one.asname or one.name for one in node.names}
        elif isinstance(node, ast.Import):
            ours = [one for one in node.names if one.name.startswith("flexdt")]
            names |= {one.asname or one.name.partition(".")[0] for one in ours}
    return names


def targets(node: ast.AST) -> list[ast.expr]:
    """What a statement or call of `setattr` sets."""
    match node:
        case ast.Assign(targets=several) | ast.Delete(targets=several):
            return several
        case ast.AugAssign(target=one) | ast.AnnAssign(target=one):
            return [one]
        case ast.Call(func=ast.Name(id="setattr" | "delattr"), args=[owner, *_]):
            return [ast.Attribute(owner, "", ast.Store())]
    return []


def replaced(text: str) -> Iterator[str]:
    """Give what a module sets in a module or class of flexdt."""
    tree = ast.parse(text)
    names = imported(tree)
    for node in ast.walk(tree):
        for target in targets(node):
            for part in ast.walk(target):
                if not (
                    isinstance(part, ast.Attribute)
                    and isinstance(part.ctx, ast.Store | ast.Del)
                ):
                    continue
                owner = ast.unparse(part.value)
                if owner.partition(".")[0] in names:
                    yield f"{owner}.{part.attr}".rstrip(".")


@pytest.mark.parametrize(
    "line",
    [
        "rows.find = None",
        "fx.twin.find = None",
        "a, rows.find = 1, 2",
        "del rows.find",
        "rows.LIMIT += 1",
        "setattr(rows, 'find', None)",
        "def test():\n    rows.find = None",
    ],
)
def test_what_is_not_restored_is_found(line: str) -> None:
    imports = "import flexdt as fx\nfrom flexdt.twin import rows\nimport other\n"
    assert len(list(replaced(imports + line))) == 1
    assert SETS.search(line)
    assert not list(replaced(imports + "other.find = rows.find"))


def test_tests_restore_what_they_replace() -> None:
    found = []
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*.py")):
            name = path.relative_to(ROOT).as_posix()
            if name not in OWN_PROCESS:
                text = path.read_text(encoding="utf-8")
                sets = replaced(text) if SETS.search(text) else ()
                found += [f"{name}: {one}" for one in sets if one not in RESTORED]
    assert found == []
