"""Lists of words that two or more modules write out: each list should stand once."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator, Sequence

from house.sources import Measure, Module, counted

LEAST_WORDS = 3


def measure(modules: Sequence[Module]) -> list[Measure]:
    """Return each set of `LEAST_WORDS` or more words that two or more modules list."""
    places: dict[frozenset[str], dict[str, int]] = defaultdict(dict)
    for module in modules:
        for words, line in _lists(module):
            places[frozenset(words)].setdefault(module.path, line)
    copied = {words: where for words, where in places.items() if len(where) > 1}
    ordered = sorted(copied.items(), key=lambda item: (-len(item[1]), sorted(item[0])))
    return [
        counted(
            "lists of words in two or more modules",
            [
                f"{' '.join(f'{path}:{line}' for path, line in where.items())}"
                f" {', '.join(sorted(words))}"
                for words, where in ordered
            ],
        )
    ]


def _lists(module: Module) -> Iterator[tuple[list[str], int]]:
    """Yield words and line of tuples, lists, sets, keys of dictionaries, and `Literal`
    types."""
    for node in module.nodes:
        if isinstance(node, ast.Tuple | ast.List | ast.Set):
            elements: Sequence[ast.expr | None] = node.elts
        elif isinstance(node, ast.Dict):
            elements = node.keys
        else:
            continue
        words = [
            e.value
            for e in elements
            if isinstance(e, ast.Constant) and isinstance(e.value, str)
        ]
        if len(words) == len(elements) and len(set(words)) >= LEAST_WORDS:
            yield words, node.lineno
