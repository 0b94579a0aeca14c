"""The twin's client of a projector, with what only tests ask of it."""

from __future__ import annotations

import ssl as tls
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from flexdt.protocol import parse_result
from flexdt.protocol.projector import Health, VolumeList
from flexdt.server.imaging.projector_client import ProjectorClient
from flexdt.server.imaging.projector_pool import ProjectorPool


@dataclass(frozen=True)
class Rows:
    """Views as they are, which a projector may refuse."""

    rows: npt.NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.rows)


class ProjectorUser(ProjectorPool):
    """A pool of one projector; connects at once, ends with its block, lists what it holds."""

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 55001,
        *,
        token: str | None = None,
        patience_s: float = 5.0,
        ssl: tls.SSLContext | None = None,
    ) -> None:
        self.client = ProjectorClient(host, port, token=token, ssl=ssl)
        super().__init__([self.client], patience_s)

    async def __aenter__(self) -> Self:
        await self.connect()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def connect(self) -> None:
        await self.health()

    async def health(self) -> Health:
        return await self.client.health()

    async def volumes(self) -> VolumeList:
        return parse_result(VolumeList, await self.client.ask("volume.list", {}))

    async def project(self, name: str, cone_vec: Any, shape: tuple[int, int]) -> Any:
        rows = np.atleast_2d(np.asarray(getattr(cone_vec, "rows", cone_vec), np.float64))
        return await super().project(name, Rows(rows), shape)  # type: ignore[arg-type]
