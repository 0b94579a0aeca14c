"""The words of options and arguments as values.

Invalid words of the command line (AXIS=VALUE, lists, file names) become usage errors
(exit code 2) that quote the word and state the allowed form. The twin, not this module,
knows the names of the axes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

import typer

from flexdt.library.failure import CommandError

T = TypeVar("T")


def if_given(word: str | None, read: Callable[[str], T]) -> T | None:
    """Read the word of an option; None for one that was left out. Raises as `read`."""
    return None if word is None else read(word)


def number(word: str, what: str) -> float:
    """Read a finite number, negative ones and exponents included.

    `what` names the value in the error.

    Raises:
        typer.BadParameter: not a finite number.
    """
    try:
        value = float(word)
    except ValueError:
        raise typer.BadParameter(f"{what}: {word!r} is not a number") from None
    if not math.isfinite(value):
        raise typer.BadParameter(f"{what}: {word!r} is not finite")
    return value


def assignments(words: Iterable[str]) -> dict[str, float]:
    """Read AXIS=VALUE words as axis -> value, in order.

    Values are numbers, of any unit. Blanks around the axis are dropped. No words give {}.

    Raises:
        typer.BadParameter: a word of another form, an axis given twice, or a value that
            is no finite number.
    """
    out: dict[str, float] = {}
    for word in words:
        name, equals, value = word.partition("=")
        name = name.strip()
        if not equals or not name or not value.strip():
            raise typer.BadParameter(
                f"{word!r} is not of the form AXIS=VALUE, e.g. tra_obj=-12.5"
            )
        if name in out:
            raise typer.BadParameter(f"{name} is given twice")
        out[name] = number(value, f"the value of {name}")
    return out


def span(word: str, what: str) -> tuple[float, float]:
    """Read LOWER:UPPER, or one number for both.

    `word`: as given; `what`: names the value in the error.
    Returns (lower, upper), equal ones for one number.
    Raises typer.BadParameter: another form, an end that is no finite number, or the lower is
    above the upper."""
    ends = [number(part, what) for part in word.split(":")]
    if len(ends) > 2:
        raise typer.BadParameter(
            f"{what}: {word!r} is not of the form VALUE or LOWER:UPPER"
        )
    if ends[0] > ends[-1]:
        raise typer.BadParameter(f"{what}: the lower end of {word!r} is above the upper")
    return ends[0], ends[-1]


def numbers(
    word: str, what: str, form: str, *counts: int, by: str = ",", whole: bool = False
) -> list[float]:
    """Read a list of finite numbers, as floats; blanks and case do not matter.

    `what` and `form` are its name and form with an example, for typer.BadParameter;
    `counts`: allowed lengths; `by`: separator; `whole`: integers above 0.
    """
    parts = [part.strip() for part in word.lower().split(by)]
    if len(parts) not in counts or (
        whole and not all(p.isdecimal() and int(p) for p in parts)
    ):
        raise typer.BadParameter(f"{what} {word!r} is not {form}")
    return [number(part, what) for part in parts]


def triple(word: str, what: str, form: str) -> tuple[float, float, float]:
    """Read three of `numbers`."""
    x, y, z = numbers(word, what, form, 3)
    return x, y, z


def position(word: str) -> tuple[float, float]:
    """Read SOD[:LATERAL] as (SOD, lateral) [mm]; lateral is 0 if left out.

    Raises:
        typer.BadParameter: not finite numbers.
    """
    sod, _, lateral = word.partition(":")
    return (
        number(sod, "the SOD of --position"),
        number(lateral, "the lateral of --position") if lateral else 0.0,
    )


def names(word: str) -> tuple[str, ...]:
    """Read a comma-separated list of names, blanks dropped."""
    return tuple(part.strip() for part in word.split(",") if part.strip())


def require_ending(file: Path, *allowed: str) -> None:
    """Check a file's ending, of any case; raises typer.BadParameter."""
    if file.suffix.lower() not in allowed:
        raise typer.BadParameter(
            f"{file.name}: the ending must be {' or '.join(allowed)}"
        )


def require_folder(*files: Path | None) -> None:
    """Check that files can be written where they are to be. Only the parent folder is looked at;
    files that are None are skipped. The first failing file raises. Raises CommandError: a folder
    does not exist."""
    for file in files:
        if file is not None and not file.absolute().parent.is_dir():
            raise CommandError(f"{file}: the folder does not exist")
