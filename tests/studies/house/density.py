"""Dense code: several statements in one line's place."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator, Sequence

from house.sources import Measure, Module

LONG_LINE = 90
"""Characters above which a line counts as long; the linter allows 100."""


def measure(modules: Sequence[Module]) -> list[Measure]:
    """Return rates of dense constructions per 1000 code lines."""
    thousands = sum(module.lines_of_code for module in modules) / 1000 or 1.0
    counts = {
        "stacked assignments": _nodes(modules, _is_stacked),
        "conditional expressions": _nodes(modules, _is_conditional),
        "fmt: skip": _lines(modules, lambda line: line.rstrip().endswith("# fmt: skip")),
        f"lines above {LONG_LINE} characters": _lines(
            modules, lambda line: len(line) > LONG_LINE
        ),
    }
    return [
        Measure(name, len(found) / thousands, "/ 1000 lines", tuple(found))
        for name, found in ((name, list(found)) for name, found in counts.items())
    ]


def _is_stacked(node: ast.AST) -> bool:
    """Return True for `a, b = x, y`."""
    return (
        isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Tuple)
        and isinstance(node.value, ast.Tuple)
    )


def _is_conditional(node: ast.AST) -> bool:
    return isinstance(node, ast.IfExp)


def _nodes(modules: Sequence[Module], wanted: Callable[[ast.AST], bool]) -> Iterator[str]:
    """Place and text of each node that is wanted."""
    for module in modules:
        for node in module.nodes:
            if wanted(node):
                yield f"{module.path}:{getattr(node, 'lineno', 0)} {ast.unparse(node)[:80]}"


def _lines(modules: Sequence[Module], wanted: Callable[[str], bool]) -> Iterator[str]:
    """Place and text of each line that is wanted."""
    for module in modules:
        for number, line in enumerate(module.text.splitlines(), 1):
            if wanted(line):
                yield f"{module.path}:{number} {line.strip()[:80]}"
