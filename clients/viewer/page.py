"""One open page: its own connection to the twin, and an outbox in which only the newest
survives.

A page acts for one person: it acquires and loses control by itself, and its requests end
with it. Answers and notes are sent in order, and a page that does not read them is
closed. States and images replace older ones that have not gone out, so a slow browser
delays no other.

The page acknowledges states and parts of images, and few of either are on their way: data
queued in sockets cannot be replaced by newer ones, and on a slow link that would be
seconds of them. Images go in parts, so that a state waits for a part of an image and not
for all of it.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from typing import Any, Final

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from flexdt.clients.client.kept_connection import KeptConnection, TwinAddress, Unsendable
from flexdt.clients.client.transport import ConnectionLost
from flexdt.clients.viewer.page_words import for_reader
from flexdt.clients.viewer.scenes.layers import Shown
from flexdt.clients.viewer.scenes.stage_volume import MadeOf, StageVolume
from flexdt.clients.viewer.watched_tasks import watched
from flexdt.protocol import METHODS, Code, RpcError, parse_params
from flexdt.protocol.rpc_errors import busy, clip, internal, link_down
from flexdt.runtime.log import log, traced
from flexdt.twin.geometry.conventions import FloatArray

MAX_NOTES: Final = 1000
MAX_ASKED: Final = 64
"""Largest number of a page's running requests; urgent ones (stop, E-stop, abort) do
not count."""
MAX_PARTS: Final = 500_000
"""Largest number of parts of a request's JSON, about; each costs some hundred bytes
once read."""
MAX_WORD: Final = 200
DRAG_S: Final = 0.1
TRY_AGAIN: Final = 1013
"""WebSocket's code for "come back later"; the reason is for people."""
ON_THE_WAY: Final = {"state": 2, "image": 3, "volume": 1}
"""Largest number of states, parts of images, and slices, that the page has not
acknowledged yet."""
ACKNOWLEDGEMENTS: Final = {f'{{"took":"{slot}"}}': slot for slot in ON_THE_WAY}
"""A page's acknowledgements."""
PART_BYTES: Final = 10_240
"""Size of a part of an image [bytes]. Three hold most images in motion, and are an
eighth of a second of 2 Mbit/s."""
LARGE_PART_BYTES: Final = 131_072
QUICK_S: Final = 0.02
"""Time of an acknowledgement below which parts become large [s]."""
HIDDEN: Final = frozenset({"session.hello", "state.subscribe", "state.unsubscribe"})
"""Methods of the wire that a page does not use: its viewer does."""

MAX_NAME: Final = 40
Local = Callable[["Page", Mapping[str, Any]], Awaitable[object]]
"""A method of the viewer itself."""


