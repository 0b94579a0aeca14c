"""The viewer's HTTP and WebSocket front: one port for the page, its data, and viser's scenes.

viser accepts any connection, so only this module can reach it (see `viser_gate`). Requests
under `/scene/PAGE/VIEW` are relayed to viser after Host, Origin and (where there is one) the
token have been checked. `/ws/PAGE` is the page's own connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import gzip
import hashlib
import hmac
import http
import logging
import mimetypes
import re
import ssl as tls
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from typing import Final, cast
from urllib.parse import SplitResult, parse_qs, urlsplit

from websockets.asyncio.client import ClientConnection
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from flexdt.clients.viewer.browser_connections import Admission, BrowserConnection
from flexdt.clients.viewer.page_html import PAGE, TRANSLUCENT, page_file, token_form
from flexdt.clients.viewer.page_messages import MessageFilter
from flexdt.clients.viewer.viser_gate import MARK, parted
from flexdt.runtime.access import (
    PublicAddress,
    check_bind,
    is_loopback,
    is_rebound,
    token_matches,
)
from flexdt.runtime.log import log
from flexdt.runtime.process import TLS_HANDSHAKE_S, one_at_a_time

COOKIE: Final = "flexdt_viewer"
MAX_FROM_PAGE: Final = 16 << 20
"""Largest message of a browser [bytes]: a script of 8 MiB as JSON, a piece of an
upload, a picture."""
CLOSE_HEADER: Final = {"Connection": "close"}
"""Header of plain answers: websockets closes after them; a client without it would
send its next request to a closed connection."""
SILENT_S: Final = 60.0
"""Time without an answer to a ping after which a browser counts as gone [s]; busy
machines are slow."""
STILL_S: Final = 8.0
"""Time limit for a picture [s]: websockets cuts a connection that has no answer for 10
s."""
RELAYED_HZ: Final = 500.0
"""Largest rate of messages of one view to viser [1/s]; a dragging hand sends 60."""
GUESS_S: Final = 0.4
"""Delay of the answer to a wrong token [s]; wrong ones wait for each other."""
PAGE_PATH: Final = re.compile(r"/ws/([0-9a-f]{8,64})")
SCENE_PATH: Final = re.compile(r"/scene/([0-9a-f]{8,64})/([a-z]{1,16})")
DOWNLOAD_PATH: Final = re.compile(r"/download/([0-9a-f]{32})")
FOR_GOOD: Final = "private, max-age=31536000, immutable"
"""Cache header of files whose name changes with their content."""
NO_TOKEN: Final = "This viewer wants a token: open its first page, and type it there.\n"
POLICY: Final = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; "
    "connect-src 'self' data: blob: ws: wss:; frame-ancestors 'self'"
)

PageHandler = Callable[[str, ServerConnection], Awaitable[None]]
"""Serves a page's connection until it ends: the page's id, the connection."""
Still = Callable[[Mapping[str, str]], Awaitable[bytes | None]]
Connect = Callable[
    [str, Subprotocol | None], AbstractAsyncContextManager[ClientConnection]
]
"""A connection to viser for a frame's path and subprotocol."""


@dataclass(frozen=True)
class Download:
    """A file for a browser."""

    name: str
    content: bytes


