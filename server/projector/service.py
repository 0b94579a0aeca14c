"""The projector server: connections come and go, requests are answered side by side.

Compute work goes through the fair queue, results leave as they are made. It refuses to know what
any method does (see `answers`).
"""

from __future__ import annotations

import asyncio
import logging
import ssl as tls
import time
from collections.abc import Callable, Mapping
from typing import Final

from flexdt.protocol import (
    MAX_FRAME,
    Failure,
    Malformed,
    Notification,
    Request,
    Response,
    RpcError,
    find,
    frames,
    parse_params,
)
from flexdt.protocol.errors import busy, internal, invalid_params, invalid_request, not_authorised
from flexdt.protocol.messages import Id
from flexdt.protocol.projector import PROJECTOR_METHODS
from flexdt.server.access import Limits, check_bind
from flexdt.server.log import LOGGER, log
from flexdt.server.loop import one_at_a_time
from flexdt.server.peer import Observe
from flexdt.server.projector.answers import ANSWERS
from flexdt.server.projector.compute import ComputeThread
from flexdt.server.projector.context import Client, Context
from flexdt.server.projector.store import VolumeStore
from flexdt.server.projector.wire import FrameLink
from flexdt.server.trace import current, traced
from flexdt.twin.errors import TwinError

MAX_PENDING_BYTES: Final = 64 * 2**20
"""Bytes of unanswered requests of one client above which it is not read any more."""


class ProjectorServer:
    """A listening projector; made by `serve_projector`."""

    def __init__(
        self,
        context: Context,
        limits: Limits,
        observe: Observe = lambda method, seconds, code: None,
    ) -> None:
        self.context, self.limits, self.observe = context, limits, observe
        self.server: asyncio.Server | None = None

    @property
    def port(self) -> int:
        """The port it listens on."""
        assert self.server is not None
        return int(self.server.sockets[0].getsockname()[1])

    async def close(self) -> None:
        """Stop listening, end all connections and the compute thread."""
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
        """A client has connected."""
        client = Client(link, let_in=self.context.token is None)
        self.context.clients[link] = client
        if len(self.context.clients) > self.limits.max_clients:
            allowed = {"allowed": self.limits.max_clients}
            self.refuse(link, busy("too many clients", allowed))
        elif not client.let_in:
            loop = asyncio.get_running_loop()
            client.timer = loop.call_later(self.limits.hello_timeout_s, link.transport.abort)

    def lost(self, link: FrameLink) -> None:
        """A client has gone: nothing more is computed for it."""
        client = self.context.clients.pop(link)
        if client.timer is not None:
            client.timer.cancel()
        error = ConnectionResetError("the client has gone")
        for job in list(client.jobs.values()):
            job.end(error)
        self.context.compute.give_up(lambda job: job.customer is client, error)
        self.context.store.forget(client)
        for task in client.tasks:
            task.cancel()

    def refuse(self, link: FrameLink, error: RpcError) -> None:
        """Say why, and end the connection."""
        log("refused", logging.WARNING, client=link.peer, reason=error.message)
        link.dismiss(Failure(None, error))

    def frame(self, link: FrameLink, body: memoryview) -> None:
        """A client's message."""
        client = self.context.clients[link]
        if len(client.tasks) >= self.limits.max_waiting:
            self.refuse(link, busy("too many requests under way"))
            return
        client.pending_bytes += len(body)
        if client.pending_bytes > MAX_PENDING_BYTES:
            link.transport.pause_reading()
        task = asyncio.get_running_loop().create_task(self._serve(client, body))
        client.tasks.add(task)
        task.add_done_callback(client.tasks.discard)

    # -- requests ----------------------------------------------------------------------------

    async def _serve(self, client: Client, body: memoryview) -> None:
        request: Id = None
        try:
            match frames.unpack(body):
                case Request(id) if id in client.under_way:
                    error = invalid_request(f"request id {id!r} is in use")
                    await client.link.send(Failure(id, error))
                case Request(id, name, params):
                    request = id
                    client.under_way.add(id)
                    await client.link.send(await self._call(client, id, name, params))
                case Notification("cancel", params):
                    await self._call(client, None, "cancel", params)
                case Malformed() as broken:
                    await client.link.send(broken.reply)
                case _:
                    await client.link.send(Failure(None, invalid_request("one request a frame")))
        except ConnectionError:
            pass  # the client has gone; `lost` cleans up
        except Exception:
            log("reply not sent", logging.ERROR, error=True, client=client.link.peer)
            client.link.transport.abort()
        finally:
            self.context.finish(client, request)
            client.pending_bytes -= len(body)
            if client.pending_bytes <= MAX_PENDING_BYTES and not client.link.lost:
                client.link.transport.resume_reading()

    async def _call(
        self, client: Client, id: Id, name: str, given: Mapping[str, object] | list[object] | None
    ) -> Response | Failure:
        begun = time.monotonic()
        with traced(str(id)):
            answer = await self._try(client, id, name, given)
        taken = time.monotonic() - begun
        code = answer.error.code if isinstance(answer, Failure) else None
        self.observe(name if name in PROJECTOR_METHODS else "unknown", taken, code)
        if LOGGER.isEnabledFor(logging.DEBUG):
            log("request", logging.DEBUG, trace=str(id), client=client.link.peer,
                method=name[:100], ms=round(1000 * taken, 3), code=code)  # fmt: skip
        return answer

    async def _try(
        self, client: Client, id: Id, name: str, given: Mapping[str, object] | list[object] | None
    ) -> Response | Failure:
        try:
            if not client.let_in and name != "session.hello":
                raise not_authorised()
            method = find(name, PROJECTOR_METHODS)
            params = parse_params(method, given)
            return Response(id, await ANSWERS[name](self.context, client, id, params))
        except RpcError as error:
            return Failure(id, error)
        except TwinError as error:
            return Failure(id, invalid_params(error.message, [], error.data or None))
        except ConnectionError:
            raise
        except Exception:
            log("handler failed", logging.ERROR, error=True, method=name, client=client.link.peer)
            return Failure(id, internal(current()))