class Page:
    """A browser's page.

    Args:
        id: made up by the page; its scenes carry it too.
        connection: to the browser.
        address: of the twin.
        local: the viewer's own methods.
        person: who is there, for the others.
    """

    def __init__(
        self,
        id: str,
        connection: ServerConnection,
        address: TwinAddress,
        local: Mapping[str, Local],
        person: str = "a visitor",
    ) -> None:
        """Prepare the page's state and its connection to the twin; `run` serves.

        It shows line integrals live, with the default layers. `local` methods come before
        the twin's.

        Args:
            id: of the page.
            connection: to the browser.
            address: of the twin.
            local: the viewer's own methods, by name.
            person: name of the page's user.
        """
        self.id = id
        self.kind = "line_integral"
        self.dark = False
        self.live: tuple[str, bool] | None = None
        """Data set whose volume the page follows, and whether that scan is over."""
        self.volume: StageVolume | None = None
        """Newest surface of that volume, for this page's own scenes."""
        self.ghost = False
        """Whether the surface is shown as a ghost where it does not fit the stage."""
        self.fine = True
        """Whether the page has reported that a graphics processor draws; True before."""
        self.shown = Shown()
        self.covered: dict[str, FloatArray] = {}
        """View -> boxes (n, 4) that the page lays over it [px]."""
        self._subjects: dict[str, list[list[int]]] = {}
        """View -> boxes of what its picture is about, as the page was told [px]."""
        self.plan: Any = None
        self.orbit: Any = None
        """The focal spot's path over the plan, for later scenes of this page."""
        self.recorded: str | None = None
        """The data set whose images this page shows instead of live ones."""
        self.made: MadeOf | None = None
        """Of what those images are."""
        self.saturated: float | None = None  # of the data set that is open
        self.block = ""
        """The key of the last block of a volume offered to the page."""
        self._connection = connection
        self._local = local
        self.link = KeptConnection(
            address, person_name(person), on_change=self._link_changed
        )
        self._notes: deque[str] = deque()
        self._newest: dict[str, str | bytes] = {}
        self._sent_at: dict[str, deque[float]] = {slot: deque() for slot in ON_THE_WAY}
        """Times at which messages not yet acknowledged were sent."""
        self._image = memoryview(b"")
        self._part = PART_BYTES
        self._due = asyncio.Event()
        self._over = asyncio.Event()
        self._tasks: set[asyncio.Task[None]] = set()
        self._dragged: dict[str, float] | None = None
        self._dragging: asyncio.Task[None] | None = None
        self._asked = self._busy = 0

    async def run(self) -> None:
        """Serve until the browser leaves or no longer reads, or the connection to the
        twin, sending or reading fails; then cancel the page's tasks.

        With more than `MAX_NOTES` notices unsent, logs a warning and closes the
        connection with TRY_AGAIN.
        """
        for work in (self.link.run(), self._send(), self._read()):
            self._start(work, "a page's connection", self._over.set)
        try:
            await self._over.wait()
        finally:
            for task in list(self._tasks):
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)
        if len(self._notes) > MAX_NOTES:
            log(
                "a page was closed",
                logging.WARNING,
                page=self.id,
                reason="it takes nothing",
            )
            await self._connection.close(TRY_AGAIN, "this page took nothing for too long")

    def _start(
        self,
        work: Coroutine[Any, Any, None],
        what: str,
        died: Callable[[], None] = lambda: None,
    ) -> asyncio.Task[None]:
        """Run work in a task that is canceled when the page closes.

        A failure is logged as of `what`, and calls `died`.
        """
        task = watched(work, what, died)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def _read(self) -> None:
        """Read the page's messages until it closes: acknowledgements free their slots,
        requests are each answered in a task; bytes are ignored. At the end the page is
        over.

        Requests are not waited for, so their answers may come in another order.
        """
        with contextlib.suppress(ConnectionClosed):
            async for message in self._connection:
                if not isinstance(message, str):
                    continue
                if (slot := ACKNOWLEDGEMENTS.get(message)) is not None:
                    self._took(slot)
                else:
                    self._start(self._handle(message), "a page's request")
        self._over.set()

    def say(self, kind: str, **content: object) -> None:
        """Send something that must arrive, in order, as JSON.

        A page with more than `MAX_NOTES` unsent is closed.
        """
        self._notes.append(json.dumps({"type": kind, **content}))
        if len(self._notes) > MAX_NOTES:
            self._over.set()
        self._due.set()

    def show(self, slot: str, content: str | bytes) -> None:
        """Send the newest content of `slot`; older content that has not gone out is dropped."""
        self._newest[slot] = content
        self._due.set()

    def tell_subject(self, view: str, boxes: FloatArray) -> None:
        """Tell the page the boxes (n, 4) of what a view's picture is about [px], if it does not
        know them."""
        told = boxes.round().astype(int).tolist()
        if self._subjects.get(view) != told:
            self._subjects[view] = told
            content = {"type": "subject", "view": view, "boxes": told}
            self.show(f"subject {view}", json.dumps(content))

    def drag(self, targets: dict[str, float]) -> None:
        """Move a stage that is dragged in one of this page's frames; the newest
        targets win."""
        self._dragged = targets
        if self._dragging is None or self._dragging.done():
            self._dragging = self._start(self._follow(), "dragging")

    async def _follow(self) -> None:
        """Send the axes' newest dragged targets to the twin, one request at a time with a
        pause, until none is left; the page is told whether each can be reached.

        The pause is `DRAG_S`; targets given meanwhile replace each other. A refusal and a
        lost connection say why not.
        """
        while (targets := self._dragged) is not None:
            self._dragged = None
            told: dict[str, object] = {"type": "drag", "targets": targets}
            try:
                answer: Any = await self.link.request("axes.move", {"targets": targets})
                told |= {"why": None, "duration_s": answer["duration_s"]}
            except (RpcError, ConnectionLost) as error:
                told |= {"why": _words(error), "duration_s": None}
            self.show("drag", json.dumps(told))
            await asyncio.sleep(DRAG_S)

    async def _send(self) -> None:
        """Send waiting messages to the page, in order of its slots, whenever there is
        something; returns when the connection closes.

        Messages that are unsent then are dropped.
        """
        with contextlib.suppress(ConnectionClosed):
            while True:
                await self._due.wait()
                self._due.clear()
                while (content := self._next()) is not None:
                    await self._connection.send(content)

    def _next(self) -> str | bytes | None:
        """Select the next message: answers and notes, then the newest content of a slot,
        then a part of an image (first byte 1: its last).

        None if nothing waits or too much is on the way. The other slots go in the order
        in which they were shown first. A part is `_part` bytes long; first byte 0 says
        that more parts follow.
        """
        if self._notes:
            return self._notes.popleft()
        for slot in self._newest:
            if slot != "image" and self._may_send(slot):
                return self._newest.pop(slot)
        if not self._image and (image := self._newest.pop("image", None)) is not None:
            self._image = memoryview(image)  # type: ignore[arg-type]
        if not self._image or not self._may_send("image"):
            return None
        part = self._image[: self._part]
        self._image = self._image[self._part :]
        return (b"\0" if self._image else b"\1") + part

    def _may_send(self, slot: str) -> bool:
        """Check that a slot may have one more message on the way (`ON_THE_WAY`), and
        count it.
        """
        if (sent := self._sent_at.get(slot)) is None:
            return True
        if len(sent) >= ON_THE_WAY[slot]:
            return False
        sent.append(time.monotonic())
        return True

    def _took(self, slot: str) -> None:
        """Note that the page has taken a message of a slot, and wake the sender.

        After an image taken within `QUICK_S` larger parts of images are sent, else small
        ones. Ignored if none was sent.
        """
        if not (sent := self._sent_at[slot]):
            return
        took_s = time.monotonic() - sent.popleft()
        if slot == "image":
            if took_s < QUICK_S:
                self._part = LARGE_PART_BYTES
            else:
                self._part = PART_BYTES
        self._due.set()

    async def _handle(self, text: str) -> None:
        """Answer a request of the page, in a trace of its own, with its result or an
        error.

        Errors of any kind are sent, none is raised; unexpected ones are logged and sent
        without details. A message that is no request is answered with INVALID_REQUEST.
        With `MAX_ASKED` requests under way only urgent methods are called.

        Args:
            text: JSON with id, method and params.
        """
        id: object = None
        try:
            id, request = _read(text)
            method, params = _request(request)
        except ValueError as error:
            self._fail(id, RpcError(Code.INVALID_REQUEST, f"not a request: {error}"))
            return
        known = METHODS.get(method)
        if self._busy >= MAX_ASKED and (known is None or not known.urgent):
            self._fail(
                id, busy(f"{MAX_ASKED} requests of this page are under way already")
            )
            return
        self._asked += 1
        trace = f"page-{self.id[:8]}-{self._asked}"
        self._busy += 1
        with traced(trace):
            try:
                self.say(
                    "answer",
                    id=id,
                    result=await self._ask(method, params),
                    at=time.time(),
                )
            except RpcError as error:
                self._fail(id, error)
            except ConnectionLost as error:
                self._fail(id, link_down(str(error)))
            except Exception:
                # Every failure is reported to the page; the process goes on for the others.
                log(
                    "a page's request failed",
                    logging.ERROR,
                    error=True,
                    method=clip(method, 100),
                )
                self._fail(id, internal(trace))
            finally:
                self._busy -= 1

    async def _ask(self, method: str, params: dict[str, Any]) -> object:
        """Call a method for the page, one of the viewer's own or else of the twin's, and
        return its result.

        Bytes in the twin's result become None.

        Raises:
            RpcError: no method that pages may call, parameters that do not fit, or a
                refusal.
            ConnectionLost: the twin's connection is lost.
        """
        if method in self._local:
            return await self._local[method](self, params)
        if method not in METHODS or method in HIDDEN:
            asked = clip(method, 100)
            raise RpcError(Code.METHOD_NOT_FOUND, f"the page may not call {asked!r}")
        try:
            return without_bytes(await self.link.request(method, params))
        except Unsendable:
            parse_params(
                METHODS[method], params
            )  # names the field and the allowed values
            raise

    def _fail(self, id: object, error: RpcError) -> None:
        """Answer the request `id` with an error's code, message for people (`_words`) and
        data, in which bytes are None.
        """
        data = without_bytes(error.data)
        self.say(
            "answer",
            id=id,
            error={"code": error.code, "message": _words(error), "data": data},
        )

    def _link_changed(self) -> None:
        hello = self.link.hello
        self.say("session", connected=hello is not None, session=hello and hello.session)


