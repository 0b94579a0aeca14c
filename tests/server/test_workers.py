"""Work in processes of its own: what it may take, how it ends, what comes back."""

from __future__ import annotations

import asyncio
import json
import os
import pickle
import signal
import time
from collections.abc import Awaitable, Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from in_process import script

from flexdt.protocol import Codec, Connection, RpcError
from flexdt.protocol.rpc_errors import Code
from flexdt.runtime.files.directory import open_data
from flexdt.runtime.process import process_seconds
from flexdt.runtime.workers import Workers
from flexdt.server.scans import checking
from flexdt.server.scans.checking import CheckInput, Checks
from flexdt.server.scans.scan_record import JobRecord, PoseList, ScanSource
from flexdt.server.twin import message_reading
from flexdt.server.twin.message_reading import MAX_PARAMS, Reader
from flexdt.twin.collision.convex_solids import hull
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.script import ScanPlan, StartState
from flexdt.twin.script.planning.plan_values import SampleSize
from flexdt.twin.script.problems import ScriptCode

M = builtin_machine()
P = builtin_profile(M.default_profile)


def check_input(wish: ScanSource) -> CheckInput:
    return CheckInput(wish, M, P, StartState.of(M), None, (), NOMINAL)


def long_script(lines: int) -> bytes:
    rows = (f"rot_obj\tmove absolute\t{i % 360}\t\tACK\t\t\r\n" for i in range(lines))
    return "".join(rows).encode()


def checked(body: Callable[[Checks], Awaitable[None]]) -> None:
    async def main() -> None:
        checks = Checks()
        try:
            await asyncio.wait_for(body(checks), 120)
        finally:
            checks.close()

    asyncio.run(main())


def same(a: ScanPlan, b: ScanPlan) -> bool:
    """Equal but for arrays, which are compared by the images they make."""
    return (a.steps, a.trajectories, a.beam, a.problems, a.duration_s, a.exposures) == (
        b.steps, b.trajectories, b.beam, b.problems, b.duration_s, b.exposures,
    )  # fmt: skip


@pytest.mark.parametrize("wish", [
    ScanSource(script(2500).encode() + long_script(600)),
    ScanSource.of_poses([{"rot_obj": i * 0.1, "mag_obj": 500.0} for i in range(700)], 50.0),
], ids=["script", "poses"])  # fmt: skip
@pytest.mark.daily(1)
def test_a_plan_made_apart_is_the_plan_made_here(wish: ScanSource) -> None:
    async def body(checks: Checks) -> None:
        there = check_input(wish)
        assert not there.light
        found = await checks.runnable(there)
        plan, warnings = checking.planned(there)
        assert same(found.plan, plan)
        assert found.plan.machine is M
        assert found.warnings == warnings
        for codec in Codec:
            report = b"".join(await checks.report(there, codec))
            wire = Connection(codec)
            assert wire.codec is codec
            read = json.loads(report) if codec is Codec.JSON else _unpacked(report)
            assert read == json.loads(json.dumps(there.report().to_dict()))

    checked(body)


OTHERS: dict[str, Callable[[CheckInput], Any]] = {
    "source": lambda m: ScanSource(long_script(2)),
    "machine": lambda m: M.model_copy(update={"safety_margin_mm": 3.0}),
    "profile": lambda m: P.model_copy(update={"name": "another"}),
    "start": lambda m: replace(m.start, xrays_on=True),
    "size": lambda m: SampleSize(30.0, 40.0),
    "pieces": lambda m: (hull(np.eye(4, 3) * 5.0),),
    "parameters": lambda m: Offsets(dD_x=0.5),
    "physics": lambda m: "poly",
}


def test_a_plan_is_made_once_and_anew_where_anything_it_depends_on_is_another() -> None:
    assert set(OTHERS) == {field.name for field in fields(CheckInput) if field.compare}

    async def body(checks: Checks) -> None:
        first = check_input(ScanSource(long_script(1)))
        for name, other in OTHERS.items():
            made = await checks.runnable(first)
            assert await checks.runnable(replace(first)) is made, (
                "equal input, the same certificate"
            )
            made = await checks.runnable(first)
            changed = replace(first, **{name: other(first)})
            found = await checks.runnable(changed)
            assert found is not made, name
            assert found.check_input is changed

    checked(body)


def _unpacked(data: bytes) -> Any:
    import msgpack

    return json.loads(json.dumps(msgpack.unpackb(data)))


