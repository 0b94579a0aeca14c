"""Import circles: groups of modules, and of folders, that reach each other by imports.

Every import counts: at the top, inside a function, and under `TYPE_CHECKING`, which the
contracts of import-linter leave out. Importing a neighbour does not import the package of both.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping, Sequence

from house.sources import Measure, Module, counted


def measure(modules: Sequence[Module]) -> list[Measure]:
    """Return the circles of modules and those of folders."""
    graph = imports(modules)
    folders: dict[str, set[str]] = {module.room: set() for module in modules}
    room_of = {module.name: module.room for module in modules}
    for name, targets in graph.items():
        folders[room_of[name]] |= {room_of[target] for target in targets} - {
            room_of[name]
        }
    return [
        counted("import circles of modules", [" ".join(c) for c in circles(graph)]),
        counted("import circles of folders", [" ".join(c) for c in circles(folders)]),
    ]


def imports(modules: Sequence[Module]) -> dict[str, set[str]]:
    """Return module -> modules of the same tree that it imports anywhere."""
    known = {module.name for module in modules}
    return {
        module.name: {t for t in _targets(module, known) if t != module.name}
        for module in modules
    }


def circles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """Return the strongly connected components of two or more nodes, each sorted.

    A node belongs to the component of another when each reaches the other.
    """
    reached = {node: _reached(graph, node) for node in graph}
    found: list[list[str]] = []
    left = set(graph)
    for node in sorted(graph):
        if node in left:
            group = {node} | {other for other in reached[node] if node in reached[other]}
            left -= group
            if len(group) > 1:
                found.append(sorted(group))
    return found


def _reached(graph: Mapping[str, set[str]], start: str) -> set[str]:
    """All nodes to which arrows lead from `start`; itself only if it is on a circle."""
    seen: set[str] = set()
    waiting = list(graph[start])
    while waiting:
        node = waiting.pop()
        if node not in seen:
            seen.add(node)
            waiting.extend(graph[node])
    return seen


def _targets(module: Module, known: set[str]) -> Iterator[str]:
    """Names of known modules that a module imports, anywhere in it."""
    for node in module.nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in known)
        elif isinstance(node, ast.ImportFrom):
            yield from _from_targets(module, node, known)


def _from_targets(module: Module, node: ast.ImportFrom, known: set[str]) -> Iterator[str]:
    """Yield the modules that `from ... import ...` names: the submodules, or else the
    package."""
    origin = node.module or ""
    if node.level:
        levels = node.level - module.is_package
        parts = module.name.split(".")
        base = parts[: len(parts) - levels]
        origin = ".".join([*base, *filter(None, [node.module])])
    for alias in node.names:
        inner = f"{origin}.{alias.name}"
        if inner in known:
            yield inner
        elif origin in known:
            yield origin
