"""Limits as options, the controller's lease, retries, versions, and errors that overflowed."""

from __future__ import annotations

import asyncio
import json
import math
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from lab import Refused, Wire, fly_script, projector, twin

from flexdt.clients.cli.command_tree import run
from flexdt.clients.client.client import AsyncTwinClient, TwinClient
from flexdt.protocol import METHODS, Connection, Failure, RpcError
from flexdt.protocol.method import compatible
from flexdt.runtime.access import (
    AccessError,
    ConnectionLimits,
    TwinLimits,
    limit_names,
    with_limits,
)
from flexdt.runtime.files.directory import open_data
from flexdt.runtime.wire_errors import ProjectorUnavailable
from flexdt.server.scans import job_retries
from flexdt.server.scans.job_retries import Retry, transient
from flexdt.server.storage.disk_room import UsedBytes
from flexdt.server.twin.core import ControlLease
from flexdt.twin.dataset.dataset_errors import DiskFullError
from flexdt.twin.errors import LimitError
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.script.dry_run import check_plan, check_script
from flexdt.twin.script.planning.plan_values import StartState
from flexdt.twin.script.planning.pose_plan import plan_poses

M = builtin_machine("flexray")
P = builtin_profile(M.default_profile)


def test_limits_by_name() -> None:
    words = ["max_clients=7", "send_timeout_s=2.5", "max_jobs=3", "disk_quota=1e9"]
    limits = with_limits(words, ConnectionLimits(), limit_names(TwinLimits()))
    assert (limits.max_clients, limits.send_timeout_s) == (7, 2.5)
    assert limits.max_message == ConnectionLimits().max_message
    twins = with_limits(words, TwinLimits(), limit_names(ConnectionLimits()))
    assert (twins.max_jobs, twins.disk_quota) == (3, 1_000_000_000)


NO_LIMITS = ("max_jobs", "max_jobs=", "max_jobs=many", "max_jobs=0", "max_jobs=-1", "max_jobs=nan",
             "max_jobs=inf", "speed=3", "=3")  # fmt: skip


@pytest.mark.parametrize("word", NO_LIMITS)
def test_limits_that_are_none(word: str) -> None:
    with pytest.raises(AccessError, match=r"max_jobs|no limit called"):
        with_limits([word], TwinLimits(), limit_names(ConnectionLimits()))


