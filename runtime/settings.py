"""Settings declared once: fields of a frozen dataclass, with their help, bounds and defaults.

The options of `python -m flexdt....main`, the keys of a table of the settings file, and
the words that a process is started with are all derived from the declaration. Servers and
command line both import this module, so it is above their two packages.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields
from typing import Annotated, Any, ClassVar, TypeVar, get_type_hints

import typer
from typer.main import get_command


@dataclass(frozen=True, kw_only=True)
class Settings:
    """A table of the settings file.

    The help of a process begins with the text of its class's docstring.

    Attributes:
        command: the `flexdt` command that the table is for.
    """

    command: ClassVar[str]


S = TypeVar("S", bound=Settings)


def option(default: object, *flags: str, public: bool = True, **details: Any) -> Any:
    """Declare a field of settings that is an option; its help is its text in
    the class's docstring.

    Args:
        default: where the option is left out.
        flags: as typed; they follow from the field's name.
        public: whether `flexdt up` lists it in its help.
        details: of `typer.Option`, such as metavar, min, max and parser.
    """
    return field(
        default=default, metadata={"public": public, "flags": flags, "details": details}
    )


def parameters(settings: type[Settings]) -> dict[str, inspect.Parameter]:
    """Convert the fields of a settings class to keyword-only parameters that typer reads
    as options.

    A field without own flags is --its-name; a tuple becomes a list option. Help texts are
    those of the class's docstring and its bases'.

    Args:
        settings: class of the table.

    Returns:
        Field's name -> parameter.
    """
    hints = get_type_hints(settings)
    found = {}
    helps = {
        n: h for kind in settings.__mro__[::-1] for n, h in described(kind)[1].items()
    }
    for f in fields(settings):
        flags = f.metadata["flags"] or (f"--{f.name.replace('_', '-')}",)
        default = str(f.default) if _is_read(f) else f.default
        kind: Any = list[str] if isinstance(default, tuple) else hints[f.name]
        details = {"help": helps.get(f.name, ""), **f.metadata["details"]}
        found[f.name] = inspect.Parameter(
            f.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=[*default] if isinstance(default, tuple) else default,
            annotation=Annotated[kind, typer.Option(*flags, **details)],
        )
    return found


def _is_read(declared: Field[Any]) -> bool:
    """Return whether a parser reads the default, as it reads words; None is left alone."""
    return "parser" in declared.metadata["details"] and declared.default is not None


def described(thing: object) -> tuple[str, dict[str, str]]:
    """Split a docstring into its text and its arguments or attributes.

    Sections of results and errors are left out.
    Returns the text before the sections, and name -> description on one line.
    """
    whole = inspect.getdoc(thing) or ""
    whole = re.sub(r"\n\n(?:Yields|Returns|Raises):\n(?: +\S.*\n?)+", "", whole)
    text, *lists = re.split(r"\n\n(?:Args|Attributes):\n", whole)
    items = re.findall(r"^    (\w+): (.*(?:\n {5,}.*)*)", "\n".join(lists), re.MULTILINE)
    return text, {name: " ".join(about.split()) for name, about in items}


def has_parameters(
    command: Callable[..., Any], shown: Iterable[inspect.Parameter]
) -> None:
    """Set the signature of a command to these parameters, for typer."""
    named = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in shown]
    command.__signature__ = inspect.Signature(named)  # type: ignore[attr-defined]
    command.__annotations__ = {p.name: p.annotation for p in named}


def read(settings: type[S], words: Sequence[str] | None = None) -> S | None:
    """Read settings from the words of a command line; `--help` is printed.

    Repeated options are tuples.

    Args:
        settings: class of the process or command.
        words: of the command line; None: `sys.argv`'s.

    Returns:
        The settings; None after the help.

    Raises:
        Exception: typer's usage errors, of any version; they have a `format_message`.
    """
    found: dict[str, Any] = {}

    def take(**given: Any) -> None:
        """Store the values that typer has read, lists as tuples."""
        found.update(
            {n: tuple(v) if isinstance(v, list) else v for n, v in given.items()}
        )

    has_parameters(take, parameters(settings).values())
    app = typer.Typer(add_completion=False, rich_markup_mode=None)
    app.command(
        help=described(settings)[0],
        context_settings={"help_option_names": ["-h", "--help"]},
    )(take)
    get_command(app).main(words, f"flexdt {settings.command}", standalone_mode=False)
    return settings(**found) if found else None


def parse(settings: type[S], words: Sequence[str] | None = None) -> S:
    """Read settings like `read`; after wrong words print the reason on standard error and
    exit with code 2, after the help with 0.

    Errors that are not of the words are raised.
    """
    try:
        found = read(settings, words)
    except Exception as error:
        if not hasattr(error, "format_message"):
            raise
        print(f"flexdt {settings.command}: {error.format_message()}", file=sys.stderr)
        sys.exit(2)
    if found is None:
        sys.exit(0)
    return found


def words(given: Mapping[str, object]) -> list[str]:
    """Convert options to words of a command line, of which `read` makes the same
    settings.

    Underscores of a name become dashes.

    Args:
        given: name -> value; None and False are left out, True is a bare flag, a list or
            tuple is repeated for each item, others are texts by `str`.
    """
    out = []
    for name, value in given.items():
        flag = f"--{name.replace('_', '-')}"
        if value is True:
            out.append(flag)
        elif value is not None and value is not False:
            each: Iterable[object] = value if isinstance(value, list | tuple) else [value]
            out += [word for item in each for word in (flag, str(item))]
    return out


def shared(settings: Settings, other: type[Settings]) -> dict[str, object]:
    """Return the values of `settings` that a process with settings `other` takes
    too, by name."""
    mine = {f.name for f in fields(settings)}
    return {f.name: getattr(settings, f.name) for f in fields(other) if f.name in mine}
