"""The methods of the projector server, and what they work with: volumes, meshes and scenes by name.

`Context` has the compute thread, the volumes and the clients; jobs are started and results are sent
from there, in one piece or in parts. Each method translates parameters, has the work done in the
compute thread, and translates back. The connections are in `service`.

Memory is counted as what a volume takes once it is projected: its voxels and the projector's own
z-contiguous copy. Nothing is evicted: above the limit a put is an error.
"""

from __future__ import annotations

import asyncio
import math
import time
import uuid
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.metadata import version
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.phantoms.checked_reading import scene_from_dict
from flexdt.protocol import MAX_FRAME, PROTOCOL, Correlation, Notification, Role, image
from flexdt.protocol import projector as wire
from flexdt.protocol.fields import Params
from flexdt.protocol.messages import Id
from flexdt.protocol.methods import openrpc_document
from flexdt.protocol.methods.session_messages import Hello
from flexdt.protocol.rpc_errors import RpcError, cancelled, invalid_params, superseded, too_large
from flexdt.runtime.log import Sparing
from flexdt.server.network.shell_parts import TokenCheck
from flexdt.server.projector.compute import (
    ComputeJob,
    ComputeThread,
    Lane,
    Step,
    projection_steps,
    views_a_block,
)
from flexdt.server.projector.wire import FrameLink
from flexdt.twin.projection import Body, TriangleMesh, Volume, back
from flexdt.twin.projection.operators import as_cone_vec

LAYOUT_COPIES = 2
"""A volume's voxels are kept twice: as they came and z-contiguous."""

SOLID_BYTES = 1024
"""Counted for each solid of a scene."""


@dataclass
class _Upload:
    """Voxels or a mesh that are still coming, and their bytes."""

    owner: object
    what: wire.VoxelGrid | wire.MeshSize
    data: np.ndarray[tuple[int], np.dtype[np.uint8]]
    received: int = 0

    def whole(self) -> Volume | TriangleMesh:
        """What they are once all have come.

        Raises:
            GeometryError: a mesh that does not close.
        """
        if isinstance(self.what, wire.VoxelGrid):
            voxels = self.data.view("<f4").reshape(self.what.shape)
            return Volume(voxels, self.what.voxel_mm, self.what.center_mm)
        corners = 24 * self.what.vertices
        return TriangleMesh(
            self.data[:corners].view("<f8").reshape(-1, 3),
            self.data[corners:].view("<i4").reshape(-1, 3).astype(np.int64),
        )


class VolumeStore:
    """The server's volumes, by name.

    Args:
        limit: bytes that all volumes together may take.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._held: dict[str, Body] = {}
        self._uploads: dict[tuple[object, str], _Upload] = {}

    def __len__(self) -> int:
        return len(self._held)

    def __contains__(self, name: object) -> bool:
        return name in self._held

    @property
    def used(self) -> int:
        """Bytes taken by volumes and uploads."""
        held = sum(memory_of(v) for v in self._held.values())
        return held + sum(_needed(u.what) for u in self._uploads.values())

    def get(self, name: str) -> Body:
        """The volume called `name`.

        Raises:
            RpcError: -32602, listing the names.
        """
        if name not in self._held:
            raise invalid_params(
                f"no volume {name!r}; there are: {', '.join(sorted(self._held)) or 'none'}",
                [{"path": "volume", "message": "unknown volume", "asked": name}],
                sorted(self._held),
            )
        return self._held[name]

    def put(self, name: str, value: Body) -> None:
        """Store a whole volume, mesh or scene under `name`, in place of its namesake.

        Raises:
            RpcError: -32008, above the memory limit.
        """
        self.reserve(f"volume {name!r}", memory_of(value), name)
        self._held[name] = value

    def chunk(
        self,
        owner: object,
        name: str,
        what: wire.VoxelGrid | wire.MeshSize,
        start: int,
        data: memoryview,
    ) -> tuple[int, Callable[[], Volume | TriangleMesh] | None]:
        """Take a chunk of voxels or of a mesh.

        Chunks come in order. The complete volume is not stored: `put` does that.

        Returns:
            Bytes received so far and, once all have come, what makes the volume or mesh of them.

        Raises:
            RpcError: -32008 above the memory limit; -32602, chunks that do not fit together.
        """
        total = what.nbytes
        key = (owner, name)
        if start == 0:
            self._uploads.pop(key, None)
            # The namesake stays in use until the new volume is whole, so both are counted.
            self.reserve(f"volume {name!r}", _needed(what))
            self._uploads[key] = _Upload(owner, what, np.empty(total, np.uint8))
        upload = self._uploads.get(key)
        if upload is None or upload.what != what or upload.received != start:
            expected = 0 if upload is None else upload.received
            raise _bad_chunk(name, start, expected)
        end = start + data.nbytes
        if end > total or (data.nbytes == 0 and total > 0):
            raise _bad_chunk(name, end, total)
        upload.data[start:end] = np.frombuffer(data, np.uint8)
        upload.received = end
        if end < total:
            return end, None
        del self._uploads[key]
        return end, upload.whole

    def remove(self, name: str) -> bool:
        """Forget a volume; returns whether there was one."""
        return self._held.pop(name, None) is not None

    def forget(self, owner: object) -> None:
        """Drop the unfinished uploads of a client that has gone."""
        for key in [k for k in self._uploads if k[0] is owner]:
            del self._uploads[key]

    def describe(self) -> list[wire.VolumeInfo]:
        """All volumes, by name."""
        return [_info(name, self._held[name]) for name in sorted(self._held)]

    def reserve(self, what: str, needed: int, replaced: str | None = None) -> None:
        """Raise -32008 unless there is room for `needed` bytes more, in place of a volume's."""
        old = self._held.get(replaced) if replaced is not None else None
        used = self.used - (0 if old is None else memory_of(old))
        if used + needed > self.limit:
            error = too_large(what, needed, max(0, self.limit - used))
            assert isinstance(error.data, dict)
            error.data.update(memory_used=used, memory_limit=self.limit)
            raise error


