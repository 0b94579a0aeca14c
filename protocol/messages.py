"""JSON-RPC 2.0 messages as frozen values, and their plain (dict and list) form.

`from_plain` never raises: a document that is not a message becomes `Malformed`, which
holds the error to answer with. Bytes are the business of `codec`, methods of `methods`.

`Connection` turns bytes into messages; a `Correlation` above it, at either end, knows
which requests have no answer yet. A client sends requests and a server answers, so each
role may receive only some messages:

| role   | may receive                                      | sends                          |
|--------|--------------------------------------------------|--------------------------------|
| client | answers to its own requests, notifications       | requests, notifications        |
| server | requests, notifications                          | answers, each once, and events |

Anything else is a `ProtocolError`, after which the connection cannot be trusted: if one
answer has a wrong id, the right one may have been sent to another client. Either peer may
end the stream, but only between two messages (see `Connection.receive_end`).
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Generic, TypeVar, assert_never

from flexdt.protocol.method import PROTOCOL
from flexdt.protocol.rpc_errors import (
    Code,
    ProtocolError,
    RpcError,
    clip,
    invalid_request,
    too_large,
)

Id = str | int | float | None
"""A request's id: text or number; None only where the request's own id could not be read."""

Params = Mapping[str, object] | list[object] | None
_JSON_TYPE_NAMES: Mapping[type, str] = {
    dict: "an object",
    list: "a list",
    str: "text",
    bool: "a truth value",
    int: "a number",
    float: "a number",
    type(None): "null",
    bytes: "bytes",
}
_W = TypeVar("_W")


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
    """A result that is already encoded, in the codec of the requesting connection, in
    pieces."""

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
    """Make an event notification, `{topic, seq, time, data}` on the wire.

    Args:
        topic: state, projection, job or log.
        seq: counts the topic's events; a gap means that newer values have replaced older
            ones.
        time: the twin's clock [s].
        data: as the topic's model has it.
    """
    return Notification("event", {"topic": topic, "seq": seq, "time": time, "data": data})


def to_plain(message: Message) -> object:
    """Convert a message to the dict (or the list, for a batch) that a codec encodes.

    Parameters that are None are left out, and so is error data that is None; numbers in
    error data that are not finite become text. Parameters and results are not copied.

    Args:
        message: a call, an answer, a malformed message (its error) or a batch.
    """
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
    """Replace NaN and infinities in an error's `data` by text, as JSON has none.

    Dicts, lists and tuples are copied at all levels, as an error repeats what overflowed.
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
    """Convert a decoded document to a message; raises nothing.

    `document`: plain data; `max_batch`: largest number of messages in a batch.
    Returns a message; a `Batch` for a list, whose items may be `Malformed`; `Malformed` for an
    empty or too long list, or for a document that is no message.
    """
    if not isinstance(document, list):
        return _single(document)
    if not document:
        return Malformed(invalid_request("an empty batch"))
    if len(document) > max_batch:
        return Malformed(too_large("a batch", len(document), max_batch, "messages"))
    return Batch(tuple(_single(item) for item in document))


def _call(plain: dict[str, object], params: Params) -> dict[str, object]:
    """Add `params` to a call's document, in place, unless they are None; return it."""
    if params is not None:
        plain["params"] = params
    return plain


def _single(document: object) -> Single:
    """Convert one document of a codec to a message; raises nothing.

    The checks, in this order: object, version "2.0", id, then method, result or error. An
    answer needs an id, which may be null, and has either a result or an error; members
    beyond these are ignored in answers.

    Args:
        document: plain data; not a batch.

    Returns:
        A request, notification, response or failure; `Malformed` with the error and,
        where known, the id for anything that JSON-RPC does not allow.
    """
    if not isinstance(document, dict):
        return Malformed(invalid_request(f"expected an object, got {_kind(document)}"))
    id = document.get("id")
    known = _valid_id(id)
    answer_to: Id = id if known else None
    if document.get("jsonrpc") != "2.0":
        return Malformed(invalid_request('"jsonrpc" must be "2.0"'), answer_to)
    if not known:
        return Malformed(
            invalid_request(f'"id" must be text or a finite number, not {_kind(id)}')
        )
    if "method" in document:
        return _request(document, answer_to)
    if "result" in document and "error" not in document and "id" in document:
        return Response(answer_to, document["result"])
    if "error" in document and "result" not in document and "id" in document:
        return _failure(answer_to, document["error"])
    return Malformed(
        invalid_request('neither "method" nor "result" nor "error"'), answer_to
    )


