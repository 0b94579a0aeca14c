"""Large messages are decoded and their parameters validated in a worker process, not on the
loop.

Decoding 15 MB of JSON, or describing their errors, holds an interpreter for seconds. What
comes back is small, or bytes: parameters of a call are unpickled when its turn comes.
"""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Final

from flexdt.protocol import METHODS, Codec, Connection, RpcError, find
from flexdt.protocol import messages as m
from flexdt.protocol.fields import Params
from flexdt.protocol.method import parse_params
from flexdt.protocol.methods.job_messages import TrajectoryInput
from flexdt.protocol.rpc_errors import too_large
from flexdt.runtime.fair_turns import REQUESTER, Requester
from flexdt.runtime.workers import Workers
from flexdt.server.network.shell_parts import Call, Frozen
from flexdt.server.scans.scan_record import PoseList

MAX_PARAMS: Final = 1 << 20
"""Largest size of a call's parameters, except for methods marked `bulky` [bytes]."""
MEMORY_BYTES: Final = 3 << 30
MAX_READ_S: Final = 60.0


class Reader:
    """Reads messages in workers; `close` must be called at the end."""

    def __init__(self) -> None:
        """Set up two worker processes, for what may be urgent and for the rest; each starts
        at its first message."""
        self._ordinary = Workers(1, MEMORY_BYTES, MAX_READ_S)
        # Its messages are at most `MAX_EXAMINED_BYTES`, and none of them waits for minutes.
        self._urgent = Workers(1, MEMORY_BYTES, MAX_READ_S)

    async def __call__(
        self, raw: bytes, wire: Connection, urgent: bool = False
    ) -> Frozen | tuple[Frozen, ...]:
        """Decode the message of `raw`, or those of a batch.

        An empty batch gives (). The parameters stay pickled.
        `raw`: bytes of the message. `wire`: its connection. `urgent`: whether it may be urgent;
        then it has a worker that larger messages do not keep.
        Raises RpcError: -32008, it cannot be read within the limits."""
        REQUESTER.set(Requester(wire, lambda: False))
        workers = self._urgent if urgent else self._ordinary
        kind, *items = await workers.ask(work, wire.codec, wire.max_batch, raw=(raw,))
        pairs = zip(items[::2], items[1::2], strict=True)
        frozen = tuple(Frozen(item, method.decode()) for method, item in pairs)
        return frozen if kind == b"batch" else frozen[0]

    def close(self) -> None:
        """End the processes."""
        self._ordinary.close()
        self._urgent.close()


def work(codec: Codec | None, most: int, raw: bytes) -> list[bytes]:
    """Decode a message or a batch and validate the parameters of its calls, in the
    worker.

    A malformed message's error is pickled. `most`: items in a batch. Returns b"batch" or
    b"single", then for each item the method's name (b"" if unknown or no call), and the
    pickle of `_pickled_call`.
    """
    message = Connection(codec, max_batch=most).decode(raw)
    batch = isinstance(message, m.Batch)
    if isinstance(message, m.Batch):
        items = message.items
    else:
        items = (message,)
    parts = [b"batch" if batch else b"single"]
    for item in items:
        name = ""
        if isinstance(item, m.Request | m.Notification):
            name = item.method
        parts += [name.encode() if name in METHODS else b"", _pickled_call(item)]
    return parts


def _pickled_call(message: m.Single) -> bytes:
    """Pickle a request or notification as a `Call` with validated parameters; other
    messages are pickled as they are.

    In place of parameters the call has an RpcError if they are not valid, or if its
    pickle is larger than `MAX_PARAMS` and the method is not bulky. A notification's call
    has no id and is not answered.
    """
    if not isinstance(message, m.Request | m.Notification):
        return pickle.dumps(message)
    answered = isinstance(message, m.Request)
    id = None
    if isinstance(message, m.Request):
        id = message.id
    call = Call(id, message.method, _params(message), answered)
    data = pickle.dumps(call)
    method = METHODS.get(message.method)
    if len(data) > MAX_PARAMS and (method is None or not method.bulky):
        what = f"what {message.method[:100]} is given"
        data = pickle.dumps(replace(call, params=too_large(what, len(data), MAX_PARAMS)))
    return data


def _params(message: m.Request | m.Notification) -> Params | RpcError:
    """Validate a call's parameters as the model of its method; the poses of a trajectory
    are packed into one text.

    Returns:
        The parameters, or (not raised) the RpcError: an unknown method, or parameters
        that do not fit.
    """
    try:
        params = parse_params(find(message.method), message.params)
    except RpcError as error:
        return error
    if isinstance(params, TrajectoryInput):
        # 200 000 poses as they are would take the loop's interpreter too long to unpickle.
        return params.model_copy(update={"poses": PoseList.of(params.poses)})
    return params
