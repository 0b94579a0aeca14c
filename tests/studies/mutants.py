"""Small changes of code, one at a time: what `mutations.py` draws and puts in place.

A mutant is one change of one operator, comparison, condition, constant or sign in one file. It
is known by file, function, the text before and after, and a number where these are the same, so
that a change elsewhere in the file neither renames it nor moves it in the draw.
"""

from __future__ import annotations

import ast
import copy
import hashlib
import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult,
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
    ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
REVERSED = {ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt}
NAMES = {
    "min": "max",
    "max": "min",
    "any": "all",
    "all": "any",
    "sin": "cos",
    "cos": "sin",
}
SKIPPED = (ast.JoinedStr, ast.Assert, ast.Import, ast.ImportFrom)
"""Texts for people, and what only type checkers need; nor is `strict` of `zip`, an
assertion."""


@dataclass(frozen=True)
class Mutant:
    """One change: the `choice`-th one of the `node`-th node of a file."""

    file: str
    function: str
    before: str
    after: str
    repeat: int
    """How many with the same four texts come before it in the file."""
    node: int
    choice: int
    lines: range
    """Those of the statement, or of its head, in the file; for a default those where the
    function begins."""
    inside: bool
    """Whether it counts when a function is called, as its defaults do, not when the module
    is imported."""

    def __str__(self) -> str:
        return f"{self.file}:{self.lines[0]} ({self.function}): {self.before}  ->  {self.after}"

    @property
    def name(self) -> tuple[str, str, str, str, int]:
        """What stays the same when other code changes."""
        return self.file, self.function, self.before, self.after, self.repeat


def variants(node: ast.AST) -> list[ast.AST]:
    """What a node may become."""
    out: list[ast.AST] = []

    def changed(**values: object) -> None:
        """Add a copy of the node with other values."""
        other = copy.copy(node)
        for name, value in values.items():
            setattr(other, name, value)
        out.append(other)

    match node:
        case ast.BinOp(op=op) | ast.BoolOp(op=op) | ast.AugAssign(op=op) if (
            type(op) in SWAPS
        ):
            changed(op=SWAPS[type(op)]())
        case ast.Compare(ops=[op]):
            for table in (SWAPS, REVERSED):
                if type(op) in table:
                    changed(ops=[table[type(op)]()])
        case ast.UnaryOp(op=ast.USub() | ast.Not(), operand=operand):
            out.append(operand)
        case ast.Constant(value=bool(value)):
            changed(value=not value)
        case ast.Constant(value=int(value)):
            changed(value=value + 1)
        case ast.Constant(value=float(value)):
            changed(value=1.0 if value == 0.0 else value * 1.25)
        case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test):
            changed(test=ast.UnaryOp(ast.Not(), test))
        case ast.Call(func=ast.Name(id="abs"), args=[operand]):
            out.append(operand)
        case ast.Call(func=ast.Name(id=name)) if name in NAMES:
            changed(func=ast.Name(NAMES[name], ast.Load()))
        case ast.Call(func=ast.Attribute(value=owner, attr=name)) if name in NAMES:
            changed(func=ast.Attribute(owner, NAMES[name], ast.Load()))
    return out


@dataclass(frozen=True)
class Place:
    """Where a node stands."""

    parent: ast.AST
    field: str
    node: ast.AST
    function: str
    lines: range
    inside: bool


def places(
    tree: ast.AST,
    function: str = "module",
    lines: range = range(1, 2),
    inside: bool = False,
) -> Iterator[Place]:
    """Yield every expression and statement that runs, in order; annotations and
    decorators do not.

    Args:
        tree: to walk.
        function: name of the function it is in.
        lines: of the statement it is in.
        inside: whether that is a function's body.
    """
    if isinstance(tree, ast.Assign | ast.AnnAssign) and _is_type(tree):
        return
    for field, value in ast.iter_fields(tree):
        if field in ("annotation", "returns", "decorator_list", "type_comment"):
            continue
        for node in value if isinstance(value, list) else [value]:
            if not isinstance(node, ast.AST) or isinstance(node, SKIPPED):
                continue
            if isinstance(node, ast.keyword) and node.arg == "strict":
                continue
            its_lines, its_function = lines, function
            its_inside = inside
            if isinstance(tree, ast.FunctionDef | ast.AsyncFunctionDef):
                its_inside = True
                its_lines = _begin(tree)  # defaults are seen by whoever calls it
            if isinstance(node, ast.stmt):
                its_lines = _head(node)
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                its_function = (
                    node.name if function == "module" else f"{function}.{node.name}"
                )
            yield Place(tree, field, node, its_function, its_lines, its_inside)
            yield from places(node, its_function, its_lines, its_inside)


def _begin(function: ast.FunctionDef | ast.AsyncFunctionDef) -> range:
    """The lines of a function's first statement behind its docstring."""
    documented = ast.get_docstring(function, clean=False) is not None
    return _head(function.body[1 if documented and len(function.body) > 1 else 0])


def _head(statement: ast.stmt) -> range:
    """The lines of a statement without those of the statements in it."""
    inner = [
        s.lineno
        for s in ast.walk(statement)
        if isinstance(s, ast.stmt) and s is not statement
    ]
    end = statement.end_lineno or statement.lineno
    return range(
        statement.lineno, max(statement.lineno, min([end, *(n - 1 for n in inner)])) + 1
    )


def _is_type(statement: ast.Assign | ast.AnnAssign) -> bool:
    """Whether a statement names a type, as in `A = B | None`."""
    value = statement.value
    return isinstance(value, ast.BinOp | ast.Subscript) and all(
        isinstance(n, ast.Name | ast.Attribute | ast.Subscript | ast.BinOp | ast.BitOr | ast.Load
                   | ast.Tuple | ast.Constant)
        and not (isinstance(n, ast.Name) and not (n.id[:1].isupper() or n.id in ("type", "str",
                 "int", "float", "bool", "tuple", "list", "dict", "slice", "npt", "np", "bytes")))
        for n in ast.walk(value)
    )  # fmt: skip


def mutants_of(file: str, text: str) -> list[Mutant]:
    """All mutants of a file, in order."""
    found: list[Mutant] = []
    seen: Counter[tuple[str, str, str]] = Counter()
    for index, place in enumerate(places(ast.parse(text))):
        for choice, other in enumerate(variants(place.node)):
            named = place.function, _short(place.node), _short(other)
            found.append(
                Mutant(
                    file, *named, seen[named], index, choice, place.lines, place.inside
                )
            )
            seen[named] += 1
    return found


def draw(mutants: Sequence[Mutant], count: int, seed: int) -> list[Mutant]:
    """So many of them; another code draws the same ones where it has them."""

    def ticket(mutant: Mutant) -> bytes:
        return hashlib.sha256(repr((seed, mutant.name)).encode()).digest()

    return sorted(mutants, key=ticket)[:count]


def _short(node: ast.AST) -> str:
    shown = node.test if isinstance(node, ast.If | ast.While) else node
    return " ".join(ast.unparse(shown).split())


def mutated(mutant: Mutant, text: str) -> str:
    """The text of the mutant's file, made from the original one."""
    tree = ast.parse(text)
    place = next(itertools.islice(places(tree), mutant.node, None))
    other = variants(place.node)[mutant.choice]
    value = getattr(place.parent, place.field)
    if isinstance(value, list):
        value[next(i for i, n in enumerate(value) if n is place.node)] = other
    else:
        setattr(place.parent, place.field, other)
    return ast.unparse(ast.fix_missing_locations(tree))
