"""Find places of a program that compare a finding's code with text, by its syntax tree.

    python -m tests.support.codes_as_text [FOLDER]

A code is `x.code`, `x["code"]` or `x.get("code")`, a collection made of these, or a name that
holds such a collection. Text is a string, a collection or table of strings, or a name that holds
one, here or in the module that it is imported from. Comparing means `==`, `in` and their like,
`&` and `-` of sets, and looking up in a table.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

ROOMS: Final = (
    "clients",
    "extensions/flexdt_extensions",
    "flexdt/library",
    "phantoms",
    "runtime",
    "server",
    "twin",
)
"""Folders of the program; tests and examples may name codes as their readers see them."""


def is_code(node: ast.AST) -> bool:
    """Check whether an expression is the code of one value."""
    match node:
        case ast.Attribute(attr="code"):
            return True
        case ast.Subscript(slice=ast.Constant(value="code")):
            return True
        case ast.Call(
            func=ast.Attribute(attr="get"), args=[ast.Constant(value="code"), *_]
        ):
            return True
    return False


def has_code(node: ast.AST, names: set[str]) -> bool:
    """Check whether an expression is a code or is made of codes.

    Args:
        node: the expression.
        names: that hold collections of codes.
    """
    if isinstance(node, ast.Name):
        return node.id in names
    if isinstance(node, ast.SetComp | ast.ListComp | ast.GeneratorExp):
        return any(is_code(part) for part in ast.walk(node.elt))
    if isinstance(node, ast.Set | ast.List | ast.Tuple):
        return any(has_code(part, names) for part in node.elts)
    if isinstance(node, ast.BinOp):
        return has_code(node.left, names) or has_code(node.right, names)
    if isinstance(node, ast.Call) and not is_code(node):
        return any(has_code(part, names) for part in node.args)
    return is_code(node)


def is_text(node: ast.AST | None, names: set[str]) -> bool:
    """Check whether an expression is a string, or a collection or table of strings.

    Args:
        node: the expression.
        names: that hold such values.
    """
    match node:
        case ast.Constant(value=str()) | ast.JoinedStr():
            return True
        case ast.Name(id=name):
            return name in names
        case ast.Tuple(elts=parts) | ast.List(elts=parts) | ast.Set(elts=parts):
            return any(is_text(part, names) for part in parts)
        case ast.Dict(keys=parts):
            return any(is_text(part, names) for part in parts)
        case ast.Call(func=ast.Name(id="frozenset" | "set" | "tuple"), args=[part]):
            return is_text(part, names)
        case ast.BinOp(left=left, right=right):
            return is_text(left, names) or is_text(right, names)
        case ast.Starred(value=part):
            return is_text(part, names)
    return False


def assigned(tree: ast.AST) -> Iterator[tuple[str, ast.expr]]:
    """Yield each name that a module assigns, and the value."""
    for node in ast.walk(tree):
        match node:
            case ast.Assign(targets=[ast.Name(id=name)], value=value):
                yield name, value
            case ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value):
                yield name, value


def texts_of(tree: ast.AST, imported: set[str]) -> set[str]:
    """Return the names of a module that hold text, those of `imported` among them."""
    texts = set(imported)
    for name, value in assigned(tree):
        if is_text(value, texts):
            texts.add(name)
    return texts


def lines_of(tree: ast.AST, imported: set[str]) -> list[int]:
    """Return the lines of a module that compare a code with text.

    Args:
        tree: of the module.
        imported: names that it imports, and that hold text.
    """
    texts = texts_of(tree, imported)
    codes = {
        name
        for name, value in assigned(tree)
        if has_code(value, set()) and not is_code(value)
    }
    found = set()
    for node in ast.walk(tree):
        sides: list[ast.expr] = []
        match node:
            case ast.Compare(left=left, comparators=others):
                sides = [left, *others]
            case ast.BinOp(left=left, op=ast.Sub() | ast.BitAnd(), right=right):
                sides = [left, right]
            case ast.Subscript(value=table, slice=key) if is_code(key):
                sides = [table, key]
        some_code = any(has_code(side, codes) for side in sides)
        if some_code and any(is_text(side, texts) for side in sides):
            found.add(node.lineno)
    return sorted(found)


def found_in(root: Path) -> list[str]:
    """List `file:line` of each place below the rooms of a copy of the repository."""
    trees = {
        file.relative_to(root): ast.parse(file.read_text(encoding="utf-8"))
        for room in ROOMS
        for file in sorted((root / room).rglob("*.py"))
    }
    own = {_module(file): texts_of(tree, set()) for file, tree in trees.items()}
    out = []
    for file, tree in trees.items():
        imported = {
            name.asname or name.name
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
            for name in node.names
            if name.name in own.get(node.module or "", ())
        }
        out += [f"{file}:{line}" for line in lines_of(tree, imported)]
    return out


def _module(file: Path) -> str:
    """Return the name under which a file of the repository is imported."""
    parts = [part for part in file.with_suffix("").parts if part != "__init__"]
    if parts[0] == "extensions":
        return ".".join(parts[1:])
    return ".".join(("flexdt", *(part for part in parts if part != "flexdt")))


if __name__ == "__main__":
    places = found_in(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
    print("\n".join(places))
    print(f"{len(places)} comparisons of a code with text")
