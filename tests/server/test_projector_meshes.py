"""Meshes on the projector: exact paths, uploads in pieces, what does not close.

The witness of the paths is the box or ball that the mesh stands for, as an analytic solid, and
for drawn meshes every ray met with every triangle.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
import pytest
import trimesh
from traced_mesh import traced

from flexdt.protocol import Code, RpcError
from flexdt.server.projector.service import ProjectorServer, serve_projector
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import TriangleMesh, project_scene
from flexdt.twin.projection.analytic_solids import Box, Scene, Solid
from tests.support.projector_user import ProjectorUser

SHAPE = (24, 30)
Body = Callable[[ProjectorServer, ProjectorUser], Awaitable[None]]


def views(rng: np.random.Generator, n: int) -> np.ndarray:
    """n views from drawn directions, 60 mm from the source, 100 to the panel."""
    rows = []
    for _ in range(n):
        ahead = rng.normal(size=3)
        ahead /= np.linalg.norm(ahead)
        u = np.cross(ahead, rng.normal(size=3))
        u /= np.linalg.norm(u)
        rows.append(
            np.concatenate([-60 * ahead, 40 * ahead, 0.5 * u, 0.5 * np.cross(ahead, u)])
        )
    return np.array(rows)


def run(body: Body, memory_limit: int = 64 * 2**20) -> None:
    async def main() -> None:
        server = await serve_projector(memory_limit=memory_limit)
        client = ProjectorUser(port=server.port)
        try:
            await asyncio.wait_for(body(server, client), 300)
        finally:
            await client.close()
            await server.close()

    asyncio.run(main())


def box(x: float, y: float, z: float) -> TriangleMesh:
    made = trimesh.creation.box((x, y, z))
    return TriangleMesh(made.vertices, made.faces)


def test_paths_through_a_box_are_those_of_the_solid() -> None:
    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        rng = np.random.default_rng(4)
        cone = views(rng, 5)
        await client.put("m", box(5.0, 6.0, 7.0))
        solid = Scene((Solid(Box((0.0, 0.0, 0.0), (5.0, 6.0, 7.0)), "water", 1.0),))
        got = await client.project("m", cone, SHAPE)
        np.testing.assert_allclose(got, project_scene(solid, cone, SHAPE), atol=7e-5)
        [held] = (await client.volumes()).volumes
        assert (held.kind, held.triangles, held.name) == ("mesh", 12, "m")
        assert got.max() > 5.0

    run(body)


def test_drawn_meshes_come_whole_in_many_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flexdt.server.imaging.projector_client.CHUNK_BYTES", 1000)

    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        rng = np.random.default_rng(11)
        for i in range(4):
            ball = trimesh.creation.icosphere(2, 1.0)
            corners = ball.vertices * rng.uniform(4, 7, (len(ball.vertices), 1))
            mesh = TriangleMesh(corners @ np.diag(rng.uniform(0.7, 1.3, 3)), ball.faces)
            await client.put("drawn", mesh)
            [row] = views(rng, 1)
            image = (await client.project("drawn", row, SHAPE))[0].ravel()
            pixels = rng.choice(image.size, 60, replace=False)
            expected = traced(mesh.vertices, mesh.faces, row, SHAPE, pixels)
            known = np.isfinite(expected)
            assert known.sum() > 50
            np.testing.assert_allclose(image[pixels][known], expected[known], atol=1e-4)
            assert i or image.max() > 3.0

    run(body)


def test_what_is_no_closed_mesh_is_refused_and_the_server_lives_on() -> None:
    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        good = box(2.0, 2.0, 2.0)
        corners, faces = good.vertices.astype("<f8"), good.faces.astype("<i4")

        async def put(points: np.ndarray, triangles: np.ndarray, **more: Any) -> object:
            data = points.astype("<f8").tobytes() + triangles.astype("<i4").tobytes()
            size = {"vertices": len(points), "triangles": len(triangles)}
            params = {"name": "m", "mesh": size, "start": 0, "data": data, **more}
            return await client.client.ask("volume.put", params)

        lost = corners.copy()
        lost[3, 1] = np.nan
        far = faces.copy()
        far[2, 2] = 8
        negative = faces.copy()
        negative[2, 2] = -1
        cases = [
            (corners, faces[:-1], {}, "the mesh is not closed"),
            (lost, faces, {}, "finite"),
            (corners, far, {}, "names vertex 8"),
            (corners, negative, {}, "names vertex"),
            (corners, faces, {"start": 8}, "does not fit"),
            (
                corners,
                faces,
                {"mesh": {"vertices": 9, "triangles": 13, "name": 1}},
                "name",
            ),
            (corners, faces, {"mesh": {"vertices": 3, "triangles": 12}}, "vertices"),
            (
                corners,
                faces,
                {"grid": {"shape": [1, 1, 1], "voxel_mm": [1, 1, 1]}},
                "give one of",
            ),
            (corners, faces, {"data": None}, "data"),
        ]
        for points, triangles, more, says in cases:
            with pytest.raises(RpcError, match=says) as caught:
                await put(points, triangles, **more)
            assert caught.value.code == Code.INVALID_PARAMS
            assert (await client.volumes()).volumes == []
        await put(corners, faces)
        with pytest.raises(RpcError, match="has no voxels"):
            await client.client.ask("volume.get", {"name": "m"})
        assert (
            await client.project("m", views(np.random.default_rng(1), 1), SHAPE)
        ).any()

    run(body)


def test_memory_is_counted_and_a_restarted_server_gets_the_mesh_again() -> None:
    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        ball = trimesh.creation.icosphere(5, 8.0)
        mesh = TriangleMesh(ball.vertices, ball.faces)
        with pytest.raises(RpcError) as caught:
            await client.put("big", mesh)
        assert caught.value.code == Code.TOO_LARGE
        small = box(3.0, 3.0, 3.0)
        await client.put("m", small)
        cone = ConeVec(views(np.random.default_rng(2), 1))
        before = await client.project("m", cone, SHAPE)
        port = server.port
        await server.close()
        again = await serve_projector(port=port, memory_limit=2**20)
        try:
            np.testing.assert_array_equal(await client.project("m", cone, SHAPE), before)
        finally:
            await again.close()

    run(body, memory_limit=2**20)
