"""`ProjectorClient`: the projector server's methods for an asyncio program such as the twin server.

Several requests may be open at once. The client keeps the volumes it has sent and, after a
reconnect with back-off, sends them again to a server that has restarted; requests are stateless and
are simply repeated. When its patience ends, it raises `ProjectorUnavailable`.
"""

from __future__ import annotations

import asyncio
import ssl as tls
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt

from flexdt.phantoms.checked_reading import scene_to_dict
from flexdt.protocol import Code, RpcError, hello_params, image, parse_result
from flexdt.protocol.projector import Health
from flexdt.runtime.wire_errors import ProjectorUnavailable
from flexdt.server.projector.wire import LinkLost, ProjectorLink
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Body, TriangleMesh
from flexdt.twin.projection.analytic_solids import Scene

_T = TypeVar("_T")

CHUNK: Final = 8 * 2**20
"""Bytes of a volume in one message."""
FIRST_PAUSE_S: Final = 0.02
LONGEST_PAUSE_S: Final = 1.0


@dataclass(eq=False, repr=False)
class ProjectorClient:
    """A connection to a projector server that is restored when it is lost.

    Attributes:
        host, port: of the server.
        token: where it wants one.
        patience_s: how long a call tries to reach the server [s].
        ssl: a client's TLS context.
    """

    host: str = "127.0.0.1"
    port: int = 55001
    _: KW_ONLY
    token: str | None = None
    patience_s: float = 5.0
    ssl: tls.SSLContext | None = None

    def __post_init__(self) -> None:
        self._volumes: dict[str, Body] = {}
        self._instance: str | None = None
        self._channel: ProjectorLink | None = None
        self._connecting = asyncio.Lock()
        self._closed = False

    @property
    def connected(self) -> bool:
        """Whether there is a connection at this moment."""
        return self._channel is not None and not self._channel.lost

    async def close(self) -> None:
        """End the connection; open requests fail."""
        self._closed = True
        if self._channel is not None:
            self._channel.close()

    # -- methods -----------------------------------------------------------------------------

    async def put(self, name: str, body: Body) -> None:
        """Store a body under `name`, and keep it to be sent again.

        Raises:
            RpcError: -32008, above the server's memory limit; -32602, a mesh that does not close.
            ProjectorUnavailable: the server does not answer.
        """
        await self._persist("volume.put", lambda channel: _send(channel, name, body))
        self._volumes[name] = body

    async def remove(self, name: str) -> None:
        """Remove a volume, here and on the server."""
        self._volumes.pop(name, None)
        await self._ask("volume.remove", {"name": name})

    async def project(
        self, name: str, cone_vec: ConeVec | npt.ArrayLike, shape: tuple[int, int]
    ) -> npt.NDArray[np.float32]:
        """Line integrals of a named volume or scene.

        Args:
            name: it was put under.
            cone_vec: ConeVec or (n, 12) [mm], object frame.
            shape: detector (rows, cols).

        Returns:
            float32 (n, rows, cols), read-only.

        Raises:
            RpcError: invalid parameters, or an unknown volume.
            ProjectorUnavailable: the server does not answer.
        """
        rows = cone_vec.rows if isinstance(cone_vec, ConeVec) else np.asarray(cone_vec, np.float64)
        rows = np.atleast_2d(rows)
        params: dict[str, object] = {
            "volume": name, "cone_vec": image.encode(rows), "detector": list(shape),
        }  # fmt: skip
        whole = (len(rows), *shape)
        try:
            return await self._persist("project", lambda c: c.ask_array("project", params, whole))
        except RpcError as error:
            if not self._lacks_volume(error, name):
                raise
        await self.put(name, self._volumes[name])  # another client removed it
        return await self._persist("project", lambda c: c.ask_array("project", params, whole))

    async def health(self) -> Health:
        """The server's version, load and memory."""
        return parse_result(Health, await self._ask("health", {}))

    # -- requests ----------------------------------------------------------------------------

    async def _ask(self, method: str, params: Mapping[str, object]) -> object:
        return await self._persist(method, lambda channel: channel.ask(method, params))

    async def _persist(self, method: str, work: Callable[[ProjectorLink], Awaitable[_T]]) -> _T:
        """Do `work`; after a lost connection repeat it.

        Raises:
            ProjectorUnavailable: the client's patience has ended.
            RpcError: the server's answer is an error.
        """
        loop = asyncio.get_running_loop()
        deadline = loop.time() + self.patience_s
        while True:
            channel = await self._connected()
            try:
                return await work(channel)
            except LinkLost:
                if self._closed or loop.time() > deadline:
                    raise ProjectorUnavailable(
                        f"the projector at {self.host}:{self.port} went away during {method}"
                    ) from None

    def _lacks_volume(self, error: RpcError, name: str) -> bool:
        unknown = isinstance(error.data, Mapping) and name not in (error.data.get("allowed") or ())
        return error.code == Code.INVALID_PARAMS and name in self._volumes and unknown

    # -- connection --------------------------------------------------------------------------

    async def _connected(self) -> ProjectorLink:
        if self._closed:
            raise ProjectorUnavailable("the projector client is closed")
        if self._channel is not None and not self._channel.lost:
            return self._channel
        async with self._connecting:
            if self._channel is None or self._channel.lost:
                self._channel = await self._connect()
            return self._channel

    async def _connect(self) -> ProjectorLink:
        loop = asyncio.get_running_loop()
        deadline = loop.time() + self.patience_s
        pause = FIRST_PAUSE_S
        while True:
            try:
                return await self._open()
            except OSError as error:
                if loop.time() + pause > deadline or self._closed:
                    why = getattr(error, "strerror", None) or str(error) or "no answer"
                    raise ProjectorUnavailable(
                        f"no projector at {self.host}:{self.port} ({why})"
                    ) from None
            await asyncio.sleep(pause)
            pause = min(2 * pause, LONGEST_PAUSE_S)

    async def _open(self) -> ProjectorLink:
        channel = await ProjectorLink.connect(self.host, self.port, self.ssl)
        try:
            answer = await channel.ask("session.hello", hello_params("flexdt twin", self.token))
            instance = answer.get("instance") if isinstance(answer, Mapping) else None
            if instance != self._instance:
                for name, value in list(self._volumes.items()):
                    await _send(channel, name, value)
                self._instance = instance if isinstance(instance, str) else None
        except BaseException:
            channel.close()
            raise
        return channel


async def _send(channel: ProjectorLink, name: str, value: Body) -> None:
    """Send a volume or mesh in chunks, or a scene."""
    if isinstance(value, Scene):
        await channel.ask("volume.put", {"name": name, "scene": scene_to_dict(value)})
        return
    what: dict[str, object]
    if isinstance(value, TriangleMesh):
        what = {"mesh": {"vertices": len(value.vertices), "triangles": len(value.faces)}}
        corners, faces = value.vertices.astype("<f8"), value.faces.astype("<i4")
        flat = np.frombuffer(corners.tobytes() + faces.tobytes(), np.uint8)
    else:
        center = [float(c) for c in value.center_mm]
        shape, voxel = list(value.shape), list(value.voxel_xyz)
        what = {"grid": {"shape": shape, "voxel_mm": voxel, "center_mm": center}}
        flat = np.ascontiguousarray(value.data, dtype="<f4").reshape(-1).view(np.uint8)
    for start in range(0, flat.size, CHUNK):
        data = flat[start : start + CHUNK].data.toreadonly()
        await channel.ask("volume.put", {"name": name, **what, "start": start, "data": data})
