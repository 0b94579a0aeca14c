"""The errors of the pure core, one type for each thing a caller may want to handle differently.

Every error names the value asked for, what is allowed and where; `data` carries the same facts
for a program. The server maps the types to wire codes.
"""

from __future__ import annotations

import errno
from collections.abc import Iterable, Mapping, Sequence
from numbers import Real
from typing import Final, Self

from flexdt.message_words import SUGGESTION as SUGGESTION
from flexdt.message_words import nearest_name as nearest_name
from flexdt.message_words import reason_of


def shape_words(shape: Sequence[int | str]) -> str:
    """Write the shape of an array for people.

    Example:
        >>> shape_words(()), shape_words((3,)), shape_words(("n", 12))
        ('a single number', '3', 'n x 12')"""
    return " x ".join(map(str, shape)) or "a single number"


class TwinError(ValueError):
    """Base of all errors a user can cause. `data` is JSON-serialisable.

    Example:
        >>> from flexdt.twin.geometry import ConeVec
        >>> try:
        ...     ConeVec([[1, 2, 3]])
        ... except TwinError as error:
        ...     print(error.message, error.data["allowed"])
        cone_vec of shape 1 x 3; allowed: n x 12 ['n', 12]
    """

    def __init__(self, message: str, data: Mapping[str, object] | None = None) -> None:
        """Make the error with its message and a copy of `data` (None: no data)."""
        super().__init__(message)
        self.message = message
        self.data: dict[str, object] = dict(data or {})

    @classmethod
    def instead(cls, said: str, asked: object, allowed: object, **where: object) -> Self:
        """Make the error whose message is `said`, then "; allowed: " and what is allowed;
        returned, not raised.

        Args:
            said: the problem, in words.
            asked: value that is not allowed, for the data.
            allowed: a value, or a list, tuple or dict whose members (keys) as texts end
                the message.
            **where: further members of the data.

        Example:
            >>> error = TwinError.instead("no unit 'mile'", "mile", ("mm", "m"))
            >>> print(error, error.data)
            no unit 'mile'; allowed: mm, m {'asked': 'mile', 'allowed': ['mm', 'm']}
        """
        several = None
        if isinstance(allowed, list | tuple | dict):
            several = list(map(str, allowed))
        words = allowed
        if several is not None:
            words = ", ".join(several)
        data = {
            **where,
            "asked": asked,
            "allowed": allowed if several is None else several,
        }
        return cls(f"{said}; allowed: {words}", data)

    @classmethod
    def of_shape(
        cls, what: str, got: Sequence[int], allowed: Sequence[int | str], more: str = ""
    ) -> Self:
        """Make the error for an array's shape: its message is `what`, the shape it has
        and the one it must have, and `more`; returned, not raised.

        The data has `asked` and `allowed`, the shapes as lists.

        Example:
            >>> print(TwinError.of_shape("points", (4, 2), ("...", 3), " [mm]"))
            points of shape 4 x 2; allowed: ... x 3 [mm]"""
        given = f"of shape {shape_words(got)}" if got else "is a single number"
        return cls(
            f"{what} {given}; allowed: {shape_words(allowed)}{more}",
            {"asked": list(got), "allowed": list(allowed)},
        )


class FileError(TwinError, OSError):
    """A file or folder that cannot be read or written, because the system says no.

    It is an OSError, so that who knows only those has its number and words, too.
    """

    def __init__(self, message: str, data: Mapping[str, object] | None = None) -> None:
        """Make the error; its `strerror` is its message where the system has said none."""
        super().__init__(message, data)
        self.strerror = message

    @classmethod
    def of(cls, error: OSError) -> FileError:
        """Make the error for one of the system's that names a file; returned, not raised.

        Example:
            >>> print(FileError.of(FileNotFoundError(2, "No such file", "scan.json")))
            there is no file or folder scan.json
        """
        data = {"asked": str(error.filename)}
        found: FileError
        if isinstance(error, FileNotFoundError):
            found = MissingFileError(f"there is no file or folder {error.filename}", data)
        else:
            why = reason_of(error, "not to be had").lower()
            where = f"{error.filename}: " if error.filename else ""
            found = cls(f"{where}{why}", data)
        found.errno, found.strerror = error.errno, error.strerror or found.strerror
        found.filename, found.filename2 = error.filename, error.filename2
        return found

    def __str__(self) -> str:
        """Return the message, without the system's number."""
        return self.message


class MissingFileError(FileError, FileNotFoundError):
    """A file or folder that is not there; the one type for it, at every call."""

    def __init__(self, message: str, data: Mapping[str, object] | None = None) -> None:
        """Make the error, with the system's number of such."""
        super().__init__(message, data)
        self.errno = errno.ENOENT


