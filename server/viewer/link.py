"""A connection to the twin server for an asyncio program: requests, events, reconnection.

Speaks MessagePack on the ordinary port. After a lost connection it comes back by itself, says hello
and subscribes again; requests under way fail with `LinkDown` and are never repeated, since some of
them move the machine. It refuses to interpret what it carries.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import ssl as tls
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from flexdt.protocol import (
    PROTOCOL,
    Batch,
    Code,
    Codec,
    Connection,
    Failure,
    Message,
    Notification,
    Request,
    Response,
    RpcError,
)
from flexdt.server.log import log

CHUNK: Final = 1 << 18
FIRST_PAUSE_S: Final = 0.1
LONGEST_PAUSE_S: Final = 1.0
HELLO_S: Final = 10.0

OnEvent = Callable[[str, Mapping[str, object]], None]
"""Called with an event's topic and its params."""


class LinkDown(ConnectionError):
    """The twin cannot be reached at this moment."""


class Unsendable(RpcError):
    """Parameters that cannot travel: a number or a text that the wire has no bytes for."""

    def __init__(self, method: str, error: Exception) -> None:
        super().__init__(Code.INVALID_PARAMS, f"{method}: cannot be sent: {error}")


@dataclass(frozen=True)
class Way:
    """How to reach a twin server.

    Attributes:
        host, port: of the server.
        token: where it wants one.
        ssl: a client's TLS context.
    """

    host: str
    port: int
    token: str | None = None
    ssl: tls.SSLContext | None = None

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


class TwinLink:
    """One connection to the twin that comes back.

    Args:
        way: to the server.
        name: of this program, for people who look at the server.
        on_event: called with every event.
        on_change: called when the connection has been made or lost.
        subscription: parameters of `state.subscribe`, sent after every hello; None for none.
    """

    def __init__(
        self,
        way: Way,
        name: str,
        on_event: OnEvent = lambda topic, params: None,
        on_change: Callable[[], None] = lambda: None,
        subscription: Mapping[str, object] | None = None,
    ) -> None:
        self.way, self.name = way, name
        self.hello: Mapping[str, object] | None = None
        self.problem = "not connected yet"
        self._on_event, self._on_change = on_event, on_change
        self._subscription = subscription
        self._ids = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[object]] = {}
        self._writer: asyncio.StreamWriter | None = None
        self._wire = Connection(Codec.MSGPACK)
        self._up = asyncio.Event()
        self._greeting: asyncio.Task[None] | None = None

    @property
    def connected(self) -> bool:
        """Whether the twin has said hello."""
        return self.hello is not None

    @property
    def session(self) -> str | None:
        """This connection's name, as in `controller`."""
        name = None if self.hello is None else self.hello.get("session")
        return name if isinstance(name, str) else None

    async def wait_connected(self) -> None:
        """Wait for the twin."""
        await self._up.wait()

    async def run(self) -> None:
        """Keep the connection until cancelled."""
        pause = FIRST_PAUSE_S
        while True:
            try:
                reader, writer = await asyncio.open_connection(
                    self.way.host, self.way.port, ssl=self.way.ssl
                )
            except OSError as error:
                self.problem = f"nobody answers on {self.way} ({error.strerror or error})"
                self._on_change()
                await asyncio.sleep(pause)
                pause = min(2 * pause, LONGEST_PAUSE_S)
                continue
            self._writer, self._wire = writer, Connection(Codec.MSGPACK)
            self._greeting = asyncio.create_task(self._greet())
            try:
                await self._read(reader)
                self.problem = "the twin ended the connection"
            except (OSError, asyncio.IncompleteReadError) as error:
                self.problem = f"the connection broke ({error})"
            except Exception:  # whoever answers there: a later connection may be better
                self.problem = "what the twin said was not understood"
                log("a connection to the twin failed", logging.ERROR, error=True)
            finally:
                self._down(writer)
            await asyncio.sleep(pause)
            pause = FIRST_PAUSE_S if self._up.is_set() else min(2 * pause, LONGEST_PAUSE_S)
            self._up.clear()

    async def request(self, method: str, params: object = None) -> object:
        """Ask and wait for the answer.

        Raises:
            RpcError: the twin's answer is an error, or the parameters cannot travel.
            LinkDown: there is no connection, or it was lost meanwhile.
        """
        if not self.connected:
            raise LinkDown(self.problem)
        return await self._ask(method, params)

    async def subscribe(self, subscription: Mapping[str, object]) -> None:
        """Change what is subscribed to, now and after every reconnection."""
        self._subscription = subscription
        if self.connected:
            await self._ask("state.subscribe", subscription)

    async def _ask(self, method: str, params: object) -> object:
        if self._writer is None:
            raise LinkDown(self.problem)
        id = next(self._ids)
        try:
            data = self._wire.send(Request(id, method, {} if params is None else params))  # type: ignore[arg-type]
        except (ValueError, TypeError, OverflowError, RecursionError) as error:
            raise Unsendable(method, error) from None
        answer: asyncio.Future[object] = asyncio.get_running_loop().create_future()
        self._waiting[id] = answer
        try:
            self._writer.write(data)
            await self._writer.drain()
            return await answer
        except OSError as error:
            raise LinkDown(str(error)) from None
        finally:
            self._waiting.pop(id, None)

    async def _greet(self) -> None:
        hello: dict[str, object] = {"protocol": PROTOCOL, "client": self.name}
        if self.way.token is not None:
            hello["token"] = self.way.token
        try:
            async with asyncio.timeout(HELLO_S):
                answer = await self._ask("session.hello", hello)
                if self._subscription is not None:
                    await self._ask("state.subscribe", self._subscription)
        except (RpcError, LinkDown, TimeoutError) as error:
            self.problem = f"the twin on {self.way} does not let {self.name} in: {error}"
            if self._writer is not None:
                self._writer.close()
            return
        if isinstance(answer, Mapping):
            self.hello, self.problem = answer, ""
            self._up.set()
            self._on_change()

    async def _read(self, reader: asyncio.StreamReader) -> None:
        while data := await reader.read(CHUNK):
            for message in self._wire.receive_data(data):
                self._take(message)

    def _take(self, message: Message) -> None:
        match message:
            case Batch(items):
                for item in items:
                    self._take(item)
            case Response(int() as id, result):
                if (waiting := self._waiting.get(id)) is not None and not waiting.done():
                    waiting.set_result(result)
            case Failure(int() as id, error):
                if (waiting := self._waiting.get(id)) is not None and not waiting.done():
                    waiting.set_exception(error)
            case Failure(_, error):
                self.problem = error.message
            case Notification("event", params) if isinstance(params, Mapping):
                try:
                    self._on_event(str(params.get("topic")), params)
                except Exception:  # one event that nobody understands must not end them all
                    log("an event was not understood", logging.ERROR, error=True)

    def _down(self, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            writer.close()
        if self._greeting is not None:
            self._greeting.cancel()
        self._writer, self.hello = None, None
        for waiting in self._waiting.values():
            if not waiting.done():
                waiting.set_exception(LinkDown("the connection to the twin was lost"))
        self._on_change()
