"""Several projectors behind one twin: bytes as from one, whoever is lost, stopped or slow."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
import time
import urllib.request
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lab import Process, Wire, digests, fly_script, projector, twin

from flexdt.protocol import Code, RpcError
from flexdt.runtime.wire_errors import ProjectorUnavailable
from flexdt.server.imaging.projector_pool import ProjectorPool
from flexdt.testing.in_process import SimulatedLoop
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection.analytic_solids import Scene, Solid, Sphere

FRAMES = 121
SCENE = Scene((Solid(Sphere((0, 0, 0), 2.0), "steel", 0.5),))
VIEWS = ConeVec.circular(sod=600, sdd=1000, angles=4, shape=(2, 2), pixel=1)


@dataclass(eq=False)
class Stand:
    """Stands for a projector's client; answers after `pace_s` a view, on the loop's clock."""

    port: int
    pace_s: float = 0.01
    fails: Callable[[], Exception | None] = lambda: None
    backend: str = "numba"
    stopped: asyncio.Event | None = None
    held: dict[str, Scene] = field(default_factory=dict)
    calls: list[float] = field(default_factory=list)
    busy: int = 0
    most: int = 0
    host: str = "host"
    connected: bool = True

    async def health(self) -> Any:
        self.check()
        return SimpleNamespace(version="1", backend=self.backend)

    def check(self) -> None:
        if (error := self.fails()) is not None:
            raise error

    async def give(self, name: str, scene: Scene) -> None:
        self.check()
        self.held[name] = scene

    async def remove(self, name: str) -> None:
        self.check()
        del self.held[name]

    async def project(
        self, name: str, body: Scene, views: ConeVec, shape: tuple[int, int]
    ) -> Any:
        self.calls.append(asyncio.get_running_loop().time())
        self.busy += 1
        self.most = max(self.most, self.busy)
        try:
            if self.stopped is not None:
                await self.stopped.wait()
            await asyncio.sleep(self.pace_s * len(views))
            self.check()
            thickness = float(self.held[name].solids[0].mu_per_mm)
            return np.full((len(views), *shape), thickness, np.float32)
        finally:
            self.busy -= 1

    async def close(self) -> None:
        self.connected = False


def on_virtual_time(work: Callable[[], Awaitable[None]]) -> None:
    with asyncio.Runner(loop_factory=lambda: SimulatedLoop(random.Random(4))) as runner:
        runner.run(work())  # type: ignore[arg-type]


def pool_of(*stands: Stand) -> ProjectorPool:
    return ProjectorPool(stands, patience_s=10.0)  # type: ignore[arg-type]


def test_views_are_dealt_by_speed_and_a_volume_of_the_same_name_replaces_the_old_one() -> (
    None
):
    quick, slow = Stand(1, pace_s=0.01), Stand(2, pace_s=0.04)

    async def work() -> None:
        pool = pool_of(quick, slow)
        await pool.put("s", SCENE)
        asked = [pool.project("s", VIEWS, (2, 2)) for _ in range(100)]
        images = await asyncio.gather(*asked)
        assert {float(image.max()) for image in images} == {0.5}
        # 100 requests, four to one: 80 and 20.
        assert len(quick.calls) == pytest.approx(80, abs=4)
        assert len(quick.calls) + len(slow.calls) == 100
        assert (quick.most, slow.most) == (2, 2)
        assert pool.views == {
            "host:1": 4 * len(quick.calls),
            "host:2": 4 * len(slow.calls),
        }
        await pool.put("s", Scene((Solid(Sphere((0, 0, 0), 2.0), "steel", 0.7),)))
        again = await asyncio.gather(
            *(pool.project("s", VIEWS, (2, 2)) for _ in range(20))
        )
        assert {round(float(image.max()), 6) for image in again} == {0.7}

    on_virtual_time(work)


def test_one_that_is_stopped_delays_only_what_it_has_and_works_again_when_it_goes_on() -> (
    None
):
    async def work() -> None:
        good, other = Stand(1), Stand(2)
        pool = pool_of(good, other)
        await pool.put("s", SCENE)
        await asyncio.gather(*(pool.project("s", VIEWS, (2, 2)) for _ in range(20)))
        other.stopped = asyncio.Event()
        before, loop = len(other.calls), asyncio.get_running_loop()
        begun = loop.time()
        await asyncio.gather(*(pool.project("s", VIEWS, (2, 2)) for _ in range(200)))
        assert len(other.calls) == before + 2, "what it does not answer fills its places"
        # 200 * 4 views by one at two a time; what the other has is asked anew after 1.24 s + .
        assert loop.time() - begun < 200 * 4 * 0.01 / 2 + 2.0
        other.stopped.set()
        await asyncio.sleep(0.1)
        await asyncio.gather(*(pool.project("s", VIEWS, (2, 2)) for _ in range(20)))
        assert len(other.calls) > before + 8
        await pool.close()
        assert not pool.connected

    on_virtual_time(work)


def test_what_is_lost_goes_to_another_and_the_lost_one_is_asked_again_after_a_rest() -> (
    None
):
    async def work() -> None:
        loop = asyncio.get_running_loop()
        back_at = loop.time() + 3.0

        def away() -> Exception | None:
            return ProjectorUnavailable("gone") if loop.time() < back_at else None

        lost, good = Stand(1, fails=away), Stand(2)
        pool = pool_of(lost, good)
        await pool.put("s", SCENE)
        while loop.time() < 5.0:
            image = await pool.project("s", VIEWS, (2, 2))
            assert image.shape == (4, 2, 2)
        assert pool.views["host:1"] > 0
        # All gone: the pool's patience, then an error; as soon as one is there it goes on.
        gone = Stand(3, fails=lambda: ProjectorUnavailable("no projector at host:3"))
        begun = loop.time()
        with pytest.raises(ProjectorUnavailable, match="host:3"):
            await pool_of(gone, Stand(4, fails=gone.fails)).put("s", SCENE)
        assert 10.0 <= loop.time() - begun < 13.0
        back_at = loop.time() + 4.0
        late = pool_of(Stand(5, fails=away), Stand(6, fails=gone.fails))
        await late.put("s", SCENE)
        assert (await late.project("s", VIEWS, (2, 2))).max() == np.float32(0.5)

    on_virtual_time(work)


def test_errors_a_small_memory_and_calls_given_up() -> None:
    small = RpcError(Code.TOO_LARGE, "too large")

    async def work() -> None:
        tiny, big = Stand(1, fails=lambda: small), Stand(2)
        pool = pool_of(tiny, big)
        await pool.put("s", SCENE)
        for _ in range(20):
            await pool.project("s", VIEWS, (2, 2))
        assert len(tiny.calls) == 0
        with pytest.raises(RpcError, match="too large"):
            await pool_of(tiny, Stand(3, fails=tiny.fails)).put("s", SCENE)
        wrong = Stand(4, fails=lambda: RpcError(Code.INVALID_PARAMS, "wrong"))
        with pytest.raises(RpcError, match="wrong"):
            await pool_of(wrong, wrong).put("s", SCENE)
        # A call that is given up leaves its place free, also one that has not begun.
        for wait_s in (0.0, 0.01) * 10:
            call = asyncio.ensure_future(pool.project("s", VIEWS, (2, 2)))
            await asyncio.sleep(wait_s)
            call.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await call
        assert (await pool.project("s", VIEWS, (2, 2))).max() == np.float32(0.5)
        assert big.most <= 2

    on_virtual_time(work)


def test_projectors_of_different_kinds_are_told(caplog: pytest.LogCaptureFixture) -> None:
    async def work() -> None:
        pool = pool_of(Stand(1), Stand(2, backend="H200 (CUDA), numba"))
        await pool.put("s", SCENE)
        await asyncio.gather(*(pool.project("s", VIEWS, (2, 2)) for _ in range(4)))

    on_virtual_time(work)
    assert "last digits" in caplog.text


# -- processes -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pool() -> Iterator[list[Process]]:
    made = [projector() for _ in range(3)]
    yield made
    for process in made:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGCONT)
        process.end()


def scanned(wire: Wire, name: str, after: Callable[[], None] = lambda: None) -> None:
    """A scan; `after` is called once when 10 frames are there and many are not."""
    job = wire.call("script.submit", text=fly_script(FRAMES), name=name, seed=4)["job"]
    while (status := wire.call("job.status", job=job))["frames_done"] < 10:
        time.sleep(0.002)
    assert status["frames_done"] < FRAMES - 10
    after()
    wire.wait(job, "done")


def views(process: Process) -> dict[str, float]:
    url = f"http://127.0.0.1:{process.ready['http_port']}/metrics"
    with urllib.request.urlopen(url, timeout=20) as answer:
        lines = answer.read().decode().splitlines()
    found = [x.split(" ") for x in lines if x.startswith("flexdt_projector_views_total{")]
    return {name.split('"')[1]: float(count) for name, count in found}


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_a_scan_survives_kill_and_stop_of_projectors_with_the_bytes_of_one(
    pool: list[Process], tmp_path: Path
) -> None:
    alone = twin(pool[0].port, tmp_path / "one", "--speed-up", "max")
    wire = Wire(alone.port)
    scanned(wire, "scan")
    alone.end()
    expected = digests(next((tmp_path / "one").glob("**/scan_000000.tif")).parent)
    assert len(expected) == FRAMES + 2
    others = ",".join(f"127.0.0.1:{p.port}" for p in pool[1:])
    process = twin(
        pool[0].port, tmp_path / "many", "--projectors", others, "--speed-up", "max",
        "--http-port", 0,
    )  # fmt: skip

    def same(name: str) -> bool:
        file = next((tmp_path / "many").glob(f"**/*{name}*/scan_000000.tif"))
        return digests(file.parent) == expected

    try:
        wire = Wire(process.port)
        scanned(wire, "whole")
        assert same("whole")
        made = views(process)
        assert len(made) == 3
        assert min(made.values()) > 0
        # One is stopped: the scan ends all the same.
        scanned(wire, "stopped", lambda: os.kill(pool[1].pid, signal.SIGSTOP))
        assert same("stopped")
        os.kill(pool[1].pid, signal.SIGCONT)
        # One is killed: no pause, no frame lost, and two are left.
        scanned(wire, "killed", lambda: os.kill(pool[2].pid, signal.SIGKILL))
        assert same("killed")
        after = views(process)  # the one that was stopped works again
        assert after[f"127.0.0.1:{pool[1].port}"] > made[f"127.0.0.1:{pool[1].port}"]
        assert not [x for x in process.logged("error") if "job" in str(x)]
    finally:
        process.end()
