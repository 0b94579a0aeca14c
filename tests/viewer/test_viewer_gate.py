"""viser behind the front: who reaches it, and what a page may tell it.

What this module says of a new version of viser: `flexdt.clients.viewer.viser_gate` has to be
looked at.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import os
import socket
import struct
import tempfile
from collections.abc import Awaitable, Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import msgpack
import numpy as np
import pytest
import viser
import websockets.asyncio.server as library
from hypothesis import given
from hypothesis import strategies as st
from viser import _messages
from viser._viser import CameraHandle
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import InvalidStatus
from websockets.typing import Origin, Subprotocol

from flexdt.clients.viewer import page_messages
from flexdt.clients.viewer import viser_gate as gate
from flexdt.clients.viewer.front import Front, cookie_name
from flexdt.clients.viewer.page_messages import ALLOWED, Unwanted, admitted
from flexdt.clients.viewer.scenes.views import Standpoint
from flexdt.clients.viewer.viser_gate import GateError, Scenes

TOKEN = "a-token-of-sixteen-or-more"
SPOKEN = Subprotocol(f"viser-v{viser.__version__}")
FRAME = f"/scene/{'a' * 12}/iso"
CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [3, 3.5, 3], "fov": 1.3,
    "near": 0.01, "far": 1000, "image_height": 400, "image_width": 600, "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1],
}  # fmt: skip
DRAG: dict[str, Any] = {
    "type": "TransformControlsUpdateMessage", "name": "/gizmos/object", "owner": "",
    "wxyz": [1, 0, 0, 0], "position": [0.1, 0.2, 0.3],
}  # fmt: skip
CLICK: dict[str, Any] = {
    "type": "SceneNodeClickMessage", "name": "/machine/detector/look", "instance_index": None,
    "ray_origin": [3, 3, 3], "ray_direction": [0.6, 0, 0.8], "screen_pos": [0.5, 0.25],
    "modifier": None, "owner": "",
}  # fmt: skip
PNG = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 640, 480)
PICTURE: dict[str, Any] = {
    "type": "GetRenderResponseMessage", "payload": PNG, "render_uuid": "u",
}  # fmt: skip


def without(message: dict[str, Any], *names: str) -> dict[str, Any]:
    return {k: v for k, v in message.items() if k not in names}


# -- the form of messages ----------------------------------------------------------------------


@pytest.mark.parametrize("message", [CAMERA, DRAG, without(DRAG, "owner"), CLICK, PICTURE,
                                     PICTURE | {"payload": b""}])  # fmt: skip
def test_what_scenes_send_gets_through_as_it_is(message: dict[str, Any]) -> None:
    heard = _messages.Message.deserialize(admitted(msgpack.packb(message)))
    assert heard == _messages.Message.deserialize(msgpack.packb(message))


@pytest.mark.parametrize(
    "message",
    [
        {"type": "ShareUrlRequest"},
        {"type": "ShareUrlDisconnect"},
        {"type": "GuiUpdateMessage", "uuid": "x", "updates": {}},
        {"type": "FileTransferStartUpload"},
        {"type": "RunJavascriptMessage", "source": "1"},
        {"type": ["ShareUrlRequest"]},
        {"type": None},
        {},
        [],
        "ShareUrlRequest",
        3,
        CAMERA | {"image_height": 0},
        CAMERA | {"image_width": "600"},
        CAMERA | {"fov": float("nan")},
        CAMERA | {"position": [1e300, 0, 0]},
        CAMERA | {"position": [0, 0]},
        CAMERA | {"more": 1},
        without(CAMERA, "far"),
        DRAG | {"position": [float("inf"), 0, 0]},
        DRAG | {"wxyz": None},
        DRAG | {"name": "x" * 201},
        DRAG | {"name": 2**63},
        CLICK | {"modifier": "meta"},
        CLICK | {"instance_index": 1.5},
        PICTURE | {"payload": "text"},
        PICTURE | {"payload": b"GIF89a" * 9},
        PICTURE | {"payload": PNG[:-8] + struct.pack(">II", 65_000, 65_000)},
    ],
)
def test_nothing_else_does(message: object) -> None:
    with pytest.raises(Unwanted):
        admitted(msgpack.packb(message))


def test_rubbish_does_not() -> None:
    twice = msgpack.packb({"type": "ShareUrlRequest"})[1:] + msgpack.packb(CAMERA)[1:]
    deep = b"\x91" * 100_000
    for raw in ("text", b"", b"\xc1", b"\xff" * 9, deep, b"\x81" + msgpack.packb("type") + deep,
                b"\x8b" + twice[:40], msgpack.packb(CAMERA) + b"\x00",
                msgpack.packb({"type": "ViewerCameraMessage", "x": "y" * 10**6}),
                b"\x81\xa4type\xa3\xed\xa0\x80"):  # fmt: skip
        with pytest.raises(Unwanted):
            admitted(raw)


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text()
    | st.binary(max_size=40),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=9), inner),
    max_leaves=8,
)  # fmt: skip
TYPES = sorted(_messages.Message._subclass_from_type_string())


@given(
    st.sampled_from(TYPES), st.sampled_from([CAMERA, DRAG, CLICK, PICTURE, {}]), st.data()
)
def test_whatever_gets_through_is_on_the_list_and_viser_can_read_it(
    kind: str, base: dict[str, Any], data: st.DataObject
) -> None:
    changed = data.draw(
        st.dictionaries(st.sampled_from([*base, "x"]), ANYTHING, max_size=2)
    )
    raw = msgpack.packb({**base, **changed, "type": kind}, unicode_errors="surrogatepass")
    try:
        heard = _messages.Message.deserialize(admitted(raw))
    except Unwanted:
        return
    assert type(heard).__name__ in ALLOWED


@given(st.binary(max_size=200))
def test_bytes_of_any_kind_are_told_from_messages(raw: bytes) -> None:
    with pytest.raises(Unwanted):
        admitted(raw)


def test_the_list_says_what_viser_says() -> None:
    """Every message on it has the fields that this version of viser gives it."""
    for name, model in ALLOWED.items():
        theirs = {f.name for f in dataclasses.fields(getattr(_messages, name))}
        assert set(model.model_fields) == theirs, name
    assert set(ALLOWED).isdisjoint({"ShareUrlRequest", "ShareUrlDisconnect"})


# -- who reaches it ----------------------------------------------------------------------------


def ports_of(pid: int) -> set[int]:
    """TCP ports that a process listens on, from the kernel's own tables."""
    inodes = set()
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        try:
            inodes.add(str(entry.readlink()).removeprefix("socket:[").removesuffix("]"))
        except OSError:
            continue
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and fields[9] in inodes:
                found.add(int(fields[1].rpartition(":")[2], 16))
    return found


