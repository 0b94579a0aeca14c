"""The methods of the projector server.

Each method translates parameters, has the work done in the compute thread, and translates
back. The connections are in `service`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from dataclasses import replace
from functools import cache
from importlib.metadata import version
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.phantoms.checked_reading import scene_from_dict
from flexdt.protocol import MAX_FRAME, PROTOCOL, image
from flexdt.protocol import projector as wire
from flexdt.protocol.fields import Params
from flexdt.protocol.messages import Id
from flexdt.protocol.methods import openrpc_document
from flexdt.protocol.methods.session_messages import Hello
from flexdt.protocol.rpc_errors import cancelled, invalid_params, too_large
from flexdt.server.projector.compute import (
    ComputeJob,
    Step,
    compiling,
    marking_steps,
    projection_steps,
    views_a_block,
    within_steps,
)
from flexdt.server.projector.job_context import SPARE_BYTES, Context, JobClient
from flexdt.twin.errors import GeometryError
from flexdt.twin.plausibility import Operation, examine, settled
from flexdt.twin.projection import Body, TriangleMesh, Volume, back
from flexdt.twin.projection.operators import as_cone_vec
from flexdt.twin.projection.pixel_areas import Need, Within

MAX_VIEW_BYTES: Final = 512 * 2**20
"""Largest view [bytes]."""

Answer = Callable[[Context, JobClient, Id, Any], Awaitable[object]]


async def hello(context: Context, client: JobClient, id: Id, p: Hello) -> object:
    """Check the token, admit the client, and cancel the time limit for its hello.

    The protocol version is not checked here.

    `context`: of the server; `client`: that connects; `id`: of the request; `p`: token.
    Returns a dict with the keys protocol, server, machine (empty), instance and evicts.
    Raises RpcError: not authorised: a wrong or missing token.
    """
    await client.token_check.check(p.token, client.link.peer, client.address)
    client.let_in = True
    client.link.deadlines.stop("hello")
    return {
        "protocol": PROTOCOL,
        "server": f"flexdt projector {version('flexdt')}",
        "machine": "",
        "instance": context.instance,
        "evicts": True,
    }


async def volume_put(
    context: Context, client: JobClient, id: Id, p: wire.VolumePut
) -> object:
    """Store a scene, or a chunk of voxels or of a mesh; the last chunk has the whole
    prepared and stored.

    A scene comes whole (received 0). The chunks come in order and belong to the
    connection.

    Args:
        context: of the server.
        client: that sends it.
        id: of the request.
        p: name, and a scene, or the sizes of grid or mesh with a chunk.

    Returns:
        A dict with the keys name, received [bytes], total [bytes], complete and, where
        its values are doubtful, warnings.

    Raises:
        RpcError: -32008, above the memory limit; -32602, chunks that do not fit together
            or values that are not finite.
        GeometryError: values that are no attenuation.
    """
    if p.scene is not None:
        context.store.put(p.name, scene_from_dict(p.scene), evictable=p.evictable)
        return {"name": p.name, "received": 0, "total": 0, "complete": True}
    what = p.grid or p.mesh
    assert what is not None
    assert p.data is not None
    doubts: list[str] = []
    received, complete_body = context.store.chunk(client, p.name, what, p.start, p.data)
    complete = complete_body is not None
    if complete_body is not None:
        ready = complete_body
        volume = await context.run(client, id, lambda: _prepared(ready(), doubts))
        assert isinstance(volume, Volume | TriangleMesh)
        context.store.put(p.name, volume, evictable=p.evictable)
    return {
        "name": p.name,
        "received": received,
        "total": what.nbytes,
        "complete": complete,
        **_warnings(doubts),
    }


async def volume_get(
    context: Context, client: JobClient, id: Id, p: wire.VolumeRef
) -> object:
    """Send a volume's voxels to the client.

    `context`: of the server; `client`: that calls; `id`: of the request; `p`: name of the
    volume.
    Returns as `Context.send_array`: the image value, or type, shape and number of the parts
    sent.
    Raises RpcError: no such volume, or one without voxels.
    """
    volume = context.store.get(p.name)
    if not isinstance(volume, Volume):
        raise invalid_params(
            f"{p.name!r} is a mesh or an analytic scene and has no voxels"
        )
    data = volume.data
    voxels = await context.run(client, id, lambda: np.ascontiguousarray(data))
    assert isinstance(voxels, np.ndarray)
    return await context.send_array(client, id, voxels)


async def volume_list(context: Context, client: JobClient, id: Id, p: Params) -> object:
    """List the volumes and their memory, as a dict with the keys volumes, memory_used and
    memory_limit [bytes].

    Each volume has its name, kind, bytes and sizes. Nothing but `context` is used.
    """
    return {
        "volumes": context.store.describe(),
        "memory_used": context.store.used,
        "memory_limit": context.store.limit,
    }


async def volume_remove(
    context: Context, client: JobClient, id: Id, p: wire.VolumeRef
) -> object:
    """Remove a volume."""
    return {"removed": context.store.remove(p.name)}


async def project(context: Context, client: JobClient, id: Id, p: wire.Project) -> object:
    """Compute line integrals, one block of views after the other, and send them.

    A request with a key first ends the client's waiting requests of the same key. The geometry
    is examined before anything is computed.

    `context`: of the server; `client`: that calls; `id`: of the request; `p`: name of the
    volume, cone_vec (n, 12), detector (rows, cols), key.
    Returns the image value if all views fit into one frame; else dtype, shape and the number of
    parts, sent before. With warnings about the geometry if there are any.
    Raises RpcError: no such volume, or a view of more than `MAX_VIEW_BYTES`; GeometryError: a
    geometry that no scanner has.
    """
    volume, rows, warnings = _looked_at(context, p)
    block = views_a_block(p.detector)
    if p.within is None:
        steps = projection_steps(volume, rows, p.detector, block)
        shape: tuple[int, ...] = (len(rows), *p.detector)
    else:
        pixels = Within(p.within.places, p.within.each)
        if len(pixels.pixels) and pixels.pixels[-1] >= len(rows) * math.prod(p.detector):
            raise invalid_params("a pixel is beyond the last view")
        steps = within_steps(volume, rows, p.detector, block, pixels)
        shape = (int(pixels.starts[-1]),)
    if p.key is not None:
        context.supersede(client, p.key)
    job = client.begin(id, p.key)
    return {**await _sent(context, client, id, job, steps, shape), **warnings}


async def rays(context: Context, client: JobClient, id: Id, p: wire.RaysNeeded) -> object:
    """Find the rays that pixels need, and send their marks (`pixel_areas.packed`).

    `client`: that calls; `id`: of the request; `p`: name of the volume, cone_vec (n, 12),
    detector, and the permitted error. Returns as of `project`. Raises RpcError,
    GeometryError: as of `project`.
    """
    volume, rows, warnings = _looked_at(context, p)
    steps = marking_steps(
        volume,
        rows,
        p.detector,
        views_a_block(p.detector),
        (Need(p.error, p.counts), p.weight),
    )
    job = client.begin(id, None)
    return {**await _sent(context, client, id, job, steps, None), **warnings}


def _looked_at(
    context: Context, p: wire.Project | wire.RaysNeeded
) -> tuple[Body, npt.NDArray[np.float64], dict[str, list[str]]]:
    """Examine a request's geometry before anything is computed: body, rows and warnings.

    All rows at once: blocks would count from their own first row.

    Raises:
        RpcError: no such volume, or a view of more than `MAX_VIEW_BYTES`.
        GeometryError: a geometry that no scanner has.
    """
    volume = context.store.get(p.volume)
    view = 4 * math.prod(p.detector)
    if view > MAX_VIEW_BYTES:
        raise too_large("a view", view, MAX_VIEW_BYTES)
    views = as_cone_vec(p.cone_vec)
    boxes = volume.boxes if isinstance(volume, Volume) else None
    found = examine(Operation.PROJECT, views, p.detector, boxes=boxes)
    return volume, views.rows, _warnings(settled(found, GeometryError))


async def _sent(
    context: Context,
    client: JobClient,
    id: Id,
    job: ComputeJob,
    steps: Iterator[Step],
    shape: tuple[int, ...] | None,
) -> dict[str, Any]:
    """Compute steps one after the other and send their values: the image value if there is one
    step and it fits into a frame; else dtype, shape and the number of parts, sent before.

    Args:
        context: of the server.
        client: that called.
        id: of its request.
        job: of the request.
        steps: of the array's first axis, in order.
        shape: of the array; None for as many values as there are.
    """
    parts = done = 0
    dtype = np.dtype(np.float32)
    every = list(steps)
    for step in every:
        values = await job.run(context.compute, step)
        assert isinstance(values, np.ndarray)
        if values.dtype == np.float32 and values.ndim == 3:
            context.views += len(values)
        if len(every) == 1 and values.nbytes + SPARE_BYTES <= MAX_FRAME:
            return dict(image.encode(values))
        parts += await context.send_parts(client, id, values, done)
        done += values.size
        dtype = values.dtype
    return {"dtype": str(dtype), "shape": list(shape or (done,)), "parts": parts}


async def backproject(
    context: Context, client: JobClient, id: Id, p: wire.Backproject
) -> object:
    """Compute the adjoint of projections on a grid, and send it, or with `into` add it to a
    named volume.

    A named volume that does not exist begins at zero; the sum replaces it.

    `context`: of the server; `client`: that calls; `id`: of the request; `p`: projections,
    cone_vec, grid, and perhaps the name of the volume.
    Returns as `Context.send_array`; with `into` dtype, shape and parts 0.
    Raises RpcError: -32602, other numbers of projections and views, or a named volume of another
    shape; -32008, no memory.
    """
    if len(p.projections) != len(p.cone_vec):
        raise invalid_params(
            f"{len(p.projections)} projections and {len(p.cone_vec)} rows of cone_vec"
        )
    old = _accumulator(context, p.into, p.grid)
    needed = p.grid.nbytes
    context.store.reserve("a back projection", needed * (2 if old is None else 1))
    volume = await context.run(client, id, lambda: _backproject(p, old))
    assert isinstance(volume, Volume)
    if p.into is not None:
        context.store.put(p.into, volume)
        return {"dtype": "float32", "shape": list(volume.shape), "parts": 0}
    return await context.send_array(client, id, np.asarray(volume.data))


async def health(context: Context, client: JobClient, id: Id, p: Params) -> object:
    """Return figures about the server as a dict, by the names of the wire.

    They are instance, version, backend and threads, uptime [s], clients, waiting, views,
    superseded, volumes, memory used, allowed and evictable [bytes], and the kernel that
    compiles. `client`, `id` and `p` are ignored.

    Args:
        context: of the server.
        client: that calls.
        id: of the request.
        p: none.
    """
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
        "memory_evictable": context.store.evictable,
        "working": compiling(),
    }


async def cancel(context: Context, client: JobClient, id: Id, p: wire.Cancel) -> object:
    """Cancel a request of this client, which is then answered with an error.

    Returns a dict with the key cancelled: whether that request was under way.
    """
    job = client.jobs.get(p.request)
    if job is not None:
        job.end(cancelled(p.request))
    return {"cancelled": job is not None}


async def discover(context: Context, client: JobClient, id: Id, p: Params) -> object:
    """Return the OpenRPC document."""
    return _document()


@cache
def _document() -> object:
    """Make the OpenRPC document, once."""
    return openrpc_document(wire.PROJECTOR_METHODS, title="flexdt projector server")


def _accumulator(
    context: Context, name: str | None, grid: wire.VoxelGrid
) -> Volume | None:
    """Look up the volume `name`, to which a back projection is to be added; else None.

    Raises RpcError: -32602, it is no volume, or has another shape than `grid`.
    """
    if name is None or name not in context.store:
        return None
    held = context.store.get(name)
    if not isinstance(held, Volume) or held.shape != grid.shape:
        raise invalid_params(f"{name!r} is not a volume of shape {list(grid.shape)}")
    return held


def _warnings(doubts: list[str]) -> dict[str, list[str]]:
    """Return the result's part with warnings, empty without any."""
    return {"warnings": doubts} if doubts else {}