def memory_of(value: Body) -> int:
    """Bytes counted for a volume, mesh or scene."""
    if isinstance(value, Volume):
        return LAYOUT_COPIES * 4 * math.prod(value.shape)
    if isinstance(value, TriangleMesh):
        return value.vertices.nbytes + value.faces.nbytes
    return SOLID_BYTES * max(1, len(value.solids))


def _needed(what: wire.VoxelGrid | wire.MeshSize) -> int:
    if isinstance(what, wire.VoxelGrid):
        return LAYOUT_COPIES * what.nbytes
    return 24 * (what.vertices + what.triangles) + what.nbytes


def _bad_chunk(name: str, asked: int, allowed: int) -> RpcError:
    return invalid_params(
        f"volume {name!r}: a chunk at or up to byte {asked} does not fit; expected {allowed}",
        [{"path": "start", "message": "chunks must come in order", "asked": asked}],
        allowed,
    )


def _info(name: str, value: Body) -> wire.VolumeInfo:
    if isinstance(value, TriangleMesh):
        triangles = len(value.faces)
        return wire.VolumeInfo(name=name, kind="mesh", bytes=memory_of(value), triangles=triangles)
    if isinstance(value, Volume):
        return wire.VolumeInfo(
            name=name,
            kind="voxels",
            bytes=memory_of(value),
            shape=list(value.shape),
            voxel_mm=value.voxel_xyz,
            center_mm=value.center_mm,
        )
    return wire.VolumeInfo(
        name=name, kind="scene", bytes=memory_of(value), solids=len(value.solids)
    )


PART_BYTES: Final = 8 * 2**20
"""Payload of a part of what does not fit into one frame."""
SPARE: Final = 4096
"""Room for everything but the payload in a frame."""


class JobClient:
    """One connection, its jobs and its requests that are under way."""

    def __init__(self, link: FrameLink, token: str | None, lines: Sparing) -> None:
        self.link, self.let_in = link, token is None
        self.lanes = Lane(), Lane()
        self.jobs: dict[Id, ComputeJob] = {}
        self.calls: Correlation[None] = Correlation(Role.SERVER)
        self.tasks: set[asyncio.Task[None]] = set()
        self.pending_bytes = 0
        self.token_check = TokenCheck(token, self._close_soon, lines)

    def begin(self, id: Id, key: str | None = None) -> ComputeJob:
        """The work of a request, known by its id until that is answered."""
        job = self.jobs[id] = ComputeJob(self.lanes[key is not None], key)
        return job

    def _close_soon(self) -> None:
        """End the connection once its last answer has gone out."""
        asyncio.get_running_loop().call_later(0.1, self.link.transport.close)