def person_name(text: str) -> str:
    """Return a person's printable name of at most `MAX_NAME` characters, or "a visitor"."""
    return "".join(c for c in text if c.isprintable()).strip()[:MAX_NAME] or "a visitor"


def _words(error: RpcError | ConnectionLost) -> str:
    """Format an error's message for people: with the page's button instead of the
    wire's method.

    Others are put into words of the page (`for_reader`), a lost connection's too.
    """
    if not isinstance(error, RpcError):
        return for_reader(str(error))
    match error.data:
        case {"controller": holder, "allowed": "session.control force"}:
            return f"{holder} is the controller; “Take over” takes control"
    return for_reader(error.message)


def _read(text: str) -> tuple[str | int | None, dict[str, Any]]:
    """Read id and content of a message, unless it would take very much memory.

    Returns:
        The id, and the message as a dict.

    Raises:
        ValueError: it is no object with an id that can be answered.
    """
    if len(text) > MAX_PARTS and sum(map(text.count, ",[{")) > MAX_PARTS:
        raise ValueError(f"it has more than {MAX_PARTS} parts")
    try:
        request = json.loads(text)
    except RecursionError:
        raise ValueError("nested too deep") from None
    id: Any
    if isinstance(request, dict):
        id = request.get("id")
    else:
        id = ()
    named = id is None or (isinstance(id, str) and len(id) <= MAX_WORD)
    if named or (isinstance(id, int) and abs(id) < 2**64):
        return id, request
    raise ValueError(f"it is an object with an id of {MAX_WORD} characters at most")


def _request(message: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Read method and parameters of a message; missing, null or empty params are {}.

    Raises:
        ValueError: it has no method, or params that are not by name.
    """
    method = message.get("method")
    params = message.get("params") or {}
    if isinstance(method, str) and isinstance(params, dict):
        return method, params
    raise ValueError("it has a method, and params by name")


def without_bytes(value: Any) -> Any:
    """Convert to plain data for JSON: mappings with text keys, lists; bytes become null,
    as a page gets images another way.

    Tuples become lists; all other values stay as they are.
    """
    if isinstance(value, Mapping):
        return {str(k): without_bytes(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_bytes(v) for v in value]
    if isinstance(value, (bytes, bytearray, memoryview)):
        return None
    return value
