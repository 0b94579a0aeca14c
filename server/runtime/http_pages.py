"""A minimal HTTP server for monitoring: `/healthz` and `/metrics`.

Each connection serves one small GET or HEAD request within a few seconds. Beyond the loopback,
pages other than `/healthz` need the server's token (`Authorization: Bearer ...`).

Twin, projector and viewer supply the figures; this module puts them into the pages.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from dataclasses import dataclass
from http import HTTPStatus

from flexdt.process_settings import LOOPBACK, ServerSettings
from flexdt.server.runtime.access import check_bind, is_loopback, read_token, token_matches
from flexdt.server.runtime.log import dropped
from flexdt.server.runtime.loop import Holds, ListeningServer, ServerLoop
from flexdt.server.runtime.metrics import CONTENT_TYPE, Figure, Requests, counter, gauge, render

MAX_HEAD = 8192
TIMEOUT_S = 5.0
MAX_CLIENTS = 32
OPEN_PAGES = ("/healthz",)


@dataclass(frozen=True)
class HttpResponse:
    """The response to a request."""

    text: str
    status: HTTPStatus = HTTPStatus.OK
    content_type: str = "application/json"


Pages = Mapping[str, Callable[[], HttpResponse]]


class HttpServer(ListeningServer):
    """A listening server; made by `serve_http`."""

    def __init__(self, pages: Pages, token: str | None) -> None:
        self._pages, self._token = pages, token
        self._clients: set[asyncio.Task[None]] = set()

    async def close(self) -> None:
        """Stop listening and end the open connections."""
        if self.server is not None:
            self.server.close()
        for task in list(self._clients):
            task.cancel()
        await asyncio.gather(*self._clients, return_exceptions=True)

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve one connection."""
        task = asyncio.current_task()
        assert task is not None
        self._clients.add(task)
        try:
            async with asyncio.timeout(TIMEOUT_S):
                if len(self._clients) > MAX_CLIENTS:
                    page, head = HttpResponse("{}", HTTPStatus.SERVICE_UNAVAILABLE), False
                else:
                    page, head = await self._answer(reader)
                body = page.text.encode()
                lines = [
                    f"HTTP/1.1 {page.status.value} {page.status.phrase}",
                    f"Content-Type: {page.content_type}",
                    f"Content-Length: {len(body)}",
                    "Cache-Control: no-store",
                    "Connection: close",
                ]
                writer.write("\r\n".join([*lines, "", ""]).encode() + (b"" if head else body))
                await writer.drain()
        except (TimeoutError, ConnectionError):
            pass
        finally:
            self._clients.discard(task)
            writer.close()
            with contextlib.suppress(ConnectionError, TimeoutError):
                await writer.wait_closed()

    async def _answer(self, reader: asyncio.StreamReader) -> tuple[HttpResponse, bool]:
        try:
            text = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
        except asyncio.LimitOverrunError:
            return HttpResponse("{}", HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE), False
        except asyncio.IncompleteReadError:
            return HttpResponse("{}", HTTPStatus.BAD_REQUEST), False
        first, *fields = text.split("\r\n")
        words = first.split(" ")
        if len(words) != 3 or not words[2].startswith("HTTP/1."):
            return HttpResponse("{}", HTTPStatus.BAD_REQUEST), False
        if words[0] not in ("GET", "HEAD"):
            return HttpResponse("{}", HTTPStatus.METHOD_NOT_ALLOWED), False
        path = words[1].split("?", 1)[0]
        if path not in self._pages:
            return HttpResponse("{}", HTTPStatus.NOT_FOUND), words[0] == "HEAD"
        if self._token is not None and path not in OPEN_PAGES:
            given = [f.partition(":")[2].strip() for f in fields if f.lower().startswith("auth")]
            bearer = given[0].removeprefix("Bearer ") if given else None
            if not token_matches(bearer, self._token):
                return HttpResponse("{}", HTTPStatus.UNAUTHORIZED), False
        return self._pages[path](), words[0] == "HEAD"


async def serve_http(
    pages: Pages, host: str = LOOPBACK, port: int = 0, *, token: str | None = None
) -> HttpServer:
    """Serve `pages` by path on `host`:`port`.

    Args:
        pages: path -> function that makes the page.
        host, port: where; beyond the loopback only with a token.
        token: of the server.

    Raises:
        AccessError: the address can be reached by others and there is no token.
        OSError: the address is taken or not ours.
    """
    check_bind(host, token)
    made = HttpServer(pages, None if is_loopback(host) else token)

    def protocol() -> asyncio.StreamReaderProtocol:
        return asyncio.StreamReaderProtocol(asyncio.StreamReader(limit=MAX_HEAD), made.serve)

    await made.listen(protocol, host, port)
    return made


@contextlib.asynccontextmanager
async def served_pages(pages: Pages, settings: ServerSettings) -> AsyncIterator[dict[str, object]]:
    """Serve `pages` as long as the context lasts, where the settings name a port for them.

    Yields:
        What the process's `ready` line says about it.

    Raises:
        AccessError, OSError: as `serve_http`.
    """
    if settings.http_port is None:
        yield {}
        return
    token = read_token(settings.token_file)
    server = await serve_http(pages, settings.http_host, settings.http_port, token=token)
    try:
        yield {"http_port": server.port}
    finally:
        await server.close()


def watching_pages(
    health: Callable[[], Mapping[str, object]],
    figures: Callable[[], Iterable[Figure]],
    requests: Requests | None = None,
    *,
    failed: Callable[[], bool] = lambda: False,
) -> Pages:
    """The pages of a server that runs.

    Args:
        health: content of `/healthz` beside its status.
        figures: of `/metrics`, beside those that every process has.
        requests: answered so far; None where there are none to count.
        failed: whether a part of the server has died; then `/healthz` answers 503.
    """

    def healthz() -> HttpResponse:
        dead = failed()
        document = {"status": "failed" if dead else "ok", **health()}
        status = HTTPStatus.SERVICE_UNAVAILABLE if dead else HTTPStatus.OK
        return HttpResponse(json.dumps(document) + "\n", status)

    def metrics() -> HttpResponse:
        page = [*(requests or Requests()).figures(), *figures()]
        page.append(
            counter("flexdt_log_dropped_total", "Log lines nobody took in time.", dropped())
        )
        holds = _holds()
        if holds is not None:
            what = "How long each turn held the event loop."
            page.append(Figure("flexdt_loop_hold_seconds", "histogram", what, (({}, holds.turns),)))
            worst = "The longest turn since the last scrape."
            page.append(gauge("flexdt_loop_hold_worst_seconds", worst, holds.worst()))
        return HttpResponse(render(page), content_type=CONTENT_TYPE)

    return {"/healthz": healthz, "/metrics": metrics}


def _holds() -> Holds | None:
    loop = asyncio.get_running_loop()
    return loop.holds if isinstance(loop, ServerLoop) else None
