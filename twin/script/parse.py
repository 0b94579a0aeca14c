"""Text or bytes of an Acquila script to typed commands; every problem is reported,
not the first.

`read_script` returns all commands that could be read and all problems; `parse_script`
raises if there is an error. Limits and axes are checked when the script is planned.

Two forms are read, line by line, so that a file may mix them: seven TAB separated columns
(component, command, argument 1, argument 2, wait, timeout in ms, expected duration in ms)
and the same columns padded with spaces. Bytes are decoded as UTF-8 with undecodable bytes
kept, so a binary argument survives unchanged. One command is treated specially: `set
sample info` carries binary data in which TAB, CR and LF may be part of the argument.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from typing import Final

from flexdt.twin.backends import backend
from flexdt.twin.errors import nearest_name
from flexdt.twin.findings import Finding, Findings, Place, error, warning
from flexdt.twin.script import commands as c
from flexdt.twin.script import grammar
from flexdt.twin.script.grammar import ArgumentError, Spec, shorten
from flexdt.twin.script.problems import ENTIRE, ScriptCode, ScriptError
from flexdt.twin.signatures import PathLike

BINARY_HEAD_BYTES: Final = 64 << 10
"""Length of a file's beginning that shows whether it is text [bytes]."""
MIN_BINARY_BYTES: Final = 1024
"""Least length of a file that may be called binary [bytes]; of a shorter one each line is
reported."""
MAX_CONTROL_SHARE: Final = 0.05
"""Largest share of control characters in a text."""
CONTROL_BYTES: Final = bytes(k for k in range(32) if k not in b"\t\n\r")
"""Control characters that separate neither columns nor lines."""
FEW_PROBLEMS: Final = 20
"""Number of problems that are listed of a text without any command."""
FOREIGN_CODES: Final = (
    ScriptCode.SYNTAX,
    ScriptCode.UNKNOWN_COMPONENT,
    ScriptCode.UNKNOWN_COMMAND,
)
"""Codes of the problems of a text that is no script at all."""
LIGHT_BYTES: Final = 8 << 10
"""Longest script, or list of poses, that any thread may plan [bytes]."""
_MANY_IMAGES = re.compile(rb"(?<!\d)[1-9]\d{4}|\d[eE]\+?\d")
"""Numbers in a short script that may mean a million images."""

LOG_STAMP: Final = re.compile(rb"\t(\d\d):(\d\d):(\d\d\.\d{3})[ \t]*(?:\r\n|\n|\r|\Z)")
"""The end of a line of an executed script: the moment at which its command was sent."""

