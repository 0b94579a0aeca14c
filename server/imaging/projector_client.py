"""The methods of one projector.

It connects at the first request, and sends a volume when that is first projected, and
again to a server that has restarted or has dropped it for others.
"""

from __future__ import annotations

import asyncio
import math
import ssl as tls
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt

from flexdt.message_words import reason_of
from flexdt.phantoms.checked_reading import scene_to_dict
from flexdt.protocol import Code, RpcError, hello_params, image, parse_result
from flexdt.protocol.projector import Health, volumes_there
from flexdt.runtime.wire_errors import ProjectorUnavailable
from flexdt.server.projector.wire import LinkLost, ProjectorLink
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Body, TriangleMesh
from flexdt.twin.projection.analytic_solids import Scene
from flexdt.twin.projection.pixel_areas import Need, Within

_T = TypeVar("_T")

CHUNK_BYTES: Final = 8 * 2**20
"""Bytes of a volume in one message."""
MAX_LOSSES: Final = 5
"""Times that a projector may lose a volume of which no other has taken the place."""


@dataclass(eq=False, repr=False)
class ProjectorClient:
    """A connection to a projector server that is made again when it is lost.

    Attributes:
        host, port: of the server.
        token: where it wants one.
        ssl: a client's TLS context.
    """

    host: str = "127.0.0.1"
    port: int = 55001
    _: KW_ONLY
    token: str | None = None
    ssl: tls.SSLContext | None = None

    def __post_init__(self) -> None:
        """Begin unconnected; the first request connects."""
        self._sent: dict[str, Body] = {}
        self._instance: object = None
        self._evicts = False
        """Whether the server drops volumes when memory is needed."""
        self._channel: ProjectorLink | None = None
        self._connecting = asyncio.Lock()
        self._sending = asyncio.Lock()
        self._closed = False

    @property
    def connected(self) -> bool:
        """Whether there is a connection now."""
        return self._channel is not None and not self._channel.lost

    async def close(self) -> None:
        """End the connection for good; open requests fail, later ones are refused."""
        self._closed = True
        if self._channel is not None:
            self._channel.close()

    async def give(self, name: str, body: Body) -> None:
        """Ensure that the server has `body` under `name`; sent only if it is not there
        already.

        A body counts as there if this very object was sent to this run of the server.
        Bodies are sent one at a time.

        Raises:
            RpcError: -32008, above the server's memory limit; -32602, a mesh that does
                not close.
            ProjectorUnavailable: the server does not answer.
        """
        async with self._sending:
            await self._ask("volume.put", lambda channel: self._give(channel, name, body))

    async def _give(self, channel: ProjectorLink, name: str, body: Body) -> None:
        """Send a body unless this very object was sent under that name, and remember it.

        It may be evicted if the server evicts volumes."""
        if self._sent.get(name) is not body:
            await _send(channel, name, body, {"evictable": True} if self._evicts else {})
            self._sent[name] = body

    async def remove(self, name: str) -> None:
        """Have the server remove the body called `name`; nothing if it was not sent from here."""
        if self._sent.pop(name, None) is not None:
            await self.ask("volume.remove", {"name": name})

    async def project(
        self, name: str, body: Body | None, cone_vec: ConeVec, shape: tuple[int, int]
    ) -> npt.NDArray[np.float32]:
        """Compute line integrals.

        Args:
            name, body: the body to project; body None if it is there already.
            cone_vec: n views, object frame.
            shape: detector (rows, cols).

        Returns:
            float32 (n, rows, cols), read-only.

        Raises:
            RpcError, ProjectorUnavailable: as of `_array`.
        """
        sizes = (len(cone_vec), *shape)
        return await self._array("project", name, body, (cone_vec, shape), {}, sizes)

    async def rays_needed(
        self,
        name: str,
        body: Body | None,
        cone_vec: ConeVec,
        shape: tuple[int, int],
        need: tuple[Need, float],
    ) -> Within:
        """Find the pixels that need several rays.

        Args:
            name, body, cone_vec, shape: as of `project`.
            need: and the body's weight; see `pixel_areas.rays_needed`.
        """
        wanted, weight = need
        params = {
            "error": wanted.error,
            "counts": wanted.counts,
            "weight": abs(float(weight)),
        }
        pixels = math.prod(shape)
        sizes = (len(cone_vec) * (pixels + 1),)
        values = await self._array(
            "rays", name, body, (cone_vec, shape), params, sizes, np.uint32, most=True
        )
        try:
            found = Within.unpacked(values, len(cone_vec), pixels)
        except ValueError as error:
            raise RpcError(
                Code.INTERNAL, f"the projector's answer to rays: {error}"
            ) from None
        return Within(found.pixels, wanted.given(found.marks))

    async def paths_within(
        self,
        name: str,
        body: Body | None,
        cone_vec: ConeVec,
        shape: tuple[int, int],
        within: Within,
    ) -> npt.NDArray[np.float32]:
        """Compute line integrals along several rays of some pixels, float32 (rays,).

        Args:
            name, body, cone_vec, shape: as of `project`.
            within: the pixels; see `pixel_areas.paths_within`.
        """
        if not len(within.pixels):
            return np.zeros(0, np.float32)
        pixels = within.pixels.astype("<i8").view(np.uint8).data.toreadonly()
        marks = within.marks.data.toreadonly()
        params = {"within": {"pixels": pixels, "marks": marks}}
        sizes = (int(within.starts[-1]),)
        return await self._array("project", name, body, (cone_vec, shape), params, sizes)

    async def _array(
        self,
        method: str,
        name: str,
        body: Body | None,
        views: tuple[ConeVec, tuple[int, int]],
        more: Mapping[str, object],
        sizes: tuple[int, ...],
        dtype: npt.DTypeLike = np.float32,
        *,
        most: bool = False,
    ) -> npt.NDArray[Any]:
        """Request an array about a body; send the body again if the server has dropped it.

        A volume that the server does not know is sent and requested again: as often as
        other clients' volumes displace it, which are projected meanwhile, and until it is lost
        `MAX_LOSSES` times without that. Without `body` it is an error at once.

        Args:
            method: of the wire.
            name, body: the body; None if it is there already.
            views: object frame, and detector (rows, cols).
            more: the method's further parameters.
            sizes, dtype, most: of the array, as of `ProjectorLink.ask_array`.

        Returns:
            The array, read-only.

        Raises:
            RpcError: invalid parameters, or an unknown volume.
            ProjectorUnavailable: the server does not answer.
        """
        cone_vec, shape = views
        params: dict[str, object] = {
            "volume": name,
            "cone_vec": image.encode(cone_vec.rows),
            "detector": list(shape),
            **more,
        }
        losses = 0
        while True:
            if body is not None:
                await self.give(name, body)
            try:
                return await self._ask(
                    method, lambda c: c.ask_array(method, params, sizes, dtype, most=most)
                )
            except RpcError as error:
                there = volumes_there(error, name)
                if body is None or there is None or name in there:
                    raise
                losses += not there
                if losses == MAX_LOSSES:
                    raise
            self._sent.pop(name, None)

    async def health(self) -> Health:
        """Request the server's version, load and memory."""
        return parse_result(Health, await self.ask("health", {}))

    async def ask(self, method: str, params: Mapping[str, object]) -> object:
        """Call any method and return its result; raises as `project`."""
        return await self._ask(method, lambda channel: channel.ask(method, params))

    async def _ask(
        self, method: str, work: Callable[[ProjectorLink], Awaitable[_T]]
    ) -> _T:
        """Call `work` with a connection, which is made if there is none.

        Connections are made one at a time, and `work` is called once.

        `method`: for the message; `work`: sends requests and awaits their answers.
        Returns the value of `work`.
        Raises ProjectorUnavailable: no connection, or it was lost; RpcError: the answer is an
        error.
        """
        async with self._connecting:
            if self._channel is None or self._channel.lost:
                self._channel = await self._connect()
            channel = self._channel
        try:
            return await work(channel)
        except LinkLost:
            raise ProjectorUnavailable(
                f"the projector at {self.host}:{self.port} went away during {method}"
            ) from None

    async def _connect(self) -> ProjectorLink:
        """Connect, say hello, and forget the bodies that were sent to another run of the
        server.

        Notes whether the server evicts volumes when memory is needed. A connection
        whose hello fails is closed.

        Returns:
            The connection.

        Raises:
            ProjectorUnavailable: the client is closed, no projector answers, or the
                connection ends during the hello.
            RpcError: the projector refuses the client.
        """
        if self._closed:
            raise ProjectorUnavailable("the projector client is closed")
        try:
            channel = await ProjectorLink.connect(self.host, self.port, self.ssl)
            try:
                answer = await channel.ask(
                    "session.hello", hello_params("flexdt twin", self.token)
                )
            except BaseException:
                channel.close()
                raise
        except OSError as error:
            why = reason_of(error, str(error) or "no answer")
            raise ProjectorUnavailable(
                f"no projector at {self.host}:{self.port} ({why})"
            ) from None
        instance = None
        if isinstance(answer, Mapping):
            instance = answer.get("instance")
        self._evicts = isinstance(answer, Mapping) and answer.get("evicts") is True
        if instance != self._instance:
            self._instance = instance
            self._sent = {}
        return channel