class Front:
    """The listening server.

    Args:
        page: serves a page's connection.
        connect: to viser.
        scene_html: viser's page, as it serves it.
        downloads: key -> file; taken out when fetched.
        token: a browser must show it once (`/?token=...`); None for none.
        public: where browsers find it behind a proxy; None: where it listens.
        max_scenes: views open at a time.
        max_pages: pages open at a time; `page` closes further ones, which have no place here.
        still: answers `/still.jpg`, the scene as a picture, from the query; None: not yet.
    """

    def __init__(
        self,
        page: PageHandler,
        connect: Connect,
        scene_html: bytes,
        downloads: dict[str, Download],
        token: str | None = None,
        public: PublicAddress | None = None,
        max_scenes: int = 256,
        max_pages: int = 64,
        still: Still | None = None,
    ) -> None:
        """Prepare the page of the scenes and the checks; `start` listens.

        viser's program is split from its page and served under a name of its own; scripts
        of ours are put into that page. Nothing listens yet.

        Args:
            page: serves a page's connection.
            connect: opens a connection to viser.
            scene_html: viser's page.
            downloads: id -> file; each is fetched once.
            token: required of browsers; None for none.
            public: where browsers find it behind a proxy; None: where it listens.
            max_scenes, max_pages: largest numbers of open views and pages.
            still: makes a picture of the scene; None for none.
        """
        self._page = page
        self._connect = connect
        self.doorkeeper = MessageFilter()
        self._max_scenes = max_scenes
        self.scenes = 0
        self._max_pages = max_pages
        self._pages = 0
        self.admission = Admission()
        self._guessing = asyncio.Lock()
        self._closing = asyncio.Event()
        self.wrong_tokens = 0
        self._downloads = downloads
        self._token = token
        self._public = public
        self._still = still
        more = b"<style>%s</style><script>%s</script><script>%s</script>" % (
            page_file("scene.css"),
            page_file(TRANSLUCENT),
            page_file("scene.js"),
        )
        bare, self._program = parted(scene_html)
        self._program_path = f"/viser-{hashlib.sha256(self._program).hexdigest()[:16]}.js"
        bare = bare.replace(
            MARK, b'<script src="../..%b"></script>' % self._program_path.encode(), 1
        )
        self._scene_html = bare.replace(b"<head>", b"<head>" + more, 1)
        self._loopback = True
        self._secure = False
        self._server: Server | None = None

    @property
    def port(self) -> int:
        """The port it listens on."""
        assert self._server is not None
        return int(next(iter(self._server.sockets)).getsockname()[1])

    async def start(
        self, host: str, port: int, ssl: tls.SSLContext | None = None
    ) -> None:
        """Start to listen; port 0 is any free one.

        Connections come one at a time, uncompressed; the token is that of the front.
        Without a token only loopback addresses are allowed. Messages have at most
        `MAX_FROM_PAGE` bytes; a browser that does not answer a ping for `SILENT_S` is cut
        off.

        Args:
            host, port: to listen on.
            ssl: a server's TLS context; None for plain TCP.

        Raises:
            AccessError: others can reach the address and there is no token.
            OSError: the address is taken or not ours.
        """
        check_bind(host, self._token)
        self._loopback = is_loopback(host)
        self._secure = ssl is not None
        self._server = await serve(
            self._serve,
            host,
            port,
            ssl=ssl,
            ssl_handshake_timeout=None if ssl is None else TLS_HANDSHAKE_S,
            process_request=self._answer,
            select_subprotocol=_first,
            compression=None,
            create_connection=cast(type[ServerConnection], self.admission.connection),
            logger=_quiet(),
            max_size=MAX_FROM_PAGE,
            max_queue=4,
            ping_timeout=SILENT_S,
            write_limit=1 << 16,
            server_header=None,
            backlog=1,
        )
        one_at_a_time(self._server.server)

    async def close(self) -> None:
        """Stop listening, end every connection and wait for that.

        A second call does nothing more.
        """
        self._closing.set()
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()

    def _asked(self, request: Request) -> SplitResult:
        """Return the address of a request below this viewer, without a public path that a
        proxy has left in it."""
        url = urlsplit(request.path)
        if self._public is None:
            return url
        return url._replace(path=self._public.below(url.path))

    # -- plain requests ----------------------------------------------------------------------

    async def _answer(
        self, connection: ServerConnection, request: Request
    ) -> Response | None:
        """Answer a browser's request, or let it go on as a WebSocket.

        In this order: 400 for a request that cannot be read, the responses of `_foreign`
        and `_stranger`, the still picture, which is awaited for `STILL_S` (204 without
        one), and `_content`.

        Args:
            connection: of the browser; an admitted one moves to the second room.
            request: its request.

        Returns:
            The response; None to go on with a WebSocket.
        """
        try:
            url = self._asked(request)
            denied = self._foreign(request) or await self._stranger(
                connection, request, url
            )
        except (
            ValueError,
            LookupError,
        ):  # brackets, bytes or headers that belong nowhere
            return _plain(http.HTTPStatus.BAD_REQUEST, "this request cannot be read")
        if denied is None:
            cast(BrowserConnection, connection).admit()
        if denied is None and url.path == "/still.jpg" and self._still is not None:
            asked = {k: v[-1] for k, v in parse_qs(url.query).items()}
            picture = None
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(STILL_S):
                    picture = await self._still(asked)
            if picture is None:
                return _response(b"", "image/jpeg", status=http.HTTPStatus.NO_CONTENT)
            return _kept(request, picture, "image/jpeg")
        return denied or self._content(request, url)

    def _content(self, request: Request, url: SplitResult) -> Response | None:
        """Answer an admitted request with a page, a file of the page, a download or an
        error.

        A download can be fetched once. Unknown paths give 404. Files are those of the
        page's folder with the ending html, css, js or svg; "/" is the page.

        Args:
            request: of the browser.
            url: its parts.

        Returns:
            The response; None for a known WebSocket's path.
        """
        if request.headers.get("Upgrade", "").lower() == "websocket":
            known = PAGE_PATH.fullmatch(url.path) or SCENE_PATH.fullmatch(url.path)
            if known:
                return None
            return _plain(http.HTTPStatus.NOT_FOUND, "no such connection")
        if SCENE_PATH.fullmatch(url.path):
            return _kept(request, self._scene_html, "text/html; charset=utf-8")
        if self._program and url.path == self._program_path:
            return _kept(
                request, self._program, "text/javascript; charset=utf-8", FOR_GOOD
            )
        if (match := DOWNLOAD_PATH.fullmatch(url.path)) is not None:
            file = self._downloads.pop(match[1], None)
            if file is None:
                return _plain(
                    http.HTTPStatus.NOT_FOUND, "this file has been fetched already"
                )
            kind = mimetypes.guess_type(file.name)[0] or "application/octet-stream"
            disposition = f'attachment; filename="{file.name}"'
            return _response(file.content, kind, {"Content-Disposition": disposition})
        if url.path == "/":
            name = PAGE
        else:
            name = url.path.removeprefix("/")
        if not re.fullmatch(r"[a-z0-9_-]+\.(html|css|js|svg)", name):
            return _plain(http.HTTPStatus.NOT_FOUND, "no such page")
        try:
            content = page_file(name)
        except FileNotFoundError:
            return _plain(http.HTTPStatus.NOT_FOUND, "no such page")
        kind = {"js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}.get(
            name.rsplit(".", 1)[1], "text/html"
        )
        return _kept(request, content, f"{kind}; charset=utf-8")

    def _foreign(self, request: Request) -> Response | None:
        """Check that a request is not from another site's page.

        On the loopback address the Host must be a local one or the public one; elsewhere it
        is not checked. An Origin must equal the Host, or the public one; a request without
        Origin passes.

        Returns:
            The error (403); None admits.
        """
        host = request.headers.get("Host", "")
        public = None if self._public is None else self._public.host
        if self._loopback and host != public and is_rebound(host):
            return _plain(http.HTTPStatus.FORBIDDEN, f"this viewer is not {host}")
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc not in (host, public):
            return _plain(
                http.HTTPStatus.FORBIDDEN, f"requests from {origin} are not served"
            )
        return None

    async def _stranger(
        self, connection: ServerConnection, request: Request, url: SplitResult
    ) -> Response | None:
        """Check the token in a request's URL, else its cookie.

        A right token sets the cookie, for the path at which the browser finds this viewer,
        and is redirected (302) to the page without it; only the page takes one. All others
        but a right cookie get 401, at the path / with a form. A wrong token is counted,
        logged and answered after `GUESS_S`, one after the other, at once only
        while the front closes.

        Args:
            connection: of the browser, for the log.
            request: with its cookie.
            url: with the token.

        Returns:
            The response to a request without a valid cookie; None admits, always if the
            viewer has no token.
        """
        if self._token is None:
            return None
        given = None
        if url.path == "/":
            given = parse_qs(url.query).get("token", [None])[0]
        if given is not None and token_matches(given, self._token):
            # Without a path it is that of the page as the browser knows it, and not sent to others.
            cookie = f"{cookie_name(self._token)}={_pass(self._token)}; HttpOnly; SameSite=Strict"
            if self._secure or (self._public is not None and self._public.is_secure):
                cookie += "; Secure"
            headers = Headers(
                {"Location": "./", "Set-Cookie": cookie, "Content-Length": "0"}
            )
            return Response(http.HTTPStatus.FOUND.value, "Found", headers, b"")
        if _same(_cookie(request, cookie_name(self._token)), _pass(self._token)):
            return None
        if given is not None:
            self.wrong_tokens += 1
            client = (connection.remote_address or ("?",))[0]
            log("wrong token", logging.WARNING, client=client, count=self.wrong_tokens)
            with contextlib.suppress(TimeoutError):
                async with self._guessing, asyncio.timeout(GUESS_S):
                    await self._closing.wait()
        wrong = given is not None
        if url.path == "/":
            asked = token_form(wrong)
        else:
            asked = NO_TOKEN.encode()
        if url.path == "/":
            form = "text/html"
        else:
            form = "text/plain"
        return _response(
            asked, f"{form}; charset=utf-8", status=http.HTTPStatus.UNAUTHORIZED
        )

    # -- WebSockets --------------------------------------------------------------------------

    async def _serve(self, connection: ServerConnection) -> None:
        """Serve a WebSocket, whose path has been checked, until it ends.

        A view is closed with 1013 if the largest number of views is open. A page in
        excess gets no place here, and is closed by the page handler.
        """
        assert connection.request is not None
        path = self._asked(connection.request).path
        if (match := PAGE_PATH.fullmatch(path)) is not None:
            if self._pages < self._max_pages:
                cast(BrowserConnection, connection).seat()
            self._pages += 1
            try:
                await self._page(match[1], connection)
            finally:
                self._pages -= 1
        elif self.scenes >= self._max_scenes:
            await connection.close(
                1013, f"{self._max_scenes} views are open, and no more may be"
            )
        else:
            cast(BrowserConnection, connection).seat()
            self.scenes += 1
            try:
                await self._relay(connection, path)
            finally:
                self.scenes -= 1

    async def _relay(self, browser: ServerConnection, path: str) -> None:
        """Pass messages between a browser and viser until either ends; `MessageFilter`
        filters those to viser.

        Then both directions end and viser's connection is closed. Lost or refused
        connections are not raised.
        """
        with contextlib.suppress(OSError, ConnectionClosed, InvalidHandshake):
            async with self._connect(path, browser.subprotocol) as viser:
                pumps = [
                    asyncio.create_task(self._up(browser, viser)),
                    asyncio.create_task(_down(viser, browser)),
                ]
                await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
                for pump in pumps:
                    pump.cancel()
                await asyncio.gather(*pumps, return_exceptions=True)

    async def _up(self, browser: ServerConnection, viser: ClientConnection) -> None:
        """Relay messages from a browser to viser, without those that the message filter holds
        back.

        At most `RELAYED_HZ` messages a second; runs until the browser closes.
        """
        async for message in browser:
            if (admitted := self.doorkeeper.admit(message)) is not None:
                await viser.send(admitted)
            # Nothing else lets others have a turn while messages of one view are at hand.
            await asyncio.sleep(1.0 / RELAYED_HZ)


