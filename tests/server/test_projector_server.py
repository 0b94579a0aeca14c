"""Projector server and client over loopback, against direct calls of the projector."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Awaitable, Callable
from typing import Any

import msgpack
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flexdt.protocol import Code, Codec, Connection, Response, RpcError, image
from flexdt.runtime.access import AccessError, ConnectionLimits
from flexdt.runtime.wire_errors import ProjectorUnavailable
from flexdt.server.projector import compute
from flexdt.server.projector import compute as kernels
from flexdt.server.projector import projector_methods as answers
from flexdt.server.projector.service import ProjectorServer, serve_projector
from flexdt.server.projector.wire import LinkLost, ProjectorLink
from flexdt.twin.projection import Volume, back, forward, gpu, project_scene
from flexdt.twin.projection.analytic_solids import (
    Box,
    ConvexPolyhedron,
    Cylinder,
    Ellipsoid,
    Scene,
    Solid,
    Sphere,
)
from tests.support.device_simulator import run_simulated
from tests.support.projector_user import ProjectorUser

pytestmark = pytest.mark.usefixtures("on_processor")

SHAPE = (30, 40)
RNG = np.random.default_rng(5)
VOLUME = Volume(
    RNG.random((12, 10, 8), dtype=np.float32), (0.5, 0.6, 0.7), (0.1, -0.2, 0.3)
)
SCENE = Scene(
    (
        Solid(Sphere((1.0, 2.0, 3.0), 1.5), "steel", 0.8),
        Solid(Box((0.0, 0.0, 0.0), (4.0, 3.0, 2.0)), "ABS", 0.02),
        Solid(Cylinder((0.0, -1.0, 0.0), 1.0, 4.0, (0.6, 0.8, 0.0)), "ABS", -0.02),
        Solid(Ellipsoid((0.0, 0.0, 2.0), (1.0, 2.0, 0.5)), "water", 0.02),
        Solid(
            ConvexPolyhedron(
                ((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0),
                 (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)),
                (1.0, 1.0, 2.0, 2.0, 3.0, 3.0),
            ),
            "Al",
            0.05,
        ),
    )
)  # fmt: skip
LIMIT = 64 * 2**20

ConeRows = np.ndarray[Any, np.dtype[np.float64]]
Images = np.ndarray[Any, np.dtype[np.float32]]
Body = Callable[[ProjectorServer, ProjectorUser], Awaitable[None]]


def views(n: int, pixel: float = 0.4) -> np.ndarray[Any, np.dtype[np.float64]]:
    """n views of a full turn, SOD 60, SDD 100."""
    rows = []
    for a in np.linspace(0, 2 * np.pi, n, endpoint=False):
        c, s = np.cos(a), np.sin(a)
        rows.append([60 * s, -60 * c, 0, -40 * s, 40 * c, 0,
                     pixel * c, pixel * s, 0, 0, 0, -pixel])  # fmt: skip
    return np.array(rows)


def run(body: Body, memory_limit: int = LIMIT, **options: Any) -> None:
    async def main() -> None:
        server = await serve_projector(memory_limit=memory_limit, **options)
        client = ProjectorUser(port=server.port, token=options.get("token"))
        try:
            # A first call may have to compile.
            await asyncio.wait_for(body(server, client), 300)
        finally:
            await client.close()
            await server.close()

    asyncio.run(main())


async def raw(
    server: ProjectorServer, *messages: dict[str, Any], answers: int | None = None
) -> list[Any]:
    """Speak the wire by hand: msgpack and four bytes of length, nothing of flexdt."""
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    for message in messages:
        body = msgpack.packb({"jsonrpc": "2.0", **message})
        writer.write(len(body).to_bytes(4, "big") + body)
    out = []
    for _ in range(len(messages) if answers is None else answers):
        size = int.from_bytes(await reader.readexactly(4), "big")
        out.append(msgpack.unpackb(await reader.readexactly(size)))
    writer.close()
    return out


def test_projections_of_voxels_and_scenes_are_those_of_the_projector() -> None:
    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        await client.put("v", VOLUME)
        await client.put("s", SCENE)
        cone = views(7)
        got = await client.project("v", cone, SHAPE)
        assert_array_equal(got, forward(VOLUME, cone, SHAPE))
        assert not got.flags.writeable
        assert got.dtype == np.float32
        assert_array_equal(
            await client.project("s", cone, SHAPE), project_scene(SCENE, cone, SHAPE)
        )
        held = {v.name: v for v in (await client.volumes()).volumes}
        assert held["v"].shape == [12, 10, 8]
        assert held["v"].center_mm == (0.1, -0.2, 0.3)
        assert held["s"].solids == 5
        health = await client.health()
        assert (health.volumes, health.views) == (2, 14)

    run(body)


def test_a_view_without_rays_is_refused_by_its_row() -> None:
    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        await client.put("v", VOLUME)
        await client.put("s", SCENE)
        many = 40  # more than are computed in one go
        assert many > compute.BLOCK_VIEWS
        flat = views(many)
        flat[35, 6:9] = 0
        parallel = views(many)
        parallel[36, 9:12] = 2 * parallel[36, 6:9]
        endless = views(many)
        endless[37, 4] = np.nan
        for rows, index in ((flat, 35), (parallel, 36), (endless, 37)):
            for name in ("v", "s"):
                with pytest.raises(RpcError, match=f"row {index}") as caught:
                    await client.project(name, rows, SHAPE)
                assert caught.value.code == Code.INVALID_PARAMS
            with pytest.raises(RpcError, match=f"row {index}") as caught:
                await backprojected(server, np.zeros((many, *SHAPE), np.float32), rows)
            assert caught.value.code == Code.INVALID_PARAMS
        assert (await client.project("v", views(1), SHAPE)).any()

    run(body)


def test_results_larger_than_a_frame_come_in_parts() -> None:
    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        await client.put("s", SCENE)
        cone = views(9, 0.02)
        shape = (1000, 1100)  # 4.4 MB a view
        whole = project_scene(SCENE, cone, shape)
        assert whole.nbytes > 2**25
        assert_array_equal(await client.project("s", cone, shape), whole)
        big = (2500, 2600)  # one view above a frame
        assert_array_equal(
            await client.project("s", cone[:1], big), project_scene(SCENE, cone[:1], big)
        )

    run(body)


def test_a_volume_of_many_chunks_arrives_whole() -> None:
    data = RNG.random((200, 120, 100), dtype=np.float32)  # 9.6 MB: two chunks
    big = Volume(data, 0.1)

    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        await client.put("big", big)
        cone = views(1, 0.2)
        assert_array_equal(
            await client.project("big", cone, SHAPE), forward(big, cone, SHAPE)
        )
        await client.put("big", VOLUME)
        assert_array_equal(
            await client.project("big", cone, SHAPE), forward(VOLUME, cone, SHAPE)
        )

    run(body)


async def backprojected(
    server: ProjectorServer, stack: Images, cone: ConeRows, into: str | None = None
) -> Images:
    """The adjoint on the grid of `VOLUME`; two views a request where a name is given."""
    grid = {"shape": list(VOLUME.shape), "voxel_mm": list(VOLUME.voxel_xyz),
            "center_mm": [float(c) for c in VOLUME.center_mm]}  # fmt: skip
    link = await ProjectorLink.connect("127.0.0.1", server.port)
    try:
        if into is None:
            params = {"grid": grid, "cone_vec": image.encode(cone),
                      "projections": image.encode(stack)}  # fmt: skip
            return await link.ask_array("backproject", params, VOLUME.shape)
        for k in range(0, len(stack), 2):
            params = {"grid": grid, "into": into, "cone_vec": image.encode(cone[k : k + 2]),
                      "projections": image.encode(stack[k : k + 2])}  # fmt: skip
            await link.ask("backproject", params)
        return await link.ask_array("volume.get", {"name": into}, VOLUME.shape)
    finally:
        link.close()


def test_backprojection_in_one_and_in_several_requests() -> None:
    cone = views(6)
    stack = RNG.random((6, *SHAPE), dtype=np.float32)
    expected = back(stack, cone, VOLUME)

    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        assert_array_equal(await backprojected(server, stack, cone), expected.data)
        made = await backprojected(server, stack, cone, into="sum")
        assert_allclose(made, expected.data, rtol=1e-5)
        await client.client.ask("volume.remove", {"name": "sum"})
        assert (await client.volumes()).volumes == []

    run(body)


def test_several_requests_at_once_each_get_their_own_answer() -> None:
    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        await client.put("v", VOLUME)
        cone = views(24)
        got = await asyncio.gather(*(client.project("v", row, SHAPE) for row in cone))
        assert_array_equal(np.concatenate(got), forward(VOLUME, cone, SHAPE))

    run(body)


class Gate:
    """Holds the compute thread until it is told to go on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.open = threading.Event()
        self.entered = threading.Event()
        self.computed: list[int] = []
        self.order: list[float] = []
        original = answers.projection_steps

        def gated(volume: Any, rows: Any, shape: Any, block: int) -> Any:
            for step in original(volume, rows, shape, block):

                def held(step: Any = step, mark: float = float(rows[0, 0])) -> object:
                    self.entered.set()
                    assert self.open.wait(20)
                    self.order.append(mark)
                    return step()

                yield held

        monkeypatch.setattr(answers, "projection_steps", gated)


