"""One open page: its own connection to the twin, and an outbox in which only the newest survives.

A page is a person: it takes and loses control by itself, and what it holds ends with it. Answers
and notes are sent in order; states and images replace older ones that have not gone out, so a slow
browser costs nobody anything. It refuses to know what the requests mean.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from flexdt.protocol import METHODS, Code, RpcError
from flexdt.protocol.errors import internal
from flexdt.server.viewer.link import LinkDown, TwinLink, Way
from flexdt.server.viewer.uploads import Gathering

MAX_NOTES: Final = 1000
DRAG_S: Final = 0.1
HIDDEN: Final = frozenset({"session.hello", "state.subscribe", "state.unsubscribe"})
"""Methods of the wire that a page does not use: its viewer does."""

Local = Callable[["Page", Mapping[str, Any]], Awaitable[object]]
"""A method of the viewer itself."""


class Page:
    """A browser's page.

    Args:
        id: made up by the page; its scenes carry it too.
        connection: to the browser.
        way: to the twin.
        local: the viewer's own methods.
    """

    def __init__(
        self,
        id: str,
        connection: ServerConnection,
        way: Way,
        local: Mapping[str, Local],
    ) -> None:
        self.id = id
        self.kind = "line_integral"
        self.dark = False
        self.plan: Any = None
        self.orbit: Any = None
        """The focal spot's path over the plan, for the scenes of this page that open later."""
        self.tracks: Mapping[str, Any] | None = None
        """Beads of the last fit asked for here."""
        self._connection, self._local = connection, local
        self.gathering = Gathering()
        self.link = TwinLink(way, "flexdt viewer", on_change=self._link_changed)
        self._notes: deque[str] = deque(maxlen=MAX_NOTES)
        self._newest: dict[str, str | bytes] = {}
        self._due = asyncio.Event()
        self._tasks: set[asyncio.Task[None]] = set()
        self._dragged: dict[str, float] | None = None
        self._dragging: asyncio.Task[None] | None = None
        self.sent: dict[str, int] = {}

    async def run(self) -> None:
        """Serve until the browser goes."""
        own = [asyncio.create_task(self.link.run()), asyncio.create_task(self._send())]
        try:
            with contextlib.suppress(ConnectionClosed):
                async for message in self._connection:
                    if isinstance(message, str):
                        task = asyncio.create_task(self._handle(message))
                        self._tasks.add(task)
                        task.add_done_callback(self._tasks.discard)
        finally:
            for task in (*own, *self._tasks):
                task.cancel()
            await asyncio.gather(*own, *self._tasks, return_exceptions=True)

    def say(self, kind: str, **content: object) -> None:
        """Send something that must arrive, in order."""
        self._notes.append(json.dumps({"type": kind, **content}))
        self._due.set()

    def show(self, slot: str, content: str | bytes) -> None:
        """Send the newest of `slot`; an older one that has not gone out is forgotten."""
        self._newest[slot] = content
        self._due.set()

    def drag(self, targets: dict[str, float]) -> None:
        """Somebody drags a stage in one of this page's frames; the newest targets win."""
        self._dragged = targets
        if self._dragging is None or self._dragging.done():
            self._dragging = asyncio.create_task(self._follow())

    async def _follow(self) -> None:
        while (targets := self._dragged) is not None:
            self._dragged = None
            try:
                await self.link.request("axes.move", {"targets": targets})
            except (RpcError, LinkDown) as error:
                self.say("note", level="error", title="Cannot go there", body=_words(error))
            await asyncio.sleep(DRAG_S)

    async def _send(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            while True:
                await self._due.wait()
                self._due.clear()
                while self._notes:
                    await self._connection.send(self._notes.popleft())
                newest, self._newest = self._newest, {}
                for slot, content in newest.items():
                    await self._connection.send(content)
                    self.sent[slot] = self.sent.get(slot, 0) + 1

    async def _handle(self, text: str) -> None:
        id: object = None
        try:
            request = json.loads(text)
            id, method = request.get("id"), str(request["method"])
            params = request.get("params") or {}
            if not isinstance(params, dict):
                raise TypeError("params must be an object")
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            self._fail(id, RpcError(Code.INVALID_REQUEST, f"not a request: {error}"))
            return
        try:
            self.say("answer", id=id, result=await self._ask(method, params), at=time.time())
        except RpcError as error:
            self._fail(id, error)
        except LinkDown as error:
            self._fail(id, RpcError(Code.INTERNAL, f"no connection to the twin: {error}"))
        except asyncio.CancelledError:
            raise
        except Exception as error:
            # A page must hear of every failure; the process goes on for the others.
            self._fail(id, internal(f"{method}: {error}"))

    async def _ask(self, method: str, params: dict[str, Any]) -> object:
        if method in self._local:
            return await self._local[method](self, params)
        if method not in METHODS or method in HIDDEN:
            raise RpcError(Code.METHOD_NOT_FOUND, f"the page may not call {method!r}")
        return _without_bytes(await self.link.request(method, params))

    def _fail(self, id: object, error: RpcError) -> None:
        data = _without_bytes(error.data)
        self.say(
            "answer", id=id, error={"code": error.code, "message": _words(error), "data": data}
        )

    def _link_changed(self) -> None:
        self.say("session", connected=self.link.connected, session=self.link.session)


def _words(error: RpcError | LinkDown) -> str:
    """An error's message for people: with the page's button instead of the wire's method."""
    if not isinstance(error, RpcError):
        return str(error)
    match error.data:
        case {"controller": holder, "allowed": "session.control force"}:
            return f"{holder} is the controller; “Take over” takes control"
    return error.message


def _without_bytes(value: object) -> object:
    """Plain data for JSON; a page gets images another way."""
    if isinstance(value, Mapping):
        return {str(k): _without_bytes(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_bytes(v) for v in value]
    if isinstance(value, (bytes, bytearray, memoryview)):
        return None
    return value