def test_what_is_wrong_is_said_with_a_number_of_problems_and_the_rest_counted() -> None:
    text = b"rot_obj\tmove absolute\tfar\t\tACK\t\t\r\n" * 5000

    async def body(checks: Checks) -> None:
        with pytest.raises(RpcError) as refused:
            await checks.runnable(check_input(ScanSource(text)))
        assert refused.value.code == Code.SCRIPT_INVALID
        assert isinstance(refused.value.data, list)
        assert len(refused.value.data) == checking.MAX_PROBLEMS
        assert "and 4999 more" in refused.value.message

    checked(body)


def _unwanted(*_: object) -> Any:
    pytest.fail("it was swept")


def test_a_report_too_large_is_refused_before_it_is_swept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(checking, "MAX_ANSWER", {Codec.JSON: 50_000})
    monkeypatch.setattr(checking, "collision_check", lambda *_: _unwanted)
    with pytest.raises(RpcError) as refused:
        checking._encoded(check_input(ScanSource(long_script(600))), Codec.JSON)
    assert refused.value.code == Code.TOO_LARGE
    assert refused.value.data["allowed"] == 50_000  # type: ignore[index, call-overload]


def worked(body: Callable[[Workers], Awaitable[None]], **limits: Any) -> None:
    async def main() -> None:
        workers = Workers(
            **{"count": 1, "memory_bytes": 2 << 30, "seconds": 60.0, **limits}
        )
        try:
            await asyncio.wait_for(body(workers), 120)
        finally:
            workers.close()

    asyncio.run(main())


def heavy() -> CheckInput:
    """A check of some seconds."""
    return check_input(ScanSource(long_script(60_000)))


def light() -> CheckInput:
    return check_input(ScanSource(long_script(1)))


@pytest.mark.slow
def test_work_beyond_its_time_is_ended_and_says_what_is_allowed() -> None:
    async def body(workers: Workers) -> None:
        await workers.ask(checking.in_pieces, light())
        workers.seconds = 0.5
        with pytest.raises(RpcError) as refused:
            await workers.ask(checking.in_pieces, heavy())
        assert refused.value.code == Code.TOO_LARGE
        assert refused.value.data["allowed"] == 0.5  # type: ignore[index, call-overload]
        workers.seconds = 60.0
        await workers.ask(checking.in_pieces, light())  # another process

    worked(body)


@pytest.mark.slow
def test_work_on_a_busy_machine_has_the_time_that_it_has_alone() -> None:
    """A process that is stopped for most of the time is one of a busy machine."""

    async def stutter(pid: int) -> None:
        """Stop the process for 0.4 s each time that it has worked for a moment."""
        while True:
            os.kill(pid, signal.SIGSTOP)
            await asyncio.sleep(0.4)
            worked = process_seconds(pid)
            os.kill(pid, signal.SIGCONT)
            while process_seconds(pid) == worked:
                await asyncio.sleep(0.005)

    some = check_input(ScanSource(long_script(4_000)))

    async def body(workers: Workers) -> None:
        await workers.ask(checking.in_pieces, light())
        pid = workers._idle[-1].pid
        before = process_seconds(pid)
        await workers.ask(checking.in_pieces, some)
        after = process_seconds(pid)
        assert before is not None
        assert after is not None
        workers.seconds = max(2.0, 3.0 * (after - before))
        busy = asyncio.create_task(stutter(pid))
        began = time.monotonic()
        await workers.ask(checking.in_pieces, some)
        assert time.monotonic() - began > workers.seconds
        busy.cancel()
        os.kill(pid, signal.SIGCONT)

    worked(body)


@pytest.mark.slow
def test_work_beyond_its_memory_says_what_is_allowed() -> None:
    async def body(workers: Workers) -> None:
        with pytest.raises(RpcError) as refused:
            await workers.ask(
                message_reading.work, Codec.JSON, 10, b"[" + b"{}," * 10_000_000 + b"{}]"
            )
        assert refused.value.code == Code.TOO_LARGE
        await workers.ask(message_reading.work, Codec.JSON, 10, b"{}")

    worked(body, memory_bytes=600 << 20)


@pytest.mark.slow
def test_a_process_that_is_killed_costs_who_asked_an_error_and_nobody_else() -> None:
    async def body(workers: Workers) -> None:
        await workers.ask(checking.in_pieces, light())
        [worker] = workers._idle
        asked = asyncio.create_task(workers.ask(checking.in_pieces, heavy()))
        await asyncio.sleep(0.3)
        os.kill(worker.pid, signal.SIGKILL)
        with pytest.raises(RpcError) as refused:
            await asked
        assert refused.value.code == Code.TOO_LARGE
        assert "ended" in refused.value.message
        await workers.ask(checking.in_pieces, light())

    worked(body)