@dataclass(eq=False, repr=False)
class Context:
    """The projector's state.

    Attributes:
        compute: the thread that computes.
        store: named volumes.
        token: clients must bring it.
        facts: backend and threads, for `health`.
        clients: by connection.
        instance: names this start of the server.
        started: when it was [s], monotonic.
        views: projected so far.
        superseded: requests that newer ones have replaced.
        lines: of the log about connections.
    """

    compute: ComputeThread
    store: VolumeStore
    token: str | None
    facts: Mapping[str, object]
    clients: dict[FrameLink, JobClient] = field(default_factory=dict)
    instance: str = field(default_factory=lambda: uuid.uuid4().hex)
    started: float = field(default_factory=time.monotonic)
    views: int = 0
    superseded: int = 0
    lines: Sparing = field(default_factory=Sparing)

    @property
    def waiting(self) -> int:
        """Requests whose work waits for its turn."""
        return sum(job.waits for client in self.clients.values() for job in client.jobs.values())

    async def run(self, client: JobClient, id: Id, step: Step) -> object:
        """The value of the one step of a request."""
        return await client.begin(id).run(self.compute, step)

    def supersede(self, client: JobClient, key: str) -> None:
        """End this client's interactive jobs of that key that have not been computed."""
        for job in client.jobs.values():
            if job.key == key and job.waits:
                job.end(superseded(key))
                self.superseded += 1

    async def send_array(
        self, client: JobClient, id: Id, array: npt.NDArray[np.generic]
    ) -> dict[str, object]:
        """An array as the result of a request; what does not fit has gone before, in parts."""
        if array.nbytes + SPARE <= MAX_FRAME:
            return image.encode(array)
        parts = await self.send_parts(client, id, array, 0)
        return {"dtype": array.dtype.name, "shape": list(array.shape), "parts": parts}

    async def send_parts(
        self, client: JobClient, id: Id, array: npt.NDArray[np.generic], start: int
    ) -> int:
        """Send an array as parts of a result, from its element `start` on; how many."""
        flat = np.ascontiguousarray(array).reshape(-1)
        step = PART_BYTES // flat.itemsize
        parts = 0
        for at in range(0, flat.size, step):
            data = flat[at : at + step].view(np.uint8).data.toreadonly()
            part = {"request": id, "start": start + at, "data": data}
            await client.link.send(Notification("part", part))
            parts += 1
        return parts


MAX_VIEW_BYTES: Final = 512 * 2**20

Answer = Callable[[Context, JobClient, Id, Any], Awaitable[object]]


async def hello(context: Context, client: JobClient, id: Id, p: Hello) -> object:
    """Check the token."""
    await client.token_check.check(p.token, client.link.peer)
    client.let_in = True
    client.link.deadlines.stop("hello")
    return {
        "protocol": PROTOCOL, "server": f"flexdt projector {version('flexdt')}",
        "machine": "", "instance": context.instance,
    }  # fmt: skip


async def volume_put(context: Context, client: JobClient, id: Id, p: wire.VolumePut) -> object:
    """Store a scene, or a chunk of voxels or of a mesh."""
    if p.scene is not None:
        context.store.put(p.name, scene_from_dict(p.scene))
        return {"name": p.name, "received": 0, "total": 0, "complete": True}
    what = p.grid or p.mesh
    assert what is not None
    assert p.data is not None
    received, made = context.store.chunk(client, p.name, what, p.start, p.data)
    complete = made is not None
    if made is not None:
        ready = made
        volume = await context.run(client, id, lambda: _prepared(ready()))
        assert isinstance(volume, Volume | TriangleMesh)
        context.store.put(p.name, volume)
    return {"name": p.name, "received": received, "total": what.nbytes, "complete": complete}


async def volume_get(context: Context, client: JobClient, id: Id, p: wire.VolumeRef) -> object:
    """Send a volume's voxels."""
    volume = context.store.get(p.name)
    if not isinstance(volume, Volume):
        raise invalid_params(f"{p.name!r} is a mesh or an analytic scene and has no voxels")
    data = volume.data
    whole = await context.run(client, id, lambda: np.ascontiguousarray(data))
    assert isinstance(whole, np.ndarray)
    return await context.send_array(client, id, whole)


async def volume_list(context: Context, client: JobClient, id: Id, p: Params) -> object:
    """Volumes and memory."""
    return {
        "volumes": context.store.describe(),
        "memory_used": context.store.used,
        "memory_limit": context.store.limit,
    }