_END = re.compile(r"\r\n|\n|\r")
_BLOB = re.compile(
    r"[ \t]*scanner[ \t]+set[ \t]+sample[ \t]+info(?=[ \t]|$)", re.IGNORECASE
)
_BLOB_WAIT = re.compile(
    r"\t(?:ACK|no\s+wait|POS|RCV)(?:\t[^\t]*){0,2}\s*$", re.IGNORECASE
)
_COMMENT = re.compile(r"\s*(?:#|//|;)")
_TAIL_COMMENT = re.compile(r"(?<!\S)(?:#|//|;).*$", re.DOTALL)
"""A comment that starts a word: `# ...`, `// ...` or `; ...`."""
_WORD = re.compile(r"\S+")
_BLANK = " \t\ufeff\x1a"
_MAX_BLOB_LINES = 64
"""Largest number of lines in one binary argument; a real one is about a hundred bytes."""
_COMMENT_MARKS = ("#", "//", ";")
_CUSTOM_NAME = re.compile(r"[A-Za-z][\w$.-]*", re.ASCII)
Source = str | bytes | PathLike
"""A script's text or bytes, or the path of its file."""


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
        text: the line without its end.
        columns: the TAB separated fields, blanks stripped; None in the space-padded form.
    """

    line: int
    text: str
    columns: tuple[Field, ...] | None

    def words(self, start: int = 0) -> tuple[Field, ...]:
        """Split the line into words, from character `start` on."""
        return tuple(Field(m[0], m.start() + 1) for m in _WORD.finditer(self.text, start))


def decode(data: str | bytes) -> str:
    """Decode a script's bytes; those that are not UTF-8 become lone surrogates
    (`encode` undoes it)."""
    if isinstance(data, bytes):
        text = data.decode("utf-8", "surrogateescape")
    else:
        text = data
    return text.removeprefix("\ufeff")


def is_utf16(data: str | bytes) -> bool:
    """Return whether a text seems saved as UTF-16, which no scanner writes.

    By its mark, or zeros at either all even or all odd of the first 40 bytes.
    """
    if isinstance(data, bytes):
        head = data[:40]
    else:
        head = data[:40].encode("utf-8", "surrogatepass")
    return head[:2] in (b"\xff\xfe", b"\xfe\xff") or (
        len(head) >= 4 and any(head[0::2]) != any(head[1::2])
    )


def is_binary(data: str | bytes) -> bool:
    """Return whether a file is an image or the like, by its control characters.

    They are more than `MAX_CONTROL_SHARE` of its head; a script's binary argument is far
    less. Short texts never are.
    """
    head = data[:BINARY_HEAD_BYTES]
    if isinstance(head, str):
        head = head.encode("utf-8", "surrogatepass")
    if len(head) < MIN_BINARY_BYTES:
        return False
    controls = len(head) - len(head.translate(None, CONTROL_BYTES))
    return controls > MAX_CONTROL_SHARE * len(head)


def is_log(text: str | bytes) -> bool:
    r"""Return whether a text is an executed script: some line ends with a moment after a TAB.

    Example:
        >>> is_log("tube\txrayoff\t\t\tACK")
        False
        >>> is_log("tube\txrayoff\t\t\tACK\t\t\t501\t\t09:36:31.952")
        True"""
    return (
        LOG_STAMP.search(grammar.encode(text) if isinstance(text, str) else text)
        is not None
    )


def rows(data: str | bytes) -> Iterator[CodeLine]:
    """Yield the rows of a script as `CodeLine`, without blank lines and lines that are a
    comment.

    A row without tabs has no columns (None); one with the binary argument of `set sample
    info` is divided in its own way (`_blob_columns`)."""
    for number, text in _lines(decode(data)):
        if _BLOB.match(text) and "\t" in text:
            yield CodeLine(number, text, _blob_columns(text))
        elif text.strip(_BLANK) and _WORD.search(text) and not _COMMENT.match(text):
            yield CodeLine(number, text, _columns(text) if "\t" in text else None)


def line_count(data: str | bytes) -> int:
    """Count the lines of a script, the last one also without a line end; 0 for an empty text."""
    text = decode(data)
    return len(_END.findall(text)) + (not text.endswith(("\n", "\r")) and bool(text))


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """Yield (number from 1, line without its end); a binary argument that contains line
    ends stays in one piece, with the number of its first line.
    """
    parts = _END.split(text)
    ends = _END.findall(text)
    crlf = "\r\n" in ends
    i = 0
    while i < len(parts):
        line = parts[i]
        last = i
        if _BLOB.match(line) and "\t" in line:
            last = _blob_end(parts, ends, i, crlf)
            line = "".join(parts[k] + ends[k] for k in range(i, last)) + parts[last]
        yield i + 1, line
        i = last + 1


def _blob_end(parts: list[str], ends: list[str], first: int, crlf: bool) -> int:
    """Find the part that ends the binary argument begun in part `first`.

    It ends where a line ends with a wait column. With `crlf` the search stops at the
    first CRLF, as data have a lone CR or LF. `ends`: behind each part. Without a wait:
    `first`, or with CRLF that part.
    """
    joined = ""
    for i in range(first, min(first + _MAX_BLOB_LINES, len(parts))):
        joined += parts[i]
        if _BLOB_WAIT.search(joined) and (
            not crlf or i >= len(ends) or ends[i] == "\r\n"
        ):
            return i
        if i >= len(ends) or (crlf and ends[i] == "\r\n"):
            return i if crlf else first
        joined += ends[i]
    return first


def _columns(text: str) -> tuple[Field, ...]:
    """Split a row at TABs into fields with blanks stripped.

    A comment from column 5 on is dropped with all that follows, and empty columns at the
    end, but for the first.
    """
    fields: list[Field] = []
    start = 0
    for i, piece in enumerate(text.split("\t")):
        if i >= 4 and piece:
            cut = _TAIL_COMMENT.sub("", piece)
        else:
            cut = piece
        fields.append(_field(cut, start))
        if cut is not piece and cut != piece:
            break
        start += len(piece) + 1
    while len(fields) > 1 and not fields[-1].text:
        fields.pop()
    return tuple(fields)


def _blob_columns(text: str) -> tuple[Field, ...]:
    """Split a `set sample info` row: component, command, argument, then the columns from
    one before the wait on, found from the right.

    Without a wait it is split as any row (`_columns`).

    Args:
        text: the row.

    Returns:
        Its columns; the argument keeps its blanks and may contain TABs.
    """
    pieces = text.split("\t")
    tail = next(
        (
            k
            for k in range(len(pieces) - 1, 3, -1)
            if _BLOB_WAIT.fullmatch("\t" + pieces[k])
        ),
        None,
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
    """Make a field with blanks stripped, unless `keep`.

    Its column, from 1, is that of the first character left; `start` is the piece's, from
    0.
    """
    if keep or not piece:
        return Field(piece, start + 1)
    stripped = piece.strip(_BLANK)
    lead = 0
    if stripped:
        lead = len(piece) - len(piece.lstrip(_BLANK))
    return Field(stripped, start + lead + 1)


def is_light(script: bytes) -> bool:
    """Return whether a script is planned so fast that any thread may do it.

    It has at most `LIGHT_BYTES` and no number of five digits or more, or with an
    exponent, which may mean many images."""
    return len(script) <= LIGHT_BYTES and _MANY_IMAGES.search(script) is None


def parse_script(text: Source) -> c.Script:
    """Read a script in either of its two forms; raise one error for all of its errors.

    Args:
        text: the file's text or, so that binary arguments survive, its bytes, or its
            path.

    Returns:
        The script, with its warnings.

    Raises:
        ScriptError: has all errors (and warnings), with line and column.

    Example:
        >>> script = parse_script("tube set kV 90 ACK")
        >>> script.commands[0].kV, script.lines
        (90.0, 1)
    """
    script, problems = read_script(text)
    if problems.errors:
        raise ScriptError(problems)
    return script


def read_script(text: Source) -> tuple[c.Script, Findings]:
    r"""Read the commands of a script and every problem of its text, in line order;
    problems are not raised.

    Args:
        text: text or bytes of a script, or the path of its file, which is read.

    Returns:
        The script of the lines that could be read, and all problems. A log, UTF-16 text
        or a binary file gives an empty script and one error. A text without any command
        is an error. If one kind of problem occurs more than `FEW_PROBLEMS` times, only
        the first ones are listed, after an error that says so.

    Example:
        >>> script, problems = read_script("camera\tset exposure\tlong\t\tACK\t\t\r\n")
        >>> [(problem.line, problem.column) for problem in problems]
        [(1, 21)]
    """
    text = content(text)
    if is_utf16(text):
        message = "the script is UTF-16 text; save it as UTF-8 or plain ASCII"
        return _nothing(error(ScriptCode.SYNTAX, message, place=Place(1)))
    problems: list[Finding] = []
    if is_log(text):
        message = (
            "this is an executed script, a log: `flexdt commission` learns the machine "
            "from it, and `flexdt check SCRIPT --against` it compares; to run, "
            "a script has seven columns"
        )
        return _nothing(error(ScriptCode.EXECUTED_LOG, message, place=ENTIRE))
    if is_binary(text):  # a log, above, holds binary replies
        message = "the file holds binary data; allowed: the text of a scan script"
        return _nothing(error(ScriptCode.SYNTAX, message, place=Place(1)))
    commands: list[c.Command] = []
    for row in rows(text):
        command = read_row(row, problems)
        if command is not None:
            commands.append(command)
    foreign = all(p.code in FOREIGN_CODES for p in problems)
    if foreign and not commands and len(problems) > FEW_PROBLEMS:
        message = (
            f"no line is a command of a scan script; {FEW_PROBLEMS} of {len(problems)} "
            "problems are listed"
        )
        first = Findings(problems).by_place()[:FEW_PROBLEMS]
        problems = [error(ScriptCode.SYNTAX, message, place=ENTIRE), *first]
    if not commands and not problems:
        problems.append(
            error(ScriptCode.SYNTAX, "the script holds no command", place=ENTIRE)
        )
    ordered = Findings(problems).by_place()
    return c.Script(tuple(commands), ordered.warnings, line_count(text)), ordered


def _nothing(problem: Finding) -> tuple[c.Script, Findings]:
    """Return the script of a text that is none, and the error that says so."""
    return c.Script(()), Findings((problem,))


def read_row(row: CodeLine, problems: list[Finding]) -> c.Command | None:
    """Read the command of a row; None after an error, which is added to `problems`."""
    return _Line(row, problems).command()


def content(text: Source) -> str | bytes:
    """Return the text or bytes of a script as given; read a path's file as bytes."""
    if isinstance(text, str | bytes):
        return text
    read: bytes = backend("scripts").read(text)
    return read