@pytest.mark.skipif(not Path("/proc").exists(), reason="looks for the process in /proc")
@pytest.mark.slow
def test_work_that_nobody_waits_for_any_more_is_stopped() -> None:
    async def body(workers: Workers) -> None:
        await workers.ask(checking.in_pieces, light())
        [worker] = workers._idle
        asked = asyncio.create_task(workers.ask(checking.in_pieces, heavy()))
        await asyncio.sleep(0.3)
        asked.cancel()
        with pytest.raises(asyncio.CancelledError):
            await asked
        while Path(f"/proc/{worker.pid}").exists():
            await asyncio.sleep(0.01)
        assert not workers._idle

    worked(body)


def read(raw: bytes, codec: Codec = Codec.JSON) -> Any:
    async def main() -> Any:
        reader = Reader()
        try:
            return await reader(raw, Connection(codec))
        finally:
            reader.close()

    return asyncio.run(main())


def request(method: str, params: object) -> bytes:
    document = {"jsonrpc": "2.0", "id": 7, "method": method, "params": params}
    return json.dumps(document).encode()


@pytest.mark.slow
def test_poses_read_apart_are_two_strings() -> None:
    poses = [{"rot_obj": i / 4} for i in range(3000)]
    call = read(request("trajectory.submit", {"poses": poses, "seed": 5})).thawed()
    assert (call.id, call.method, call.answered) == (7, "trajectory.submit", True)
    assert call.params.seed == 5
    assert call.params.poses == PoseList.of(poses)
    assert call.params.poses.decoded() == poses


@pytest.mark.slow
def test_parameters_that_do_not_fit_say_so_in_a_few_words() -> None:
    raw = request("trajectory.check", {"poses": [{"rot_obj": "x"}] * 200_000})
    call = read(raw).thawed()
    assert call.params.code == Code.INVALID_PARAMS
    assert len(json.dumps(call.params.data)) < 20_000


@pytest.mark.slow
def test_large_parameters_of_a_method_that_needs_none_are_refused() -> None:
    raw = request("session.hello", {"protocol": "1.0", "client": "x" * (2 * MAX_PARAMS)})
    assert read(raw).thawed().params.code in (Code.INVALID_PARAMS, Code.TOO_LARGE)


def test_a_batch_read_apart_keeps_its_order_and_each_method() -> None:
    calls = [json.loads(request("state.get", {})) | {"id": i} for i in range(500)]
    calls[100]["method"] = "safety.estop"
    items = read(json.dumps(calls).encode())
    assert [item.thawed().id for item in items] == list(range(500))
    assert [i for i, item in enumerate(items) if item.method == "safety.estop"] == [100]


def test_poses_of_a_beginning_come_back(tmp_path: Path) -> None:
    wish = ScanSource.of_poses([{"rot_obj": 1.0}, {"mag_obj": 2.5}], 10.0)
    text = wish.script.decode()
    assert text.splitlines() == [
        "# trajectory, exposure_ms 10.0, flat true",
        '# pose 0: {"rot_obj": 1.0}',
        '# pose 1: {"mag_obj": 2.5}',
    ]
    from flexdt.server.scans.scan_record import StartConditions
    from flexdt.twin.scanner.state import Sample

    JobRecord(wish, StartConditions(StartState.of(M), Sample(), 1, 1)).write(
        open_data(tmp_path), "a"
    )
    assert JobRecord.read(open_data(tmp_path), "a").source.poses == wish.poses
    file = tmp_path / "jobs" / "a.json"
    document = json.loads(file.read_text())
    document["wish"]["poses"] = json.loads(document["wish"]["poses"])  # as it was before
    file.write_text(json.dumps(document))
    assert JobRecord.read(open_data(tmp_path), "a").source.poses == wish.poses


@pytest.mark.slow
def test_a_plan_comes_in_pieces_that_are_read_at_once() -> None:
    plan = check_input(ScanSource(script(60_000))).report().plan
    pieces = checking._pickled_pieces(plan)
    assert max(len(parts) for _, parts in map(pickle.loads, pieces[1:])) <= 250
    assert same(checking._rebuilt_plan(pieces, M, P), plan)
    assert [g.files for g in checking._rebuilt_plan(pieces, M, P).groups] == [
        g.files for g in plan.groups
    ]


def test_a_check_looks_at_the_end_of_the_clock() -> None:
    """A submission was refused for it, and the check of the same script said nothing."""
    scan = check_input(ScanSource(b"rot_obj\tmove absolute\t90\t0\tACK\t\t\r\n"))
    assert scan.report().ok
    late = replace(scan, clock_left_s=1.0).report()
    assert [problem.code for problem in late.errors] == [ScriptCode.LIMIT]
    assert "the twin's clock ends in 1 s" in late.errors[0].message
    assert replace(scan, clock_left_s=1.0) == scan  # one plan for both
