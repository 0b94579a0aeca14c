"""JSON-RPC 2.0 messages as frozen values, and their plain (dict and list) form.

`from_plain` never raises: a document that is not a message becomes `Malformed`, which holds the
error to answer with. Bytes are the business of `codec`, methods of `methods`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from flexdt.protocol.rpc_errors import Code, RpcError, clip, invalid_request, too_large

Id = str | int | float | None
"""A request's id: text or number; None only where the request's own id could not be read."""

Params = Mapping[str, object] | list[object] | None


@dataclass(frozen=True)
class Request:
    """A call that must be answered."""

    id: Id
    method: str
    params: Params = None


@dataclass(frozen=True)
class Notification:
    """A call without an answer; the server's events are notifications of method `event`."""

    method: str
    params: Params = None


@dataclass(frozen=True)
class Encoded:
    """A result that is already encoded, in the codec of the requesting connection, in pieces."""

    pieces: tuple[bytes, ...]


@dataclass(frozen=True)
class Response:
    """The answer to a request."""

    id: Id
    result: object


@dataclass(frozen=True)
class Failure:
    """The answer to a request that failed."""

    id: Id
    error: RpcError


@dataclass(frozen=True)
class Malformed:
    """Not a message: answer with `error`; if `fatal`, the connection must be closed."""

    error: RpcError
    id: Id = None
    fatal: bool = False

    @property
    def reply(self) -> Failure:
        """The answer to send."""
        return Failure(self.id, self.error)


Single = Request | Notification | Response | Failure | Malformed


@dataclass(frozen=True)
class Batch:
    """Several messages in one document, answered in one document."""

    items: tuple[Single, ...] = field(default_factory=tuple)


Message = Single | Batch


def event(topic: str, seq: int, time: float, data: object) -> Notification:
    """An event notification, `{topic, seq, time, data}` on the wire.

    Args:
        topic: state, projection, job or log.
        seq: counts the topic's events; a gap means that newer values have replaced older ones.
        time: the twin's clock [s].
        data: as the topic's model has it.
    """
    return Notification("event", {"topic": topic, "seq": seq, "time": time, "data": data})


def to_plain(message: Message) -> object:
    """The dict (or list, for a batch) that a codec writes."""
    match message:
        case Request(id, method, params):
            return _call({"jsonrpc": "2.0", "id": id, "method": method}, params)
        case Notification(method, params):
            return _call({"jsonrpc": "2.0", "method": method}, params)
        case Response(id, result):
            return {"jsonrpc": "2.0", "id": id, "result": result}
        case Failure(id, error):
            plain: dict[str, object] = {"code": error.code, "message": error.message}
            if error.data is not None:
                plain["data"] = finite(error.data)
            return {"jsonrpc": "2.0", "id": id, "error": plain}
        case Malformed():
            return to_plain(message.reply)
        case Batch(items):
            return [to_plain(item) for item in items]


def finite(data: object) -> object:
    """`data` of an error, with NaN and infinities as text because JSON has no numbers for them.

    An error repeats the value it is about, and that may have overflowed on the way.
    """
    match data:
        case float():
            return data if math.isfinite(data) else str(data)
        case dict():
            return {key: finite(value) for key, value in data.items()}
        case list() | tuple():
            return [finite(value) for value in data]
    return data


def from_plain(document: object, max_batch: int = 1000) -> Message:
    """The message in a decoded document; a batch may hold at most `max_batch` messages."""
    if not isinstance(document, list):
        return _single(document)
    if not document:
        return Malformed(invalid_request("an empty batch"))
    if len(document) > max_batch:
        return Malformed(too_large("a batch", len(document), max_batch, "messages"))
    return Batch(tuple(_single(item) for item in document))


def _call(plain: dict[str, object], params: Params) -> dict[str, object]:
    if params is not None:
        plain["params"] = params
    return plain


def _single(document: object) -> Single:
    if not isinstance(document, dict):
        return Malformed(invalid_request(f"expected an object, got {_kind(document)}"))
    id = document.get("id")
    known = _valid_id(id)
    answer_to: Id = id if known else None
    if document.get("jsonrpc") != "2.0":
        return Malformed(invalid_request('"jsonrpc" must be "2.0"'), answer_to)
    if not known:
        return Malformed(invalid_request(f'"id" must be text or a finite number, not {_kind(id)}'))
    if "method" in document:
        return _request(document, answer_to)
    if "result" in document and "error" not in document and "id" in document:
        return Response(answer_to, document["result"])
    if "error" in document and "result" not in document and "id" in document:
        return _failure(answer_to, document["error"])
    return Malformed(invalid_request('neither "method" nor "result" nor "error"'), answer_to)


def _request(document: dict[object, object], id: Id) -> Single:
    method, params = document["method"], document.get("params")
    extra = [clip(k, 40) for k in document if k not in ("jsonrpc", "id", "method", "params")]
    if extra:
        return Malformed(invalid_request(f"unknown member {', '.join(extra[:5])}"), id)
    if not isinstance(method, str):
        return Malformed(invalid_request(f'"method" must be text, not {_kind(method)}'), id)
    if not isinstance(params, (dict, list)) and "params" in document:
        return Malformed(invalid_request('"params" must be an object or a list'), id)
    if isinstance(params, dict) and not all(isinstance(key, str) for key in params):
        return Malformed(invalid_request('the names in "params" must be text'), id)
    call: Params = params if isinstance(params, (dict, list)) else None
    return Request(id, method, call) if "id" in document else Notification(method, call)


def _failure(id: Id, error: object) -> Single:
    if isinstance(error, dict):
        code, message = error.get("code"), error.get("message")
        if type(code) is int and isinstance(message, str):
            return Failure(id, RpcError(code, message, error.get("data")))
    return Malformed(RpcError(Code.INVALID_REQUEST, "invalid response: no code or message"), id)


def _valid_id(id: object) -> bool:
    if isinstance(id, float):
        return math.isfinite(id)
    return id is None or isinstance(id, str) or type(id) is int


_KINDS: Mapping[type, str] = {
    dict: "an object", list: "a list", str: "text", bool: "a truth value",
    int: "a number", float: "a number", type(None): "null", bytes: "bytes",
}  # fmt: skip


def _kind(value: object) -> str:
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return _KINDS.get(type(value), type(value).__name__)