async def until(condition: Callable[[], bool]) -> None:
    while not condition():
        await asyncio.sleep(0.002)


async def keyed(link: ProjectorLink, row: ConeRows) -> Images:
    params = {
        "volume": "v",
        "cone_vec": image.encode(row[None]),
        "detector": SHAPE,
        "key": "k",
    }
    return await link.ask_array("project", params, (1, *SHAPE))


def test_newest_wins_and_the_stale_are_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    gate = Gate(monkeypatch)

    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        await client.put("v", VOLUME)
        cone = views(6)
        tasks = []
        link = await ProjectorLink.connect("127.0.0.1", server.port)
        for row in cone:
            tasks.append(asyncio.create_task(keyed(link, row)))
            await until(gate.entered.is_set)
            await link.ask("health", {})  # the request before it has been queued
        gate.open.set()
        results = await asyncio.gather(*tasks, return_exceptions=True)
        link.close()
        codes = [getattr(r, "code", None) for r in results]
        assert codes == [None, *[Code.SUPERSEDED] * 4, None]
        assert_array_equal(results[-1], forward(VOLUME, cone[5], SHAPE))  # type: ignore[arg-type]
        assert (await client.health()).superseded == 4

    run(body)


def test_keys_of_different_clients_do_not_touch(monkeypatch: pytest.MonkeyPatch) -> None:
    gate = Gate(monkeypatch)

    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        await client.put("v", VOLUME)
        links = [await ProjectorLink.connect("127.0.0.1", server.port) for _ in range(2)]
        first = [asyncio.create_task(keyed(link, views(1)[0])) for link in links]
        await until(gate.entered.is_set)
        await until(lambda: server.context.waiting == 1)
        gate.open.set()
        assert all(isinstance(r, np.ndarray) for r in await asyncio.gather(*first))
        for link in links:
            link.close()

    run(body)