async def serve_projector(
    host: str = "127.0.0.1",
    port: int = 0,
    *,
    memory_limit: int,
    begin: Callable[[], None] = lambda: None,
    facts: Mapping[str, object] | None = None,
    limits: Limits | None = None,
    token: str | None = None,
    ssl: tls.SSLContext | None = None,
    observe: Observe = lambda method, seconds, code: None,
) -> ProjectorServer:
    """Compile, then listen on `host`:`port` (0: any free port).

    Args:
        host, port: where; others than loopback need a token.
        memory_limit: bytes that all volumes together may take.
        begin: run first in the compute thread: threads, warm-up.
        facts: backend and threads, for `health`.
        limits: of connections.
        token: clients must bring it.
        ssl: a server's TLS context.
        observe: told of every answered request.

    Raises:
        AccessError: the address can be reached by others and there is no token.
        OSError: the address is taken or not ours.
    """
    check_bind(host, token)
    limits = limits or Limits()
    compute = ComputeThread(begin)
    facts = {"backend": "numba", "threads": 0} if facts is None else facts
    server = ProjectorServer(
        Context(compute, VolumeStore(memory_limit), token, facts), limits, observe
    )
    try:
        await compute.ready
        loop = asyncio.get_running_loop()
        server.server = await loop.create_server(
            lambda: FrameLink(
                server.frame,
                server.refuse,
                server.lost,
                server.made,
                max_frame=min(MAX_FRAME, limits.max_message),
                send_timeout_s=limits.send_timeout_s,
                frame_timeout_s=limits.message_timeout_s,
            ),
            host,
            port,
            ssl=ssl,
            backlog=1,
        )
        one_at_a_time(server.server)
    except BaseException:
        compute.close()
        raise
    return server