@pytest.mark.timeout(120)
@pytest.mark.slow
def test_limits_hold_in_a_process(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rays = projector("--limit", "max_clients=9")
    options = [f"--limit={w}" for w in ("max_jobs=2", "max_upload=1000", "disk_quota=30e6",
                                         "control_idle_s=2", "max_clients=3",
                                         "max_subscriptions=3", "max_views=2")]  # fmt: skip
    server = twin(rays.port, tmp_path / "data", *options)
    try:
        one, two = Wire(server.port), Wire(server.port)
        one.call("clock.set", speed_up=0.001)
        with pytest.raises(
            Refused, match=r"-32001.* needs .* MB, of which 16.8 MB are to stay free"
        ):
            one.call("script.submit", text=fly_script(721, roi="0 0 1943 1535"))
        running = one.call("script.submit", text=fly_script(3))["job"]
        one.wait(running, "running")
        for _ in range(2):
            one.call("script.submit", text=fly_script(3))
        with pytest.raises(Refused, match="-32003: 2 jobs wait already"):
            one.call("script.submit", text=fly_script(3))
        with pytest.raises(Refused, match="-32008"):
            two.call("sample.upload", name="x", format="stl", total=1001, data="AAAA")
        one.call("state.subscribe", topics=["state", "job"])
        with pytest.raises(Refused, match="-32003: there would be 4 subscriptions"):
            two.call("state.subscribe", topics=["state", "job"])
        two.call("state.subscribe", topics=["projection"], projection_binning=16)
        with pytest.raises(Refused, match="-32003: there would be 3 different views"):
            one.call("state.subscribe", topics=["job"], projection_binning=32)
        one.call("state.unsubscribe", topics=["state", "job"])
        two.call("state.unsubscribe", topics=["projection"])
        until, refused = time.monotonic() + 60.0, 0
        one.call("session.ping")
        # One is silent from here on, and two asks until it is let in.
        while "error" in (answer := two.ask("clock.set", speed_up="max")):
            assert answer["error"]["code"] == -32003
            assert time.monotonic() < until
            refused += 1
            time.sleep(0.05)
        assert refused
        three, four = Wire(server.port), Wire(server.port)
        three.call("session.ping")
        # One too many is told why, by every client, and stops the scanner nevertheless.
        assert four.ask("state.get")["error"]["code"] == -32003
        with TwinClient(port=server.port) as late:
            with pytest.raises(RpcError, match="too many clients") as refused_:
                late.state()
            assert late.estop().safety.estop
        assert (refused_.value.code, refused_.value.data) == (-32003, {"allowed": 3})

        async def later() -> None:
            async with AsyncTwinClient(port=server.port) as late:
                with pytest.raises(RpcError, match="too many clients"):
                    await late.state()
                assert (await late.estop()).safety.estop

        asyncio.run(later())
        assert run(["state", "--server", f"127.0.0.1:{server.port}"]) == 4
        assert "too many clients" in capsys.readouterr().err
    finally:
        server.end()
        rays.end()
    with pytest.raises(RuntimeError, match="no limit called 'max_client'"):
        twin(rays.port, tmp_path / "other", "--limit", "max_client=3")


def test_a_silent_controller_gives_way_to_whoever_asks() -> None:
    now = [0.0]
    control = ControlLease(10.0, lambda: now[0])
    control.require("a", "session.control")
    now[0] = 9.0
    with pytest.raises(RpcError):
        control.require("b", "axes.move")
    control.heard("a")
    control.heard("b")  # others' requests keep nobody's lease
    now[0] = 18.0
    with pytest.raises(RpcError):
        control.require("b", "axes.move")
    now[0] = 19.5
    control.require("b", "axes.move")
    assert control.holder == "b"
    with pytest.raises(RpcError):
        control.require("a", "axes.move")


def test_retries_wait_longer_each_time_and_forget_after_progress(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    waits: list[float] = []

    async def sleep(seconds: float) -> None:
        waits.append(seconds)
        await asyncio.sleep(0)

    own = {
        "create_task": asyncio.create_task,
        "get_running_loop": asyncio.get_running_loop,
    }
    monkeypatch.setattr(job_retries, "asyncio", SimpleNamespace(sleep=sleep, **own))

    async def body() -> None:
        retry = Retry(10.0, 50.0)
        done = asyncio.Event()
        for attempt in range(5):
            done.clear()
            retry.schedule(ProjectorUnavailable("gone"), done.set)
            left = retry.waits_s
            retry.schedule(
                ProjectorUnavailable("gone"), done.set
            )  # the pending one is kept
            assert left is not None
            assert 0.0 <= left <= min(50.0, 10.0 * 2.0**attempt)
            await done.wait()
            assert retry.waits_s is None
            if attempt == 3:
                retry.progressed()
        done.clear()
        retry.schedule(ProjectorUnavailable("gone"), done.set)
        retry.cancel()
        for _ in range(10):
            await asyncio.sleep(0)
        assert not done.is_set()

    asyncio.run(body())
    assert waits == [10.0, 20.0, 40.0, 50.0, 10.0]


@pytest.mark.parametrize("enough", [2000, None])  # None: the system does not say
def test_a_full_disk_is_retried_when_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, enough: int | None
) -> None:
    free: list[int | None] = [10]
    looked = [0]

    def free_bytes(path: Path) -> int | None:
        looked[0] += 1
        return free[0]

    monkeypatch.setattr(job_retries, "free_bytes", free_bytes)

    async def body() -> None:
        retry, done = Retry(0.01), asyncio.Event()
        error = DiskFullError("full", {"path": str(tmp_path / "scan.tif"), "bytes": 1000})
        retry.schedule(error, done.set)
        for room in (10, 0, 1000):  # nothing at all is no room either
            free[0], looked[0] = room, 0
            while looked[0] < 3:
                await asyncio.sleep(0.001)
            assert not done.is_set()
        free[0] = enough
        await asyncio.wait_for(done.wait(), 30.0)

    asyncio.run(body())
    assert transient(DiskFullError("x"))
    assert not transient(LimitError("x", {}))
    assert not transient(None)


def test_bytes_of_a_folder_without_links(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b").write_bytes(b"x" * 100)
    (tmp_path / "c").write_bytes(b"x" * 11)
    (tmp_path / "loop").symlink_to(tmp_path, target_is_directory=True)
    link = (tmp_path / "loop").lstat().st_size
    assert UsedBytes(open_data(tmp_path)).count() == 111 + link


@pytest.mark.parametrize(
    ("spoken", "served"),
    [("1.0", True), ("1.9", True), ("1", True), ("0.9", False), ("2.0", False), ("", False),
     ("one", False), ("-1.0", False), ("1.0.0.0", True), ("10.0", False)],
)  # fmt: skip
def test_older_and_newer_clients_are_served_or_refused(spoken: str, served: bool) -> None:
    assert compatible(spoken) is served


def test_the_wire_of_version_1_is_not_taken_back() -> None:
    """A client of 1.0 finds every method and parameter it knew (tests/data/wire-1.0.json)."""
    known = json.loads((Path(__file__).parents[1] / "data" / "wire-1.0.json").read_text())
    for name, parameters in known.items():
        fields = METHODS[name].params.model_fields
        for parameter, required in parameters.items():
            assert parameter in fields, f"{name} has lost {parameter}"
            assert fields[parameter].is_required() <= required, (
                f"{name}: {parameter} is required"
            )
        new = set(fields) - set(parameters)
        assert not [n for n in new if fields[n].is_required()], f"{name} requires more"


def test_what_overflowed_is_repeated_as_text() -> None:
    error = RpcError(
        -32001, "too far", {"asked": math.inf, "all": [math.nan, 1.0, (-math.inf,)]}
    )
    sent: Any = json.loads(Connection().send(Failure(1, error)))
    assert sent["error"]["data"] == {"asked": "inf", "all": ["nan", 1.0, ["-inf"]]}


@pytest.mark.parametrize(
    "text", [b"rot_obj\t", b"camera\t\t\t\t\t\t", b"ver_tube\t\r\nx\t"]
)
def test_a_component_alone_is_a_syntax_error(text: bytes) -> None:
    report = check_script(text, M, P)
    assert not report.ok
    assert report.problems[0].code == "syntax"


def test_absurd_settings_leave_a_finite_plan() -> None:
    report = check_plan(plan_poses([{"rot_obj": 1.0}], M, P, 1e308))
    assert not report.ok
    assert math.isfinite(report.plan.duration_s)
    start = replace(StartState.of(M), kV=1e-320, xrays_on=True)
    report = check_plan(plan_poses([{"rot_obj": 1.0}], M, P, 50.0, start=start))
    json.dumps(report.to_dict(), allow_nan=False)
    scanner = ScannerTwin(M, P)
    for rate in (1e-320, 1e-9, 0.0, -1.0, math.nan):
        with pytest.raises(LimitError):
            scanner.set_axis("rot_obj", speed=rate)
        with pytest.raises(LimitError):
            scanner.set_axis("rot_obj", acceleration=rate)
