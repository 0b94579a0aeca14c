"""A private viser server, and a filter for the messages that pages send to it.

viser accepts any connection and obeys any message, up to opening a public tunnel. So it listens on
a Unix socket in a folder that only this user can open, and on no port: every byte has passed the
front's checks. Of a page's messages only those of a list get through, each validated field by field
and encoded anew. Everything that relies on viser's private parts is in this module (viser 1.1; the
version is pinned), and `tests/viewer/test_viewer_gate.py` shows what a new version has changed.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import re
import shutil
import socket
import struct
import tempfile
import threading
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, redirect_stdout
from pathlib import Path
from typing import Annotated, Any, Final

import msgpack
import viser
import websockets.asyncio.server as library
from annotated_types import Ge, Gt, Le, MaxLen
from pydantic import Field, ValidationError
from viser._messages import (
    Message,
    SceneNodeUpdateMessage,
    SetCameraLookAtMessage,
    SetCameraPositionMessage,
    SetSceneNodeVisibilityMessage,
    ShareUrlDisconnect,
    ShareUrlRequest,
)
from websockets.asyncio.client import ClientConnection, unix_connect
from websockets.typing import Subprotocol

from flexdt.clients.viewer.scenes.world import Nodes, Standpoint
from flexdt.protocol.fields import Params
from flexdt.runtime.log import log

MAX_OF_VISER: Final = 256 << 20
LARGEST_SIDE: Final = 4096
"""Of a picture of a view [px]."""
MAX_SMALL: Final = 4096
"""Bytes of any message but a picture."""
SHOWN: Final = 40
LONGEST_TMP: Final = 70
"""Bytes of the folder for temporary files; a socket's path has at most about a hundred."""
PREFIX: Final = "flexdt-viser-"
YOUNG_S: Final = 60.0
"""A younger folder may belong to a viewer that does not listen yet."""


class GateError(RuntimeError):
    """viser differs from the version that this module was written for."""


class Scenes:
    """A viser server that accepts connections from `connect` alone.

    Raises:
        GateError: viser listens elsewhere.
        OSError: no socket can be made.
    """

    def __init__(self, label: str | None = None) -> None:
        usual = tempfile.gettempdir()
        short = usual if len(usual.encode()) <= LONGEST_TMP else "/tmp"
        clear_left_behind(Path(short))
        self._folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=short))  # 0700
        self.path = self._folder / "viser"
        try:
            with _listening_at(self.path), redirect_stdout(io.StringIO()):  # its banner
                self.server = viser.ViserServer(host="127.0.0.1", port=0, label=label)
            # Nothing that a page or a button of viser's says opens a way in from outside.
            for message in (ShareUrlRequest, ShareUrlDisconnect):
                self.server._websock_server.unregister_handler(message)
        except BaseException:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise

    def html(self) -> bytes:
        """viser's page."""
        return (Path(viser.__file__).parent / "client" / "build" / "index.html").read_bytes()

    @asynccontextmanager
    async def connect(
        self, path: str, subprotocol: Subprotocol | None
    ) -> AsyncIterator[ClientConnection]:
        """Connect a browser's frame to viser; `path` identifies the frame."""
        async with unix_connect(
            str(self.path),
            f"ws://localhost{path}",
            subprotocols=None if subprotocol is None else [subprotocol],
            compression=None,
            max_size=MAX_OF_VISER,
        ) as connection:
            yield connection

    def path_of(self, client_id: int) -> str | None:
        """The path of a client's connection; None when it has closed."""
        connection = self.server._websock_server._live_connections.get(client_id)
        request = None if connection is None else connection.request
        return None if request is None else str(request.path.partition("?")[0])

    @property
    def said(self) -> int:
        """How much has been said to all clients so far."""
        return self.server._websock_server._broadcast_buffer.message_counter

    def heard(self, client_id: int, said: int) -> bool:
        """Whether a client has been sent all that had been said to everybody by then. What is said
        to it alone has a queue of its own, and could overtake that."""
        at = self.server._websock_server._broadcast_buffer.generator_cursors.get(client_id, -1)
        return at >= said - 1

    def stop(self) -> None:
        """End it; blocks for a second at most."""
        with redirect_stdout(io.StringIO()):
            self.server.stop()
        shutil.rmtree(self._folder, ignore_errors=True)


def clear_left_behind(folder: Path) -> None:
    """Remove the sockets of viewers that were killed, on which no process listens any more."""
    for left in folder.glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as probe:
            if time.time() - left.stat().st_mtime < YOUNG_S:
                continue
            try:
                probe.connect(str(left / "viser"))
            except ConnectionRefusedError:
                shutil.rmtree(left, ignore_errors=True)


def set_nodes(client: viser.ClientHandle, nodes: Nodes) -> None:
    """Give nodes that all clients have other properties in the frame of one."""
    with client.atomic():
        for message in _changes(nodes):
            client._websock_connection.queue_message(message)


def _changes(nodes: Nodes) -> Iterator[Message]:
    for name, properties in nodes.items():
        if (rest := dict(properties)).pop("visible", None) is not None:
            yield SetSceneNodeVisibilityMessage(name, properties["visible"])
        if rest:
            yield SceneNodeUpdateMessage(name, rest)


def look_from(serializer: Any, camera: Standpoint, nodes: Nodes) -> None:
    """Set the first camera of a recorded scene, and what is shown of it.

    `server.initial_camera` would say it too, but also overrule the cameras of pages that come.
    """
    serializer._insert_message(SetCameraPositionMessage(camera.position, initial=True))
    serializer._insert_message(SetCameraLookAtMessage(camera.look_at, initial=True))
    for message in _changes(nodes):
        serializer._insert_message(message)


MARK: Final = b"<!-- program -->"


