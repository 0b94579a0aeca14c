"""Commands as typer takes them: with the options of `flexdt` itself, and their answers
printed.

`--json`, `--server` and `--token-file` are options of `flexdt` itself, which commands get
as arguments: a generator's answers obey `--json`, and a parameter `twin: Twin` connects
to the server.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial, wraps
from typing import Any, Final, Literal

import typer

from flexdt.clients.cli.console import emit, say
from flexdt.clients.cli.settings_file import configuration
from flexdt.clients.cli.twin_connection import connect
from flexdt.runtime.files.writable import require_writable
from flexdt.runtime.settings import described, has_parameters

FILLED_PARAMETERS: Final = ("context", "twin", "json")
"""Parameters of commands that are filled in, not options."""


VERBOSITY_OPTIONS: Final = ("--quiet", "-q", "--verbose", "-v")
"""Options of `flexdt` that all of these commands obey."""


def completed(command: Callable[..., Any]) -> tuple[Callable[..., None], tuple[str, ...]]:
    """Wrap a command for typer: fill its arguments from `flexdt`'s options, print its
    answers.

    A command that takes `context` and is no generator is returned unchanged, with no
    options. Options without help get that of the docstring.

    Args:
        command: function with `Args:` as help; a generator yields texts and a document.

    Returns:
        The wrapped command, and the options of `flexdt` that it obeys.
    """
    own = inspect.signature(command, eval_str=True).parameters
    yields = inspect.isgeneratorfunction(inspect.unwrap(command))
    if not yields and "context" in own:  # it passes its words on
        return command, ()

    about, helps = described(command)
    for name, parameter in own.items():
        if getattr(parameter.default, "help", "") is None:
            parameter.default.help = helps.get(name)

    outputs = [name for name, p in own.items() if getattr(p.default, "written", False)]

    @wraps(command)
    def complete(context: typer.Context, **given: Any) -> None:
        """Run the command with the arguments that it takes from `flexdt` itself: check the keys
        of the settings file and that its output files can be written, and print its answers, as
        lines or (--json) as documents.

        A generator's texts are printed without --json, its other values only with it.
        `given` are the command's own options.
        """
        configuration()
        root = context.find_root().params
        if "context" in own:
            given["context"] = context
        if "twin" in own:
            given["twin"] = partial(connect, root["server"], root["token_file"])
        if "json" in own:
            given["json"] = root["json"]
        for name in outputs:
            require_writable(given[name])
        answer = command(**given)
        for part in answer if yields else ():
            if isinstance(part, str) and not root["json"]:
                say(part)
            elif root["json"] and not isinstance(part, str):
                emit(part)

    complete.__doc__ = about
    context = inspect.Parameter(
        "context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context
    )
    offered = (
        _with_choices(p) for name, p in own.items() if name not in FILLED_PARAMETERS
    )
    has_parameters(complete, [context, *offered])
    heeds = ("--json",) if yields or "json" in own else ()
    reaches: tuple[str, ...]
    if "twin" in own:
        reaches = ("--server", "--token-file")
    else:
        reaches = ()
    return complete, (*heeds, *reaches, *VERBOSITY_OPTIONS)


def _with_choices(parameter: inspect.Parameter) -> inspect.Parameter:
    """Return the parameter with the allowed words of its option (and None, if that is its
    default) as its type; unchanged if its option has no such list.

    The list is made now, as the command line is built.
    """
    among = getattr(parameter.default, "among", None)
    if among is None:
        return parameter
    choices: Any = Literal[tuple(among())]
    optional = parameter.default.default is None
    return parameter.replace(annotation=choices | None if optional else choices)
