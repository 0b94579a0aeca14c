"""A client's end of one connection to the projector.

Several requests may be open at once; results that come in parts are put together. When the
connection ends, every open request fails with `ChannelLost` and the channel cannot be used again:
`projector_client` makes a new one.
"""

from __future__ import annotations

import asyncio
import logging
import math
import ssl as tls
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.protocol import (
    Answered,
    Code,
    Correlation,
    Notification,
    ProtocolError,
    Role,
    RpcError,
    image,
    parse_result,
)
from flexdt.protocol import msgpack_frames as frames
from flexdt.protocol.projector import Array
from flexdt.server.projector.wire import FrameLink
from flexdt.server.runtime.log import current, log


class ChannelLost(ConnectionError):
    """The connection ended while a request was open."""


@dataclass
class _Pending:
    """A request that waits for its answer, and the array that its parts go into."""

    answer: asyncio.Future[Answered[_Pending]]
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
        self._calls: Correlation[_Pending] = Correlation(Role.CLIENT)
        self._notes: set[asyncio.Future[None]] = set()
        self._closed = False
        self.link = FrameLink(self._frame, self._broken, self._lost)

    @classmethod
    async def connect(cls, host: str, port: int, ssl: tls.SSLContext | None = None) -> Channel:
        """Connect to a server.

        Raises:
            OSError: no server answers.
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
        """End the connection; open requests fail."""
        self._closed = True
        self.link.transport.abort()
        self._lost(self.link)

    async def ask(self, method: str, params: Mapping[str, object]) -> object:
        """Send a request and wait for its result.

        Raises:
            RpcError: the answer is an error.
            ChannelLost: the connection has ended.
        """
        return (await self._request(method, params, None))[0]

    async def ask_array(
        self, method: str, params: Mapping[str, object], shape: tuple[int, ...]
    ) -> npt.NDArray[np.float32]:
        """Request a float32 array of `shape`, which comes in one piece or in parts; read-only.

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
        pending = _Pending(asyncio.get_running_loop().create_future(), shape)
        request = self._calls.request(method, params, pending, (current() or "")[:100])
        sent = False
        try:
            await self.link.send(request)
            sent = True
            return (await pending.answer).result(), pending.parts
        except ConnectionResetError:
            raise ChannelLost("the connection ended") from None
        except asyncio.CancelledError:
            sent = True  # perhaps, so the answer may come
            if not self.lost:
                self._notify(Notification("cancel", {"request": request.id}))
            raise
        finally:
            self._calls.abandon(request, sent=sent)

    def _notify(self, notification: Notification) -> None:
        note = asyncio.ensure_future(self.link.send(notification))
        self._notes.add(note)
        note.add_done_callback(self._noted)

    def _noted(self, note: asyncio.Future[None]) -> None:
        self._notes.discard(note)
        if not note.cancelled():
            note.exception()  # a connection that has ended needs no cancellation

    def _frame(self, link: FrameLink, body: memoryview) -> None:
        try:
            received = self._calls.receive(frames.unpack(body))
        except ProtocolError:
            self.close()
            return
        for item in received:
            match item:
                case Answered(pending) if not pending.answer.done():
                    pending.answer.set_result(item)
                case Notification("part", params) if isinstance(params, Mapping):
                    if (waiter := self._calls.waiter(params.get("request"))) is not None:
                        waiter.part(params)

    def _broken(self, link: FrameLink, error: RpcError) -> None:
        link.transport.abort()

    def _lost(self, link: FrameLink) -> None:
        if link.mid_frame and not self._closed:
            self._calls.violate(ProtocolError("the stream ended inside a frame"))
        why = "the connection ended"
        if self._calls.violation is not None:
            why = f"the projector broke the protocol: {self._calls.violation}"
            log(why, logging.ERROR)
        for pending in self._calls.waiting():
            if not pending.answer.done():
                pending.answer.set_exception(ChannelLost(why))