def parted(html: bytes) -> tuple[bytes, bytes]:
    """viser's page with MARK for its program, and the program as a script of its own.

    The program is nearly all of the page, and the same for every view: as a file under one name
    a browser fetches it once. A page that is built otherwise stays whole.
    """
    match = re.search(rb"<script((?: data-[a-z]+=\"[^\"]*\")+)>(.*?)</script>", html, re.DOTALL)
    if match is None:
        return html, b""
    facts = dict(re.findall(r'data-([a-z]+)="([^"]*)"', match[1].decode()))
    script = b"Object.assign(document.currentScript.dataset, %b);" % json.dumps(facts).encode()
    return html[: match.start()] + MARK + html[match.end() :], script + match[2]


_one_at_a_time = threading.Lock()


@contextlib.contextmanager
def _listening_at(path: Path) -> Iterator[None]:
    """While it lasts, a server that viser starts listens there and nowhere else."""
    listener = socket.socket(socket.AF_UNIX)
    serve, used = library.serve, False

    def privately(handler: Any, host: Any, port: Any, **options: Any) -> Any:
        nonlocal used
        used = True
        return serve(handler, unix=True, sock=listener, **options)

    with _one_at_a_time:
        try:
            listener.bind(str(path))
            library.serve = privately  # type: ignore[assignment, misc]
            yield
        except BaseException:
            listener.close()
            raise
        finally:
            library.serve = serve  # type: ignore[misc]
    if not used:
        listener.close()
        raise GateError(f"viser {viser.__version__} starts its server in another way")


# -- messages that a page may send to viser ----------------------------------------------------

Length = Annotated[float, Ge(-1e6), Le(1e6)]
Part = Annotated[float, Ge(-2), Le(2)]
Triple = Annotated[tuple[Length, Length, Length], Field(strict=False)]
Turn = Annotated[tuple[Part, Part, Part, Part], Field(strict=False)]
Pixels = Annotated[float, Ge(1), Le(100_000)]
Name = Annotated[str, MaxLen(200)]


class ViewerCameraMessage(Params):
    """Where a frame looks from [m]."""

    wxyz: Turn
    position: Triple
    fov: Annotated[float, Gt(0), Le(3.2)]
    near: Annotated[float, Gt(0), Le(1e6)]
    far: Annotated[float, Gt(0), Le(1e9)]
    image_height: Pixels
    image_width: Pixels
    look_at: Triple
    up_direction: Triple


class TransformControlsDragStartMessage(Params):
    """A drag of a handle begins."""

    name: Name
    owner: Name = ""


class TransformControlsUpdateMessage(TransformControlsDragStartMessage):
    """A handle is dragged [m]."""

    wxyz: Turn
    position: Triple


class TransformControlsDragEndMessage(TransformControlsDragStartMessage):
    """A drag of a handle ends."""


class GetRenderResponseMessage(Params):
    """A picture that the viewer has requested."""

    payload: bytes
    render_uuid: Name


ALLOWED: Final[dict[str, type[Params]]] = {
    model.__name__: model
    for model in (
        ViewerCameraMessage,
        TransformControlsDragStartMessage,
        TransformControlsUpdateMessage,
        TransformControlsDragEndMessage,
        GetRenderResponseMessage,
    )
}
"""What a page's scenes send, by viser's names for it, each checked field by field."""


class Unwanted(ValueError):
    """A message that pages may not send to viser; its text is short, for the log."""


def admitted(raw: str | bytes) -> bytes:
    """A page's message, validated and encoded anew for viser.

    Raises:
        Unwanted: says what is wrong.
    """
    if isinstance(raw, str):
        raise Unwanted("text")
    try:
        fields = msgpack.unpackb(raw)
        kind = fields.pop("type")
        model = ALLOWED.get(kind)
    except (ValueError, msgpack.UnpackException, AttributeError, LookupError, TypeError):
        raise Unwanted("no message") from None
    if model is None:
        raise Unwanted(f"{str(kind)[:SHOWN]!a}")
    if model is not GetRenderResponseMessage and len(raw) > MAX_SMALL:
        raise Unwanted(f"a {kind} that is too long")
    try:
        read = model.model_validate(fields)
    except ValidationError as error:
        where = ".".join(map(str, error.errors()[0]["loc"]))
        raise Unwanted(f"a {kind} with a wrong {where[:SHOWN]!a}") from None
    if isinstance(read, GetRenderResponseMessage) and not _small_picture(read.payload):
        raise Unwanted(f"a {kind} that is no PNG of at most {LARGEST_SIDE} pixels a side")
    return bytes(msgpack.packb({**read.model_dump(), "type": kind}))


def _small_picture(data: bytes) -> bool:
    """Whether a PNG's header states a small size; empty bytes report a failure and pass."""
    if not data:
        return True
    if len(data) < 24 or not data.startswith(b"\x89PNG\r\n\x1a\n") or data[12:16] != b"IHDR":
        return False
    return all(0 < side <= LARGEST_SIDE for side in struct.unpack(">II", data[16:24]))


class MessageFilter:
    """Passes pages' messages on to viser; each reason to drop one is logged once.

    Attributes:
        dropped: messages so far.
    """

    MAX_LOGGED: Final = 100

    def __init__(self) -> None:
        self.dropped = 0
        self._logged: set[str] = set()

    def admit(self, raw: str | bytes) -> bytes | None:
        """The message as it goes to viser, or None to drop it."""
        try:
            return admitted(raw)
        except Unwanted as error:
            self.dropped += 1
            problem = str(error)
        if problem not in self._logged and len(self._logged) < self.MAX_LOGGED:
            self._logged.add(problem)
            log("a scene's message was dropped", logging.WARNING, message=problem)
        return None