async def volume_remove(context: Context, client: JobClient, id: Id, p: wire.VolumeRef) -> object:
    """Forget a volume."""
    return {"removed": context.store.remove(p.name)}


async def project(context: Context, client: JobClient, id: Id, p: wire.Project) -> object:
    """Line integrals, view block by view block."""
    volume = context.store.get(p.volume)
    view = math.prod(p.detector)
    if 4 * view > MAX_VIEW_BYTES:
        raise too_large("a view", 4 * view, MAX_VIEW_BYTES)
    # All rows at once, before any is computed: blocks would count from their own first row.
    rows = as_cone_vec(p.cone_vec).rows
    block = views_a_block(p.detector)
    if p.key is not None:
        context.supersede(client, p.key)
    job, parts, done = client.begin(id, p.key), 0, 0
    for step in projection_steps(volume, rows, p.detector, block):
        views = await job.run(context.compute, step)
        assert isinstance(views, np.ndarray)
        context.views += len(views)
        if len(views) == len(rows) and views.nbytes + SPARE <= MAX_FRAME:
            return image.encode(views)
        parts += await context.send_parts(client, id, views, done * view)
        done += len(views)
    return {"dtype": "float32", "shape": [len(rows), *p.detector], "parts": parts}


async def backproject(context: Context, client: JobClient, id: Id, p: wire.Backproject) -> object:
    """The adjoint, answered or added to a named volume."""
    if len(p.projections) != len(p.cone_vec):
        raise invalid_params(
            f"{len(p.projections)} projections and {len(p.cone_vec)} rows of cone_vec"
        )
    old = _accumulator(context, p.into, p.grid)
    needed = p.grid.nbytes
    context.store.reserve("a back projection", needed * (2 if old is None else 1))
    made = await context.run(client, id, lambda: _backproject(p, old))
    assert isinstance(made, Volume)
    if p.into is not None:
        context.store.put(p.into, made)
        return {"dtype": "float32", "shape": list(made.shape), "parts": 0}
    return await context.send_array(client, id, np.asarray(made.data))


async def health(context: Context, client: JobClient, id: Id, p: Params) -> object:
    """Figures about the server."""
    return {
        "instance": context.instance,
        "version": version("flexdt"),
        **context.facts,
        "uptime_s": time.monotonic() - context.started,
        "clients": len(context.clients),
        "waiting": context.waiting,
        "views": context.views,
        "superseded": context.superseded,
        "volumes": len(context.store),
        "memory_used": context.store.used,
        "memory_limit": context.store.limit,
    }


async def cancel(context: Context, client: JobClient, id: Id, p: wire.Cancel) -> object:
    """Give up a request."""
    job = client.jobs.get(p.request)
    if job is not None:
        job.end(cancelled(p.request))
    return {"cancelled": job is not None}


async def discover(context: Context, client: JobClient, id: Id, p: Params) -> object:
    """The OpenRPC document."""
    return _document()


@cache
def _document() -> object:
    return openrpc_document(wire.PROJECTOR_METHODS, title="flexdt projector server")


def _accumulator(context: Context, name: str | None, grid: wire.VoxelGrid) -> Volume | None:
    if name is None or name not in context.store:
        return None
    held = context.store.get(name)
    if not isinstance(held, Volume) or held.shape != grid.shape:
        raise invalid_params(f"{name!r} is not a volume of shape {list(grid.shape)}")
    return held


def _prepared(volume: Volume | TriangleMesh) -> Volume | TriangleMesh:
    if isinstance(volume, Volume):
        if not np.isfinite(volume.data).all():
            raise invalid_params("the volume holds numbers that are not finite")
        _ = volume.layout  # made now, so that the first projection does not wait for it
    return volume


def _backproject(p: wire.Backproject, old: Volume | None) -> Volume:
    blank = np.broadcast_to(np.float32(0), p.grid.shape)
    made = back(p.projections, p.cone_vec, Volume(blank, p.grid.voxel_mm, p.grid.center_mm))
    data = np.ascontiguousarray(made.data)
    if old is not None:
        data = data + old.data
    return replace(made, data=data)


ANSWERS: Final[Mapping[str, Answer]] = {
    "session.hello": hello,
    "volume.put": volume_put,
    "volume.get": volume_get,
    "volume.list": volume_list,
    "volume.remove": volume_remove,
    "project": project,
    "backproject": backproject,
    "health": health,
    "cancel": cancel,
    "rpc.discover": discover,
}
"""The function that answers each method."""
