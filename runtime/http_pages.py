"""Pages for monitoring, `/healthz` and `/metrics`, by the threads
of prometheus_client's server.

Beyond the loopback, pages other than `/healthz` need the server's token (`Authorization:
Bearer ...`), and a wrong one is answered late, as at the other ports; on the loopback,
requests of other sites' pages are refused by their Host.
Twin, projector and viewer supply the figures; this module puts them into the pages. A
page is made in a turn of the event loop, to which the figures belong. Requests are
counted as they are answered; gauges are read at the moment of the scrape.

Each connection has a thread. One whose request is not complete waits in a room
(`runtime/waiting_room.py`); so does one that is being answered, in a second room.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import socket
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from concurrent.futures import Future, wait
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from threading import Lock, Thread
from typing import Any, Final
from wsgiref.simple_server import WSGIRequestHandler, make_server

from prometheus_client import Counter, Metric, ProcessCollector, generate_latest
from prometheus_client.exposition import ThreadingWSGIServer

from flexdt.runtime.access import (
    check_bind,
    is_loopback,
    is_rebound,
    read_token,
    token_matches,
)
from flexdt.runtime.log import dropped, log
from flexdt.runtime.process import BACKLOG, ServerLoop, durations
from flexdt.runtime.process_settings import ServerSettings
from flexdt.runtime.waiting_room import Guesses, WaitingList, neighbourhood

MAX_SILENCE_S: Final = 5.0
"""Time after which a silent client is disconnected [s]."""
MAX_HELD_S: Final = 60.0
"""Time after which an event loop that makes no page counts as failed (503) [s]."""
MAX_UNADMITTED: Final = 64
"""Largest number of connections that wait for the end of their request.

Where one address opens 167 a second, each of them still has 0.4 s for it.
"""
MAX_ANSWERED: Final = 16
"""Largest number of requests that are answered at a time."""
ADMIT: Final = "flexdt.admit"
"""Key of a request's environment: function to call before it is answered."""
OPEN_PAGES: Final = ("/healthz",)
CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"


def _figure(
    kind: str, name: str, help: str, values: float | Mapping[str, float], label: str = ""
) -> Metric:
    """Make a figure of the metrics page, with one value or one for each value of a label.

    `kind`: gauge or counter, whose name ends with `_total`.
    """
    metric = Metric(name.removesuffix("_total"), help, kind)
    for what, value in values.items() if isinstance(values, Mapping) else [("", values)]:
        metric.add_sample(name, {label: what} if label else {}, value)
    return metric


gauge, counter = partial(_figure, "gauge"), partial(_figure, "counter")
"""A figure that may go up and down; a figure that only grows."""


class Requests:
    """Counts and durations of requests, by method."""

    def __init__(self) -> None:
        """Make the empty metrics of requests: counts by method and code, durations by method
        [s].
        """
        what = "Requests answered, by method and error code."
        self._counts = Counter("flexdt_requests", what, ["method", "code"], registry=None)
        what = "Time from a request's turn to its answer."
        self._times = durations("flexdt_request_seconds", what, ["method"])

    def observe(self, method: str, seconds: float, code: int | None) -> None:
        """Count an answered request; `code` of the error, None for a result."""
        self._counts.labels(method, "ok" if code is None else code).inc()
        self._times.labels(method).observe(seconds)

    def figures(self) -> list[Metric]:
        """List the counts and durations so far."""
        return [*self._counts.collect(), *self._times.collect()]


@dataclass(frozen=True)
class _Collected:
    """Adapter that `generate_latest` reads."""

    metrics: list[Metric]

    def collect(self) -> list[Metric]:
        """Return the metrics given, in the form that prometheus_client collects."""
        return self.metrics


def render(figures: Iterable[Metric]) -> str:
    """Format the page in Prometheus's text format, with the library's figures
    of the process."""
    process = ProcessCollector(registry=None).collect()
    return generate_latest(_Collected([*figures, *process])).decode()


@dataclass(frozen=True)
class HttpResponse:
    """The response to a request."""

    text: str
    status: HTTPStatus = HTTPStatus.OK
    content_type: str = "application/json"


Pages = Mapping[str, Callable[[], HttpResponse]]
"""Path -> function that makes the page."""


@dataclass(eq=False)
class _Visitor:
    """A connection, as the rooms see it."""

    sock: socket.socket
    address: str

    def displace(self) -> None:
        """Shut the connection down, which wakes its thread; errors are ignored."""
        with contextlib.suppress(OSError):
            self.sock.shutdown(socket.SHUT_RDWR)


