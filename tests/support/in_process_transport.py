"""A client's transport straight into a function, through the codec on both ways."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable

from flexdt.clients.client.transport import ConnectionLost
from flexdt.protocol import Codec, Connection, Message


class InProcessTransport:
    """Messages go to a function and its answers come back, through the codec on both ways.

    Any thread may push and close.

    Args:
        handler: takes a message, returns the messages to answer with (none, one or several).
        codec: what the two ends speak.
    """

    place = "this process"

    def __init__(
        self,
        handler: Callable[[Message], Iterable[Message]],
        codec: Codec = Codec.MSGPACK,
    ) -> None:
        """Begin closed; `opened` counts how often it is opened."""
        self.handler, self.codec = handler, codec
        self.opened = 0
        self._client, self._server = Connection(codec), Connection()
        self._alive = False

    async def open(self) -> None:
        """Start afresh."""
        self.opened += 1
        self._loop = asyncio.get_running_loop()
        self._inbox: asyncio.Queue[bytes] = asyncio.Queue()
        self._client, self._server = Connection(self.codec), Connection()
        self._alive = True

    async def send(self, message: Message) -> None:
        """Hand the message to the handler; its answers wait to be received."""
        if not self._alive:
            raise ConnectionLost("not connected")
        for received in self._server.receive_data(self._client.send(message)):
            for answer in self.handler(received):
                self.push(answer)

    def push(self, message: Message) -> None:
        """Send something from the server's side, such as an event."""
        self._put(self._server.send(message))

    async def receive(self) -> list[Message]:
        """Messages, or an empty list at the end."""
        messages: list[Message] = []
        while not messages:
            data = await self._inbox.get()
            if not data:
                return []
            messages = self._client.receive_data(data)
        return messages

    def close(self) -> None:
        """End the connection."""
        self._alive = False
        self._put(b"")

    def _put(self, data: bytes) -> None:
        self._loop.call_soon_threadsafe(self._inbox.put_nowait, data)
