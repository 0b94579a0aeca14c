"""The projector's work in this process, where a test is about what is done with its images."""

from __future__ import annotations

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection import Body, project_body


class DirectProjector:
    """The projector's work without its server."""

    def __init__(self) -> None:
        self.known: dict[str, Body] = {}

    async def put(self, name: str, body: Body) -> None:
        self.known[name] = body

    async def remove(self, name: str) -> None:
        del self.known[name]

    async def project(self, name: str, cone_vec: ConeVec, shape: tuple[int, int]) -> Float32Array:
        return project_body(self.known[name], cone_vec, shape)