class _Server(ThreadingWSGIServer):
    """Threading server with a bounded number of connections."""

    request_queue_size = BACKLOG

    def __init__(self, *given: Any, **more: Any) -> None:
        """Make the server, with places for unadmitted and for answered connections."""
        self._strangers = WaitingList[_Visitor](MAX_UNADMITTED)
        self._answered = WaitingList[_Visitor](MAX_ANSWERED)
        self._here: dict[object, _Visitor] = {}
        self._lock = Lock()
        super().__init__(*given, **more)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Register a connection as not admitted, which may end another one of the crowded
        list, and serve it in a thread of its own.

        Connections are grouped by address, see `WaitingList`.
        """
        visitor = _Visitor(request, neighbourhood(str(client_address[0])))
        with self._lock:
            self._here[request] = visitor
            self._strangers.enter(visitor)
        super().process_request(request, client_address)

    def admit(self, request: Any) -> None:
        """Move a connection to those that are answered, which may displace another."""
        with self._lock:
            self._strangers.leave(self._here[request])
            self._answered.enter(self._here[request])

    def shutdown_request(self, request: Any) -> None:
        """Close a connection and free its place: it has ended, or its thread could not start."""
        with self._lock:
            visitor = self._here.pop(request)
            self._strangers.leave(visitor)
            self._answered.leave(visitor)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log an error unless it is the end of a connection."""
        if not isinstance(sys.exc_info()[1], OSError):
            log("http page failed", logging.ERROR, error=True)


class _Handler(WSGIRequestHandler):
    """One connection: a request; its own log lines are suppressed."""

    timeout = MAX_SILENCE_S
    server: _Server

    def get_environ(self) -> dict[str, Any]:
        """Return the request's WSGI environment, with the function that admits it under `ADMIT`."""
        return {
            **super().get_environ(),
            ADMIT: partial(self.server.admit, self.connection),
        }

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""


def _foreign(host: str) -> bool:
    """Return whether a request's Host names another site than this machine; True also if
    it cannot be parsed.
    """
    try:
        return is_rebound(host)
    except ValueError:
        return True


def _application(
    pages: Pages, token: str | None, *, loopback: bool
) -> Callable[..., list[bytes]]:
    """Make a WSGI application of the pages, which are made in turns of the event loop
    that runs now.

    Only GET and HEAD are answered, HEAD without a body.

    Args:
        pages: path -> function that makes the page.
        token: required of clients for all but `OPEN_PAGES`; None: never.
        loopback: whether requests whose Host is another site are rejected.

    Returns:
        The application, for threads; an error is the page "{}" with status 401, 403, 404,
        405, or 503 if the loop is held.
    """
    loop = asyncio.get_running_loop()
    guesses = Guesses()

    def response(asked: Mapping[str, Any]) -> HttpResponse:
        """Check a request, admit its connection, and have the loop make its page.

        The checks are, in order: 403 another site's Host (on loopback), 405 method, 404
        path, 401 token. No turn of the loop within `MAX_HELD_S`, or a closed loop, is
        503. An exception of a page is raised. A wrong token is logged, and answered
        late by this thread, which is not admitted meanwhile.

        Args:
            asked: the request as WSGI has it.

        Returns:
            The page, or "{}" with the status of the error.
        """
        path = asked["PATH_INFO"]
        given = asked.get("HTTP_AUTHORIZATION", "")
        if loopback and "HTTP_HOST" in asked and _foreign(asked["HTTP_HOST"]):
            return HttpResponse("{}", HTTPStatus.FORBIDDEN)
        if asked["REQUEST_METHOD"] not in ("GET", "HEAD"):
            return HttpResponse("{}", HTTPStatus.METHOD_NOT_ALLOWED)
        if path not in pages:
            return HttpResponse("{}", HTTPStatus.NOT_FOUND)
        bearer = given.removeprefix("Bearer ")
        if (
            token is not None
            and path not in OPEN_PAGES
            and not token_matches(bearer, token)
        ):
            if given:  # without one nothing is guessed
                host = str(asked["REMOTE_ADDR"])
                time.sleep(guesses.wrong(host, host))
            return HttpResponse("{}", HTTPStatus.UNAUTHORIZED)
        asked[ADMIT]()
        page: Future[HttpResponse] = Future()

        def make() -> None:
            """Make the page in a turn of the loop; the result or the exception goes to `page`."""
            try:
                page.set_result(pages[path]())
            except Exception as error:
                page.set_exception(error)

        with contextlib.suppress(RuntimeError):  # the loop is closed
            loop.call_soon_threadsafe(make)
            wait([page], MAX_HELD_S)
        if page.done():
            return page.result()
        return HttpResponse("{}", HTTPStatus.SERVICE_UNAVAILABLE)

    def application(asked: dict[str, Any], start: Callable[..., object]) -> list[bytes]:
        """Answer a request, as WSGI has it: call `start` with status and headers, and
        return the body, [] for HEAD.

        The headers are type, length, and one that forbids caches.
        """
        page = response(asked)
        body = page.text.encode()
        head = {
            "Content-Type": page.content_type,
            "Content-Length": str(len(body)),
            "Cache-Control": "no-store",
        }
        start(f"{page.status.value} {page.status.phrase}", list(head.items()))
        if asked["REQUEST_METHOD"] == "HEAD":
            return []
        return [body]

    return application


