"""`flexdt.testing`: a twin in process on a virtual clock, its fixture, and what is drawn."""

from __future__ import annotations

import asyncio
import doctest
import hashlib
import importlib
import json
import math
import re
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, assume, given, reject, settings
from hypothesis import strategies as st
from in_process import script

import flexdt as fx
from flexdt.clients import AsyncTwinClient, RpcError
from flexdt.protocol import Code
from flexdt.testing import Deadlock, InProcessTwin, twin
from flexdt.testing.fixtures import flexdt_twin
from flexdt.testing.strategies import geometries, machines
from flexdt.twin.machine.description import Machine

__all__ = ["flexdt_twin"]

ROOT = Path(__file__).resolve().parents[2]
FAST = 100.0
"""Twin seconds a second of the loop, where nobody looks at what is between."""
BLOCKS = re.findall(
    r"```\{code-block\} python\n(.*?)```",
    (ROOT / "docs/clients.md").read_text("utf-8"),
    re.S,
)


def block(mark: str) -> dict[str, Any]:
    (text,) = (b for b in BLOCKS if mark in b)
    assert len([line for line in text.splitlines() if line.strip()]) <= 15
    space: dict[str, Any] = {}
    exec(compile(text, "clients.md", "exec"), space)
    return space


def travelled(way: float, speed: float, acceleration: float, t: float) -> float:
    """Own integral of speed, by trapezoids: up by `acceleration` to `speed` at most, and
    down."""
    rise = min(speed / acceleration, math.sqrt(way / acceleration))
    whole = way / (acceleration * rise) + rise
    bends = np.clip([rise, whole - rise, whole], 0.0, t)  # between which speed is linear
    steps = np.sort(np.append(np.linspace(0.0, t, 2001), bends))
    v = acceleration * np.clip(np.minimum(steps, whole - steps), 0.0, rise)
    return float(((v[1:] + v[:-1]) / 2.0 * np.diff(steps)).sum())


# The page ---------------------------------------------------------------------------------------


def test_the_pages_test_holds(flexdt_twin: InProcessTwin) -> None:
    block("flexdt_twin")["test_a_turn_is_half_done_at_half_time"](flexdt_twin)


def test_the_pages_property_holds() -> None:
    settings(max_examples=20)(block("geometries")["test_what_is_printed_is_right"])()


def test_the_examples_hold() -> None:
    for name in ("in_process", "strategies"):
        module = importlib.import_module(f"flexdt.testing.{name}")
        found = doctest.testmod(module, extraglobs={"given": given})
        assert found.attempted > 0
        assert found.failed == 0


# Time -------------------------------------------------------------------------------------------


@settings(
    max_examples=15, deadline=None, phases=[Phase.generate], database=None
)  # no shrinking
@given(
    machine=machines(), draw=st.data(), to=st.floats(0.0, 1.0), part=st.floats(0.0, 1.2)
)
@pytest.mark.slow
def test_any_machines_motors_move_as_its_file_says(
    machine: Machine, draw: st.DataObject, to: float, part: float
) -> None:
    motor = draw.draw(st.sampled_from(sorted(machine.axes)))
    axis = machine.axes[motor]
    target = axis.lower + to * (axis.upper - axis.lower)
    assume(abs(target - axis.home) > 1e-3)
    with twin(machine=machine, speed_up=FAST) as scanner:
        try:
            move = scanner.client.move({motor: target})
        except RpcError as refused:
            if refused.code != Code.COLLISION:
                raise
            reject()
        moment = part * move.duration_s
        scanner.advance(moment / FAST)
        seen = scanner.client.state()
    way = abs(target - axis.home)
    gone = travelled(way, axis.speed, axis.acceleration, moment)
    assert seen.time == pytest.approx(moment, rel=1e-6, abs=1e-6)
    there = seen.axes[motor]
    assert abs(there.position - axis.home) == pytest.approx(
        gone, rel=1e-6, abs=1e-6 * way
    )
    assert there.moving == (part < 1.0)


