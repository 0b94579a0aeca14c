"""The projector server: connections, and what each method does.

Requests of all clients run side by side; compute work goes through the fair queue, results leave
as they are made. It refuses to compute on the event loop, and to keep anything but named volumes.
"""

from __future__ import annotations

import asyncio
import logging
import math
import ssl as tls
import time
import uuid
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.phantoms.serial import scene_from_dict
from flexdt.protocol import (
    MAX_FRAME,
    PROTOCOL,
    Failure,
    Malformed,
    Notification,
    Request,
    Response,
    RpcError,
    find,
    frames,
    image,
    openrpc,
    parse_params,
)
from flexdt.protocol.errors import (
    busy,
    cancelled,
    internal,
    invalid_params,
    invalid_request,
    not_authorised,
    superseded,
    too_large,
)
from flexdt.protocol.fields import Params
from flexdt.protocol.messages import Id
from flexdt.protocol.params import Hello
from flexdt.protocol.projector import (
    PROJECTOR_METHODS,
    Backproject,
    Cancel,
    Grid,
    Project,
    VolumePut,
    VolumeRef,
)
from flexdt.server.access import Limits, check_bind, token_matches
from flexdt.server.log import log
from flexdt.server.projector.compute import (
    ComputeThread,
    Customer,
    Job,
    projection_steps,
    views_a_block,
)
from flexdt.server.projector.store import VolumeStore
from flexdt.server.projector.wire import FrameLink
from flexdt.twin.errors import TwinError
from flexdt.twin.projection import Volume, back

PART_BYTES: Final = 8 * 2**20
"""Payload of a part of what does not fit into one frame."""
SPARE: Final = 4096
"""Room for everything but the payload in a frame."""
MAX_PENDING_BYTES: Final = 64 * 2**20
"""Bytes of unanswered requests of one client above which it is not read any more."""
MAX_VIEW_BYTES: Final = 512 * 2**20


class Client(Customer):
    """One connection, its jobs and its requests that are under way."""

    def __init__(self, link: FrameLink, let_in: bool) -> None:
        super().__init__()
        self.link, self.let_in = link, let_in
        self.jobs: dict[Id, Job] = {}
        self.tasks: set[asyncio.Task[None]] = set()
        self.pending_bytes = 0
        self.wrong_tokens = 0
        self.timer: asyncio.TimerHandle | None = None


@dataclass
class Counters:
    """What `health` reports."""

    views: int = 0
    superseded: int = 0


Answer = Callable[["ProjectorServer", Client, Id, Any], Awaitable[object]]