@pytest.mark.slow
def test_a_viewer_listens_on_its_own_port_and_no_other(lab: Any) -> None:
    assert ports_of(lab.viewer.process.pid) == {lab.viewer.port}


def test_the_socket_lies_in_a_folder_of_this_user_alone() -> None:
    scenes = Scenes()
    folder = scenes.path.parent
    assert scenes.path.is_socket()
    assert folder.stat().st_mode & 0o777 == 0o700
    scenes.stop()
    assert not folder.exists()


def test_a_long_way_to_temporary_files_is_not_too_long(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    far = tmp_path / ("x" * 120)
    far.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(far))
    scenes = Scenes()
    assert scenes.path.is_socket()
    scenes.stop()
    assert not scenes.path.parent.exists()


def test_a_viser_that_listens_elsewhere_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    serve = library.serve
    monkeypatch.setattr(viser, "ViserServer", lambda **_: SimpleNamespace())
    with pytest.raises(GateError, match="starts its server in another way"):
        Scenes()
    assert library.serve is serve


def with_scenes(
    work: Callable[[Scenes, Front], Awaitable[None]], token: str | None = None
) -> None:
    async def page(id: str, connection: object) -> None:
        return None

    async def run() -> None:
        scenes = Scenes()
        front = Front(page, scenes.connect, scenes.html(), {}, token)
        await front.start("127.0.0.1", 0)
        try:
            await work(scenes, front)
        finally:
            await front.close()
            await asyncio.to_thread(scenes.stop)

    asyncio.run(run())


