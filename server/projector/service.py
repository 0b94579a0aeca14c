"""The projector server: connections come and go, requests are answered side by side.

Work is computed in turns (see `compute`) and results are sent as they are made. The
methods are in `projector_methods`.

A client takes one of `max_clients` places when it has shown the token, or with its first
request where there is none. Until then it waits in a `WaitingList`; without the token, small
messages are taken from it, one at a time and few in all.

On its health and metrics pages volumes are counted but not named, since names may reveal
a user's samples.
"""

from __future__ import annotations

import asyncio
import logging
import ssl as tls
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from typing import Final

from prometheus_client import Metric

from flexdt.protocol import MAX_FRAME, ProtocolError, RpcError, find, parse_params
from flexdt.protocol import connection as frames
from flexdt.protocol import messages as m
from flexdt.protocol import rpc_errors as errors
from flexdt.protocol.projector import PROJECTOR_METHODS
from flexdt.runtime import waiting_room
from flexdt.runtime.access import ConnectionLimits, check_bind
from flexdt.runtime.http_pages import Pages, Requests, counter, gauge, watching_pages
from flexdt.runtime.log import current, log
from flexdt.runtime.process import ListeningServer
from flexdt.runtime.waiting_room import WaitingList
from flexdt.server.network.shell_parts import Observe, answered, unobserved
from flexdt.server.projector.compute import ComputeThread
from flexdt.server.projector.job_context import Context, JobClient
from flexdt.server.projector.projector_methods import ANSWERS
from flexdt.server.projector.volume_store import VolumeStore
from flexdt.server.projector.wire import FrameLink
from flexdt.twin.errors import TwinError

MAX_PENDING_BYTES: Final = 64 * 2**20
"""Bytes of one client's unanswered requests above which it is not read."""
HELLO: Final = "session.hello"
MAX_STRANGER_FRAME_BYTES: Final = 32 << 10
"""Largest frame of a connection without the token [bytes]."""
MAX_STRANGE_MESSAGES: Final = 10
"""Number of messages without the token after which a connection is closed."""
Given = Mapping[str, object] | list[object] | None
"""Parameters of a call as they came."""


