"""The last state that is written wins over one that is still on its way to the disk."""

from __future__ import annotations

import asyncio
import errno
import json
import random
import threading
from pathlib import Path

import pytest
from simulated_disk import Disk, Fault
from simulation import Simulation

from flexdt.runtime.files.directory import Directory
from flexdt.runtime.files.own_documents import Changes
from flexdt.server.storage.job_files import JobFiles
from flexdt.server.storage.journal import content_of, record_of
from flexdt.server.storage.memory import FILE, Memory, StateStore, remember
from flexdt.twin.dataset.dataset_errors import DatasetWriteError
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.scanner.scanner import ScannerTwin

M = builtin_machine("flexray")


def test_a_write_that_is_under_way_does_not_undo_the_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scanner = ScannerTwin(M, builtin_profile(M.default_profile))
    made = threading.Event()
    ended = threading.Event()

    def make(last: bool) -> Memory:
        record = record_of(content_of(scanner, 0.0), 1)
        return remember(scanner, 0.0, record, 0, [], ended=last)

    class Late(Memory):
        """Encoded by its thread only after the server has ended."""

        def model_dump_json(self, **options: object) -> str:  # type: ignore[override]
            made.set()
            assert ended.wait(30.0)
            return super().model_dump_json(by_alias=True)

    first = Late.model_construct(**dict(make(False)))
    root = Directory(tmp_path)
    state_store = StateStore(
        root, lambda last: make(True) if last else first, JobFiles(root), dict
    )
    written: list[str] = []
    keep = Directory.keep

    def put(folder: Directory, name: str, data: bytes) -> None:
        written.append(name)
        keep(folder, name, data)

    monkeypatch.setattr(Directory, "keep", put)

    async def body() -> None:
        work = asyncio.create_task(state_store.run())
        state_store.changed()
        await asyncio.to_thread(made.wait, 30.0)
        work.cancel()  # its thread goes on
        await asyncio.gather(work, return_exceptions=True)
        threading.Timer(0.2, ended.set).start()
        await asyncio.to_thread(state_store.end)

    asyncio.run(body())
    assert json.loads((tmp_path / FILE).read_text())["ended"] is True
    assert written


@pytest.mark.parametrize("at", range(12))
def test_a_change_is_undone_on_a_disk_that_stays_full(tmp_path: Path, at: int) -> None:
    """Whatever write of three the disk is full at: it takes no room to have the old files
    back."""
    root = tmp_path / "disk"
    root.mkdir()
    for name in ("a", "b"):
        Directory(root).keep(name, name.encode())

    def change(folder: Directory) -> None:
        with Changes() as changes:
            for name in ("a", "c", "b"):
                changes.put(folder, name, b"new")

    disk = Disk(root, random.Random(0))
    with disk.watched(), Directory(root) as folder:
        disk.set(Fault(at, errno.ENOSPC, lasting=True))
        with pytest.raises(DatasetWriteError):
            change(folder)
    assert {f.name: f.read_bytes() for f in root.iterdir()} == {"a": b"a", "b": b"b"}
    with Directory(root) as folder, Changes() as changes:
        changes.put(folder, "a", b"newer")
        changes.put(folder, "a", b"newest")
    assert {f.name: f.read_bytes() for f in root.iterdir()} == {"a": b"newest", "b": b"b"}


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("failing", [False, True])
def test_an_estop_survives_a_kill_a_moment_after_its_answer(
    tmp_path: Path, seed: int, failing: bool
) -> None:
    """Also right after another change, or after one that could not be written."""
    rng = random.Random(seed)
    with Simulation(tmp_path, seed) as sim:
        sim.start()
        client = sim.client()
        sim.advance(5.0)
        if failing:
            sim.disk.set(Fault(0, errno.EIO, lasting=True))
        sim.call(client, "axes.move", targets={"rot_obj": 5.0})
        sim.advance(rng.uniform(0.01, 3.0))
        if failing:
            assert sim.disk.failed
            sim.disk.set(None)
        answer = sim.call(client, "safety.estop")
        assert answer["safety"]["estop"]
        if answer["unsaved"] is not None:
            sim.advance(0.07)  # a thread under way, and the next one: 0.03 s each at most
        if rng.random() < 0.5:
            sim.advance(2.0)  # the motors have come to rest
            before = len(sim.disk.ops)
            for _ in range(20):  # it is in force: no more news for the disk
                sim.call(client, "safety.estop")
            assert len(sim.disk.ops) == before
        sim.kill()
        sim.start()
        assert sim.call(sim.client(), "state.get")["safety"]["state"] == "estop"