async def _down(viser: ClientConnection, browser: ServerConnection) -> None:
    async for message in viser:
        await browser.send(message)


def _quiet() -> logging.Logger:
    """Return the library's logger, without a traceback for each silent connection.

    Such are pages' connections to us, and ours to viser when a page leaves at once.
    """
    front = logging.getLogger("websockets.front")
    for logger in (front, logging.getLogger("websockets.server")):
        if not logger.filters:
            logger.addFilter(
                lambda record: record.getMessage() != "opening handshake failed"
            )
    return front


def _first(_: ServerConnection, offered: Sequence[Subprotocol]) -> Subprotocol | None:
    return offered[0] if offered else None


def _pass(token: str) -> str:
    return hmac.new(token.encode(), b"flexdt viewer", hashlib.sha256).hexdigest()


def _same(given: str | None, wanted: str) -> bool:
    """Compare in constant time; the received text may hold anything."""
    return given is not None and hmac.compare_digest(
        given.encode("utf-8", "surrogateescape"), wanted.encode()
    )


def cookie_name(token: str) -> str:
    """Return the name of the cookie for a token: that of another viewer at the same host has
    another."""
    return (
        f"{COOKIE}_{hmac.new(token.encode(), b'cookie', hashlib.sha256).hexdigest()[:8]}"
    )


