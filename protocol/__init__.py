"""What two processes must agree on: messages, framing, codec, images, errors. No sockets."""

from flexdt.protocol.codec import Codec
from flexdt.protocol.connection import MAX_FRAME, Connection, Prepared
from flexdt.protocol.errors import Code, RpcError
from flexdt.protocol.messages import (
    Batch,
    Failure,
    Malformed,
    Message,
    Notification,
    Request,
    Response,
    event,
)
from flexdt.protocol.methods import (
    METHODS,
    PROTOCOL,
    Method,
    find,
    parse_params,
    parse_result,
    require_compatible,
)

__all__ = [
    "MAX_FRAME",
    "METHODS",
    "PROTOCOL",
    "Batch",
    "Code",
    "Codec",
    "Connection",
    "Failure",
    "Malformed",
    "Message",
    "Method",
    "Notification",
    "Prepared",
    "Request",
    "Response",
    "RpcError",
    "event",
    "find",
    "parse_params",
    "parse_result",
    "require_compatible",
]