@contextlib.asynccontextmanager
async def served_pages(
    pages: Pages, settings: ServerSettings
) -> AsyncIterator[dict[str, object]]:
    """Serve `pages` in a daemon thread as long as the context lasts.

    Without a port in the settings nothing is served, and {} is yielded. On the loopback
    no token is required.

    Args:
        pages: path -> function that makes the page, called in the loop that runs now.
        settings: host and port; beyond the loopback only with a token.

    Yields:
        Facts for the process's `ready` line: `http_port`, the port in use.

    Raises:
        AccessError: the address can be reached by others and there is no token, or the
            token has fewer than 16 characters.
        AccessFileError: the token's file cannot be read.
        OSError: the address is taken or not ours.
    """
    if settings.http_port is None:
        yield {}
        return
    host = settings.http_host
    token = read_token(settings.token_file)
    check_bind(host, token)

    class Server(_Server):
        if ":" in host:
            address_family = socket.AF_INET6
        else:
            address_family = socket.AF_INET

    loopback = is_loopback(host)
    application = _application(pages, None if loopback else token, loopback=loopback)
    port = settings.http_port
    server = await asyncio.to_thread(
        make_server, host, port, application, Server, _Handler
    )
    Thread(target=server.serve_forever, name="http pages", daemon=True).start()
    try:
        yield {"http_port": server.server_port}
    finally:
        await asyncio.to_thread(server.shutdown)
        server.server_close()


def watching_pages(
    health: Callable[[], Mapping[str, object]],
    figures: Callable[[], Iterable[Metric]],
    requests: Requests | None = None,
    *,
    failed: Callable[[], bool] = lambda: False,
) -> Pages:
    """Make the pages `/healthz` and `/metrics` of a running server.

    Args:
        health: content of `/healthz` in addition to its status, which it may replace.
        figures: of `/metrics`, in addition to those that every process has.
        requests: counts of answered requests, for `/metrics`; None where there are none.
        failed: whether a part of the server has died; then `/healthz` answers 503.

    Returns:
        Path -> function that makes the page.
    """

    def healthz() -> HttpResponse:
        """Make `/healthz`: JSON of the status and the server's facts.

        200 and "ok", or 503 and "failed" after a failure for good.
        """
        dead = failed()
        document = {"status": "failed" if dead else "ok", **health()}
        if dead:
            status = HTTPStatus.SERVICE_UNAVAILABLE
        else:
            status = HTTPStatus.OK
        return HttpResponse(json.dumps(document) + "\n", status)

    def metrics() -> HttpResponse:
        """Make `/metrics`: counts of requests, the server's figures, dropped log lines
        and, on a `ServerLoop`, durations of its turns.

        The longest turn is that since the last call.
        """
        page = [*(requests or Requests()).figures(), *figures()]
        page.append(
            counter(
                "flexdt_log_dropped_total", "Log lines nobody took in time.", dropped()
            )
        )
        loop = asyncio.get_running_loop()
        if isinstance(loop, ServerLoop):
            page += loop.holds.turns.collect()
            worst = "The longest turn since the last scrape."
            page.append(
                gauge("flexdt_loop_hold_worst_seconds", worst, loop.holds.worst())
            )
        return HttpResponse(render(page), content_type=CONTENT_TYPE)

    return {"/healthz": healthz, "/metrics": metrics}