def test_time_passes_in_calls_that_wait_and_at_no_other_time() -> None:
    begun = time.perf_counter()
    with twin(speed_up=10.0) as scanner:
        client = scanner.client
        client.move({"rot_obj": 90.0})
        assert [client.state().time for _ in range(5)] == [0.0] * 5
        assert client.state().axes["rot_obj"].position == 0.0
        client.move({"rot_obj": 7200.0}, wait=True)
        assert client.state().time == pytest.approx(
            162.0, abs=0.01
        )  # 7200 / 45 + 45 / 22.5
        with client.subscribe("state") as events:
            client.move({"rot_obj": 7110.0})
            moving = [False]
            while moving[-1] or True not in moving:
                moving.append(events.next().data.axes["rot_obj"].moving)  # type: ignore[union-attr]
        assert client.state().time == pytest.approx(166.0, abs=1.0)
        scanner.advance(3600.0)
        assert client.state().time > 36_000.0
    assert time.perf_counter() - begun < 60.0


@pytest.mark.parametrize("speed_up", [FAST, "max"])
def test_nothing_sleeps_listens_or_starts_a_thread_or_process(
    speed_up: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And a scan with as many checks as make a server start a process is done to its last
    file."""

    def forbidden(*_: object, **__: object) -> None:
        raise AssertionError("a socket, sleep, thread or process")

    for owner, name in (
        (socket.socket, "bind"), (socket.socket, "listen"), (socket.socket, "connect"),
        (subprocess.Popen, "__init__"), (threading.Thread, "start"), (time, "sleep"),
    ):  # fmt: skip
        monkeypatch.setattr(owner, name, forbidden)
    with twin(data=tmp_path, speed_up=speed_up, sample="normal-5") as scanner:
        client = scanner.client
        client.move({"mag_obj": 600.0}, wait=True)
        text = script(3)
        assert all(client.check_script(text).ok for _ in range(12))
        assert client.projection("counts", binning=8).image.max() > 0
        done = client.wait_job(client.submit_script(text, "one").job)
        assert (done.state, done.frames_done) == ("done", 3)
        assert scanner.data == tmp_path
    assert len(list((tmp_path / "one").glob("scan_*.tif"))) == 3


def test_the_same_calls_give_the_same_data_set(tmp_path: Path) -> None:
    def scanned(name: str) -> tuple[float, dict[str, str]]:
        with twin(data=tmp_path / name, sample="chiral", speed_up=FAST) as scanner:
            client = scanner.client
            client.move({"mag_obj": 600.0})
            scanner.advance(0.0125)
            client.wait_job(client.submit_script(script(3), "one").job)
            folder = scanner.data / "one"
            sums = {
                f.name: hashlib.sha256(f.read_bytes()).hexdigest()
                for f in folder.glob("*.tif")
            }
            return client.state().time, sums

    first = scanned("a")
    assert len(first[1]) > 3
    assert scanned("b") == first


def test_a_scan_under_way_ends_with_the_block_and_says_so(tmp_path: Path) -> None:
    def broken() -> None:
        with twin(data=tmp_path, sample="chiral") as scanner:
            job = scanner.client.submit_script(script(9), "one").job
            scanner.advance(25.0)
            assert 0 < scanner.client.job_status(job).frames_done < 9
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        broken()
    assert json.loads((tmp_path / "one" / "flexdt.json").read_text())["complete"] is False
    with twin(
        data=tmp_path
    ) as scanner:  # a new server does not know what the old one did
        assert scanner.client.jobs().jobs == []


# Clients ----------------------------------------------------------------------------------------


def test_clients_are_apart_and_a_stop_overtakes(flexdt_twin: InProcessTwin) -> None:
    """As over TCP: one controls, the other looks on but may stop, and who moved hears of it."""
    watcher = flexdt_twin.connect("watcher")

    async def stopped() -> Any:
        async with AsyncTwinClient(
            transport=flexdt_twin.transport(), name="mover"
        ) as mover:
            moving = asyncio.create_task(mover.move({"rot_obj": 90.0}, wait=True))
            await asyncio.sleep(1.0)
            await mover.stop()
            return (await moving).arrived, (await mover.state()).controller

    arrived, controller = flexdt_twin.run(stopped())
    assert arrived is False
    assert controller == "mover #3"
    at = watcher.state().axes["rot_obj"]
    assert at.position == pytest.approx(
        22.5, abs=1e-6
    )  # 22.5 deg/s^2 for 1 s, and as far to brake
    watcher.move({"rot_obj": 0.0})
    with pytest.raises(RpcError, match="watcher #2 is the controller"):
        flexdt_twin.client.move({"rot_obj": 1.0})
    watcher.close()
    flexdt_twin.client.move({"rot_obj": 1.0}, wait=True)


def test_a_connection_that_was_lost_is_made_anew(flexdt_twin: InProcessTwin) -> None:
    transport = flexdt_twin.transport()

    async def again() -> list[float]:
        async with AsyncTwinClient(transport=transport) as client:
            seen = [(await client.state()).time]
            transport.close()
            await asyncio.sleep(0.01)
            seen += [(await client.state()).time for _ in range(2)]
        return seen

    assert flexdt_twin.run(again()) == pytest.approx([0.0, 0.0, 0.0], abs=0.1)


class TimeIsOver(BaseException):
    """What ends a test at its time limit, wherever the thread is then."""


def _raise(error: BaseException) -> None:
    raise error


@pytest.mark.parametrize("place", ["a thread", "a callback", "a task"])
def test_the_end_of_a_test_is_no_deadlock(flexdt_twin: InProcessTwin, place: str) -> None:
    """It came as one: what it interrupted was logged, and what waited for that, waited."""
    loop = flexdt_twin.loop

    async def interrupted() -> None:
        error = TimeIsOver("after 300 s")
        match place:
            case "a thread":
                await asyncio.to_thread(_raise, error)
            case "a callback":
                loop.call_later(1.0, _raise, error)
            case _:

                async def service() -> None:
                    _raise(error)

                started = loop.create_task(service())
                assert not started.done()
        await asyncio.Event().wait()

    with pytest.raises(TimeIsOver, match="after 300 s"):
        flexdt_twin.run(interrupted())


def test_a_threads_error_that_no_future_may_have_is_told(
    flexdt_twin: InProcessTwin,
) -> None:
    with pytest.raises(RuntimeError, match="StopIteration"):
        flexdt_twin.run(asyncio.to_thread(next, iter(())))


def test_a_deadlock_names_what_waits_and_where(flexdt_twin: InProcessTwin) -> None:
    async def inner() -> None:
        await asyncio.Event().wait()

    async def outer() -> None:
        await inner()

    with pytest.raises(Deadlock) as caught:
        flexdt_twin.run(outer())
    said = str(caught.value)
    assert re.search(r"outer \(test_testing.py:\d+\) > .*inner \(test_testing.py:\d+\) > "
                     r"Event.wait", said)  # fmt: skip
    assert "Jobs.work" in said


def test_waits_that_cannot_end_are_said(flexdt_twin: InProcessTwin) -> None:
    with pytest.raises(Deadlock, match="nothing is left that could happen"):
        flexdt_twin.run(asyncio.Event().wait())

    async def blocking() -> None:
        flexdt_twin.client.state()

    with pytest.raises(RuntimeError, match="await it, or use LocalTwin"):
        flexdt_twin.run(blocking())
    with pytest.raises(RuntimeError, match="await it, or use LocalTwin"):
        asyncio.run(blocking())
    elsewhere = AsyncTwinClient(transport=flexdt_twin.transport())
    with pytest.raises(RuntimeError, match=r"RunEngine\(\{\}, loop=twin.loop\)"):
        asyncio.run(elsewhere.connect())  # type: ignore[arg-type]
    assert flexdt_twin.client.ping() == pytest.approx(0.0, abs=1.0)


def test_a_loop_that_a_thread_runs_serves_blocking_clients_and_ends() -> None:
    before = threading.active_count()
    with twin() as scanner:
        thread = threading.Thread(target=scanner.loop.run_forever)
        thread.start()
        scanner.client.move({"rot_obj": 90.0}, wait=True)
        assert scanner.client.state().axes["rot_obj"].position == 90.0
        rest = scanner.loop.time()
        while (now := scanner.loop.time()) != rest or scanner.client.state().axes[
            "rot_obj"
        ].moving:
            rest = now
    assert threading.active_count() == before
    assert scanner.loop.is_closed()


@pytest.mark.parametrize(
    "flexdt_twin",
    [{"machine": "micro_ct", "physics": "mono", "seed": None}],
    indirect=True,
)
def test_the_fixture_takes_the_arguments_of_a_twin(
    flexdt_twin: InProcessTwin, tmp_path: Path
) -> None:
    assert flexdt_twin.client.server.machine == "micro_ct"
    assert flexdt_twin.server.radiography.physics == "mono"
    assert flexdt_twin.server.submissions.seed() is None
    assert flexdt_twin.data == tmp_path / "twin"


def test_what_does_not_exist_is_said() -> None:
    with (
        pytest.raises(fx.TwinError, match="no machine called 'flexrey'"),
        twin(machine="flexrey"),
    ):
        pass
    with (
        pytest.raises(fx.TwinError, match="no sample called 'legi'"),
        twin(sample="legi"),
    ):
        pass


# What loads what --------------------------------------------------------------------------------


def test_nothing_heavy_is_loaded_before_it_is_used() -> None:
    program = (
        "import sys, flexdt; dir(flexdt); first = 'flexdt.testing' in sys.modules\n"
        "import flexdt.testing.fixtures\n"
        "print(first, [m for m in ('numpy', 'pydantic', 'hypothesis', 'flexdt.server') "
        "if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "False []\n", done.stderr


def test_without_hypothesis_the_command_that_installs_it_is_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "hypothesis", None)  # type: ignore[arg-type]
    monkeypatch.delitem(sys.modules, "flexdt.testing.strategies")
    with pytest.raises(
        fx.TwinError, match=r"needs hypothesis.*: pip install 'flexdt\[testing\]'"
    ):
        importlib.import_module("flexdt.testing.strategies")


# What is drawn ----------------------------------------------------------------------------------


def test_geometries_are_of_every_kind_and_each_is_a_scanners() -> None:
    """Worked out from the rows alone: what stands still in every view, and where the panel
    is."""
    kinds: set[tuple[bool, bool, bool, bool]] = set()

    @settings(max_examples=150, database=None)
    @given(geometries(max_views=5, max_pixels=9))
    def look(scan: fx.ConeVec) -> None:
        source, centre, u, v = np.split(np.array(scan.rows), 4, axis=1)
        assert 1 <= len(scan) <= 5
        assert scan.detector_shape is not None
        assert all(1 <= n <= 9 for n in scan.detector_shape)
        sod = np.hypot(source[:, 0], source[:, 1])
        np.testing.assert_allclose(sod, sod[0], rtol=1e-9)
        assert sod[0] >= 1.0
        normal = np.cross(u, v)
        assert (np.abs(np.einsum("ij,ij->i", u, v)) <= 1e-9).all()
        far = np.einsum("ij,ij->i", centre - source, normal) / np.linalg.norm(
            normal, axis=1
        )
        assert (np.abs(far) > sod * 0.9).all()
        assert json.loads(json.dumps(scan.to_dict()))["rows"] == np.asarray(scan).tolist()
        pitch = np.linalg.norm(u[0]), np.linalg.norm(v[0])
        kinds.add((
            len(scan) > 1, bool(np.ptp(source[:, 2]) > 1e-6),
            not math.isclose(*pitch), bool(abs(normal[0, 2]) > 1e-9),
        ))  # fmt: skip

    look()
    assert all(any(kind[i] for kind in kinds) for i in range(4))
    assert all(not all(kind[i] for kind in kinds) for i in range(2))


def test_machines_are_of_every_shipped_kind() -> None:
    names: set[tuple[str, ...]] = set()

    @settings(max_examples=60, database=None)
    @given(machines())
    def look(machine: Machine) -> None:
        names.add(tuple(sorted(machine.axes)))
        for axis in machine.axes.values():
            assert axis.lower <= axis.home <= axis.upper
            assert axis.lower < axis.upper
            assert 0.0 < axis.speed <= axis.max_speed

    look()
    assert len(names) >= 3