def _cookie(request: Request, wanted: str) -> str | None:
    """Return the value of a cookie in a request; None without it.

    The first one counts.
    """
    for header in request.headers.get_all("Cookie"):
        for part in header.split(";"):
            name, _, value = part.strip().partition("=")
            if name == wanted:
                return value
    return None


def _kept(
    request: Request, body: bytes, kind: str, how_long: str = "no-cache"
) -> Response:
    """Make a response that a browser may keep: sent again only where it has changed.

    It is packed with gzip if the browser accepts that. The tag is a hash of the content.

    Args:
        request: with the tag that the browser has.
        body: content.
        kind: its type.
        how_long: value of Cache-Control.

    Returns:
        The response; 304 "Not Modified" without content if the browser has this content.
    """
    tag = f'"{hashlib.sha256(body).hexdigest()[:32]}"'
    more = {
        "ETag": tag,
        "Cache-Control": how_long,
        "Vary": "Accept-Encoding",
        **CLOSE_HEADER,
    }
    if tag in request.headers.get("If-None-Match", ""):
        return Response(
            http.HTTPStatus.NOT_MODIFIED.value, "Not Modified", Headers(more), b""
        )
    if "gzip" in request.headers.get("Accept-Encoding", ""):
        body = _packed(body)
        more["Content-Encoding"] = "gzip"
    return _response(body, kind, more)


@functools.lru_cache(64)
def _packed(body: bytes) -> bytes:
    return gzip.compress(body, mtime=0)


def _response(
    body: bytes,
    kind: str,
    more: Mapping[str, str] | None = None,
    status: http.HTTPStatus = http.HTTPStatus.OK,
) -> Response:
    """Make a response with the headers of all content: length, type, policy, no cache.

    It also says that the connection closes. Further headers are those of `more`.

    Args:
        body: content.
        kind: its media type.
        more: further headers, which override.
        status: of HTTP.
    """
    headers = Headers(
        {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Cache-Control": "no-cache",
            "Content-Security-Policy": POLICY,
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            **CLOSE_HEADER,
            **(more or {}),
        }
    )
    return Response(status.value, status.phrase, headers, body)


def _plain(status: http.HTTPStatus, text: str) -> Response:
    return _response(f"{text}\n".encode(), "text/plain; charset=utf-8", status=status)
