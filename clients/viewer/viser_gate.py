"""A private viser server.

viser accepts any connection and obeys any message, up to opening a public tunnel. So it listens
on a Unix socket in a folder that only this user can open, and on no port: every byte has passed
the front's checks, and `page_messages` filters messages of pages. Everything that relies on
viser's private parts is in this module (viser 1.1; the version is pinned), and
`tests/viewer/test_viewer_gate.py` fails where a new version has changed them.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
import shutil
import socket
import tempfile
import threading
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, redirect_stdout
from pathlib import Path
from typing import Any, Final

import viser
import websockets.asyncio.server as library
from viser._messages import (
    DragBinding,
    Message,
    SceneNodeUpdateMessage,
    SetCameraFovMessage,
    SetCameraLookAtMessage,
    SetCameraPositionMessage,
    SetCameraUpDirectionMessage,
    SetSceneNodeClickBindingsMessage,
    SetSceneNodeVisibilityMessage,
    ShareUrlDisconnect,
    ShareUrlRequest,
)
from websockets.asyncio.client import ClientConnection, unix_connect
from websockets.typing import Subprotocol

from flexdt.clients.viewer.scenes.layers import Nodes
from flexdt.clients.viewer.scenes.views import Standpoint

MAX_OF_VISER: Final = 256 << 20
LONGEST_TMP: Final = 70
"""Longest path of the folder for temporary files [bytes]; a socket's has at most about
a hundred."""
PREFIX: Final = "flexdt-viser-"
YOUNG_S: Final = 60.0
"""Age below which a folder may belong to a viewer that does not listen yet [s]."""
MARK: Final = b"<!-- program -->"
_one_at_a_time = threading.Lock()


class GateError(RuntimeError):
    """viser differs from the version that this module was written for."""


class Scenes:
    """A viser server that accepts connections from `connect` alone.

    Raises:
        GateError: viser listens elsewhere.
        OSError: no socket can be made.
    """

    def __init__(self, label: str | None = None) -> None:
        """Start viser's server on a Unix socket in a private folder, without its ways to
        the outside.

        Sockets of viewers that were killed are removed first; on a failure the folder is
        removed. The folder for temporary files is /tmp if the usual one's path exceeds
        `LONGEST_TMP` bytes. viser's own output is dropped.

        Args:
            label: of the server.

        Raises:
            GateError: viser starts its server in another way than on that socket.
        """
        usual = tempfile.gettempdir()
        if len(usual.encode()) <= LONGEST_TMP:
            short = usual
        else:
            short = "/tmp"
        clear_left_behind(Path(short))
        self._folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=short))  # 0700
        self.path = self._folder / "viser"
        try:
            with _listening_at(self.path), redirect_stdout(io.StringIO()):  # its banner
                # Neither address is used: `_listening_at` puts the socket in their place.
                self.server = viser.ViserServer(host="127.0.0.1", port=0, label=label)
            # No request of a page or a button of viser's opens a way in from outside.
            for message in (ShareUrlRequest, ShareUrlDisconnect):
                self.server._websock_server.unregister_handler(message)
        except BaseException:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise

    def html(self) -> bytes:
        """Read viser's page."""
        return (
            Path(viser.__file__).parent / "client" / "build" / "index.html"
        ).read_bytes()

    @asynccontextmanager
    async def connect(
        self, path: str, subprotocol: Subprotocol | None
    ) -> AsyncIterator[ClientConnection]:
        """Connect a browser's frame to viser's socket, uncompressed, and close the connection at
        the end.

        A message has at most `MAX_OF_VISER` bytes.

        `path`: identifies the frame. `subprotocol`: of the browser; None for none.
        Yields the connection.
        Raises OSError, InvalidHandshake: viser does not accept it.
        """
        async with unix_connect(
            str(self.path),
            f"ws://localhost{path}",
            subprotocols=None if subprotocol is None else [subprotocol],
            # The bytes do not leave the machine: packing them would only take time.
            compression=None,
            max_size=MAX_OF_VISER,
        ) as connection:
            yield connection

    def path_of(self, client_id: int) -> str | None:
        """Return the path of a client's connection without its query; None when it has
        closed.

        None for an unknown client, too.
        """
        connection = self.server._websock_server._live_connections.get(client_id)
        if connection is None:
            request = None
        else:
            request = connection.request
        if request is None:
            return None
        return str(request.path.partition("?")[0])

    @property
    def said(self) -> int:
        """Number of messages sent to all clients so far."""
        return self.server._websock_server._broadcast_buffer.message_counter

    def heard(self, client_id: int, said: int) -> bool:
        """Check that a client has been sent the first `said` messages to all clients.

        Messages to it alone could overtake.
        """
        at = self.server._websock_server._broadcast_buffer.generator_cursors.get(
            client_id, -1
        )
        return at >= said - 1

    def stop(self) -> None:
        """End it; blocks for a second at most."""
        with redirect_stdout(io.StringIO()):
            self.server.stop()
        shutil.rmtree(self._folder, ignore_errors=True)


