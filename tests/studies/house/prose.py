"""Docstrings and comments: first words, and words that a technical editor would replace."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator, Sequence
from pathlib import Path

from house.sources import Measure, Module

VERBS = frozenset(
    Path(__file__).with_name("verbs.txt").read_text(encoding="utf-8").split()
)
"""Verbs in the form of a command. Add one to the file where a docstring begins with another."""

WORDS = {
    '"what" as a noun': r"\b[Ww]hat\b(?! ?(?:if|\?))",
    "told, say, ask": r"\b(?:told|tells?|said|says?|asked|asks?)\b",
    "stands, lies": r"\b(?:stands?|stood|lies|lie|lay)\b",
}
NO_PROSE = re.compile(r"#\s*(?:type:|noqa|fmt:|pragma|!)")
Function = ast.FunctionDef | ast.AsyncFunctionDef


def measure(modules: Sequence[Module]) -> list[Measure]:
    """Return the share of docstrings that begin with a verb, and rates of words to replace."""
    documented = [
        (m, f, ast.get_docstring(f) or "") for m in modules for f in _functions(m)
    ]
    documented = [(m, f, text) for m, f, text in documented if text]
    other = [
        f"{m.path}:{f.lineno} {f.name}: {text.splitlines()[0]}"
        for m, f, text in documented
        if not begins_with_a_verb(text)
    ]
    share = 100 * (1 - len(other) / len(documented)) if documented else 0.0
    verbs = Measure("docstrings that begin with a verb", share, "%", tuple(other))
    return [verbs, *_rates(modules)]


def begins_with_a_verb(docstring: str) -> bool:
    """Return True if the first word is a verb; "Plan of ..." and "Name: ..." begin with a
    noun."""
    first, _, rest = docstring.strip().partition(" ")
    if first.rstrip(".;,").lower() not in VERBS:
        return False
    return rest.split(" ")[0] not in ("of", "and", "or", "in", "at", "that", "is", "are")


def _rates(modules: Sequence[Module]) -> list[Measure]:
    """How often each of WORDS is in the prose, for 1000 words, with the places."""
    prose = [passage for module in modules for passage in passages(module)]
    count = sum(len(re.findall(r"[A-Za-z]+", text)) for _, text in prose) or 1
    rates = []
    for name, pattern in WORDS.items():
        found = [
            f"{place} {text[max(0, m.start() - 30) : m.end() + 30]}"
            for place, text in prose
            for m in re.finditer(pattern, text)
        ]
        rates.append(
            Measure(name, 1000 * len(found) / count, "/ 1000 words", tuple(found))
        )
    return rates


def passages(module: Module) -> Iterator[tuple[str, str]]:
    """Yield place and text of each docstring, without its examples, and of each comment."""
    for node in module.nodes:
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            lines = node.value.value.splitlines()
            kept = (s for s in lines if not s.strip().startswith((">>>", "...")))
            yield f"{module.path}:{node.lineno}", " ".join(" ".join(kept).split())
    for token in tokenize.generate_tokens(io.StringIO(module.text).readline):
        if token.type == tokenize.COMMENT and not NO_PROSE.match(token.string):
            yield f"{module.path}:{token.start[0]}", token.string.lstrip("# ")


def _functions(module: Module) -> Iterator[Function]:
    """Yield functions, but for properties, whose docstrings are noun phrases."""
    for node in module.nodes:
        if isinstance(node, Function):
            marks = {ast.unparse(mark).rpartition(".")[2] for mark in node.decorator_list}
            if not marks & {"property", "cached_property", "setter"}:
                yield node