def frame(front: Front, origin: str | None = None, cookie: str = "") -> connect:
    headers = {"Cookie": cookie} if cookie else {}
    return connect(
        f"ws://127.0.0.1:{front.port}{FRAME}", subprotocols=[SPOKEN], max_size=None, proxy=None,
        origin=None if origin is None else Origin(origin), additional_headers=headers,
    )  # fmt: skip


async def until(condition: Callable[[], Any]) -> Any:
    async with asyncio.timeout(30):
        while not (value := condition()):
            await asyncio.sleep(0.01)
    return value


async def joined(scenes: Scenes, connection: ClientConnection) -> Any:
    """The client that viser has made of a frame: it has told where it looks from."""
    await asyncio.wait_for(connection.recv(), 30)
    await connection.send(msgpack.packb(CAMERA))
    clients = await until(scenes.server.get_clients)
    (client,) = clients.values()
    return client


def test_a_frame_reaches_viser_and_is_known_by_its_path() -> None:
    async def work(scenes: Scenes, front: Front) -> None:
        async with frame(front, f"http://127.0.0.1:{front.port}") as page:
            client = await joined(scenes, page)
            assert scenes.path_of(client.client_id) == FRAME
            assert client.camera.position.tolist() == [3.0, 3.5, 3.0]
            handle = scenes.server.scene.add_transform_controls("/gizmos/object")
            await page.send(msgpack.packb(DRAG))
            await until(lambda: handle.position.tolist() == [0.1, 0.2, 0.3])
        assert front.doorkeeper.dropped == 0

    with_scenes(work)


def test_strangers_do_not_reach_viser() -> None:
    """Another site's page, no token, a wrong token: none sees a byte of a scene."""

    async def work(scenes: Scenes, front: Front) -> None:
        own, theirs = f"http://127.0.0.1:{front.port}", "http://evil.example"
        name = cookie_name(TOKEN)
        right = f"{name}={gate_pass()}"
        for origin, cookie, code in (
            (theirs, "", 403), (theirs, right, 403), (own, "", 401),
            (own, f"{name}=wrong", 401), (None, "", 401),
        ):  # fmt: skip
            with pytest.raises(InvalidStatus) as refused:
                async with frame(front, origin, cookie):
                    pass
            assert refused.value.response.status_code == code
        assert front.scenes == 0
        async with frame(front, own, right) as page:
            await joined(scenes, page)

    with_scenes(work, TOKEN)


def gate_pass() -> str:
    from flexdt.clients.viewer.front import _pass

    return _pass(TOKEN)


