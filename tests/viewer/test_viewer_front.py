"""Who may come in, and what a page may ask: the viewer's front, over real sockets."""

from __future__ import annotations

import asyncio
import gzip
import json
import re
import ssl
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
import typer
from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed, InvalidStatus

from flexdt.clients.viewer import browser_connections
from flexdt.clients.viewer import front as module
from flexdt.clients.viewer.front import Download, Front
from flexdt.clients.viewer.page import ON_THE_WAY
from flexdt.runtime import waiting_room
from flexdt.runtime.access import AccessError, client_tls, server_tls
from flexdt.runtime.process_settings import public_address

TOKEN = "a-token-of-sixteen-or-more"
TLS = Path(__file__).parents[1] / "data" / "tls"
CERTIFICATE, KEY = TLS / "test-only-cert.pem", TLS / "test-only-key.pem"
HTML = b"<html><head></head><body>viser</body></html>"


async def echo(id: str, connection: ServerConnection) -> None:
    async for message in connection:
        await connection.send(f"{id}:{message!s}")


@asynccontextmanager
async def nowhere(path: str, subprotocol: object) -> AsyncIterator[ClientConnection]:
    raise ConnectionRefusedError
    yield


async def fetch(
    port: int, path: str, tls: ssl.SSLContext | None = None, **headers: str
) -> tuple[int, dict[str, str], bytes]:
    reader, writer = await asyncio.open_connection("127.0.0.1", port, ssl=tls)
    lines = {"Host": f"127.0.0.1:{port}", "Connection": "close", **headers}
    head = "".join(f"{k}: {v}\r\n" for k, v in lines.items())
    writer.write(f"GET {path} HTTP/1.1\r\n{head}\r\n".encode())
    answer = await reader.read()
    writer.close()
    top, _, body = answer.partition(b"\r\n\r\n")
    first, *rest = top.decode().split("\r\n")
    found = dict(line.split(": ", 1) for line in rest)
    return int(first.split()[1]), found, body


def with_front(
    work: Callable[[Front], Awaitable[Any]],
    token: str | None = None,
    tls: ssl.SSLContext | None = None,
) -> Any:
    async def run() -> Any:
        front = Front(echo, nowhere, HTML, {"0" * 32: Download("a.html", b"<p>")}, token)
        await front.start("127.0.0.1", 0, tls)
        try:
            return await work(front)
        finally:
            await front.close()

    return asyncio.run(run())


def test_pages_scripts_and_downloads() -> None:
    async def work(front: Front) -> None:
        for path, kind in (("/", "text/html"), ("/main.js", "text/javascript"),
                           ("/style.css", "text/css"), ("/logo.svg", "image/svg+xml")):  # fmt: skip
            status, headers, body = await fetch(front.port, path)
            assert (status, headers["Content-Type"].split(";")[0]) == (200, kind)
            assert body
            assert "frame-ancestors 'self'" in headers["Content-Security-Policy"]
        status, _, body = await fetch(front.port, f"/scene/{'a' * 12}/iso?x=1")
        assert status == 200
        assert b"<style>" in body
        assert b"viser" in body
        assert (await fetch(front.port, f"/download/{'0' * 32}"))[0] == 200
        assert (await fetch(front.port, f"/download/{'0' * 32}"))[0] == 404

    with_front(work)


def test_a_picture_that_takes_too_long_is_answered_with_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "STILL_S", 0.05)

    async def slow(asked: object) -> bytes:
        await asyncio.sleep(30.0)
        return b"late"

    async def work() -> None:
        front = Front(echo, nowhere, HTML, {}, still=slow)
        await front.start("127.0.0.1", 0)
        try:
            status, headers, body = await fetch(front.port, "/still.jpg?view=iso")
            assert (status, body) == (204, b"")
            assert (
                headers["Connection"] == "close"
            )  # no further request goes into nothing
        finally:
            await front.close()

    asyncio.run(work())


