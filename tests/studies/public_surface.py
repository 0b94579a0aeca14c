"""The public surface of the library and of the command line, a line for each name.

    python tests/studies/public_surface.py > docs/reference/surface.txt

The wire's surface is `protocol/openrpc.json`. `tests/face/test_public_surface.py` compares.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import typer.core
import typer.main

import flexdt as fx
from flexdt import testing
from flexdt.clients.cli.command_tree import build
from flexdt.testing import fixtures, strategies


def library() -> Iterator[str]:
    """`fx.__all__`: functions and public methods with their parameters, fields of values.

    And `flexdt.testing`, which nothing else loads.
    """
    for name in sorted(fx.__all__):
        yield from _lines(f"fx.{name}", getattr(fx, name))
    for module in (testing, fixtures, strategies):
        yield from _lines(module.__name__, module)


def _lines(name: str, what: Any) -> Iterator[str]:
    """The names of a module, class, function or value with their parameters, all inside
    it included.
    """
    if isinstance(what, ModuleType):
        for inner in sorted(what.__all__):
            yield from _lines(f"{name}.{inner}", getattr(what, inner))
    elif inspect.isclass(what):
        yield f"{name}{_parameters(what)}"
        ours = [base for base in what.__mro__ if base.__module__.startswith("flexdt")]
        for inner in sorted(
            {n for base in ours for n in vars(base) if not n.startswith("_")}
        ):
            if hasattr(what, inner):
                member = inspect.getattr_static(what, inner)
                called = callable(member) or isinstance(
                    member, (classmethod, staticmethod)
                )
                yield f"{name}.{inner}{_parameters(getattr(what, inner)) if called else ''}"
    elif callable(what):
        yield f"{name}{_parameters(what)}"
    else:
        yield name


def _parameters(what: Any) -> str:
    """Names, order, kinds and which have defaults; types and defaults may widen."""
    shown = []
    if getattr(what, "__init__", None) is Exception.__init__:
        return ""
    for parameter in inspect.signature(what).parameters.values():
        default = parameter.empty if parameter.default is parameter.empty else ...
        if parameter.name not in ("self", "cls"):
            shown.append(parameter.replace(annotation=parameter.empty, default=default))
    return str(inspect.Signature(shown)).replace("Ellipsis", "...")


def command_line(command: Any = None, path: str = "flexdt") -> Iterator[str]:
    """Every command with its arguments and options."""
    command = typer.main.get_command(build()) if command is None else command
    words = [
        "|".join(sorted(p.opts)) if p.param_type_name == "option" else p.name.upper()
        for p in command.params
        if not getattr(p, "hidden", False)
    ]
    yield " ".join([path, *sorted(words)])
    for name, inner in sorted(getattr(command, "commands", {}).items()):
        if not inner.hidden:
            yield from command_line(inner, f"{path} {name}")


if __name__ == "__main__":
    sys.stdout.write("\n".join([*library(), *command_line()]) + "\n")