def test_a_page_opens_no_tunnel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither through the front, nor to viser itself; each kind is one line of the log."""
    told: list[object] = []
    opened: list[object] = []
    monkeypatch.setattr(
        page_messages, "log", lambda *event, **facts: told.append(facts["message"])
    )
    monkeypatch.setattr(
        viser.ViserServer, "request_share_url", lambda *_: opened.append(1)
    )
    share = msgpack.packb({"type": "ShareUrlRequest"})

    async def work(scenes: Scenes, front: Front) -> None:
        async with frame(front) as page:
            client = await joined(scenes, page)
            for raw in (
                share,
                share,
                b"\xc1",
                "text",
                msgpack.packb({"type": "ShareUrlDisconnect"}),
            ):
                await page.send(raw)
            await page.send(msgpack.packb(CAMERA | {"fov": 0.5}))
            await until(lambda: client.camera.fov == 0.5)
        assert front.doorkeeper.dropped == 5
        async with scenes.connect(FRAME, SPOKEN) as inside:
            await asyncio.wait_for(inside.recv(), 30)
            await inside.send(share)
            await inside.send(msgpack.packb(CAMERA))
            await until(scenes.server.get_clients)
        assert opened == []

    with_scenes(work)
    assert told == ["'ShareUrlRequest'", "no message", "text", "'ShareUrlDisconnect'"]


class Reporting:
    """A frame whose report of its first camera reaches viser after some of its orders.

    Args:
        after: orders, before which viser has a record of another camera.
    """

    FIRST: ClassVar = {
        "up": (0.0, 0.0, 1.0),
        "position": (-5.0, 0.0, 0.0),
        "look_at": (-0.2, 0.3, -0.1),
        "fov": 0.5,
    }

    def __init__(self, after: int) -> None:
        self.after, self.orders, self.pose = after, 0, dict(self.FIRST)
        self.camera, self._websock_connection = CameraHandle(self), self  # type: ignore[arg-type]
        self.report()

    atomic = contextlib.nullcontext

    def report(self) -> None:
        """As `handle_camera_message` of viser: its record becomes what the frame had."""
        self.camera._state = dataclasses.replace(
            self.camera._state,
            position=np.array(self.FIRST["position"]),
            look_at=np.array(self.FIRST["look_at"]),
            up_direction=np.array(self.FIRST["up"]),
            fov=self.FIRST["fov"],
            update_timestamp=1.0,
        )

    def queue_message(self, message: _messages.Message) -> None:
        match message:
            case _messages.SetCameraUpDirectionMessage():
                self.pose["up"] = message.position
            case _messages.SetCameraPositionMessage():
                self.pose["position"] = message.position
            case _messages.SetCameraLookAtMessage():
                self.pose["look_at"] = message.look_at
            case _messages.SetCameraFovMessage():
                self.pose["fov"] = message.fov
        self.orders += 1
        if self.orders == self.after:
            self.report()


@pytest.mark.parametrize("after", range(9))
@pytest.mark.parametrize("keeps", ["", "look_at", "fov", "position", "look_at fov"])
def test_a_camera_is_as_it_was_set_whatever_the_frame_reports_meanwhile(
    after: int, keeps: str
) -> None:
    """And however much of it is as it was: a frame opens with the right target, from afar."""
    wanted = {
        "up": (0.0, 0.6, 0.8),
        "position": (0.5, -0.2, 0.2),
        "look_at": (-0.1, 0.4, 0.0),
        "fov": 0.7,
    }
    wanted |= {name: Reporting.FIRST[name] for name in keeps.split()}
    frame = Reporting(after)
    gate.set_camera(frame, Standpoint(**wanted))  # type: ignore[arg-type]
    assert frame.pose == wanted


def test_folders_of_killed_viewers_are_removed_and_those_of_others_stay() -> None:
    with tempfile.TemporaryDirectory(
        prefix="gate-"
    ) as name:  # short: it is a socket's path
        folder = Path(name)
        with contextlib.ExitStack() as stack:
            for each in ("dead", "alive", "young"):
                place = folder / f"flexdt-viser-{each}"
                place.mkdir()
                listener = stack.enter_context(socket.socket(socket.AF_UNIX))
                listener.bind(str(place / "viser"))
                if each == "alive":
                    listener.listen()
                else:
                    listener.close()
                if each != "young":
                    os.utime(place, (0, 0))
            (folder / "somebody-else").mkdir()
            gate.clear_left_behind(folder)
            assert sorted(p.name for p in folder.iterdir()) == [
                "flexdt-viser-alive", "flexdt-viser-young", "somebody-else",
            ]  # fmt: skip
