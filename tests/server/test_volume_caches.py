"""Samples in the memory of twin and projector: the least recently used go, what is in use
stays."""

from __future__ import annotations

import asyncio
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from in_process import Lab, run, script

from flexdt.protocol import Code, RpcError
from flexdt.protocol.projector import unknown_volume
from flexdt.server.imaging.projections import Imaging
from flexdt.server.imaging.projector_client import ProjectorClient
from flexdt.server.imaging.projector_pool import ProjectorPool
from flexdt.server.projector.service import serve_projector
from flexdt.server.projector.volume_store import VolumeStore
from flexdt.twin.projection import Volume
from flexdt.twin.scanner.state import Sample
from tests.support.shelf import CAMERA, POSES, Shelf, block, brightest, imaging_of

TOO_LARGE = -32008
SIDE = 8
TAKES = 2 * 4 * SIDE**3
"""Bytes of a volume of SIDE^3 in the projector."""
FLOAT_BYTES = 4


def volume_of(voxels: int) -> Volume:
    return Volume(np.zeros((1, 1, voxels), np.float32), 1.0)


@pytest.mark.parametrize("seed", range(20))
def test_the_store_forgets_as_a_list_by_last_use_does(seed: int) -> None:
    rng, limit = random.Random(seed), 4000
    store, model = VolumeStore(limit), list[tuple[str, int, bool]]()  # the oldest first
    for _ in range(300):
        name, size = f"v{rng.randint(0, 12)}", rng.randint(1, 120)
        there = next((entry for entry in model if entry[0] == name), None)
        match rng.choice(["put", "put", "get", "remove"]):
            case "put":
                evictable, nbytes = rng.random() < 0.7, 2 * FLOAT_BYTES * size
                others = [entry for entry in model if entry is not there]
                held = sum(entry[1] for entry in others if not entry[2])
                if held + nbytes > limit:
                    with pytest.raises(RpcError) as caught:
                        store.put(name, volume_of(size), evictable=evictable)
                    assert caught.value.data["allowed"] == limit - held  # type: ignore[index]
                    continue
                store.put(name, volume_of(size), evictable=evictable)
                while sum(entry[1] for entry in others) + nbytes > limit:
                    others.remove(next(entry for entry in others if entry[2]))
                model = [*others, (name, nbytes, evictable)]
            case "get" if there is not None:
                store.get(name)
                model = [*(entry for entry in model if entry is not there), there]
            case "remove":
                assert store.remove(name) is (there is not None)
                model = [entry for entry in model if entry is not there]
        assert {v.name for v in store.describe()} == {entry[0] for entry in model}
        assert store.used == sum(entry[1] for entry in model) <= limit
        assert store.evictable == sum(entry[1] for entry in model if entry[2])


def with_projector(work: Any, limit: int, projectors: int = 1) -> None:
    async def main() -> None:
        servers = [await serve_projector(memory_limit=limit) for _ in range(projectors)]
        pool = ProjectorPool([ProjectorClient(port=server.port) for server in servers])
        try:
            await asyncio.wait_for(work(pool), 300)
        finally:
            await pool.close()
            for server in servers:
                await server.close()

    asyncio.run(main())


def limited(pool: ProjectorPool, shelf: Shelf, limit: int | None = None) -> Imaging:
    imaging = imaging_of(pool, shelf)
    imaging.memory_limit, imaging.room = limit, pool.room
    return imaging