def _prepared(volume: Volume | TriangleMesh, doubts: list[str]) -> Volume | TriangleMesh:
    """Check a volume's values and make its projection layout; blocks.

    Meshes are not checked.
    `volume`: complete; `doubts`: gets warnings about the values.
    Returns `volume` itself.
    Raises RpcError: -32602, values that are not finite; GeometryError: values that are no
    attenuation."""
    if isinstance(volume, Volume):
        if not np.isfinite(volume.data).all():
            raise invalid_params("the volume holds numbers that are not finite")
        found = examine(Operation.PROJECT, None, volume=volume.data)
        doubts += settled(found, GeometryError)
        _ = volume.layout  # made now, so that the first projection does not wait for it
    return volume


def _backproject(p: wire.Backproject, old: Volume | None) -> Volume:
    """Compute a back projection on a grid, float32, without filter or weights; blocks.

    `p`: projections, cone_vec and grid. `old`: volume of that shape; the result is their sum,
    and `old` is not changed. None for none.
    Returns a new volume.
    """
    blank = np.broadcast_to(np.float32(0), p.grid.shape)
    volume = back(
        p.projections, p.cone_vec, Volume(blank, p.grid.voxel_mm, p.grid.center_mm)
    )
    data = np.ascontiguousarray(volume.data)
    if old is not None:
        data = data + old.data
    return replace(volume, data=data)


ANSWERS: Final[Mapping[str, Answer]] = {
    "session.hello": hello,
    "volume.put": volume_put,
    "volume.get": volume_get,
    "volume.list": volume_list,
    "volume.remove": volume_remove,
    "project": project,
    "rays": rays,
    "backproject": backproject,
    "health": health,
    "cancel": cancel,
    "rpc.discover": discover,
}
"""The function that answers each method."""
