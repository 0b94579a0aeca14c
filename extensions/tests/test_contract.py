"""Extensions import public names only: those of the modules that the reference lists."""

from __future__ import annotations

import ast
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "reference" / "python.md"
PUBLIC = {
    "flexdt",
    *re.findall(r"^### `([\w.]+)`$", PAGE.read_text("utf-8"), re.MULTILINE),
}
EXTENSIONS = ROOT / "extensions"
FILES = sorted([
    *(EXTENSIONS / "flexdt_extensions").rglob("*.py"),
    *(EXTENSIONS / "examples").rglob("*.py"),
])  # fmt: skip


def defined(source: str) -> set[str]:
    """Names that a module itself defines: its functions, classes and constants."""
    names: set[str] = set()
    for node in ast.parse(source).body:
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                names.add(node.name)
            case ast.Assign(targets=targets):
                names |= {
                    t.id for o in targets for t in ast.walk(o) if isinstance(t, ast.Name)
                }
            case ast.AnnAssign(target=ast.Name(id=name)):
                names.add(name)
    return {name for name in names if not name.startswith("_")}


def public_names(module: str) -> set[str]:
    found = importlib.import_module(module)
    if hasattr(found, "__all__"):
        return set(found.__all__)
    assert found.__file__ is not None
    return defined(Path(found.__file__).read_text("utf-8"))


def imports(source: str) -> Iterator[tuple[int, str, str]]:
    """(line, module, name) of each import of flexdt; the name of a whole module is empty."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            found = [(node.module, alias.name) for alias in node.names]
        elif isinstance(node, ast.Import):
            found = [(alias.name, "") for alias in node.names]
        else:
            continue
        for module, name in found:
            if module.split(".")[0] == "flexdt":
                yield node.lineno, module, name


def private(source: str) -> list[str]:
    """Imports that are not of public names."""
    return [
        f"line {line}: {module} {name}".rstrip()
        for line, module, name in imports(source)
        if module not in PUBLIC or (name and name not in public_names(module))
    ]


@pytest.mark.parametrize(
    "file", FILES, ids=lambda f: f.relative_to(EXTENSIONS).as_posix()
)
def test_only_public_names_are_imported(file: Path) -> None:
    assert private(file.read_text("utf-8")) == []


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("import flexdt as fx\nfrom flexdt import simulate\n", 0),
        ("from flexdt.twin.geometry.cone_vec import ConeVec\n", 0),
        ("from flexdt.twin.geometry.cone_vec import np\n", 1),  # not its own
        ("from flexdt.twin.calibration import fit\n", 1),
        ("def f():\n    import flexdt.twin.projection.cpu\n", 1),
        ("from flexdt.server.twin.core import TwinCore\n", 1),
        ("from flexdt import no_such_name\n", 1),
    ],
)
def test_the_contract_finds_what_is_not_public(source: str, found: int) -> None:
    assert len(private(source)) == found


def test_every_public_module_is_there() -> None:
    assert len(PUBLIC) > 20
    for module in PUBLIC:
        importlib.import_module(module)
