"""Modules of a source tree, read once for all measures."""

from __future__ import annotations

import ast
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from code_lines import code_lines

PACKAGE = "flexdt"
CORE = ("flexdt", "protocol", "twin", "phantoms", "runtime", "server", "clients")
SKIPPED_FOLDERS = {"node_modules", "__pycache__"}


@dataclass(frozen=True)
class Module:
    """One Python file of the core.

    Attributes:
        path: file, relative to the repository.
        text: its source code.
    """

    path: str
    text: str

    @cached_property
    def tree(self) -> ast.Module:
        """Parse the source once."""
        return ast.parse(self.text)

    @cached_property
    def nodes(self) -> tuple[ast.AST, ...]:
        """Walk the syntax tree once."""
        return tuple(ast.walk(self.tree))

    @cached_property
    def lines_of_code(self) -> int:
        """Number of lines without blanks, comments and docstrings."""
        return code_lines(self.text)

    @property
    def name(self) -> str:
        """Dotted name under which the module is imported."""
        parts = Path(self.path).with_suffix("").parts
        inside = parts if parts[0] == PACKAGE else (PACKAGE, *parts)
        return ".".join(inside[:-1] if inside[-1] == "__init__" else inside)

    @property
    def is_package(self) -> bool:
        """True for an `__init__.py`."""
        return Path(self.path).name == "__init__.py"

    @property
    def room(self) -> str:
        """Folder of the file, relative to the repository."""
        return Path(self.path).parent.as_posix()


@dataclass(frozen=True)
class Measure:
    """Result of one measure.

    Attributes:
        name: as the table and `--list` name it.
        value: number of findings, or a share in per cent.
        unit: of the value; empty for a count.
        findings: one text a finding, `path:line` first.
    """

    name: str
    value: float
    unit: str = ""
    findings: tuple[str, ...] = ()


def counted(name: str, findings: Sequence[str]) -> Measure:
    """Return the measure whose value is the number of its findings."""
    return Measure(name, len(findings), "", tuple(findings))


def read_modules(root: Path, folders: Sequence[str] = CORE) -> list[Module]:
    """Read the Python files below `folders`, in the order of their paths; links are not
    followed.

    Args:
        root: the repository.
        folders: folders of its top level; those that are missing are left out.
    """
    paths = sorted(path for folder in folders for path in _files(root / folder))
    return [
        Module(path.relative_to(root).as_posix(), path.read_text(encoding="utf-8"))
        for path in paths
    ]


def _files(folder: Path) -> Iterator[Path]:
    for place, inner, names in os.walk(folder):
        inner[:] = [name for name in inner if name not in SKIPPED_FOLDERS]
        yield from (Path(place) / name for name in names if name.endswith(".py"))