class GeometryError(TwinError):
    """A geometry that no scanner can have (thesis 4.8.3): names the row and the check."""


class MachineFileError(TwinError):
    """A machine or profile description that does not hold: file, key path, value, allowed."""


class LimitError(TwinError):
    """A target, speed or setting outside what the machine allows."""

    @classmethod
    def of_axis(
        cls, said: str, axis: str, asked: object, allowed: object, unit: str
    ) -> Self:
        """Make the error whose message is `said`, about what an axis allows."""
        return cls(said, {"axis": axis, "asked": asked, "allowed": allowed, "unit": unit})


def require_within(
    what: str, value: float, low: float, high: float, unit: str = ""
) -> None:
    """Check that a number is finite and from `low` to `high`.

    Texts and other values that are no number fail, and NaN.

    Args:
        what: name of the number, for the message.
        value: that is checked.
        low, high: allowed range.
        unit: for message and data; "" for none.

    Raises:
        LimitError: it is not; the message says what it is.

    Example:
        >>> require_within("tube: kV", 300, 20, 240, "kV")
        Traceback (most recent call last):
        flexdt.twin.errors.LimitError: tube: kV is 300; allowed: 20 to 240 kV
    """
    number = isinstance(value, Real)
    if not (number and low <= value <= high):
        if number:
            given = f"{value:g}"
        else:
            given = f"{value!r}, no number"
        raise LimitError(
            f"{what} is {given}; allowed: {low:g} to {high:g} {unit}".rstrip(),
            {
                "asked": value if number else repr(value),
                "allowed": [low, high],
                **({"unit": unit} if unit else {}),
            },
        )


class CollisionError(TwinError):
    """A motion that would touch something: pair, time and last free position."""


class SafetyError(TwinError):
    """Refused because of the safety state (E-stop in force, move aborted)."""


MAX_REPEATED_CHARACTERS: Final = 200
"""Largest number of characters of another program's error that a message repeats."""


def words_of(error: BaseException) -> str:
    """Return what an error says, in one line of at most `MAX_REPEATED_CHARACTERS`; the name
    of its type if it says nothing.

    Example:
        >>> words_of(OSError("no such\\n  file")), words_of(KeyError())
        ('no such file', 'KeyError')"""
    said = " ".join(str(error).split())
    return said[:MAX_REPEATED_CHARACTERS] or type(error).__name__


class UnknownNameError(TwinError):
    """An axis, component, sample or setting that does not exist; lists the valid names.

    The message ends with the valid name that is most like the one asked for, if any is.

    Example:
        >>> print(UnknownNameError("no axis 'rot'", {"asked": "rot", "allowed": ["rot_obj"]}))
        no axis 'rot'; did you mean 'rot_obj'?
    """

    def __init__(self, message: str, data: Mapping[str, object] | None = None) -> None:
        """Make the error; append "; did you mean" and the allowed name nearest to the
        asked one.

        Nothing is appended unless `data` has a text `asked` and a list `allowed` with a
        near name, or if the message has a suggestion already.
        """
        facts = dict(data or {})
        unknown = facts.get("asked")
        allowed = facts.get("allowed")
        if (
            isinstance(unknown, str)
            and isinstance(allowed, Sequence)
            and SUGGESTION not in message
        ):
            near = nearest_name(
                unknown, [name for name in allowed if isinstance(name, str)]
            )
            message += "" if near is None else f"; {SUGGESTION} {near!r}?"
        super().__init__(message, facts)

    @classmethod
    def among(
        cls, problem: str, asked: str, allowed: Iterable[str], more: str = ""
    ) -> Self:
        """Make the error whose message is `problem`, a colon, the allowed names, and
        `more`; returned, not raised.

        A near name is suggested at the end. The data has `asked` and `allowed`.

        Example:
            >>> print(UnknownNameError.among("no axis 'w'; there are", "w", ["x", "y"]))
            no axis 'w'; there are: x, y"""
        names = list(allowed)
        return cls(
            f"{problem}: {', '.join(names)}{more}", {"asked": asked, "allowed": names}
        )


class NotIdentifiableError(TwinError):
    """The data cannot determine what was asked for; names the weak directions."""


class NotBuiltError(TwinError):
    """A name of the public surface that a later version will bring.

    Example:
        >>> raise NotBuiltError("volumes on other devices are not built yet")
        Traceback (most recent call last):
        flexdt.twin.errors.NotBuiltError: volumes on other devices are not built yet
    """