def _request(document: dict[object, object], id: Id) -> Single:
    """Read a request, or a notification if the document has no id.

    The checks, in this order: unknown members (at most five are named), method is text,
    params is an object or a list, names in params are text.

    Args:
        document: with the member `method`.
        id: its valid id, or None.

    Returns:
        The call, or `Malformed` with the first problem.
    """
    method = document["method"]
    params = document.get("params")
    extra = [
        clip(k, 40) for k in document if k not in ("jsonrpc", "id", "method", "params")
    ]
    if extra:
        return Malformed(invalid_request(f"unknown member {', '.join(extra[:5])}"), id)
    if not isinstance(method, str):
        return Malformed(
            invalid_request(f'"method" must be text, not {_kind(method)}'), id
        )
    if not isinstance(params, (dict, list)) and "params" in document:
        return Malformed(invalid_request('"params" must be an object or a list'), id)
    if isinstance(params, dict) and not all(isinstance(key, str) for key in params):
        return Malformed(invalid_request('the names in "params" must be text'), id)
    call: Params = None
    if isinstance(params, (dict, list)):
        call = params
    if "id" in document:
        return Request(id, method, call)
    return Notification(method, call)


def _failure(id: Id, error: object) -> Single:
    """Convert the answer to a failed request to `Failure`; its `data` may be missing.

    `id`: of the request, valid; `error`: the member of this name.
    Returns `Failure`; `Malformed` with the id unless `error` is an object with a whole `code`
    and a text `message`.
    """
    if isinstance(error, dict):
        code = error.get("code")
        message = error.get("message")
        if type(code) is int and isinstance(message, str):
            return Failure(id, RpcError(code, message, error.get("data")))
    return Malformed(
        RpcError(Code.INVALID_REQUEST, "invalid response: no code or message"), id
    )


def _valid_id(id: object) -> bool:
    """Return whether an id is text, a finite number or null."""
    if isinstance(id, float):
        return math.isfinite(id)
    return id is None or isinstance(id, str) or type(id) is int


