"""The agreement between two processes: messages, framing, codec, images, errors. No sockets."""

from flexdt.protocol.codec import Codec
from flexdt.protocol.connection import MAX_FRAME, Connection, Prepared
from flexdt.protocol.messages import (
    Answered,
    Batch,
    Correlation,
    Failure,
    Malformed,
    Message,
    Notification,
    Request,
    Response,
    Role,
    event,
    hello_params,
)
from flexdt.protocol.method import (
    PROTOCOL,
    AnyMethod,
    Method,
    parse_params,
    parse_result,
    require_compatible,
)
from flexdt.protocol.methods import METHODS, find
from flexdt.protocol.rpc_errors import Code, ProtocolError, RpcError

__all__ = [
    "MAX_FRAME",
    "METHODS",
    "PROTOCOL",
    "Answered",
    "AnyMethod",
    "Batch",
    "Code",
    "Codec",
    "Connection",
    "Correlation",
    "Failure",
    "Malformed",
    "Message",
    "Method",
    "Notification",
    "Prepared",
    "ProtocolError",
    "Request",
    "Response",
    "Role",
    "RpcError",
    "event",
    "find",
    "hello_params",
    "parse_params",
    "parse_result",
    "require_compatible",
]
