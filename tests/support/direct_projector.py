"""The projector's work in this process, where a test is about what is done with its images."""

from __future__ import annotations

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection import TriangleMesh, Volume, forward, project_mesh, project_scene
from flexdt.twin.projection.analytic_solids import Scene


class DirectProjector:
    """The projector's work without its server."""

    def __init__(self) -> None:
        self.known: dict[str, Scene | TriangleMesh | Volume] = {}

    async def put_scene(self, name: str, scene: Scene) -> None:
        self.known[name] = scene

    async def put_mesh(self, name: str, mesh: TriangleMesh) -> None:
        self.known[name] = mesh

    async def put_volume(self, name: str, volume: Volume) -> None:
        self.known[name] = volume

    async def remove(self, name: str) -> None:
        del self.known[name]

    async def project(
        self, name: str, cone_vec: ConeVec, shape: tuple[int, int], newest_wins: bool = False
    ) -> Float32Array:
        body = self.known[name]
        if isinstance(body, Scene):
            return project_scene(body, cone_vec, shape)
        if isinstance(body, TriangleMesh):
            return project_mesh(body, cone_vec, shape)
        return forward(body, cone_vec, shape)