def _kind(value: object) -> str:
    """Name the JSON type of a value, for error messages."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return _JSON_TYPE_NAMES.get(type(value), type(value).__name__)


class Role(Enum):
    """Which end of a connection this is."""

    CLIENT = "client"
    SERVER = "server"


@dataclass(frozen=True)
class Answered(Generic[_W]):
    """An answer and the waiter that was registered with its request."""

    waiter: _W
    answer: Response | Failure

    def result(self) -> object:
        """Return the result of the request.

        Raises RpcError: the answer is an error."""
        if isinstance(self.answer, Failure):
            raise self.answer.error
        return self.answer.result


class Correlation(Generic[_W]):
    """The open requests of one connection.

    `_W` is whatever the caller wants back with an answer: an event, a future, a record.
    Not thread-safe: callers that use several threads hold a lock around each call.

    Args:
        role: of this end.

    Attributes:
        reason: an error that the peer reported about the connection as a whole.
        violation: violation of the protocol by the peer; the connection must be closed.

    Example:
        >>> calls = Correlation[str](Role.CLIENT)
        >>> request = calls.request("session.ping", {}, "the ping's waiter")
        >>> [answered] = calls.receive(Response(request.id, {"time": 1.5}))
        >>> answered.waiter, answered.result()
        ("the ping's waiter", {'time': 1.5})
    """

    def __init__(self, role: Role) -> None:
        """Make the book-keeping of one side of a connection, with no request open.

        Ids of own requests count from 1; `reason` and `violation`, why it ended, are
        None.
        """
        self.role = role
        self.reason: RpcError | None = None
        self.violation: ProtocolError | None = None
        self._ids = itertools.count(1)
        # Requests sent and not answered. The waiter of an abandoned request is None; its
        # answer may still come and is no violation.
        self._open_requests: dict[Id, _W | None] = {}
        # Requests received and not answered; a client may use an id twice at the same time.
        self._owed_answers: Counter[Id] = Counter()

    # -- the client's side -------------------------------------------------------------------

    def request(
        self, method: str, params: Mapping[str, object], waiter: _W, trace: str = ""
    ) -> Request:
        """Make a request with a new id and register who waits for its answer.

        Ids are 1, 2, ..., after "trace/". Raises TypeError: a name in `params` is no
        text.
        """
        _require_text_names(params, method)
        number = next(self._ids)
        id: Id = f"{trace}/{number}" if trace else number
        self._open_requests[id] = waiter
        return Request(id, method, dict(params))

    def abandon(self, request: Request, *, sent: bool = True) -> None:
        """Stop waiting for an answer; one that still comes is dropped.

        If it was not `sent`, an answer would be a violation.
        """
        if not sent:
            self._open_requests.pop(request.id, None)
        elif request.id in self._open_requests:
            self._open_requests[request.id] = None

    def waiter(self, id: object) -> _W | None:
        """Return the waiter for the answer with this id; None for an abandoned or unknown
        request, or an id that is neither text nor a whole number."""
        if isinstance(id, (int, str)):
            return self._open_requests.get(id)
        return None

    def waiting(self) -> list[_W]:
        """Return all waiters, oldest request first."""
        return [waiter for waiter in self._open_requests.values() if waiter is not None]

    # -- the server's side -------------------------------------------------------------------

    def owes(self, id: Id) -> bool:
        """Return whether a received request of this id has no answer yet."""
        return self._owed_answers[id] > 0

    def answer(self, answer: Response | Failure) -> Response | Failure:
        """Check that an answer belongs to an open request of the client, and close that request.

        Of two requests with one id, one is closed. An error without id is about the connection
        and always allowed; it closes none.
        Returns the answer, unchanged.
        Raises LookupError: no open request has this id.
        """
        if isinstance(answer, Response) or answer.id is not None:
            if not self._owed_answers[answer.id]:
                raise LookupError(f"no open request has the id {answer.id!r}")
            self._owed_answers[answer.id] -= 1
            if not self._owed_answers[answer.id]:
                del self._owed_answers[answer.id]  # a long connection has many ids
        return answer

    @property
    def open(self) -> int:
        """Number of requests without an answer: sent by a client, received by a server."""
        match self.role:
            case Role.CLIENT:
                return len(self._open_requests)
            case Role.SERVER:
                return self._owed_answers.total()
            case _:
                assert_never(self.role)

    # -- both sides --------------------------------------------------------------------------

    def receive(self, message: Message) -> list[Answered[_W] | Request | Notification]:
        """Match a message from the peer to the open requests, item by item.

        A server gets calls, open from then on; a client notifications, and answers with
        waiters, also of a malformed message with an id. A parse error without one fails
        all. Raises ProtocolError: the peer may not send this; `violation` keeps it.
        """
        if self.violation is not None:
            raise self.violation
        if isinstance(message, Batch):
            return [each for item in message.items for each in self.receive(item)]
        match self.role:
            case Role.SERVER:
                return self._receive_call(message)
            case Role.CLIENT:
                return self._receive_answer(message)
            case _:
                assert_never(self.role)

    def _receive_answer(
        self, message: Single
    ) -> list[Answered[_W] | Request | Notification]:
        """Match what a server sends, other than a batch, to the open requests; see
        `receive`.

        Raises:
            ProtocolError: a request, an answer to no open request, or a fatal error;
                recorded as the violation.
        """
        match message:
            case Notification():
                return [message]
            case Failure(None, RpcError(code=Code.PARSE)):
                # The server could not read one of our requests, not even its id. Which request
                # failed is unknown, so all of them fail.
                waiting = [
                    (id, w) for id, w in self._open_requests.items() if w is not None
                ]
                self._open_requests.update((id, None) for id, _ in waiting)
                return [Answered(waiter, message) for _, waiter in waiting]
            case Failure(None, error) | Malformed(error, None):
                self.reason = error
                if isinstance(message, Malformed) and message.fatal:
                    raise self._violated(error.message)
                return []
            case Malformed(error, id):
                return self._settle(Failure(id, error))
            case Response() | Failure():
                return self._settle(message)
            case Request():
                asked = clip(message.method, 40)
                raise self._violated(f"the server sent a request ({asked})")
            case _:
                assert_never(message)

    def violate(self, violation: ProtocolError) -> None:
        """Record that the peer's bytes break the protocol (see `Connection.receive_end`)."""
        self.violation = violation

    def _settle(
        self, answer: Response | Failure
    ) -> list[Answered[_W] | Request | Notification]:
        """Match an answer to its request and close the request.

        Returns:
            The answer with its waiter, in a list; [] if the request was abandoned.

        Raises:
            ProtocolError: no such request is open; recorded as the violation.
        """
        if answer.id not in self._open_requests:
            raise self._violated(
                f"an answer to a request that is not open (id {clip(answer.id, 40)})"
            )
        waiter = self._open_requests.pop(answer.id)
        if waiter is None:
            return []
        return [Answered(waiter, answer)]

    def _receive_call(
        self, message: Message
    ) -> list[Answered[_W] | Request | Notification]:
        """Register a client's call as open, and return it in a list.

        A malformed message gives [], but its id is owed an answer. Raises ProtocolError:
        an answer instead.
        """
        match message:
            case Request(id):
                self._owed_answers[id] += 1
                return [message]
            case Notification():
                return [message]
            case Malformed(_, id):
                self._owed_answers[id] += id is not None
                return []
        raise self._violated("an answer to a server, which asks nothing")

    def _violated(self, what: str) -> ProtocolError:
        """Record a violation of the protocol, which later `receive` calls raise, and return
        its error."""
        self.violation = ProtocolError(what)
        return self.violation


def hello_params(client: str, token: str | None) -> dict[str, object]:
    """Make the parameters of `session.hello`, with which a client begins.

    `client`: the program, for people.
    """
    params: dict[str, object] = {"protocol": PROTOCOL, "client": client}
    if token is None:
        return params
    return {**params, "token": token}


def _require_text_names(value: object, where: str) -> None:
    """Check that all names in nested data are text: JSON would silently turn numbers into text.

    Mappings, lists and tuples are searched at all levels; other values pass.

    Args:
        value: parameters of a call.
        where: path of `value`, for the message.

    Raises TypeError: a name of another type; names the first, with its place.
    """
    if isinstance(value, Mapping):
        for name, inner in value.items():
            if not isinstance(name, str):
                raise TypeError(
                    f"{where}: the name {name!r} must be text, not {type(name).__name__}"
                )
            _require_text_names(inner, f"{where}.{name}")
    elif isinstance(value, (list, tuple)):
        for inner in value:
            _require_text_names(inner, where)