def test_a_long_scan_does_not_starve_another_clients_single_view(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gate = Gate(monkeypatch)

    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        await client.put("v", VOLUME)
        long = views(32 * 8)
        long[:, 0] += 1000.0  # recognisable
        scan = asyncio.create_task(client.project("v", long, SHAPE))
        await until(gate.entered.is_set)
        async with ProjectorUser(port=server.port) as other:
            single = asyncio.create_task(other.project("v", views(1), SHAPE))
            await until(lambda: server.context.waiting == 1)
            gate.open.set()
            await asyncio.gather(scan, single)
        position = next(i for i, mark in enumerate(gate.order) if mark < 500)
        assert len(gate.order) == 9
        assert position == 1

    run(body)


def test_a_cancelled_call_is_not_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    gate = Gate(monkeypatch)

    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        await client.put("v", VOLUME)
        cone = views(3)
        tasks = [asyncio.create_task(client.project("v", row, SHAPE)) for row in cone]
        await until(gate.entered.is_set)
        await until(lambda: server.context.waiting == 2)
        tasks[1].cancel()
        await until(lambda: server.context.waiting == 1)
        gate.open.set()
        results = await asyncio.gather(*tasks, return_exceptions=True)
        assert isinstance(results[1], asyncio.CancelledError)
        assert_array_equal(results[2], forward(VOLUME, cone[2], SHAPE))  # type: ignore[arg-type]
        assert len(gate.order) == 2

    run(body)


def test_an_id_in_use_is_refused_and_the_first_request_goes_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gate = Gate(monkeypatch)

    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        await client.put("v", VOLUME)
        threading.Timer(0.2, gate.open.set).start()
        ask = {"volume": "v", "cone_vec": views(1).tolist(), "detector": list(SHAPE)}
        message = {"id": 1, "method": "project", "params": ask}
        refused, answered = await raw(server, message, message)
        assert refused["error"]["code"] == -32600
        assert answered["result"]["shape"] == [1, *SHAPE]

    run(body)


def test_a_client_gone_in_mid_request_leaves_no_work(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gate = Gate(monkeypatch)

    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        await client.put("v", VOLUME)
        other = await ProjectorLink.connect("127.0.0.1", server.port)
        asked = [{"volume": "v", "cone_vec": image.encode(row[None]), "detector": SHAPE}
                 for row in views(5)]  # fmt: skip
        tasks = [asyncio.create_task(other.ask("project", params)) for params in asked]
        await until(gate.entered.is_set)
        await until(lambda: server.context.waiting == 4)
        other.close()
        await until(lambda: server.context.waiting == 0)
        gate.open.set()
        results = await asyncio.gather(*tasks, return_exceptions=True)
        assert all(isinstance(r, LinkLost) for r in results)
        assert (await client.project("v", views(1), SHAPE)).shape == (1, *SHAPE)
        assert (await client.health()).clients == 1

    run(body)


def test_the_memory_limit_is_an_error_that_says_what_is_left() -> None:
    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        await client.put("small", VOLUME)
        used = (await client.volumes()).memory_used
        assert used == 2 * VOLUME.data.nbytes
        with pytest.raises(RpcError) as caught:
            await client.put("big", Volume(np.zeros((100, 100, 100), np.float32), 1.0))
        assert caught.value.code == -32008
        assert caught.value.data["asked"] == 8_000_000  # type: ignore[index]
        assert caught.value.data["memory_used"] == used  # type: ignore[index]
        assert (await client.volumes()).memory_used == used
        assert (await client.project("small", views(1), SHAPE)).shape == (1, *SHAPE)
        [reply] = await raw(
            server,
            {
                "id": 1,
                "method": "volume.put",
                "params": {
                    "name": "x",
                    "grid": {"shape": [2**15] * 3, "voxel_mm": [0.1, 0.1, 0.1]},
                    "data": b"1234",
                },
            },
        )
        assert reply["error"]["code"] == -32008

    run(body, memory_limit=1_000_000)


def test_an_upload_of_a_client_that_goes_away_is_forgotten() -> None:
    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        put = {
            "name": "x",
            "grid": {"shape": [4, 4, 4], "voxel_mm": [1, 1, 1]},
            "data": b"1234",
        }
        [reply] = await raw(server, {"id": 1, "method": "volume.put", "params": put})
        assert reply["result"]["received"] == 4
        await until(lambda: server.context.store.used == 0)

    run(body)


def test_the_wire_by_hand() -> None:
    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        sphere = {"shape": {"kind": "sphere", "center": [0, 0, 0], "radius": 2.0},
                  "material": "steel", "mu_per_mm": 0.5}  # fmt: skip
        put = {"name": "ball", "scene": {"solids": [sphere]}}
        ask = {"volume": "ball", "cone_vec": views(2).tolist(), "detector": [3, 5]}
        stored, seen = await raw(
            server,
            {"id": 1, "method": "volume.put", "params": put},
            {"id": "b", "method": "project", "params": ask},
        )
        assert stored["result"]["complete"]
        assert seen["id"] == "b"
        image = np.frombuffer(seen["result"]["data"], "<f4").reshape(
            seen["result"]["shape"]
        )
        assert image.shape == (2, 3, 5)
        assert_allclose(image[:, 1, 2], 2 * 2.0 * 0.5, rtol=1e-6)  # through the centre

    run(body)


BAD: list[tuple[dict[str, Any], int]] = [
    ({"id": 1, "method": "project", "params": {}}, -32602),
    ({"id": 1, "method": "projekt"}, -32601),
    ({"id": 1, "method": "volume.get", "params": {"name": "nope"}}, -32602),
    ({"id": 1, "method": "volume.put", "params": {"name": "../x", "scene": {}}}, -32602),
    ({"id": 1, "method": "volume.put", "params": {"name": "x", "scene": {"solids": 7}}}, -32602),
    ({"id": 1, "method": "volume.put", "params": {
        "name": "x", "grid": {"shape": [2, 2, 2], "voxel_mm": [1, 1, 1]}, "start": 8,
        "data": b"12"}}, -32602),
    ({"id": 1, "method": "volume.put", "params": {
        "name": "x", "grid": {"shape": [1, 1, 1], "voxel_mm": [1, 1, 0]},
        "data": b"1234"}}, -32602),
    ({"id": 1, "method": "volume.put", "params": {
        "name": "x", "grid": {"shape": [1, 1, 1], "voxel_mm": [1, 1, 1]},
        "data": b"\x00\x00\xc0\x7f"}}, -32602),
    ({"id": 1, "method": "cancel", "params": {"request": 5}}, 0),
    ({"method": 7, "id": 1}, -32600),
    ({"id": 1, "result": 3}, -32600),
]  # fmt: skip


def project_with(**changes: object) -> dict[str, Any]:
    params = {"volume": "v", "cone_vec": views(1).tolist(), "detector": [3, 5], **changes}
    return {"id": 1, "method": "project", "params": params}


BAD += [
    (project_with(cone_vec=[[1.0] * 11]), -32602),
    (project_with(cone_vec=[[float("nan")] * 12]), -32602),
    (project_with(cone_vec=[["1"] * 12]), -32602),
    (project_with(cone_vec=[]), -32602),
    (project_with(cone_vec={"dtype": "object", "shape": [1, 12], "data": b""}), -32602),
    (
        project_with(cone_vec={"dtype": "float64", "shape": [2, 12], "data": b"123"}),
        -32602,
    ),
    (project_with(detector=[0, 5]), -32602),
    (project_with(detector=[30000, 30000]), -32008),
    (project_with(volume="w"), -32602),
]


def test_bad_requests_get_their_codes_and_the_server_lives_on() -> None:
    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        await client.put("v", VOLUME)
        for message, code in BAD:
            [reply] = await raw(server, message)
            assert reply.get("error", {}).get("code", 0) == code, (message, reply)
        assert (await client.project("v", views(1), SHAPE)).shape == (1, *SHAPE)

    run(body)


def test_broken_bytes_half_a_frame_and_answers_end_in_an_error() -> None:
    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        await client.put("v", VOLUME)
        an_answer = msgpack.packb({"jsonrpc": "2.0", "id": 1, "result": None})
        for sent, code in (
            (b"GET / HTTP/1.1\r\n\r\n", -32008),
            (b"\xff\xff\xff\xff" + b"x" * 100, -32008),
            (b"\x00\x00\x00\x05\xc1\xc1\xc1\xc1\xc1", -32700),
            (b"\x00\x00\x00\x05\xdd\x00\xff\xff\xff", -32700),
            (b"\x00\x00\x00\x00", -32700),
            (b"\x00\x00\x10", -32700),
            (b"\x00\x00\x10\x00abc", -32700),
            (len(an_answer).to_bytes(4, "big") + an_answer, -32600),
        ):
            reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
            writer.write(sent)
            writer.write_eof()
            got = await reader.read()
            error = msgpack.unpackb(got[4:])
            assert (error["id"], error["error"]["code"]) == (None, code), sent
            writer.close()
        assert (await client.project("v", views(1), SHAPE)).shape == (1, *SHAPE)

    run(body)


@pytest.mark.parametrize("requests", [1, 60])
def test_a_client_that_never_reads_is_cut_off_and_others_are_served(
    requests: int,
) -> None:
    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        await client.put("s", SCENE)
        _, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.transport.pause_reading()  # type: ignore[attr-defined]
        each = views(300, 0.02).reshape(requests, -1, 12)
        for id, rows in enumerate(each):
            asked = {"volume": "s", "cone_vec": rows.tolist(), "detector": [700, 700]}
            message = {"jsonrpc": "2.0", "id": id, "method": "project", "params": asked}
            body = msgpack.packb(message)
            writer.write(len(body).to_bytes(4, "big") + body)
        for _ in range(5):
            assert (await client.project("s", views(1), SHAPE)).shape == (1, *SHAPE)
        await until(lambda: len(server.context.clients) == 1)
        await until(lambda: server.context.waiting == 0)
        views_made = (await client.health()).views
        assert views_made < 200  # nothing was computed for long that nobody took
        writer.close()

    run(body, limits=ConnectionLimits(send_timeout_s=0.5))


def test_a_restarted_server_gets_the_volumes_again() -> None:
    async def main() -> None:
        server = await serve_projector(memory_limit=LIMIT)
        port = server.port
        client = ProjectorUser(port=port, patience_s=60.0)
        await client.put("v", VOLUME)
        await client.put("s", SCENE)
        before = await client.project("v", views(2), SHAPE)
        await server.close()
        waiting = asyncio.create_task(client.project("v", views(2), SHAPE))
        await asyncio.sleep(0.1)
        assert not waiting.done()
        server = await serve_projector(port=port, memory_limit=LIMIT)
        assert_array_equal(await waiting, before)
        assert (await client.project("s", views(1), SHAPE)).any()
        assert len((await client.volumes()).volumes) == 2
        await client.close()
        await server.close()

    asyncio.run(main())


def test_a_volume_removed_by_somebody_else_is_sent_again() -> None:
    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        await client.put("v", VOLUME)
        async with ProjectorUser(port=server.port) as other:
            await other.remove("v")
        assert (await client.project("v", views(1), SHAPE)).shape == (1, *SHAPE)
        with pytest.raises(RpcError, match="no volume 'w'"):
            await client.project("w", views(1), SHAPE)

    run(body)


def test_nobody_there_is_projector_unavailable() -> None:
    async def main() -> None:
        client = ProjectorUser(port=1, patience_s=0.1)
        with pytest.raises(ProjectorUnavailable, match=r"no projector at 127\.0\.0\.1:1"):
            await client.project("v", views(1), SHAPE)

    asyncio.run(main())


def test_tokens_and_addresses() -> None:
    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        assert (await client.health()).clients == 1
        stranger = ProjectorUser(port=server.port)
        with pytest.raises(RpcError) as caught:
            await stranger.health()
        assert caught.value.code == -32602 or caught.value.code == -32004
        [reply] = await raw(server, {"id": 1, "method": "health"})
        assert reply["error"]["code"] == -32004

    run(body, token="a token of sixteen letters")
    with pytest.raises(AccessError, match="token"):
        asyncio.run(serve_projector("0.0.0.0", memory_limit=LIMIT))


def test_the_event_loop_stays_free_while_kernels_run() -> None:
    """Health is answered while a long job is computed: the kernels release the interpreter."""

    async def body(server: ProjectorServer, client: ProjectorUser) -> None:
        await client.put("v", VOLUME)
        scan = asyncio.create_task(client.project("v", views(400), (300, 400)))
        answered = 0
        while not scan.done():
            await client.health()
            answered += 1
        await scan
        assert answered >= 5

    run(body)


def test_health_names_what_computes(monkeypatch: pytest.MonkeyPatch) -> None:
    for present, reason, expected in (
        (False, "no CUDA driver on this machine", "numba"),
        (True, "NVIDIA X", "NVIDIA X (CUDA), numba"),
    ):
        found = gpu.Availability(present, reason)
        monkeypatch.setattr(gpu, "availability", lambda found=found: found)
        assert kernels.backend() == expected


DEVICES = """
import numpy as np
from flexdt.server.projector import compute
from flexdt.twin.projection import Volume, gpu
from flexdt.twin.projection.kernels import gpu_kernels
from tests.support.device_simulator import two_devices
from tests.twin.projection.conftest import _circle

assert gpu.availability().present
gpu_kernels.BLOCK = (4, 2)
launches, shape = two_devices(), (4, 5)
rng = np.random.default_rng(2)
rows = _circle(37, 60.0, 100.0, 1.2, start=0.2, height=1.0).rows

def projected(volume, block):
    "Images, and the devices that computed each block."
    images, used = [], []
    for step in compute.projection_steps(volume, rows, shape, block):
        launches.clear()
        images.append(step())
        used.append(set(launches))
    return np.concatenate(images), used

# A volume that is worth no move for one block goes there once a few blocks would have paid for it.
compute.BLOCK_BYTES = 4 * 20 * 4
assert compute.views_a_block(shape) == 4
volumes = [Volume(rng.random((5, 5, 3), dtype=np.float32), 0.5) for _ in range(3)]
with gpu.switched_off():
    right, used = projected(volumes[0], 16)
    assert used == [set()] * 3
gpu.WORTH_BYTES, gpu.VIEWS_A_THREAD = 0, 20 / compute.numba.get_num_threads()
here, there = [set()], [{0}]
for block, wanted in ((16, here + there * 2), (4, here * 4 + there * 6), (37, there)):
    images, used = projected(volumes.pop(), block)
    if block == 37:
        assert np.abs(images - right).max() < 3e-6 * right.max() and right.max() > 0
    assert used == wanted, (block, used)
gpu.WORTH_BYTES = 2**26
assert projected(Volume(rng.random((5, 5, 3), dtype=np.float32), 0.5), 4)[1] == here * 10
"""


@pytest.mark.slow
def test_the_volume_of_a_scan_goes_to_the_device_once_its_blocks_pay_for_that() -> None:
    run_simulated(DEVICES)


@pytest.mark.parametrize("kind", ["half a frame", "an answer nobody asked for"])
def test_a_projector_that_breaks_the_protocol_is_left(
    kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    """One that was killed may leave half a frame: that is no error of anybody's."""
    wire = Connection(Codec.MSGPACK)
    last, why = {
        "half a frame": (wire.send(Response(1, {}))[:-3], "inside a frame"),
        "an answer nobody asked for": (wire.send(Response(77, {})), "not open"),
    }[kind]

    async def broken(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(1 << 16)
        writer.write(last)
        await writer.drain()
        writer.close()

    async def body() -> None:
        server = await asyncio.start_server(broken, "127.0.0.1", 0)
        channel = await ProjectorLink.connect(
            "127.0.0.1", server.sockets[0].getsockname()[1]
        )
        async with asyncio.timeout(30.0):
            with pytest.raises(LinkLost, match=f"broke the protocol.*{why}"):
                await channel.ask("health", {})
        assert channel.lost
        server.close()

    asyncio.run(body())
    level = logging.WARNING if kind == "half a frame" else logging.ERROR
    assert {
        r.levelno for r in caplog.records if "broke the protocol" in r.getMessage()
    } == {level}