@dataclass(frozen=True)
class _Parts:
    """A line taken apart; arguments and the rest are empty fields where nothing is written."""

    spec: Spec
    first: Field
    second: Field
    wait: Field
    timeout: Field
    expected: Field


class _Refused(Exception):
    """A line that cannot be read at all, and where."""

    def __init__(self, code: ScriptCode, column: int, message: str) -> None:
        """Make the error of a line with its code, its column (from 1) and message."""
        super().__init__(message)
        self.code = code
        self.column = column


class _Line:
    """Reads one row and reports its problems."""

    def __init__(self, row: CodeLine, problems: list[Finding]) -> None:
        """Take one row to be parsed; problems found in it are appended to `problems`.

        The component is the first column, in a row without tabs the first word.
        """
        self.row = row
        self.problems = problems
        if row.columns:
            self.component = row.columns[0]
        else:
            self.component = row.words()[0]
        self.end = Field("", len(row.text) + 1)

    def error(self, code: ScriptCode, column: int, message: str) -> None:
        """Add an error about this line."""
        self.problems.append(error(code, message, place=Place(self.row.line, column)))

    def warn(self, code: ScriptCode, column: int, message: str) -> None:
        """Add a warning about this line, at a column (from 1)."""
        self.problems.append(warning(code, message, place=Place(self.row.line, column)))

    def command(self) -> c.Command | None:
        """Read the row's command; add an error to `problems` and return None if it cannot
        be read.

        An unknown component may be a custom one, with a warning (`_unknown`).
        """
        try:
            if not self.component.text:
                raise _Refused(
                    ScriptCode.SYNTAX, 1, "the component (first column) is missing"
                )
            if self.row.columns is None:
                parts = self._padded()
            else:
                parts = self._tabbed(self.row.columns)
            if parts is None:
                return self._unknown()
            return self._build(parts)
        except _Refused as refused:
            self.error(refused.code, refused.column, str(refused))
            return None

    def _tabbed(self, columns: tuple[Field, ...]) -> _Parts | None:
        """Divide a row of TAB separated columns; None for an unknown command.

        A row without a known command in its second column is divided at blanks instead
        (`_padded`), since the command's words may be in several columns.

        Args:
            columns: of the row.

        Returns:
            The columns, the missing ones empty; None for an unknown command.

        Raises:
            _Refused: text in a column beyond the seventh.
        """
        if len(columns) > 1:
            verb = columns[1]
        else:
            verb = self.end
        spec = None
        if verb.text:
            spec = grammar.find(self.component.text, verb.text)
        if spec is None:  # a multi-word command may be split over columns here too
            return self._padded()
        rest = (*columns[2:], *[self.end] * 5)
        extra = next((field for field in rest[5:] if field.text), None)
        if extra is not None:
            message = (
                f"column 8 holds {shorten(extra.text)!r}; a line has seven columns: component, "
                "command, argument 1, argument 2, wait, timeout, expected"
            )
            raise _Refused(ScriptCode.SYNTAX, extra.column, message)
        return _Parts(spec, *rest[:5])

    def _padded(self) -> _Parts | None:
        """Divide a row at blanks into command, arguments, wait and times; drop its
        comment.

        One number after the wait is the expected duration; two are time-out and expected
        duration. In an argument that may have spaces, a comment mark before the wait is
        text.

        Returns:
            The columns, the missing ones empty; None for an unknown command.

        Raises:
            _Refused: more words than the command has arguments.
        """
        words = self.row.words()
        match = grammar.match(self.component.text, [w.text for w in words[1:6]])
        if match is None:
            return None
        spec, count = match
        start = 1 + count
        at, width = _find_wait(words, start)
        if not spec.free or at == len(words):
            comment = next((i for i in range(start, at) if _is_comment(words[i])), None)
            if comment is not None:
                words = words[:comment]
                at = comment
                width = 0
        wait = self.end
        if width:
            wait = Field(
                " ".join(w.text for w in words[at : at + width]), words[at].column
            )
        tail = _until_comment(words[at + width : at + width + 3])[:2]
        # One number after the wait is in the place of the TAB form's expected duration.
        if len(tail) == 2:
            timeout, expected = tail
        else:
            timeout, expected = (self.end, *tail, self.end)[:2]
        first, second = self._arguments(spec, words[start:at])
        return _Parts(spec, first, second, wait, timeout, expected)

    def _arguments(self, spec: Spec, body: Sequence[Field]) -> tuple[Field, Field]:
        """Divide the words between command and wait into two arguments.

        An argument that may have spaces takes all words, but a last one of digits where
        the command has two arguments.

        Args:
            spec: the command, with the number of its arguments.
            body: the words.

        Returns:
            The two arguments, empty where the command has fewer.

        Raises:
            _Refused: more words than arguments.
        """
        none = Field("", body[0].column if body else len(self.row.text) + 1)
        if not body:
            return none, none
        if spec.free:
            last = body[-1]
            if spec.arguments == 2 and len(body) > 1 and last.text.isdigit():
                return self._span(body[:-1]), last
            return self._span(body), none
        if len(body) > spec.arguments:
            extra = body[spec.arguments]
            allowed = ("no argument", "one argument", "at most two arguments")[
                spec.arguments
            ]
            message = f"{shorten(extra.text)!r} is not expected here: the command takes {allowed}"
            raise _Refused(
                ScriptCode.SYNTAX,
                extra.column,
                f"{message}, then ACK, no wait, POS or RCV",
            )
        return body[0], body[1] if len(body) > 1 else none

    def _span(self, body: Sequence[Field]) -> Field:
        """Join words of this line (at least one) into one field, with the text between
        them.
        """
        start = body[0].column
        last = body[-1]
        return Field(self.row.text[start - 1 : last.column - 1 + len(last.text)], start)

    def _unknown(self) -> c.Command:
        """Read a row without a known command as a custom command with a warning, or
        refuse it with a suggestion.

        Returns:
            The custom command, which has no effect.

        Raises:
            _Refused: a component of the scanner or a name like its motors', with an
                unknown command or none; or a row without the form of a custom command
                (`_custom_form`).
        """
        name = self.component.text
        fields = [f for f in (self.row.columns or self.row.words())[1:] if f.text]
        if name.lower() in grammar.FIXED or grammar.is_reserved(name):
            allowed = grammar.vocabulary(name)
            knows = f"; it knows: {', '.join(allowed)}"
            if not fields:
                raise _Refused(
                    ScriptCode.SYNTAX, self.end.column, f"{name} without a command{knows}"
                )
            if self.row.columns:
                unknown = fields[0].text
            else:
                unknown = _likest_words([f.text for f in fields], allowed)
            message = f"{name} does not know {shorten(unknown)!r}{_meant(unknown, allowed)}{knows}"
            raise _Refused(ScriptCode.UNKNOWN_COMMAND, fields[0].column, message)
        if not self._custom_form(fields):
            message = (
                f"{shorten(name)!r} is not a component of the "
                f"scanner{_meant(name, (*grammar.FIXED,))}; a custom component needs "
                "a name, a command and a wait"
            )
            raise _Refused(
                ScriptCode.UNKNOWN_COMPONENT if fields else ScriptCode.SYNTAX,
                self.component.column,
                message,
            )
        message = f"{shorten(name)!r} is a custom component: allowed, without effect here"
        self.warn(ScriptCode.CUSTOM_COMPONENT, self.component.column, message)
        words = tuple(f.text for f in fields)
        return c.Custom(
            line=self.row.line, column=self.component.column, component=name, words=words
        )

    def _custom_form(self, fields: Sequence[Field]) -> bool:
        """Return whether the line can be for a component that the user added to the
        scanner.

        It needs a name of letters and digits, two more fields and a wait. A name near one
        of the scanner's own, with a command of that one, is a slip: False.

        Args:
            fields: of the row after the component.
        """
        name = self.component.text
        if len(fields) < 2 or _CUSTOM_NAME.fullmatch(name) is None:
            return False
        nearest = nearest_name(name, (*grammar.FIXED,))
        words = [word.text for field in fields[:5] for word in _split(field)]
        if nearest is not None and grammar.match(nearest, words) is not None:
            return False
        return any(_find_wait(_split(f), 0)[1] for f in fields) or bool(
            _find_wait(fields, 0)[1]
        )

    def _build(self, parts: _Parts) -> c.Command | None:
        """Read arguments, wait and times into a typed command; add an error for each that
        cannot be read.

        Errors: an argument too many, one that cannot be read, a wait or a time that is
        none.

        Args:
            parts: columns of a known command.

        Returns:
            The command; None if an error was added.
        """
        before = len(self.problems)
        fields: dict[str, object] = {
            "line": self.row.line,
            "column": self.component.column,
        }
        if issubclass(parts.spec.type, c.MotorCommand):
            fields["component"] = self.component.text
        for i, argument in enumerate((parts.first, parts.second)):
            if argument.text and i >= parts.spec.arguments:
                takes = ("no argument", "1 argument")[parts.spec.arguments]
                message = f"{shorten(argument.text)!r} is not expected: the command takes {takes}"
                self.error(ScriptCode.SYNTAX, argument.column, message)
        try:
            fields.update(parts.spec.read(parts.first.text, parts.second.text))
        except ArgumentError as error:
            column = (parts.first, parts.second)[error.index].column
            self.error(error.code, column, str(error))
        fields["wait"] = self._wait(parts)
        for key, field in (
            ("timeout_ms", parts.timeout),
            ("expected_ms", parts.expected),
        ):
            try:
                if field.text:
                    fields[key] = grammar.not_negative(field.text, key)
                else:
                    fields[key] = None
            except ArgumentError as error:
                self.error(ScriptCode.VALUE, field.column, str(error))
        if any(p.forbids for p in self.problems[before:]):
            return None
        return parts.spec.type(**fields)  # type: ignore[arg-type]

    def _wait(self, parts: _Parts) -> c.Wait:
        """Read the wait and check it against the trigger position; problems are added to
        `problems`.

        The wait POS is for moves with a trigger only (errors); a trigger without POS is a
        warning.

        Args:
            parts: columns of a known command.

        Returns:
            The wait as written. Where none is: ACK, for a move "no wait", with a warning.
            For an unknown one: ACK, with an error.
        """
        is_move = parts.spec.type is c.MoveAbsolute
        text = parts.wait.text
        column = parts.wait.column
        trigger = parts.second
        if not text:
            assumed = c.Wait.NO_WAIT if is_move else c.Wait.ACK
            message = f"no wait is written (ACK, no wait, POS or RCV); {assumed.value!r} is assumed"
            self.warn(ScriptCode.WAIT_MISSING, column, message)
            return assumed
        wait = grammar.WAITS.get(" ".join(text.lower().split()))
        if wait is None:
            message = f"wait is {shorten(text)!r}; allowed: ACK, no wait, POS, RCV"
            self.error(ScriptCode.WAIT, column, message)
            return c.Wait.ACK
        if wait is c.Wait.POS and not is_move:
            self.error(
                ScriptCode.WAIT, column, "POS is for moves only: it waits for a position"
            )
        elif wait is c.Wait.POS and not trigger.text:
            message = "POS needs the trigger position as argument 2 of the move"
            self.error(ScriptCode.TRIGGER, trigger.column, message)
        elif is_move and trigger.text and wait is not c.Wait.POS:
            message = (
                f"the trigger position is used with POS only; the wait is {wait.value!r}"
            )
            self.warn(ScriptCode.TRIGGER_UNUSED, trigger.column, message)
        return wait


