"""Modules that read like two: unconnected parts, constants below the first function."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator, Sequence

from house.sources import Measure, Module, counted

PART_LINES = 60
"""Smallest part, in lines, that counts as a subject of its own."""

Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef


def measure(modules: Sequence[Module]) -> list[Measure]:
    """Return modules of two or more large parts, and constants below the first function."""
    glued = [
        f"{module.path} {' + '.join(map(str, sizes))} lines"
        for module in modules
        if len(sizes := large_parts(module)) > 1
    ]
    late = [
        f"{module.path}:{node.lineno} {name}"
        for module in modules
        for name, node in _late_constants(module)
    ]
    return [
        counted(f"modules of two or more parts of {PART_LINES} lines", glued),
        counted("constants below the first function", late),
    ]


def large_parts(module: Module) -> list[int]:
    """Return the sizes in lines of the large groups of names that use each other, largest
    first."""
    owner = {name: node for node in module.tree.body for name in _names(node)}
    group = {name: {name} for name in owner}
    for name, node in owner.items():
        for used in _used(node) & owner.keys():
            joined = group[name] | group[used]
            for member in joined:
                group[member] = joined
    sizes: dict[frozenset[str], int] = {}
    for members in group.values():
        nodes = {id(owner[m]): owner[m] for m in members}.values()
        sizes[frozenset(members)] = sum(
            (n.end_lineno or n.lineno) - n.lineno + 1 for n in nodes
        )
    return sorted((size for size in sizes.values() if size >= PART_LINES), reverse=True)


def _names(node: ast.stmt) -> Iterator[str]:
    """Yield the names that a statement of a module's top level defines, but for `__all__`."""
    if isinstance(node, Definition):
        yield node.name
    elif isinstance(node, ast.Assign):
        inside = (inner for target in node.targets for inner in ast.walk(target))
        yield from (n.id for n in inside if isinstance(n, ast.Name) and n.id != "__all__")
    elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
        yield node.target.id


def _used(node: ast.stmt) -> set[str]:
    """Return the names in a statement; annotations and dispatch tables may hold them as
    texts."""
    found: dict[type, set[str]] = defaultdict(set)
    for inner in ast.walk(node):
        if isinstance(inner, ast.Name):
            found[ast.Name].add(inner.id)
        elif isinstance(inner, ast.Constant) and isinstance(inner.value, str):
            found[ast.Constant].add(inner.value)
    return found[ast.Name] | found[ast.Constant]


def _late_constants(module: Module) -> Iterator[tuple[str, ast.stmt]]:
    """Names assigned at a module's top after its first function or class."""
    defined = False
    for node in module.tree.body:
        defined = defined or isinstance(node, Definition)
        if defined and isinstance(node, ast.Assign | ast.AnnAssign):
            for name in _names(node):
                yield name, node