@dataclass(eq=False, repr=False)
class ProjectorServer(ListeningServer):
    """A listening projector; made by `serve_projector`."""

    context: Context
    limits: ConnectionLimits
    observe: Observe

    def __post_init__(self) -> None:
        """Begin with an empty waiting room and without seated clients."""
        self.waiting = WaitingList[JobClient](waiting_room.MAX_WAITING)
        self.seated: set[JobClient] = set()

    async def close(self) -> None:
        """Stop listening, abort all connections, cancel their requests and wait for them,
        and end the compute thread.
        """
        if self.server is not None:
            self.server.close()
        clients = self.context.clients
        tasks = [task for client in clients.values() for task in client.tasks]
        for link in list(clients):
            link.transport.abort()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self.context.compute.close()

    # -- connections -------------------------------------------------------------------------

    def made(self, link: FrameLink) -> None:
        """Register a new connection in the waiting room, which may displace another one.

        If a token is needed, frames are limited to `MAX_STRANGER_FRAME_BYTES` until it is
        shown, and it must be shown within `hello_timeout_s`.
        """
        client = JobClient(link, self.context.token, self.context.guesses)
        self.context.clients[link] = client
        self.waiting.enter(client)
        if not client.let_in:
            link.max_frame = min(MAX_STRANGER_FRAME_BYTES, link.max_frame)
            link.deadlines.start("hello", self.limits.hello_timeout_s)

    def lost(self, link: FrameLink) -> None:
        """Forget an ended connection, its place and its unfinished uploads, and cancel
        its requests; complete volumes stay.
        """
        client = self.context.clients.pop(link)
        self.waiting.leave(client)
        self.seated.discard(client)
        self.context.store.forget(client)
        for task in client.tasks:
            task.cancel()

    def _seat(self, client: JobClient) -> None:
        """Move a client from the waiting room to a place, and let it send frames of full
        size; nothing for one that has a place.

        Raises:
            RpcError: -32003, all `max_clients` places are taken; the client is
                disconnected soon.
        """
        if client in self.seated:
            return
        if len(self.seated) >= self.limits.max_clients:
            client.close_soon()
            raise errors.busy("too many clients", {"allowed": self.limits.max_clients})
        self.waiting.leave(client)
        self.seated.add(client)
        client.link.max_frame = self.largest_frame

    @property
    def largest_frame(self) -> int:
        """Largest frame taken from a client [bytes]."""
        return min(MAX_FRAME, self.limits.max_message)

    def refuse(self, link: FrameLink, error: RpcError) -> None:
        """Log an error as a warning, send it without an id, and end the connection.

        `link`: of the client; `error`: why it is refused.
        """
        self.context.lines.log(
            "refused", logging.WARNING, client=link.peer, reason=error.message
        )
        link.dismiss(m.Failure(None, error))

    def frame(self, link: FrameLink, body: memoryview) -> None:
        """Serve a client's frame in a task of its own, or refuse and disconnect the
        client.

        It is refused with `max_waiting` requests under way, or before the token after
        `MAX_STRANGE_MESSAGES`. Reading pauses for a client without a token, and with more
        than `MAX_PENDING_BYTES` pending.

        Args:
            link: connection of the client.
            body: frame without its length.
        """
        client = self.context.clients[link]
        if len(client.tasks) >= self.limits.max_waiting:
            self.refuse(link, errors.busy("too many requests under way"))
            return
        client.received += 1
        if not client.let_in and client.received > MAX_STRANGE_MESSAGES:
            self.refuse(link, errors.not_authorised())
            return
        client.pending_bytes += len(body)
        if client.pending_bytes > MAX_PENDING_BYTES or not client.let_in:
            link.transport.pause_reading()
        task = asyncio.get_running_loop().create_task(self._serve(client, body))
        client.tasks.add(task)
        task.add_done_callback(client.tasks.discard)

    # -- requests ----------------------------------------------------------------------------

    async def _serve(self, client: JobClient, body: memoryview) -> None:
        """Decode a frame, send the answer of its request, then release the request's lane
        and memory.

        A batch and an id in use are answered with an error. A notification other than
        `cancel` is ignored. A violation of the protocol refuses the client; any other
        failure is logged and aborts the connection. Reading resumes once at most
        `MAX_PENDING_BYTES` are pending.

        Args:
            client: that sent it.
            body: frame without its length.
        """
        request: m.Id = None
        link = client.link
        calls = client.calls
        try:
            match message := frames.unpack(body):
                case m.Batch():
                    await link.send(
                        m.Failure(None, errors.invalid_request("one request a frame"))
                    )
                    return
                case m.Request(id) if calls.owes(id):
                    error = errors.invalid_request(f"request id {id!r} is in use")
                    await link.send(m.Failure(id, error))
                    return
            calls.receive(message)
            match message:
                case m.Request(id, name, params):
                    request = id
                    await link.send(
                        calls.answer(await self._call(client, id, name, params))
                    )
                case m.Notification("cancel", params):
                    await self._call(client, None, "cancel", params)
                case m.Malformed() as broken:
                    await link.send(calls.answer(broken.reply))
        except ProtocolError as broken:
            self.refuse(link, errors.invalid_request(str(broken)))
        except ConnectionError:
            pass  # the client has gone; `lost` cleans up
        except Exception:
            log("reply not sent", logging.ERROR, error=True, client=client.link.peer)
            client.link.transport.abort()
        finally:
            if (job := client.jobs.pop(request, None)) is not None:
                job.sent()
            client.pending_bytes -= len(body)
            if client.pending_bytes <= MAX_PENDING_BYTES and not client.link.lost:
                client.link.transport.resume_reading()

    async def _call(
        self, client: JobClient, id: m.Id, name: str, given: Given
    ) -> m.Response | m.Failure:
        """Serve a call with `_handle`, log it, observe its duration, and return its
        answer or failure.
        """
        return await answered(
            self._handle(client, id, name, given),
            name,
            trace=str(id),
            client=client.link.peer,
            known=PROJECTOR_METHODS,
            observe=self.observe,
        )

    async def _handle(
        self, client: JobClient, id: m.Id, name: str, given: Given
    ) -> m.Response | m.Failure:
        """Check token, parameters and place of a call, and run its method.

        Before the token only hello is served. An unexpected error is logged and answered
        as internal, lack of memory as too large.

        Args:
            client: that calls.
            id: of the request; None for a notification.
            name: of the method.
            given: parameters as they were sent.

        Returns:
            The result, or any failure as an answer.

        Raises:
            ConnectionError: the connection has ended; no other error is raised.
        """
        try:
            if not client.let_in and name != HELLO:
                raise errors.not_authorised()
            method = find(name, PROJECTOR_METHODS)
            params = parse_params(method, given)
            if client.let_in:
                self._seat(client)
            answer = await ANSWERS[name](self.context, client, id, params)
            if name == HELLO:
                self._seat(client)  # it has shown the token
            return m.Response(id, answer)
        except RpcError as error:
            return m.Failure(id, error)
        except TwinError as error:
            return m.Failure(
                id, errors.invalid_params(error.message, [], error.data or None)
            )
        except MemoryError as error:
            return m.Failure(
                id,
                errors.too_large(
                    f"a result ({error})", "more", 0, "bytes of free memory"
                ),
            )
        except ConnectionError:
            raise
        except Exception:
            log(
                "handler failed",
                logging.ERROR,
                error=True,
                method=name,
                client=client.link.peer,
            )
            return m.Failure(id, errors.internal(current()))