def _is_comment(word: Field) -> bool:
    """Return whether a word begins a comment."""
    return word.text.startswith(_COMMENT_MARKS)


def _until_comment(words: Sequence[Field]) -> list[Field]:
    """Return the words before the first one that begins a comment, or all."""
    cut = next((i for i, w in enumerate(words) if _is_comment(w)), len(words))
    return list(words[:cut])


def _find_wait(words: Sequence[Field], start: int) -> tuple[int, int]:
    """Find the first wait that at most two numbers, and perhaps a comment, follow up to
    the end.

    Args:
        words: of a row.
        start: index from which to search.

    Returns:
        Index and number of its words (1, or 2 for "no wait"); `len(words)` and 0 if there
        is none.
    """
    for i in range(start, len(words)):
        text = words[i].text.lower()
        width = 1 if text in ("ack", "pos", "rcv") else 0
        if text == "no" and i + 1 < len(words) and words[i + 1].text.lower() == "wait":
            width = 2
        if width:
            tail = words[i + width : i + width + 3]
            numbers = _until_comment(tail)
            numeric = all(w.text.replace(".", "", 1).isdigit() for w in numbers)
            if numeric and (len(numbers) < 3 or len(numbers) < len(tail)):
                return i, width
    return len(words), 0


def _split(field: Field) -> list[Field]:
    """Split a field into words."""
    return [Field(text, field.column) for text in field.text.split()]


def _likest_words(words: Sequence[str], allowed: Sequence[str]) -> str:
    """Return so many first words of a line as are likest to an allowed command."""
    most = max((len(command.split()) for command in allowed), default=1)
    heads = [" ".join(words[:n]) for n in range(1, min(most, len(words)) + 1)]

    def likeness(head: str) -> float:
        """Return the share of letters that a head has in common with the nearest command."""
        same = (SequenceMatcher(None, head, one, autojunk=False) for one in allowed)
        return max((one.ratio() for one in same), default=0.0)

    return max(heads, key=likeness)


def _meant(asked: str, allowed: Sequence[str]) -> str:
    """Suggest the nearest allowed name, as " (did you mean ...?)"; "" if none is near."""
    near = nearest_name(asked, allowed)
    if near is None:
        return ""
    return f" (did you mean {near!r}?)"