async def _send(
    channel: ProjectorLink, name: str, value: Body, how: Mapping[str, object]
) -> None:
    """Send a volume or mesh in chunks, or a scene as one message, each awaiting its
    answer.

    A chunk has at most `CHUNK_BYTES`. Values go as little-endian float32; of a mesh all
    corners (float64) come before all triangles (int32).

    Args:
        channel: connection to the projector.
        name: of the body there.
        value: the body.
        how: further parameters of `volume.put`.

    Raises:
        RpcError: the projector refuses it.
        LinkLost: the connection has ended.
    """
    if isinstance(value, Scene):
        await channel.ask(
            "volume.put", {"name": name, "scene": scene_to_dict(value), **how}
        )
        return
    what: dict[str, object]
    if isinstance(value, TriangleMesh):
        what = {"mesh": {"vertices": len(value.vertices), "triangles": len(value.faces)}}
        corners = value.vertices.astype("<f8")
        faces = value.faces.astype("<i4")
        flat = np.frombuffer(corners.tobytes() + faces.tobytes(), np.uint8)
    else:
        center = [float(c) for c in value.center_mm]
        shape = list(value.shape)
        voxel = list(value.voxel_xyz)
        what = {"grid": {"shape": shape, "voxel_mm": voxel, "center_mm": center}}
        flat = np.ascontiguousarray(value.data, dtype="<f4").reshape(-1).view(np.uint8)
    for start in range(0, flat.size, CHUNK_BYTES):
        data = flat[start : start + CHUNK_BYTES].data.toreadonly()
        params = {"name": name, **what, **how, "start": start, "data": data}
        await channel.ask("volume.put", params)
