"""A client's end of one connection to the projector: requests and their answers by id.

Several requests may be under way; results that come in parts are put together. When the
connection ends, whoever waits gets `ChannelLost`, and the channel is of no more use: making a new
one is `projector_client`'s business.
"""

from __future__ import annotations

import asyncio
import itertools
import math
import ssl as tls
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.protocol import (
    Code,
    Failure,
    Malformed,
    Notification,
    Request,
    Response,
    RpcError,
    frames,
    image,
    parse_result,
)
from flexdt.protocol.projector import Array
from flexdt.server.projector.wire import FrameLink
from flexdt.server.trace import current


class ChannelLost(ConnectionError):
    """The connection ended while a request was under way."""


@dataclass
class _Pending:
    """A request that waits for its answer, and the array that its parts go into."""

    answer: asyncio.Future[object]
    shape: tuple[int, ...] | None
    parts: npt.NDArray[np.float32] | None = None

    def part(self, params: Mapping[str, object]) -> None:
        start, data = params.get("start"), params.get("data")
        if self.shape is None or not isinstance(start, int):
            return
        if self.parts is None:
            self.parts = np.empty(math.prod(self.shape), np.float32)
        values = np.frombuffer(image.payload(data), np.float32)
        self.parts[start : start + len(values)] = values


class Channel:
    """An open connection; made by `connect`."""

    def __init__(self) -> None:
        self._ids = itertools.count(1)
        self._pending: dict[int | str, _Pending] = {}
        self._notes: set[asyncio.Future[None]] = set()
        self.link = FrameLink(self._frame, self._broken, self._lost)

    @classmethod
    async def connect(cls, host: str, port: int, ssl: tls.SSLContext | None = None) -> Channel:
        """Connect to a server.

        Raises:
            OSError: nobody answers.
        """
        made = cls()
        loop = asyncio.get_running_loop()
        await loop.create_connection(lambda: made.link, host, port, ssl=ssl)
        return made

    @property
    def lost(self) -> bool:
        """Whether the connection has ended."""
        return self.link.lost

    def close(self) -> None:
        """End the connection; requests under way fail."""
        self.link.transport.abort()
        self._lost(self.link)

    async def ask(self, method: str, params: Mapping[str, object]) -> object:
        """Ask and wait for the answer.

        Raises:
            RpcError: the answer is an error.
            ChannelLost: the connection has ended.
        """
        return (await self._request(method, params, None))[0]

    async def ask_array(
        self, method: str, params: Mapping[str, object], shape: tuple[int, ...]
    ) -> npt.NDArray[np.float32]:
        """Ask for a float32 array of `shape`, in one piece or in parts; read-only.

        Raises:
            RpcError: the answer is an error, or no such array.
            ChannelLost: the connection has ended.
        """
        answer, parts = await self._request(method, params, shape)
        if isinstance(answer, Mapping) and answer.get("data") is not None:
            array = np.asarray(image.decode(answer))
            if array.shape == shape and array.dtype == np.float32:
                return array
        elif parts is not None and tuple(parse_result(Array, answer).shape) == shape:
            parts.setflags(write=False)
            return np.asarray(parts.reshape(shape))
        raise RpcError(Code.INTERNAL, f"the projector's answer to {method} is no {shape} array")

    async def _request(
        self, method: str, params: Mapping[str, object], shape: tuple[int, ...] | None
    ) -> tuple[object, npt.NDArray[np.float32] | None]:
        # What caused the request is in its id, so that both servers' logs can be put together.
        number, trace = next(self._ids), current()
        id: int | str = f"{trace[:100]}/{number}" if trace else number
        pending = _Pending(asyncio.get_running_loop().create_future(), shape)
        self._pending[id] = pending
        try:
            await self.link.send(Request(id, method, params))
            return await pending.answer, pending.parts
        except ConnectionResetError:
            raise ChannelLost("the connection ended") from None
        except asyncio.CancelledError:
            self._cancel(id)
            raise
        finally:
            del self._pending[id]

    def _cancel(self, id: int | str) -> None:
        """Tell the server that nobody waits for `id` any more."""
        if self.lost:
            return
        note = asyncio.ensure_future(self.link.send(Notification("cancel", {"request": id})))
        self._notes.add(note)
        note.add_done_callback(self._noted)

    def _noted(self, note: asyncio.Future[None]) -> None:
        self._notes.discard(note)
        if not note.cancelled():
            note.exception()  # a connection that has ended needs no cancellation

    def _frame(self, link: FrameLink, body: memoryview) -> None:
        match frames.unpack(body):
            case Response(id, result):
                self._settle(id, result)
            case Failure(id, error) | Malformed(error, id):
                self._settle(id, error)
            case Notification("part", params) if isinstance(params, Mapping):
                pending = self._waiting(params.get("request"))
                if pending is not None:
                    pending.part(params)

    def _waiting(self, id: object) -> _Pending | None:
        return self._pending.get(id) if isinstance(id, (int, str)) else None

    def _settle(self, id: object, outcome: object) -> None:
        pending = self._waiting(id)
        if pending is None or pending.answer.done():
            return
        if isinstance(outcome, Exception):
            pending.answer.set_exception(outcome)
        else:
            pending.answer.set_result(outcome)

    def _broken(self, link: FrameLink, error: RpcError) -> None:
        link.transport.abort()

    def _lost(self, link: FrameLink) -> None:
        for pending in self._pending.values():
            if not pending.answer.done():
                pending.answer.set_exception(ChannelLost("the connection ended"))