async def serve_projector(
    host: str = "127.0.0.1",
    port: int = 0,
    *,
    memory_limit: int,
    begin: Callable[[], None] = lambda: None,
    bound: Callable[[int], None] = lambda port: None,
    facts: Mapping[str, object] | None = None,
    limits: ConnectionLimits | None = None,
    token: str | None = None,
    ssl: tls.SSLContext | None = None,
    observe: Observe = unobserved,
) -> ProjectorServer:
    """Listen, run `begin` in the compute thread, then serve; connections wait until then.

    Without facts they are "numba" and 0 threads. After an error everything is closed.

    Args:
        host, port: where (port 0: any free one); others than loopback need a token.
        memory_limit: bytes that all volumes together may take.
        begin: run first in the compute thread: threads, warm-up.
        bound: called with the port as soon as it is taken.
        facts: backend and threads, for `health`.
        limits: of connections.
        token: clients must bring it.
        ssl: a server's TLS context.
        observe: called for every answered request.

    Returns:
        The running server; `close` ends it.

    Raises:
        AccessError: the address can be reached by others and there is no token.
        OSError: the address is taken or not ours.
    """
    check_bind(host, token)
    limits = limits or ConnectionLimits()
    compute = ComputeThread(begin)
    if facts is None:
        facts = {"backend": "numba", "threads": 0}
    server = ProjectorServer(
        Context(compute, VolumeStore(memory_limit), token, facts), limits, observe
    )
    try:
        await server.listen(
            lambda: FrameLink(
                server.frame,
                server.refuse,
                server.lost,
                server.made,
                max_frame=server.largest_frame,
                send_timeout_s=limits.send_timeout_s,
                frame_timeout_s=limits.message_timeout_s,
            ),
            host,
            port,
            ssl,
            serving=False,
        )
        bound(server.port)
        await compute.ready
        await server.serve()
    except BaseException:
        await server.close()
        raise
    return server


def projector_pages(server: ProjectorServer, requests: Requests) -> Pages:
    """Make the monitoring pages of a running projector.

    They are /healthz, with the server's version, and /metrics, with its figures and those
    of requests.

    Args:
        server: whose figures they show.
        requests: counts of answered calls.
    """
    context = server.context

    def health() -> dict[str, object]:
        """Return the facts of `/healthz`."""
        return {"server": f"flexdt projector {version('flexdt')}"}

    def figures() -> list[Metric]:
        """List the figures of `/metrics`: connections, views, requests superseded and
        waiting, volumes, their memory and its limit [bytes].
        """
        store = context.store
        return [
            gauge("flexdt_connections", "Clients connected.", len(server.seated)),
            counter("flexdt_views_total", "Views projected.", context.views),
            counter("flexdt_superseded_total", "Requests overtaken.", context.superseded),
            gauge("flexdt_waiting", "Pieces of work that wait.", context.waiting),
            gauge("flexdt_volumes", "Volumes and scenes held.", len(store)),
            gauge("flexdt_volume_bytes", "Memory they take.", store.used),
            gauge("flexdt_volume_limit_bytes", "Memory they may take.", store.limit),
        ]

    return watching_pages(health, figures, requests)
