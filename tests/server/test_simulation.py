"""The simulation itself: the same seed, the same run; what its disk loses and keeps."""

from __future__ import annotations

import errno
import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from in_process import digest, script
from simulated_disk import Disk
from simulation import Crashed, Fault, Simulation

from flexdt.protocol import RpcError
from flexdt.runtime.files.directory import Directory
from flexdt.twin.dataset.dataset_errors import DatasetWriteError, DiskFullError


def scan(root: Path, seed: int) -> tuple[list[tuple[str, str]], float, dict[str, str]]:
    """One short scan: changes of the disk, twin time at its end, images."""
    with Simulation(root, seed, speed_up=20.0) as sim:
        sim.start()
        a, b = sim.client(), sim.client()
        job = sim.call(a, "script.submit", text=script(3), name="scan", seed=3)["job"]
        while sim.call(b, "job.status", job=job)["state"] != "done":
            sim.advance(0.05)
        time = sim.twin.clock.now()
        sim.stop()
        return list(sim.disk.ops), time, digest(sim.data / "scan")


def test_a_seed_is_a_run(tmp_path: Path) -> None:
    one, again, other = (
        scan(tmp_path / n, seed) for n, seed in (("a", 1), ("b", 1), ("c", 2))
    )
    assert one == again
    assert one[1] != other[1]
    assert one[2] == other[2]
    assert len(one[2]) == 4


def test_time_passes_without_waiting(tmp_path: Path) -> None:
    with Simulation(tmp_path) as sim:
        sim.start()
        a = sim.client()
        move = sim.begin(a, "axes.move", targets={"rot_obj": 360.0}, wait=True)
        sim.advance(1.0)
        sim.call(sim.client(), "axes.stop")
        assert sim.answer(move)["arrived"] is False
        for hours in (1, 3):  # as long as the patience for an answer, and longer
            sim.advance(3600.0 * hours)
        assert sim.time == pytest.approx(4 * 3600.0 + 2.0, abs=1.0)
        assert sim.twin.clock.now() == pytest.approx(sim.time)


def test_a_killed_server_is_followed_by_another(tmp_path: Path) -> None:
    with Simulation(tmp_path) as sim:
        sim.start()
        a = sim.client()
        sim.call(a, "axes.move", targets={"mag_obj": 500.0}, wait=True)
        sim.advance(1.0)
        sim.kill()
        sim.start()
        axes = sim.call(sim.client(), "state.get")["axes"]
        assert axes["mag_obj"]["position"] == 500.0
        sim.disk.set(Fault(0, error=None))
        with pytest.raises(Crashed):
            sim.stop()
        sim.start()


def folder(tmp_path: Path, seed: int = 0) -> Disk:
    root = tmp_path / "disk"
    root.mkdir()
    return Disk(root, random.Random(seed))


def test_faults_come_when_they_are_told(tmp_path: Path) -> None:
    disk = folder(tmp_path)
    with disk.watched(), Directory(disk.root) as files:
        files.put("a", b"old")
        for n in range(4):  # open, write, fsync, rename
            disk.set(Fault(n, errno.EIO))
            with pytest.raises(DatasetWriteError):
                files.put("a", b"new")
            assert disk.failed == n + 1
            assert files.names() == {"a"}
            assert (disk.root / "a").read_bytes() == b"old"
        disk.set(Fault(1, errno.ENOSPC, lasting=True))
        for _ in range(2):
            with pytest.raises(DiskFullError):
                files.put("a", b"new")
        disk.set(Fault(1, short=True))
        files.put("a", b"newest")
        assert (disk.root / "a").read_bytes() == b"newest"
        disk.set(None)
        files.put("a", b"last")
        assert [f.name for f in disk.root.iterdir()] == ["a"]


def test_a_power_cut_loses_what_was_not_made_safe(tmp_path: Path) -> None:
    seen = set()
    for seed in range(12):
        root = tmp_path / str(seed)
        root.mkdir()
        disk = folder(root, seed)
        with disk.watched(), Directory(disk.root) as files:
            files.put("kept", b"1")
            fd = os.open(disk.root, os.O_RDONLY)
            os.fsync(fd)
            os.close(fd)
            files.put("kept", b"2")
            files.put("new", b"3")
            disk.cut()
        content = tuple(
            (disk.root / n).read_bytes() if (disk.root / n).exists() else None
            for n in ("kept", "new")
        )
        assert content in [(b"1", None), (b"2", None), (b"2", b"3")]
        seen.add(content)
    assert len(seen) == 3


@pytest.mark.parametrize("stepped", [False, True])
def test_a_job_goes_on_by_itself_after_a_full_disk_unless_somebody_took_over(
    tmp_path: Path, stepped: bool
) -> None:
    """A step meets the full disk, or the disk fills while the scan runs by itself."""

    def status() -> dict[str, Any]:
        return sim.call(a, "job.status", job="job-1")  # type: ignore[no-any-return]

    def until(reached: Callable[[dict[str, Any]], bool]) -> None:
        for _ in range(400):
            if reached(status()):
                return
            sim.advance(0.2)
        raise AssertionError(status())

    with Simulation(tmp_path, 4, speed_up=20.0) as sim:
        sim.start()
        a = sim.client()
        sim.call(a, "script.submit", text=script(120, 4.0, 1000.0), name="scan")
        until(lambda s: s["frames_done"] >= 2)
        if stepped:
            sim.call(a, "job.pause", job="job-1")
            until(lambda s: s["state"] == "paused")
            sim.advance(2.0)  # what is in the pipeline is made
        sim.disk.set(Fault(0, errno.ENOSPC, lasting=True))
        if stepped:
            sim.call(a, "job.step", job="job-1")
        until(lambda s: s["error"] is not None)
        assert (status()["retry_s"] is None) is stepped
        # What is refused takes nothing over.
        with pytest.raises(RpcError):
            sim.call(a, "axes.move", targets={"ver_obj": 1e6})
        assert (status()["retry_s"] is None) is stepped
        done = status()["frames_done"]
        sim.disk.set(None)
        sim.advance(40.0)
        assert (status()["frames_done"] > done) is not stepped
        if stepped:
            assert status()["state"] == "paused"
            sim.call(a, "job.resume", job="job-1")
        until(lambda s: s["state"] == "done")
