"""Modules that are looked up by a text, which no import contract and no type checker sees."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator, Sequence

from house.sources import PACKAGE, Measure, Module, counted

LOADERS = {"import_module", "__import__"}
ATTRIBUTE_TEXT = re.compile(
    rf"(?:{PACKAGE}(?:\.\w+)*|\w+(?:\.\w+)+):[A-Za-z_]\w*(?:\.\w+)*"
)
"""`module:attribute`, as entry points write it."""


def measure(modules: Sequence[Module]) -> list[Measure]:
    """Return calls that import a text, texts `module:attribute`, and modules' names as
    texts."""
    names = {module.name for module in modules if module.name != PACKAGE}
    calls = [at for module in modules for at in _calls(module)]
    attributes = [
        at for module in modules for at in _texts(module, ATTRIBUTE_TEXT.fullmatch)
    ]
    dotted = [at for module in modules for at in _texts(module, names.__contains__)]
    return [
        counted("look-ups: calls that import a text", calls),
        counted("look-ups: texts module:attribute", attributes),
        counted("look-ups: a module's name as a text", dotted),
    ]


def _calls(module: Module) -> Iterator[str]:
    """Calls that load a module by its name, but for those of other packages."""
    for node in module.nodes:
        if not isinstance(node, ast.Call) or not node.args:
            continue
        called = node.func.attr if isinstance(node.func, ast.Attribute) else node.func
        name = called.id if isinstance(called, ast.Name) else called
        if name in LOADERS and not _is_foreign(node.args[0]):
            yield f"{module.path}:{node.lineno} {ast.unparse(node)}"


def _is_foreign(argument: ast.expr) -> bool:
    """True for the constant name of another package: `import_module("torch")`."""
    if not isinstance(argument, ast.Constant):
        return False
    return str(argument.value).split(".")[0] != PACKAGE


def _texts(module: Module, wanted: Callable[[str], object]) -> Iterator[str]:
    """Texts that are wanted, with their places; documentation is left out."""
    documentation = {
        id(node.value) for node in module.nodes if isinstance(node, ast.Expr)
    }
    for node in module.nodes:
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in documentation
            and wanted(node.value)
        ):
            yield f"{module.path}:{node.lineno} {node.value}"