class ProjectorServer:
    """A listening projector; made by `serve_projector`."""

    def __init__(
        self, compute: ComputeThread, store: VolumeStore, limits: Limits, token: str | None,
        facts: Mapping[str, object],
    ) -> None:  # fmt: skip
        self.compute, self.store, self.limits, self.token = compute, store, limits, token
        self.facts = dict(facts)
        self.instance = uuid.uuid4().hex
        self.started = time.monotonic()
        self.counters = Counters()
        self.clients: dict[FrameLink, Client] = {}
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
        tasks = [task for client in self.clients.values() for task in client.tasks]
        for link in list(self.clients):
            link.transport.abort()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self.compute.close()

    # -- connections -------------------------------------------------------------------------

    def made(self, link: FrameLink) -> None:
        """A client has connected."""
        client = Client(link, let_in=self.token is None)
        self.clients[link] = client
        if len(self.clients) > self.limits.max_clients:
            allowed = {"allowed": self.limits.max_clients}
            self._last_word(link, busy("too many clients", allowed))
        elif not client.let_in:
            loop = asyncio.get_running_loop()
            client.timer = loop.call_later(self.limits.hello_timeout_s, link.transport.abort)

    def lost(self, link: FrameLink) -> None:
        """A client has gone: nothing more is computed for it."""
        client = self.clients.pop(link)
        if client.timer is not None:
            client.timer.cancel()
        error = ConnectionResetError("the client has gone")
        for job in list(client.jobs.values()):
            job.end(error)
        self.compute.give_up(lambda job: job.customer is client, error)
        self.store.forget(client)
        for task in client.tasks:
            task.cancel()

    def broken(self, link: FrameLink, error: RpcError) -> None:
        """A client speaks something else."""
        self._last_word(link, error)

    def frame(self, link: FrameLink, body: memoryview) -> None:
        """A client's message."""
        client = self.clients[link]
        if len(client.tasks) >= self.limits.max_waiting:
            self._last_word(link, busy("too many requests under way"))
            return
        client.pending_bytes += len(body)
        if client.pending_bytes > MAX_PENDING_BYTES:
            link.transport.pause_reading()
        task = asyncio.get_running_loop().create_task(self._serve(client, body))
        client.tasks.add(task)
        task.add_done_callback(client.tasks.discard)

    async def _serve(self, client: Client, body: memoryview) -> None:
        request: Id = None
        try:
            match frames.unpack(body):
                case Request(id, name, params):
                    request = id
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
            self._finish(client, request)
            client.pending_bytes -= len(body)
            if client.pending_bytes <= MAX_PENDING_BYTES and not client.link.lost:
                client.link.transport.resume_reading()

    async def _call(
        self, client: Client, id: Id, name: str, given: Mapping[str, object] | list[object] | None
    ) -> Response | Failure:
        try:
            if not client.let_in and name != "session.hello":
                raise not_authorised()
            method = find(name, PROJECTOR_METHODS)
            params = parse_params(method, given)
            return Response(id, await ANSWERS[name](self, client, id, params))
        except RpcError as error:
            return Failure(id, error)
        except TwinError as error:
            return Failure(id, invalid_params(error.message, [], error.data or None))
        except ConnectionError:
            raise
        except Exception:
            log("handler failed", logging.ERROR, error=True, method=name, client=client.link.peer)
            return Failure(id, internal())

    def _last_word(self, link: FrameLink, error: RpcError) -> None:
        log("refused", logging.WARNING, client=link.peer, reason=error.message)
        link.dismiss(Failure(None, error))

    # -- methods -----------------------------------------------------------------------------

    async def hello(self, client: Client, id: Id, p: Hello) -> object:
        """Check the token."""
        if self.token is not None and not token_matches(p.token, self.token):
            client.wrong_tokens += 1
            log("wrong token", logging.WARNING, client=client.link.peer)
            await asyncio.sleep(0.2 * client.wrong_tokens)
            if client.wrong_tokens >= 3:
                asyncio.get_running_loop().call_later(0.1, client.link.transport.close)
            raise not_authorised()
        client.let_in = True
        if client.timer is not None:
            client.timer.cancel()
        return {
            "protocol": PROTOCOL, "server": f"flexdt projector {version('flexdt')}",
            "machine": "", "instance": self.instance,
        }  # fmt: skip

    async def volume_put(self, client: Client, id: Id, p: VolumePut) -> object:
        """Store a scene, or a chunk of voxels."""
        if p.scene is not None:
            scene = scene_from_dict(p.scene)
            self.store.put(p.name, scene)
            return {"name": p.name, "received": 0, "total": 0, "complete": True}
        assert p.grid is not None
        assert p.data is not None
        total = 4 * math.prod(p.grid.shape)
        received, volume = self.store.chunk(client, p.name, p.grid, p.start, p.data)
        if volume is not None:
            await self._run(client, id, lambda: _prepare(volume))
            self.store.put(p.name, volume)
        return {
            "name": p.name, "received": received, "total": total, "complete": volume is not None,
        }  # fmt: skip

    async def volume_get(self, client: Client, id: Id, p: VolumeRef) -> object:
        """Send a volume's voxels."""
        volume = self.store.get(p.name)
        if not isinstance(volume, Volume):
            raise invalid_params(f"{p.name!r} is an analytic scene and has no voxels")
        data = volume.data
        whole = await self._run(client, id, lambda: np.ascontiguousarray(data))
        assert isinstance(whole, np.ndarray)
        return await self._send_array(client, id, whole)

    async def volume_list(self, client: Client, id: Id, p: Params) -> object:
        """Volumes and memory."""
        return {
            "volumes": self.store.describe(),
            "memory_used": self.store.used,
            "memory_limit": self.store.limit,
        }

    async def volume_remove(self, client: Client, id: Id, p: VolumeRef) -> object:
        """Forget a volume."""
        return {"removed": self.store.remove(p.name)}

    async def project(self, client: Client, id: Id, p: Project) -> object:
        """Line integrals, view block by view block."""
        volume = self.store.get(p.volume)
        view_bytes = 4 * math.prod(p.detector)
        if view_bytes > MAX_VIEW_BYTES:
            raise too_large("a view", view_bytes, MAX_VIEW_BYTES)
        rows: npt.NDArray[np.float64] = p.cone_vec
        block = views_a_block(p.detector)
        if p.key is not None:
            self._supersede(client, p.key)
        steps = projection_steps(volume, rows, p.detector, block)
        job = self._start(client, id, Job(client, steps, p.key))
        parts = 0
        for start in range(0, len(rows), block):
            views = await job.next()
            assert isinstance(views, np.ndarray)
            self.counters.views += len(views)
            if len(views) == len(rows) and views.nbytes + SPARE <= MAX_FRAME:
                return image.encode(views)
            parts += await self._send_parts(client, id, views, start * view_bytes // 4)
            client.took(job)
            self.compute.queue.wake()
        return {"dtype": "float32", "shape": [len(rows), *p.detector], "parts": parts}

    async def backproject(self, client: Client, id: Id, p: Backproject) -> object:
        """The adjoint, answered or added to a named volume."""
        if len(p.projections) != len(p.cone_vec):
            raise invalid_params(
                f"{len(p.projections)} projections and {len(p.cone_vec)} rows of cone_vec"
            )
        old = self._accumulator(p.into, p.grid)
        needed = 4 * math.prod(p.grid.shape)
        self.store.reserve("a back projection", needed * (2 if old is None else 1))
        made = await self._run(client, id, lambda: _backproject(p, old))
        assert isinstance(made, Volume)
        if p.into is not None:
            self.store.put(p.into, made)
            return {"dtype": "float32", "shape": list(made.shape), "parts": 0}
        return await self._send_array(client, id, np.asarray(made.data))

    async def health(self, client: Client, id: Id, p: Params) -> object:
        """Figures about the server."""
        return {
            "instance": self.instance,
            "version": version("flexdt"),
            **self.facts,
            "uptime_s": time.monotonic() - self.started,
            "clients": len(self.clients),
            "waiting": len(self.compute.queue),
            "views": self.counters.views,
            "superseded": self.counters.superseded,
            "volumes": len(self.store),
            "memory_used": self.store.used,
            "memory_limit": self.store.limit,
        }

    async def cancel(self, client: Client, id: Id, p: Cancel) -> object:
        """Give up a request."""
        job = client.jobs.get(p.request)
        if job is None:
            return {"cancelled": False}
        error = cancelled(p.request)
        job.end(error)
        self.compute.give_up(lambda other: other is job, error)
        return {"cancelled": True}

    async def discover(self, client: Client, id: Id, p: Params) -> object:
        """The OpenRPC document."""
        return openrpc.document(PROJECTOR_METHODS, title="flexdt projector server")

    # -- work --------------------------------------------------------------------------------

    def _supersede(self, client: Client, key: str) -> None:
        """End this client's interactive jobs of that key that have not been computed."""
        error = superseded(key)
        ended = self.compute.give_up(lambda job: job.customer is client and job.key == key, error)
        self.counters.superseded += ended

    async def _run(self, client: Client, id: Id, step: Callable[[], object]) -> object:
        """One step in the compute thread."""
        return await self._start(client, id, Job(client, iter((step,)))).next()

    def _start(self, client: Client, id: Id, job: Job) -> Job:
        """Submit a job, known by its request's id until that is answered."""
        if id in client.jobs:
            raise invalid_request(f"request id {id!r} is in use")
        client.jobs[id] = job
        return self.compute.submit(job)

    def _finish(self, client: Client, id: Id) -> None:
        job = client.jobs.pop(id, None)
        if job is not None:
            client.finish(job)
            self.compute.queue.wake()

    async def _send_array(
        self, client: Client, id: Id, array: npt.NDArray[np.generic]
    ) -> dict[str, object]:
        if array.nbytes + SPARE <= MAX_FRAME:
            return image.encode(array)
        parts = await self._send_parts(client, id, array, 0)
        return {"dtype": array.dtype.name, "shape": list(array.shape), "parts": parts}

    async def _send_parts(
        self, client: Client, id: Id, array: npt.NDArray[np.generic], start: int
    ) -> int:
        flat = np.ascontiguousarray(array).reshape(-1)
        step = PART_BYTES // flat.itemsize
        parts = 0
        for at in range(0, flat.size, step):
            data = flat[at : at + step].view(np.uint8).data.toreadonly()
            part = {"request": id, "start": start + at, "data": data}
            await client.link.send(Notification("part", part))
            parts += 1
        return parts

    def _accumulator(self, name: str | None, grid: Grid) -> Volume | None:
        if name is None or name not in {v.name for v in self.store.describe()}:
            return None
        held = self.store.get(name)
        if not isinstance(held, Volume) or held.shape != grid.shape:
            raise invalid_params(f"{name!r} is not a volume of shape {list(grid.shape)}")
        return held


def _prepare(volume: Volume) -> None:
    if not np.isfinite(volume.data).all():
        raise invalid_params("the volume holds numbers that are not finite")
    _ = volume.layout  # made now, so that the first projection does not wait for it


def _backproject(p: Backproject, old: Volume | None) -> Volume:
    blank = np.broadcast_to(np.float32(0), p.grid.shape)
    made = back(p.projections, p.cone_vec, Volume(blank, p.grid.voxel_mm, p.grid.center_mm))
    data = np.ascontiguousarray(made.data)
    if old is not None:
        data = data + old.data
    return replace(made, data=data)


ANSWERS: Final[Mapping[str, Answer]] = {
    "session.hello": ProjectorServer.hello,
    "volume.put": ProjectorServer.volume_put,
    "volume.get": ProjectorServer.volume_get,
    "volume.list": ProjectorServer.volume_list,
    "volume.remove": ProjectorServer.volume_remove,
    "project": ProjectorServer.project,
    "backproject": ProjectorServer.backproject,
    "health": ProjectorServer.health,
    "cancel": ProjectorServer.cancel,
    "rpc.discover": ProjectorServer.discover,
}


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

    Raises:
        AccessError: the address can be reached by others and there is no token.
        OSError: the address is taken or not ours.
    """
    check_bind(host, token)
    limits = limits or Limits()
    compute = ComputeThread(begin)
    server = ProjectorServer(
        compute, VolumeStore(memory_limit), limits, token,
        facts or {"backend": "numba", "threads": 0},
    )  # fmt: skip
    try:
        await compute.ready
        loop = asyncio.get_running_loop()
        server.server = await loop.create_server(
            lambda: FrameLink(
                server.frame,
                server.broken,
                server.lost,
                server.made,
                max_frame=min(MAX_FRAME, limits.max_message),
                send_timeout_s=limits.send_timeout_s,
                frame_timeout_s=limits.message_timeout_s,
            ),
            host,
            port,
            ssl=ssl,
        )
    except BaseException:
        compute.close()
        raise
    return server
