"""The twin's client of a projector, with what only tests ask of it."""

from __future__ import annotations

from typing import Self

from flexdt.protocol import parse_result
from flexdt.protocol.projector import VolumeList
from flexdt.server.imaging.projector_pool import ProjectorClient


class ProjectorUser(ProjectorClient):
    """Connects at once, ends with its block, and lists what the server holds."""

    async def __aenter__(self) -> Self:
        await self.connect()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def connect(self) -> None:
        await self._connected()

    async def volumes(self) -> VolumeList:
        return parse_result(VolumeList, await self._ask("volume.list", {}))