def clear_left_behind(folder: Path) -> None:
    """Remove the folders of viewers that were killed, with all they hold: those named
    `PREFIX`..., older than `YOUNG_S`, on whose socket no process listens.

    Others stay; errors are ignored.

    Args:
        folder: where they are.
    """
    for left in folder.glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as probe:
            # Between bind and listen a socket of a living viewer refuses connections, too.
            if time.time() - left.stat().st_mtime < YOUNG_S:
                continue
            try:
                probe.connect(str(left / "viser"))
            # Refused: the socket is there, and nobody listens. Other errors prove nothing.
            except ConnectionRefusedError:
                shutil.rmtree(left, ignore_errors=True)


def set_nodes(client: viser.ClientHandle, nodes: Nodes) -> None:
    """Give nodes that all clients have other properties in the frame of one.

    `nodes` is node -> properties; the nodes themselves are not checked."""
    # In one piece: else the page may draw a frame between two of the messages.
    with client.atomic():
        for message in _changes(nodes):
            client._websock_connection.queue_message(message)


def _changes(nodes: Nodes) -> Iterator[Message]:
    """Yield viser's messages that set the nodes' properties: visibility and clicks apart,
    the others together.

    A visibility of None is left out; nodes without properties give nothing.
    """
    for name, properties in nodes.items():
        if (rest := dict(properties)).pop("visible", None) is not None:
            yield SetSceneNodeVisibilityMessage(name, properties["visible"])
        if (clickable := rest.pop("clickable", None)) is not None:
            bindings = (DragBinding("left", None),) if clickable else ()
            yield SetSceneNodeClickBindingsMessage(name, bindings)
        if rest:
            yield SceneNodeUpdateMessage(name, rest)


def set_camera(client: viser.ClientHandle, camera: Standpoint) -> None:
    """Set up direction, place, target and field of view [rad] of a client's camera in one
    message.

    Unlike viser's own setters it sends all four, and leaves the record as the frame has
    reported last.
    """
    with client.atomic():
        for message in (
            SetCameraUpDirectionMessage(camera.up),
            SetCameraPositionMessage(camera.position),
            SetCameraLookAtMessage(camera.look_at),
            SetCameraFovMessage(camera.fov),
        ):
            client._websock_connection.queue_message(message)


def look_from(serializer: Any, camera: Standpoint, nodes: Nodes) -> None:
    """Set the first camera of a recorded scene, and its shown nodes.

    `server.initial_camera` would do so too, but also override the cameras of later pages.
    Up direction and opening are not set.
    """
    serializer._insert_message(SetCameraPositionMessage(camera.position, initial=True))
    serializer._insert_message(SetCameraLookAtMessage(camera.look_at, initial=True))
    still = {name: {**of, "clickable": None} for name, of in nodes.items()}
    for message in _changes(still):
        serializer._insert_message(message)


def parted(html: bytes) -> tuple[bytes, bytes]:
    """Split viser's page into the page with MARK and its program as a script of its own.

    The program is nearly all of the page, and the same for every view: as a file under
    one name a browser fetches it once. The data of the script's tag are set by the script
    itself.

    Returns:
        Page and script; the whole page and nothing if it is built otherwise.
    """
    match = re.search(
        rb"<script((?: data-[a-z]+=\"[^\"]*\")+)>(.*?)</script>", html, re.DOTALL
    )
    if match is None:
        return html, b""
    facts = dict(re.findall(r'data-([a-z]+)="([^"]*)"', match[1].decode()))
    script = (
        b"Object.assign(document.currentScript.dataset, %b);" % json.dumps(facts).encode()
    )
    return html[: match.start()] + MARK + html[match.end() :], script + match[2]


@contextlib.contextmanager
def _listening_at(path: Path) -> Iterator[None]:
    """Make a server that viser starts meanwhile listen at a path and nowhere else.

    For that a function of the library is replaced meanwhile, in any case put back; other
    contexts wait until then. The socket is left to viser, or closed after an error.

    Args:
        path: of the Unix socket.

    Raises:
        GateError: viser starts its server in another way.
    """
    listener = socket.socket(socket.AF_UNIX)
    serve = library.serve
    used = False

    def privately(handler: Any, host: Any, port: Any, **options: Any) -> Any:
        nonlocal used
        used = True
        return serve(handler, unix=True, sock=listener, **options)

    # The library's function belongs to the whole process: two at a time would put back each
    # other's replacement, and one would listen on a port.
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
    # A version that does not call the function may have opened a port of its own.
    if not used:
        listener.close()
        raise GateError(f"viser {viser.__version__} starts its server in another way")