def test_any_number_of_samples_is_shown_within_the_limits() -> None:
    """Room for three: names come by turns and at random, each is shown as it is."""
    mu = {f"s{i}": 0.001 * (i + 1) for i in range(40)}
    shelf, rng = (
        Shelf(**{name: block(value, SIDE) for name, value in mu.items()}),
        random.Random(1),
    )

    async def work(pool: ProjectorPool) -> None:
        imaging = limited(pool, shelf, 3 * TAKES // 2)
        imaging.pinned = lambda: [Sample("s7")]
        for name in [*mu, *rng.choices(list(mu), k=40)]:
            seen = await brightest(imaging, name)
            assert 24.0 * mu[name] <= seen < 24.0 * 1.5 * mu[name]
            health = await pool._members[0].client.health()
            assert health.memory_used <= 3 * TAKES
            used = sum(apart.nbytes for apart in imaging._divided.values())
            assert used <= 3 * TAKES // 2
            assert ("s7", "part") in imaging._divided or name < "s7"
            assert len(pool._values) == len(imaging._versions) == len(imaging._divided)

    with_projector(work, 3 * TAKES)


def test_a_new_twin_displaces_what_an_old_one_left_and_twins_take_turns() -> None:
    async def work(pool: ProjectorPool) -> None:
        port = pool._members[0].client.port
        others = [ProjectorPool([ProjectorClient(port=port)]) for _ in range(2)]
        twins = [limited(p, Shelf(thing=block(0.01 * (i + 1), SIDE)))
                 for i, p in enumerate([pool, *others])]  # fmt: skip
        for _ in range(3):  # room for one volume
            found = await asyncio.gather(*(brightest(twin) for twin in twins))
            for i, seen in enumerate(found):
                assert 0.24 * (i + 1) <= seen < 0.36 * (i + 1)
        for other in others:
            await other.close()

    with_projector(work, TAKES)


def test_what_another_client_keeps_is_not_forgotten_and_the_figures_are_said() -> None:
    async def work(pool: ProjectorPool) -> None:
        client = pool._members[0].client
        client._evicts = False  # as clients put volumes that they rely on
        await client.give("mine", volume_of(TAKES // 16))
        assert client._evicts  # the server says that it can
        await client.ask("volume.remove", {"name": "mine"})
        grid = {"shape": [1, 1, TAKES // 8], "voxel_mm": [1.0, 1.0, 1.0]}
        await client.ask("volume.put", {"name": "mine", "grid": grid, "start": 0,
                                        "data": bytes(TAKES // 2)})  # fmt: skip
        imaging = limited(pool, Shelf(thing=block(0.02, SIDE)))
        with pytest.raises(RpcError) as caught:
            await imaging.require_room(Sample("thing"), "part")
        assert caught.value.code == TOO_LARGE
        assert caught.value.data["asked"] == TAKES  # type: ignore[index]
        assert caught.value.data["allowed"] == TAKES // 2  # type: ignore[index]
        with pytest.raises(RpcError):
            await imaging.line_integrals(Sample("thing"), POSES, CAMERA)
        await client.ask("volume.remove", {"name": "mine"})
        await imaging.require_room(Sample("thing"), "part")
        assert await brightest(imaging) > 0.24

    with_projector(work, TAKES + TAKES // 2)


def upload(name: str, side: int) -> dict[str, Any]:
    voxels = np.full((side,) * 3, 0.02, "<f4").tobytes()
    return {"name": name, "kind": "voxels", "format": "raw", "shape": [side] * 3,
            "voxel_mm": [0.5] * 3, "total": len(voxels), "data": voxels}  # fmt: skip


def test_a_scan_whose_sample_cannot_be_held_is_refused_with_the_figures(
    tmp_path: Path,
) -> None:
    left: list[int | None] = [None]

    async def room() -> int | None:
        return left[0]

    async def body(lab: Lab) -> None:
        c = lab.client()
        for name, side in (("little", 4), ("large", 16)):
            await c.call("sample.upload", **upload(name, side))
        await c.call("sample.set", file="large")
        left[0] = 30_000
        error = await c.error("script.submit", text=script(3))
        assert (error.code, error.data["asked"], error.data["allowed"]) == (
            TOO_LARGE, 2 * 4 * 16**3, 30_000)  # fmt: skip
        assert "'large' in the memory of the projector" in error.message
        left[0] = None  # not known: the scan is taken
        job = (await c.call("script.submit", text=script(3)))["job"]
        assert (await lab.ended(c, job))["state"] == "done"
        await c.call("sample.upload", **upload("huge", 24))
        await c.call("sample.set", file="huge")
        error = await c.error("script.submit", text=script(3))
        assert (error.code, error.data["asked"]) == (TOO_LARGE, 4 * 24**3)
        assert "'huge' in the memory of the twin" in error.message
        await c.call("sample.set", file="little")
        job = (await c.call("script.submit", text=script(3)))["job"]
        assert (await lab.ended(c, job))["state"] == "done"

    run(tmp_path, body, memory_limit=40_000, projector_room=room)


def test_a_scan_that_no_projector_takes_fails_and_the_next_one_runs(
    tmp_path: Path,
) -> None:
    """What fills the projector may come after the submission."""

    async def body(lab: Lab) -> None:
        c, put = lab.client(), lab.projector.put
        await c.call("sample.upload", **upload("large", 16))
        await c.call("sample.set", file="large")

        async def full(name: str, body: object) -> None:
            raise RpcError(TOO_LARGE, "volume 'large' of 32768 bytes is too large", {})

        lab.projector.put = full  # type: ignore[method-assign]
        first = (await c.call("script.submit", text=script(3)))["job"]
        status = await lab.ended(c, first)
        assert (status["state"], status["error"]["code"]) == ("failed", TOO_LARGE)
        lab.projector.put = put  # type: ignore[method-assign]
        await c.call("job.resume", job=first)
        assert (await lab.ended(c, first))["state"] == "done"

    run(tmp_path, body)


@pytest.mark.parametrize(("there", "lost"), [(["theirs"], 40), ([], 4), ([], 5)])
def test_a_volume_that_others_displace_is_sent_until_it_is_projected(
    monkeypatch: pytest.MonkeyPatch, there: list[str], lost: int
) -> None:
    """Twins that took turns on a busy machine ended after five displacements; a projector
    that loses volumes by itself still ends the request."""
    client, sent = ProjectorClient(port=1), list[str]()
    answer = np.zeros((1, *CAMERA.shape), np.float32)

    async def give(name: str, body: object) -> None:
        sent.append(name)

    async def ask(method: str, work: object) -> np.ndarray[Any, np.dtype[np.float32]]:
        if len(sent) > lost:
            return answer
        raise unknown_volume("mine", there)

    monkeypatch.setattr(client, "give", give)
    monkeypatch.setattr(client, "_ask", ask)
    work = client.project("mine", volume_of(1), POSES.cone_vec(), CAMERA.shape)
    if there or lost < 5:
        assert asyncio.run(work) is answer
        assert len(sent) == lost + 1
    else:
        with pytest.raises(RpcError, match="no volume 'mine'"):
            asyncio.run(work)
        assert len(sent) == 5


@pytest.mark.parametrize("data", [
    None,
    {"allowed": ["volume", "cone_vec", "detector"]},
    {"problems": [{"path": "cone_vec", "message": "row 3", "asked": "mine"}], "allowed": []},
    {"problems": [{"path": "volume", "message": "too short", "asked": "mine"}], "allowed": ["a"]},
    unknown_volume("theirs", ["a"]).data,
])  # fmt: skip
def test_only_an_unknown_volume_is_sent_again(
    monkeypatch: pytest.MonkeyPatch, data: object
) -> None:
    """A refused row lists the method's parameters: that was taken for volumes of others, and
    the request repeated for ever."""
    client, sent = ProjectorClient(port=1), list[str]()

    async def give(name: str, body: object) -> None:
        sent.append(name)

    async def ask(method: str, work: object) -> np.ndarray[Any, np.dtype[np.float32]]:
        raise RpcError(Code.INVALID_PARAMS, "refused", data)

    monkeypatch.setattr(client, "give", give)
    monkeypatch.setattr(client, "_ask", ask)
    with pytest.raises(RpcError, match="refused"):
        asyncio.run(client.project("mine", volume_of(1), POSES.cone_vec(), CAMERA.shape))
    assert sent == ["mine"]