@pytest.mark.parametrize("ask", ["still", "page"])
@pytest.mark.parametrize("half", [True, False])
def test_browsers_that_leave_unanswered_leave_no_error_in_the_log(
    ask: str,
    half: bool,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Requests whose answer is waited for; the browser ends its side, or the connection."""
    asked, left = asyncio.Event(), asyncio.Event()
    pages: list[str] = []

    async def late(*_: object) -> None:
        asked.set()
        await left.wait()

    async def run() -> None:
        front = Front(echo, nowhere, HTML, {}, still=late)
        monkeypatch.setattr(front, "_stranger", late if ask == "page" else nobody)
        await front.start("127.0.0.1", 0)
        _, writer = await asyncio.open_connection("127.0.0.1", front.port)
        path = "/still.jpg?view=iso" if ask == "still" else f"/ws/{'a' * 24}"
        upgrade = (
            "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
        )
        head = f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{front.port}\r\n"
        writer.write((head + upgrade * (ask == "page") + "\r\n").encode())
        await asked.wait()
        if half:
            writer.write_eof()
        else:
            writer.transport.abort()
        await asyncio.sleep(0.1)
        left.set()
        await asyncio.sleep(0.1)
        status, _, _ = await fetch(front.port, "/main.js")
        pages.append(str(status))
        await front.close()

    asyncio.run(run())
    assert pages == ["200"]
    assert [r.getMessage() for r in caplog.records if r.levelname == "ERROR"] == []


async def nobody(*_: object) -> None:
    """Admit every request."""


def test_what_has_not_changed_is_not_sent_again() -> None:
    """viser's program, nearly all of each view, is one file under a name made of its
    content."""
    program = (
        '<script data-p="ab!c" data-ss="7">run(document.currentScript.dataset.p)</script>'
    )
    html = f"<html><head>{program}</head><body>viser</body></html>".encode()

    async def work(port: int) -> None:
        one = (await fetch(port, f"/scene/{'a' * 12}/iso"))[2].decode()
        other = (await fetch(port, f"/scene/{'b' * 12}/beam"))[2].decode()
        assert "run(" not in one
        (path,) = set(re.findall(r'src="../..(/viser-[0-9a-f]+\.js)"', one + other))
        for asked, patience in (
            (path, "immutable"),
            ("/main.js", "no-cache"),
            ("/", "no-cache"),
        ):
            status, headers, body = await fetch(port, asked)
            assert status == 200
            assert patience in headers["Cache-Control"]
            tag = {"If-None-Match": headers["ETag"]}
            assert (await fetch(port, asked, **tag))[::2] == (304, b"")
            assert (await fetch(port, asked, **{"If-None-Match": '"another"'}))[2] == body
            _, headers, packed = await fetch(
                port, asked, **{"Accept-Encoding": "br, gzip"}
            )
            assert headers["Content-Encoding"] == "gzip"
            assert gzip.decompress(packed) == body
        script = (await fetch(port, path))[2].decode()
        assert script.endswith("run(document.currentScript.dataset.p)")
        assert '{"p": "ab!c", "ss": "7"}' in script

    async def run() -> None:
        front = Front(echo, nowhere, html, {})
        await front.start("127.0.0.1", 0)
        try:
            await work(front.port)
        finally:
            await front.close()

    asyncio.run(run())


@pytest.mark.parametrize(
    "path",
    [
        "/nothing.js",
        "/../link.py",
        "/..%2flink.py",
        "/data",
        "/__init__.py",
        "/scene/x/iso",
    ],
)
def test_nothing_else_is_served(path: str) -> None:
    assert with_front(lambda front: fetch(front.port, path))[0] == 404


def test_foreign_pages_are_refused() -> None:
    """Neither another site's script nor a name that somebody points at the loopback gets in."""

    async def work(front: Front) -> None:
        assert (await fetch(front.port, "/", Host="evil.example"))[0] == 403
        assert (await fetch(front.port, "/", Origin="http://evil.example"))[0] == 403
        own = f"http://127.0.0.1:{front.port}"
        assert (await fetch(front.port, "/", Origin=own))[0] == 200
        url = f"ws://127.0.0.1:{front.port}/ws/{'b' * 12}"
        with pytest.raises(InvalidStatus):
            async with connect(url, origin="http://evil.example", proxy=None):  # type: ignore[arg-type]
                pass
        async with connect(url, origin=own, proxy=None) as page:  # type: ignore[arg-type]
            await page.send("hello")
            assert await page.recv() == f"{'b' * 12}:hello"

    with_front(work)


def test_a_token_is_asked_for_once() -> None:
    async def work(front: Front) -> None:
        status, headers, asked = await fetch(front.port, "/")
        assert (status, headers["Content-Type"]) == (401, "text/html; charset=utf-8")
        assert b'name="token"' in asked
        assert b"This is not it" not in asked
        status, _, again = await fetch(front.port, "/?token=wrong-but-long-enough")
        assert status == 401
        assert b"This is not it" in again
        assert (await fetch(front.port, "/main.js"))[1]["Content-Type"].startswith(
            "text/plain"
        )
        url = f"ws://127.0.0.1:{front.port}/ws/{'b' * 12}"
        with pytest.raises(InvalidStatus):
            async with connect(url, proxy=None):
                pass
        status, headers, _ = await fetch(front.port, f"/?token={TOKEN}")
        assert (status, headers["Location"]) == (302, "./")
        assert TOKEN not in headers["Set-Cookie"]
        assert "HttpOnly" in headers["Set-Cookie"]
        assert "Secure" not in headers["Set-Cookie"], "a browser would not send it back"
        cookie = headers["Set-Cookie"].split(";")[0]
        assert (await fetch(front.port, "/", Cookie=cookie))[0] == 200
        async with connect(
            url, additional_headers={"Cookie": cookie}, proxy=None
        ) as page:
            await page.send("x")
            assert await page.recv()

    with_front(work, TOKEN)


def test_guesses_wait_for_each_other_and_are_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Wrong tokens are answered one after another; a right one is not kept waiting by them."""
    told: list[object] = []
    monkeypatch.setattr(
        module, "log", lambda *event, **facts: told.append((event[0], facts))
    )

    async def guess(front: Front) -> list[asyncio.Task[Any]]:
        wrong = [fetch(front.port, f"/?token=wrong-{i}") for i in range(3)]
        guesses = [asyncio.create_task(g) for g in wrong]
        while len(told) < 3:
            await asyncio.sleep(0.005)
        return guesses

    async def work(front: Front) -> None:
        begun = time.monotonic()
        assert [(await g)[0] for g in await guess(front)] == [401, 401, 401]
        assert time.monotonic() - begun >= 3 * module.GUESS_S
        assert told == [
            ("wrong token", {"client": "127.0.0.1", "count": i}) for i in (1, 2, 3)
        ]
        told.clear()
        monkeypatch.setattr(module, "GUESS_S", 600.0)
        guesses = await guess(front)
        assert (await fetch(front.port, f"/?token={TOKEN}"))[0] == 302
        for g in guesses:
            assert not g.done()
            g.cancel()

    with_front(work, TOKEN)


def test_what_cannot_be_read_is_refused() -> None:
    async def work(front: Front) -> None:
        assert (await fetch(front.port, "/", Host="[::"))[0] == 400
        assert (await fetch(front.port, "/", Origin="http://[::"))[0] == 400
        cookie = f"{module.cookie_name(TOKEN)}=\u00e9\u00e9"
        assert (await fetch(front.port, "/", Cookie=cookie))[0] in (400, 401)
        assert (await fetch(front.port, "/?token=\u00e9"))[0] in (400, 401)

    with_front(work, TOKEN)


def test_over_tls_with_a_token() -> None:
    """The cookie stays on HTTPS; without TLS nobody is served."""
    mine = client_tls(CERTIFICATE, any_name=True)

    async def work(front: Front) -> None:
        assert (await fetch(front.port, "/", mine))[0] == 401
        _, headers, _ = await fetch(front.port, f"/?token={TOKEN}", mine)
        assert "; Secure" in headers["Set-Cookie"]
        cookie = headers["Set-Cookie"].split(";")[0]
        assert (await fetch(front.port, "/", mine, Cookie=cookie))[0] == 200
        url = f"wss://127.0.0.1:{front.port}/ws/{'b' * 12}"
        own = f"https://127.0.0.1:{front.port}"
        more = {"Cookie": cookie}
        async with connect(
            url,
            ssl=mine,
            origin=own,
            additional_headers=more,
            proxy=None,  # type: ignore[arg-type]
        ) as page:
            await page.send("hello")
            assert await page.recv() == f"{'b' * 12}:hello"
        with pytest.raises((OSError, ValueError, IndexError)):
            await fetch(front.port, "/", Cookie=cookie)

    with_front(work, TOKEN, server_tls(CERTIFICATE, KEY))


def test_views_beyond_the_limit_are_refused() -> None:
    async def run() -> None:
        async def viser(connection: ServerConnection) -> None:
            await connection.wait_closed()

        async with serve(viser, "127.0.0.1", 0, compression=None) as behind:
            there = f"ws://127.0.0.1:{behind.sockets[0].getsockname()[1]}"
            front = Front(
                echo, lambda *_: connect(there, proxy=None), HTML, {}, max_scenes=1
            )
            await front.start("127.0.0.1", 0)
            url = f"ws://127.0.0.1:{front.port}/scene/{'c' * 12}/iso"
            async with connect(url, proxy=None):
                while front.scenes < 1:
                    await asyncio.sleep(0.005)
                async with connect(url, proxy=None) as second:
                    with pytest.raises(ConnectionClosed) as closed:
                        await asyncio.wait_for(second.recv(), 60)
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 1013
            while front.scenes:
                await asyncio.sleep(0.005)
            await front.close()

    asyncio.run(run())


def test_silent_connections_give_way_to_newcomers_and_pages_stay(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Whatever peers without a request or without the token hold, pages are served."""
    monkeypatch.setattr(waiting_room, "MAX_WAITING", 6)

    async def run() -> None:
        front = Front(echo, nowhere, HTML, {}, TOKEN, max_scenes=1, max_pages=1)
        await front.start("127.0.0.1", 0)
        cookie = (await fetch(front.port, f"/?token={TOKEN}"))[1]["Set-Cookie"].split(
            ";"
        )[0]
        url = f"ws://127.0.0.1:{front.port}/ws/{'b' * 12}"
        held = []
        async with connect(
            url, proxy=None, additional_headers={"Cookie": cookie}
        ) as page:
            for said in [
                b"",
                b"GET / HTTP/1.1\r\n",
                b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n",
            ] * 30:
                _, writer = await asyncio.open_connection("127.0.0.1", front.port)
                writer.write(said)
                held.append(writer)
                await page.send("still here")
                assert await page.recv() == f"{'b' * 12}:still here"
                assert (await fetch(front.port, "/", Cookie=cookie))[0] == 200
                assert len(front.admission.strangers.guests) <= 6
        for writer in held:
            writer.close()
        await front.close()
        assert not front.admission.strangers.guests
        assert not front.admission.answered.guests

    asyncio.run(run())
    assert caplog.messages == []


def test_answers_that_are_not_read_give_way_to_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A peer that sends whole requests and takes no answer displaces its own alone."""
    monkeypatch.setattr(browser_connections, "ANSWERED", 3)
    monkeypatch.setattr(module, "STILL_S", 0.5)

    async def slow(asked: object) -> bytes | None:
        await asyncio.sleep(60.0)
        return None

    async def run() -> None:
        front = Front(echo, nowhere, HTML, {}, still=slow)
        await front.start("127.0.0.1", 0)
        held = []
        for _ in range(12):
            _, writer = await asyncio.open_connection("127.0.0.1", front.port)
            writer.write(b"GET /still.jpg HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            held.append(writer)
            assert (await fetch(front.port, "/"))[0] == 200
            assert len(front.admission.answered.guests) <= 3
        for writer in held:
            writer.close()
        await front.close()

    asyncio.run(run())


def test_messages_that_never_end_are_cut_and_others_are_heard(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(browser_connections, "MAX_HELD", 4 << 20)

    async def endless(port: int, number: int) -> None:
        url = f"ws://127.0.0.1:{port}/ws/{number:012x}"
        async with connect(url, proxy=None, compression=None) as page:

            async def pieces() -> AsyncIterator[str]:
                for _ in range(14):
                    yield "x" * (1 << 20)
                    await asyncio.sleep(0.01)
                await asyncio.sleep(60)

            await page.send(pieces())

    async def work(front: Front) -> None:
        async with asyncio.timeout(120):
            ended = await asyncio.gather(
                *(endless(front.port, i) for i in range(4)), return_exceptions=True
            )
        assert all(isinstance(error, ConnectionClosed) for error in ended)
        async with connect(
            f"ws://127.0.0.1:{front.port}/ws/{'b' * 12}", proxy=None
        ) as page:
            for _ in range(200):
                await page.send("y" * 100_000)
                assert len(await page.recv()) > 100_000

    with_front(work)


def test_a_view_that_says_very_much_leaves_others_their_turns() -> None:
    async def run() -> None:
        front, passed, turns = Front(echo, nowhere, HTML, {}), 0, 0

        class Viser:
            async def send(self, message: bytes) -> None:
                nonlocal passed
                passed += 1

        async def flood() -> AsyncIterator[bytes]:
            while True:
                yield b""

        front.doorkeeper.admit = lambda message: message  # type: ignore[method-assign,assignment]
        begun = time.monotonic()
        up = asyncio.create_task(front._up(flood(), Viser()))  # type: ignore[arg-type]
        while time.monotonic() - begun < 0.3:
            await asyncio.sleep(0)
            turns += 1
        assert turns > passed > 0
        assert passed < 2 + module.RELAYED_HZ * (time.monotonic() - begun)
        up.cancel()

    asyncio.run(run())


def test_other_addresses_need_a_token() -> None:
    async def run() -> None:
        front = Front(echo, nowhere, HTML, {})
        with pytest.raises(AccessError):
            await front.start("0.0.0.0", 0)

    asyncio.run(run())


def test_a_scene_without_viser_ends_politely() -> None:
    async def work(front: Front) -> None:
        url = f"ws://127.0.0.1:{front.port}/scene/{'c' * 12}/iso"
        async with connect(url, proxy=None) as scene:
            with pytest.raises(ConnectionClosed):
                await asyncio.wait_for(scene.recv(), 60)

    with_front(work)


SILENCE_S = 300
"""So long without any message means that none will come."""


@pytest.mark.slow
def test_two_pages_at_the_socket(lab: Any) -> None:
    """States and images reach every page; a page may not call what is not its business."""

    async def listen(page: Any, *wanted: Callable[[Any], bool]) -> list[Any]:
        """The first message of each kind, in whatever order they come, each acknowledged."""
        found: dict[int, Any] = {}
        while len(found) < len(wanted):
            message = await asyncio.wait_for(page.recv(), SILENCE_S)
            value = message if isinstance(message, bytes) else json.loads(message)
            slot = "image" if isinstance(value, bytes) else value["type"]
            if slot in ON_THE_WAY:
                await page.send(json.dumps({"took": slot}, separators=(",", ":")))
            for i, fits in enumerate(wanted):
                if i not in found and fits(value):
                    found[i] = value
        return [found[i] for i in range(len(wanted))]

    async def run() -> None:
        host = f"127.0.0.1:{lab.viewer.port}"
        async with (
            connect(f"ws://{host}/ws/{'d' * 12}", max_size=None, proxy=None) as one,
            connect(f"ws://{host}/ws/{'e' * 12}", max_size=None, proxy=None) as two,
        ):
            for page in (one, two):
                state, _image = await listen(
                    page,
                    lambda m: isinstance(m, dict) and m["type"] == "state",
                    lambda m: isinstance(m, bytes) and m[1:5] == b"FXI2",
                )
                assert set(state["state"]["axes"]) >= {"mag_obj", "rot_obj"}
            for id, method in enumerate(
                ("state.subscribe", "session.hello", "no.such", "viewer.nothing")
            ):
                await one.send(json.dumps({"id": id, "method": method}))
                (answer,) = await listen(
                    one, lambda m, id=id: isinstance(m, dict) and m.get("id") == id
                )
                assert answer["error"]["code"] == -32601
            for wrong in (
                "",
                "[]",
                "{",
                '{"id": 9}',
                '{"id": 9, "method": "x", "params": 3}',
            ):
                await one.send(wrong)
                (answer,) = await listen(
                    one,
                    lambda m: (
                        isinstance(m, dict) and m["type"] == "answer" and "error" in m
                    ),
                )
                assert answer["error"]["code"] == -32600

    asyncio.run(run())


@pytest.mark.parametrize(
    ("text", "host", "path", "secure"),
    [
        ("https://hub.example/user/ann/proxy/8080/", "hub.example", "/user/ann/proxy/8080/", True),
        ("http://Hub.example:8000", "hub.example:8000", "/", False),
        ("https://hub.example/node/n1/8080", "hub.example", "/node/n1/8080/", True),
    ],
)  # fmt: skip
def test_a_public_address_is_read(text: str, host: str, path: str, secure: bool) -> None:
    found = public_address(text)
    assert (found.host, found.path, found.is_secure) == (host, path, secure)
    assert public_address(str(found)) == found
    assert found.below(f"{path}ws/abc") == found.below("/ws/abc") == "/ws/abc"
    assert found.below("/other/ws/abc") == "/other/ws/abc"


@pytest.mark.parametrize(
    "text", ["", "hub.example", "ftp://hub.example/", "https://", "https://a@b/", "http://[::", "https://h/?x=1"]
)  # fmt: skip
def test_what_is_no_address_of_a_page_is_refused(text: str) -> None:
    with pytest.raises(typer.BadParameter, match=r"https://hub\.example/user"):
        public_address(text)
