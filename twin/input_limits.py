"""What a file or text from outside may cost: one table of formats, and checks made before parsing.

A document of a few bytes may claim, inflate to or make a parser allocate any amount. Readers of
every format look up their row in `LIMITS`: what is read has at most so many bytes and inflates
to at most so many, and has at most so many parts, nested at most so deep. `seconds` is what
reading at these limits may take; `tests/studies/bombs.py` measures it.

Sources of the rows: a scan of 100 000 views has 1.2 million numbers of geometry, and its
`flexdt.json` 100 MB; the largest panels have 8192 x 8192 pixels. Round figures above these are
assumed.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO, Final

from flexdt.twin.errors import TwinError

MIB: Final = 1 << 20
"""Bytes."""
NAMED_PROBLEMS: Final = 50
"""Largest number of problems of one document that an error names; validation ends there."""


class InputLimitError(TwinError):
    """A file or text from outside that is larger than its format's row allows."""


@dataclass(frozen=True)
class InputLimit:
    """What one input of a format may cost.

    Attributes:
        file_bytes: of the file or text [bytes].
        decoded_bytes: of all that is decoded or inflated from it [bytes].
        parts: of `counted`.
        depth: nesting of lists, tables or the parts of a key.
        seconds: that reading it may take [s of one slow core].
        counted: what a part is, for messages.
    """

    file_bytes: int
    decoded_bytes: int
    parts: int
    depth: int = 1000
    seconds: float = 10.0
    counted: str = "values"


LIMITS: Final[Mapping[str, InputLimit]] = {
    # Documents.
    "json": InputLimit(64 * MIB, 256 * MIB, 2_000_000),
    "flexdt.json": InputLimit(128 * MIB, 512 * MIB, 5_000_000),
    "toml": InputLimit(4 * MIB, 64 * MIB, 500_000, depth=64),
    "xml": InputLimit(64 * MIB, 256 * MIB, 2_000_000, counted="elements"),
    "settings": InputLimit(16 * MIB, 64 * MIB, 2_000_000, counted="lines"),
    "table": InputLimit(64 * MIB, 256 * MIB, 4_000_000, counted="values"),
    "script": InputLimit(64 * MIB, 256 * MIB, 1_000_000, counted="lines"),
    "log": InputLimit(256 * MIB, 512 * MIB, 4_000_000, seconds=60.0, counted="lines"),
    # Arrays and images.
    "npy": InputLimit(256 * MIB, 256 * MIB, 1, counted="arrays"),
    "npz": InputLimit(256 * MIB, 256 * MIB, 1000, counted="arrays"),
    "tiff": InputLimit(512 * MIB, 256 * MIB, 1_000_000, counted="strips"),
    # Meshes: faces are counted after parsing, parts before.
    "stl": InputLimit(
        256 * MIB, 1024 * MIB, 4_000_000, seconds=60.0, counted="triangles"
    ),
    "ply": InputLimit(
        256 * MIB, 1024 * MIB, 4_000_000, seconds=60.0, counted="triangles"
    ),
    "off": InputLimit(
        256 * MIB, 1024 * MIB, 4_000_000, seconds=60.0, counted="triangles"
    ),
    "obj": InputLimit(
        256 * MIB, 1024 * MIB, 4_000_000, seconds=60.0, counted="triangles"
    ),
    "glb": InputLimit(
        256 * MIB, 1024 * MIB, 1000, seconds=60.0, counted="nodes and parts"
    ),
}
"""Format -> what one input of it may cost."""


def require_bytes(form: str, size: int, file: str) -> None:
    """Check the size of a file or text, or of what it claims to hold as a whole.

    Args:
        form: key of `LIMITS`.
        size: [bytes].
        file: name for the message.

    Raises:
        InputLimitError: it is more.

    Example:
        >>> require_bytes("toml", 5_000_000, "m.toml")
        Traceback (most recent call last):
        flexdt.twin.input_limits.InputLimitError: m.toml has 5000000 bytes; allowed: at most 4194304
    """
    most = LIMITS[form].file_bytes
    if size > most:
        said = f"{file} has {size} bytes"
        raise InputLimitError.instead(said, size, f"at most {most}", path=file)


def require_decoded(form: str, size: int, file: str) -> None:
    """Check what an input inflates to, or says it does [bytes]; raise InputLimitError if
    it is more than its row allows.
    """
    most = LIMITS[form].decoded_bytes
    if size > most:
        said = f"{file} claims to hold {size} bytes"
        raise InputLimitError.instead(said, size, f"at most {most}", path=file)


def require_parts(form: str, count: int, file: str) -> None:
    """Check a number of parts; raise InputLimitError if it is more than its row allows."""
    limit = LIMITS[form]
    if count > limit.parts:
        said = f"{file} has {count} {limit.counted}"
        raise InputLimitError.instead(said, count, f"at most {limit.parts}", path=file)


def require_strips(counts: Sequence[int], size: int, file: str) -> None:
    """Check a TIFF's strips: their number, and that together they fit in the file.

    So none is read twice. `size`: [bytes]. Raises InputLimitError.
    """
    require_parts("tiff", len(counts), file)
    claimed = sum(counts)
    if claimed > size:
        said = f"{file} claims strips of {claimed} bytes"
        raise InputLimitError.instead(
            said, claimed, f"the {size} bytes it has", path=file
        )


def read_limited(stream: BinaryIO, form: str, file: str) -> bytes:
    """Read all of an open file, at most one byte more than its row allows.

    Devices and pipes, whose size nothing states, end there, too.

    Raises InputLimitError: it has more; OSError: it cannot be read.
    """
    most = LIMITS[form].file_bytes
    raw = stream.read(most + 1)
    if len(raw) > most:
        said = f"{file} is too long"
        raise InputLimitError.instead(said, len(raw), f"at most {most} bytes", path=file)
    return raw


def require_json(text: str, file: str, form: str = "json") -> None:
    """Check a JSON text before it is parsed: its length and its number of values.

    Values are counted by their separators, those inside texts included, so the count may
    be too large and never too small.

    Raises:
        InputLimitError: it is too long or has too many values.
    """
    require_bytes(form, len(text), file)
    require_parts(form, 1 + text.count(",") + text.count("[") + text.count("{"), file)


_TEXTS: Final = re.compile(
    r'"""(?:[^\\]|\\.)*?"""|' r"'''.*?'''|" r'"(?:[^"\\\n]|\\.)*"|' r"'[^'\n]*'|#[^\n]*",
    re.DOTALL,
)
"""Texts and comments of TOML."""
_ENDS: Final = re.compile(r"[,=\[\]{}\n]")
"""What ends a key or a number of TOML."""


def parse_toml(text: str, file: str) -> dict[str, Any]:
    """Parse a TOML text, after a check of its length, its number of values and the
    parts of its keys.

    The parser's work grows with the square of a key's parts.

    Args:
        text: that is parsed.
        file: name for the message.

    Raises:
        InputLimitError: it is too long, has too many values, or a key of too many parts.
        ValueError: no TOML (TOMLDecodeError), or nested too deep.

    Example:
        >>> parse_toml("a.b = 1", "m.toml")
        {'a': {'b': 1}}
    """
    import tomllib

    require_bytes("toml", len(text), file)
    bare = _TEXTS.sub("''", text)
    pieces = _ENDS.split(bare)
    require_parts("toml", len(pieces), file)
    deepest, most = 1 + max(piece.count(".") for piece in pieces), LIMITS["toml"].depth
    if deepest > most:
        said = f"{file} has a key of {deepest} parts"
        raise InputLimitError.instead(said, deepest, f"at most {most}", path=file)
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("it nests too deep") from None
