"""Text or bytes of an Acquila script to rows of fields, each with its column.

Two forms are read, line by line, so that a file may mix them: seven TAB separated columns
(component, command, argument 1, argument 2, wait, timeout in ms, expected duration in ms) and the
same columns padded with spaces. Bytes are decoded as UTF-8 with undecodable bytes kept, so a
binary argument survives unchanged. One command is treated specially: `set sample info` carries
binary data in which TAB, CR and LF may be part of the argument.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

LIGHT_BYTES: Final = 8 << 10
"""A script or list of poses up to this size may be planned in a thread."""
_HEAVY = re.compile(rb"(?<!\d)[1-9]\d{4}|\d[eE]\+?\d")
"""Numbers in a light script that may mean a million images."""

LOG_STAMP: Final = re.compile(rb"\t(\d\d):(\d\d):(\d\d\.\d{3})[ \t]*(?:\r\n|\n|\r|\Z)")
"""The end of a line of an executed script: the moment at which its command was sent."""

_END = re.compile(r"\r\n|\n|\r")
_BLOB = re.compile(r"[ \t]*scanner[ \t]+set[ \t]+sample[ \t]+info(?=[ \t]|$)", re.IGNORECASE)
_BLOB_WAIT = re.compile(r"\t(?:ACK|no\s+wait|POS|RCV)(?:\t[^\t]*){0,2}\s*$", re.IGNORECASE)
_COMMENT = re.compile(r"\s*(?:#|//|;)")
_TAIL_COMMENT = re.compile(r"(?<!\S)(?:#|//|;).*$", re.DOTALL)
"""A comment that starts a word: `# ...`, `// ...` or `; ...`."""
_WORD = re.compile(r"\S+")
_BLANK = " \t\ufeff\x1a"
_MAX_JOINED = 64
"""Lines that one binary argument may span; a real one is about a hundred bytes."""


@dataclass(frozen=True)
class Field:
    """A piece of text and the column (from 1) where it starts."""

    text: str
    column: int


@dataclass(frozen=True)
class CodeLine:
    """One line that is neither blank nor a comment.

    Attributes:
        line: number, from 1.
        text: the whole line without its end.
        columns: the TAB separated fields, blanks stripped; None in the space-padded form.
    """

    line: int
    text: str
    columns: tuple[Field, ...] | None

    def words(self, start: int = 0) -> tuple[Field, ...]:
        """The words of the line from character `start` on."""
        return tuple(Field(m[0], m.start() + 1) for m in _WORD.finditer(self.text, start))


def decode(data: str | bytes) -> str:
    """Text of a script; bytes that are not UTF-8 become lone surrogates (`encode` undoes it)."""
    text = data.decode("utf-8", "surrogateescape") if isinstance(data, bytes) else data
    return text.removeprefix("\ufeff")


def is_utf16(data: str | bytes) -> bool:
    """Whether the text was saved in two bytes a character, which no scanner writes."""
    head = data[:40] if isinstance(data, bytes) else data[:40].encode("utf-8", "surrogatepass")
    return head[:2] in (b"\xff\xfe", b"\xfe\xff") or (
        len(head) >= 4 and not (any(head[0::2]) and any(head[1::2]))
    )


def encode(text: str) -> bytes:
    """The bytes that `decode` was given."""
    try:
        return text.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:  # a str with lone surrogates that never came from bytes
        return text.encode("utf-8", "replace")


def is_log(text: str | bytes) -> bool:
    """Whether a text is an executed script: some line ends with a moment after a TAB.

    Example:
        >>> is_log("tube\\txrayoff\\t\\t\\tACK")
        False
        >>> is_log("tube\\txrayoff\\t\\t\\tACK\\t\\t\\t501\\t\\t09:36:31.952")
        True
    """
    return LOG_STAMP.search(encode(text) if isinstance(text, str) else text) is not None


def rows(data: str | bytes) -> Iterator[CodeLine]:
    """The rows of a script, blank lines and comment lines left out."""
    for number, text in _lines(decode(data)):
        if _BLOB.match(text) and "\t" in text:
            yield CodeLine(number, text, _blob_columns(text))
        elif text.strip(_BLANK) and _WORD.search(text) and not _COMMENT.match(text):
            yield CodeLine(number, text, _columns(text) if "\t" in text else None)


def line_count(data: str | bytes) -> int:
    """Number of lines of a script."""
    text = decode(data)
    return len(_END.findall(text)) + (not text.endswith(("\n", "\r")) and bool(text))


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """(number, line); a binary argument that holds line ends stays in one piece."""
    parts = _END.split(text)
    ends = _END.findall(text)
    crlf = "\r\n" in ends
    i = 0
    while i < len(parts):
        line, last = parts[i], i
        if _BLOB.match(line) and "\t" in line:
            last = _blob_end(parts, ends, i, crlf)
            line = "".join(parts[k] + ends[k] for k in range(i, last)) + parts[last]
        yield i + 1, line
        i = last + 1


def _blob_end(parts: list[str], ends: list[str], first: int, crlf: bool) -> int:
    """Index of the part that ends the binary argument begun in part `first`.

    It ends where a line ends with a wait column. Only in a file without CRLF, or where the line
    end is a lone CR or LF, can an end of line be part of the data for sure; so in a file with
    CRLF the search stops at the first CRLF.
    """
    joined = ""
    for i in range(first, min(first + _MAX_JOINED, len(parts))):
        joined += parts[i]
        if _BLOB_WAIT.search(joined) and (not crlf or i >= len(ends) or ends[i] == "\r\n"):
            return i
        if i >= len(ends) or (crlf and ends[i] == "\r\n"):
            return i if crlf else first
        joined += ends[i]
    return first


def _columns(text: str) -> tuple[Field, ...]:
    fields: list[Field] = []
    start = 0
    for i, piece in enumerate(text.split("\t")):
        cut = _TAIL_COMMENT.sub("", piece) if i >= 4 and piece else piece
        fields.append(_field(cut, start))
        if cut is not piece and cut != piece:
            break
        start += len(piece) + 1
    while len(fields) > 1 and not fields[-1].text:
        fields.pop()
    return tuple(fields)


def _blob_columns(text: str) -> tuple[Field, ...]:
    """Columns of a `set sample info` line: its last four columns are found from the right."""
    pieces = text.split("\t")
    tail = next(
        (k for k in range(len(pieces) - 1, 3, -1) if _BLOB_WAIT.fullmatch("\t" + pieces[k])), None
    )
    if tail is None:
        return _columns(text)
    head = pieces[: tail - 1]
    fields: list[Field] = []
    start = 0
    for piece in [head[0], head[1], "\t".join(head[2:]), *pieces[tail - 1 :]]:
        fields.append(_field(piece, start, keep=len(fields) == 2))
        start += len(piece) + 1
    return tuple(fields)


def _field(piece: str, start: int, *, keep: bool = False) -> Field:
    if keep or not piece:
        return Field(piece, start + 1)
    stripped = piece.strip(_BLANK)
    lead = len(piece) - len(piece.lstrip(_BLANK)) if stripped else 0
    return Field(stripped, start + lead + 1)


def is_light(script: bytes) -> bool:
    """Whether planning a script takes so little time that any thread may do it at once."""
    return len(script) <= LIGHT_BYTES and _HEAVY.search(script) is None
