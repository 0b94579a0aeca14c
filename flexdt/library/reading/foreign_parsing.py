"""Parse other programs' files: every error is the file's, with its name."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

from flexdt.runtime.files.directory import memory_bytes
from flexdt.runtime.files.limited_files import limited_bytes
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.errors import TwinError
from flexdt.twin.input_limits import InputLimitError

UTF_16_MARKS: Final = (b"\xff\xfe", b"\xfe\xff")
"""Byte order marks of UTF-16, as programs of Windows begin a text."""
ENDS: Final = "\x1a\0 \t\r\n"
"""What DOS and memory of a fixed size leave behind a text, and blanks."""
BEGIN_BYTES: Final = 1 << 16
"""Bytes by which the format of a text is told."""


@contextmanager
def parsing(path: Path, form: str) -> Iterator[None]:
    """Run the body of a `with`, and turn any error of a parser into the file's error.

    A TwinError passes as it is; lack of memory has its own message. The parser's words
    are not repeated: they are those of a program, not of a scan.

    Args:
        path: the file.
        form: whose format it should have.

    Raises:
        DatasetFormatError: the body raised any Exception but a TwinError.
    """
    try:
        yield
    except TwinError:
        raise
    except MemoryError:
        said = f"{path} takes more memory than there is"
        raise DatasetFormatError(said, {"path": str(path)}) from None
    except (
        Exception
    ) as error:  # a third party's parser on a damaged file: anything may come
        said = f"{path} is no {form} file, or a damaged one"
        raise DatasetFormatError(said, {"path": str(path)}) from error


def head_text(path: Path) -> str:
    """Read a text that describes a scan, as UTF-8 or, with its mark, as UTF-16.

    Raises DatasetFormatError: too large for the settings of a scan; OSError.
    """
    try:
        raw = limited_bytes(path, "settings")
    except InputLimitError as error:
        raise DatasetFormatError(error.message, error.data) from None
    return "\n".join(_decoded(raw).rstrip(ENDS).splitlines())


def begin_of(path: Path) -> str:
    """Return the first `BEGIN_BYTES` of a text, as `head_text` reads it."""
    with path.open("rb") as file:
        return _decoded(file.read(BEGIN_BYTES))


def _decoded(raw: bytes) -> str:
    """Return bytes as text: UTF-16 with a mark, or else UTF-8 with or without one."""
    encoding = "utf-16" if raw[:2] in UTF_16_MARKS else "utf-8-sig"
    return raw.decode(encoding, "replace")


def require_memory(path: Path, what: str, size: int) -> None:
    """Check that `what`, to be read in one piece of `size` bytes, fits into the machine's
    memory.

    Raises:
        DatasetFormatError: it does not; the message has both sizes [GiB].
    """
    most = memory_bytes()
    if size > most:
        said = f"{path} claims {what} of {size / 2**30:.4g} GiB"
        raise DatasetFormatError.instead(
            said, size, f"{most / 2**30:.4g} GiB", path=str(path)
        )


def xml_values(path: Path, group: str) -> Iterator[tuple[str, str]]:
    """Yield path and text of every element without members of an XML text below its first
    element, and attributes as PATH@NAME; names have no namespace.

    Args:
        path: of the file.
        group: name of the element in the first whose members stand without its name.

    Raises:
        DatasetFormatError: it is not valid XML, or larger than settings may be.
    """
    try:
        root = ElementTree.fromstring(head_text(path))
    except ElementTree.ParseError as error:
        said_of = f"{path} is not valid XML: {error}"
        raise DatasetFormatError(said_of, {"path": str(path)}) from None
    for name, value in root.attrib.items():
        yield f"@{_plain(name)}", value
    for element in root:
        for part in element if _plain(element.tag) == group else [element]:
            yield from _values(part, "")


def _plain(tag: str) -> str:
    return tag.rpartition("}")[2]


def _values(element: ElementTree.Element, above: str) -> Iterator[tuple[str, str]]:
    """Yield the values of an element below a path."""
    path = f"{above}{_plain(element.tag)}"
    for name, value in element.attrib.items():
        yield f"{path}@{_plain(name)}", value
    if not len(element):
        yield path, (element.text or "").strip()
    for inner in element:
        yield from _values(inner, f"{path}/")
