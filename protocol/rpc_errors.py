"""Error codes of the wire and the one exception that carries them.

JSON-RPC's own codes, the twin's (-32001 to -32008, fixed), two of the projector's, and
one that the viewer answers its pages with. The `data` of an error holds the received
value and the allowed ones. The server maps the twin's own exceptions to these codes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import islice


class Code(IntEnum):
    """Every error code that may appear on the wire, with the line that `rpc.discover`
    publishes."""

    meaning: str

    def __new__(cls, code: int, meaning: str) -> Code:
        """Make an enum member whose value is `code`, with the attribute `meaning`."""
        member = int.__new__(cls, code)
        member._value_ = code
        member.meaning = meaning
        return member

    PARSE = -32700, "not valid JSON or MessagePack"
    INVALID_REQUEST = -32600, "not a JSON-RPC 2.0 request"
    METHOD_NOT_FOUND = -32601, "no such method"
    INVALID_PARAMS = -32602, "parameters do not fit the method"
    INTERNAL = -32603, "the server failed; details are in its log"
    LIMIT = -32001, "outside a travel, speed or setting limit, or the disk refuses"
    COLLISION = -32002, "the motion would touch something"
    BUSY = -32003, "busy, or somebody else is the controller"
    NOT_AUTHORISED = -32004, "a valid token is needed"
    SCRIPT_INVALID = -32005, "the script does not hold; data lists line, column, message"
    PROJECTOR_UNAVAILABLE = -32006, "the projector server does not answer"
    NOT_IDENTIFIABLE = -32007, "the data cannot determine what was asked for"
    TOO_LARGE = -32008, "message, image, volume or list above a stated size"
    SUPERSEDED = -32009, "a newer request of the same kind took its place"
    CANCELLED = -32010, "cancelled by its sender"
    LINK_DOWN = -32011, "the viewer's link to the twin is not up"


@dataclass
class RpcError(Exception):
    """An error as it travels: `code`, one-line `message`, JSON-able `data`.

    Positional arguments only: pickling an exception repeats those.
    """

    code: int
    message: str
    data: object = None

    def __post_init__(self) -> None:
        """Convert the code, which may be a `Code`, to a plain int."""
        self.code = int(self.code)

    def __str__(self) -> str:
        return self.message


class ProtocolError(Exception):
    """The peer broke the protocol in a way that no answer can repair; close the connection."""


def parse_error(why: str) -> RpcError:
    """Make the error for bytes that are not a JSON document or MessagePack object."""
    return RpcError(Code.PARSE, f"parse error: {why}")


def invalid_request(why: str) -> RpcError:
    """Make the error for a document that is no JSON-RPC 2.0 message."""
    return RpcError(Code.INVALID_REQUEST, f"invalid request: {why}")


def method_not_found(asked: str, allowed: Iterable[str]) -> RpcError:
    """Make the error -32601 for an unknown method, with all methods in its data;
    returned, not raised.

    The name is cut after 200 characters; the data has the keys asked and
    allowed (sorted).
    """
    names = sorted(allowed)
    return RpcError(
        Code.METHOD_NOT_FOUND,
        f"no method {clip(asked)!r}; rpc.discover describes the {len(names)} there are",
        {"asked": clip(asked), "allowed": names},
    )


def invalid_params(
    message: str, problems: Sequence[Mapping[str, object]] = (), allowed: object = None
) -> RpcError:
    """Make (do not raise) the error -32602 for parameters that do not fit.

    `problems`: of `problem`; they and `allowed` are its data.
    """
    data: dict[str, object] = {"problems": [dict(p) for p in problems]}
    if allowed is not None:
        data["allowed"] = allowed
    return RpcError(Code.INVALID_PARAMS, message, data)


def problem(path: str, message: str, asked: object) -> dict[str, object]:
    """Make one entry of `invalid_params`: the parameter's path, the problem, the value given."""
    return {"path": path, "message": message, "asked": asked}


def internal(trace: str | None = None) -> RpcError:
    """Make the error for a failure of the server; its log has the details under
    the id `trace`."""
    message = "internal error; the server's log has the details"
    return RpcError(Code.INTERNAL, message, None if trace is None else {"trace": trace})


def busy(message: str, data: object = None) -> RpcError:
    """Make the error for a running job, or for a client that does not hold control."""
    return RpcError(Code.BUSY, message, data)


def not_authorised() -> RpcError:
    """Make the error -32004 for a missing or wrong token; returned, not raised. Its data
    names the call that is allowed."""
    message = "a valid token is needed: session.hello {token}"
    data = {"allowed": "session.hello with the server's token"}
    return RpcError(Code.NOT_AUTHORISED, message, data)


def too_large(
    what: str, asked: float | str, allowed: float, unit: str = "bytes"
) -> RpcError:
    """Make (do not raise) the error -32008 for something above its allowed size.

    `what`: with its article.
    """
    return RpcError(
        Code.TOO_LARGE,
        f"{what} of {asked} {unit} is too large; at most {allowed} {unit}",
        {"what": what, "asked": asked, "allowed": allowed, "unit": unit},
    )


def superseded(key: str) -> RpcError:
    """Make the error for a request that a newer one with the same key replaced."""
    return RpcError(
        Code.SUPERSEDED, f"superseded by a newer request for {key!r}", {"key": key}
    )


def link_down(why: str) -> RpcError:
    """Make the error for a missing or lost connection to the twin."""
    return RpcError(Code.LINK_DOWN, f"no connection to the twin: {why}")


def cancelled(request: object) -> RpcError:
    """Make the error for a request that its sender canceled."""
    return RpcError(Code.CANCELLED, "cancelled by its sender", {"request": request})


def clip(value: object, limit: int = 200) -> str:
    """Convert a value to text, cut after `limit` characters with "..." appended.

    Lone surrogates are escaped before the cut. `value`: a text is taken as it is; other
    plain data are formatted as by `repr`, no more of them than needed.
    """
    if isinstance(value, str):
        text = value[: limit + 1]
    else:
        text = _brief(value, limit)
    text = text.encode("utf-8", "backslashreplace").decode("utf-8")  # no lone surrogates
    if len(text) <= limit:
        return text
    return text[:limit] + "..."


def _brief(value: object, limit: int) -> str:
    """Format plain data like `repr`, but skip the parts that would be cut off.

    Each level down has a quarter of the limit; a whole number of over 4096 bits is
    described.

    Args:
        value: plain data, of any size.
        limit: number of characters that are needed; the text may be longer.

    Returns:
        A text that agrees with `repr(value)` in about `limit` characters; "..." replaces
        skipped members.
    """
    some = limit // 2
    match value:
        case str() | bytes() | bytearray():
            return repr(value[: limit + 1])
        case int() if value.bit_length() > 4096:
            return f"a whole number of {value.bit_length()} bits"
        case Mapping():
            pairs = islice(value.items(), some)
            inner = ", ".join(
                f"{_brief(k, limit)}: {_brief(v, limit // 4)}" for k, v in pairs
            )
            return "{" + inner + (", ...}" if len(value) > some else "}")
        case list() | tuple():
            inner = ", ".join(_brief(v, limit // 4) for v in value[:some])
            return "[" + inner + (", ...]" if len(value) > some else "]")
    return repr(value)
