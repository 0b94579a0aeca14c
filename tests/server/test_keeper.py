"""The last state that is written wins over one that is still on its way to the disk."""

from __future__ import annotations

import asyncio
import json
import threading
from pathlib import Path

import pytest

from flexdt.server import memory as memory_module
from flexdt.server.files import put_file
from flexdt.server.memory import FILE, Keeper, Memory, remember
from flexdt.twin.machine import builtin_machine, builtin_profile
from flexdt.twin.scanner import ScannerTwin

M = builtin_machine("flexray")


def test_a_write_that_is_under_way_does_not_undo_the_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scanner = ScannerTwin(M, builtin_profile(M.default_profile))
    made = threading.Event()
    ended = threading.Event()

    def make(last: bool) -> Memory:
        return remember(scanner, 0.0, [], 0, ended=last)

    class Late(Memory):
        """Encoded by its thread only after the server has ended."""

        def model_dump_json(self, **options: object) -> str:  # type: ignore[override]
            made.set()
            assert ended.wait(30.0)
            return super().model_dump_json(by_alias=True)

    first = Late.model_construct(**dict(make(False)))
    keeper = Keeper(tmp_path, lambda last: make(True) if last else first)
    written: list[str] = []

    def put(folder: Path, name: str, data: bytes) -> None:
        written.append(name)
        put_file(folder, name, data)

    monkeypatch.setattr(memory_module, "put_file", put)

    async def body() -> None:
        work = asyncio.create_task(keeper.run(lambda: False))
        keeper.changed()
        await asyncio.to_thread(made.wait, 30.0)
        work.cancel()  # its thread goes on
        await asyncio.gather(work, return_exceptions=True)
        threading.Timer(0.2, ended.set).start()
        await asyncio.to_thread(keeper.end)

    asyncio.run(body())
    assert json.loads((tmp_path / FILE).read_text())["ended"] is True
    assert written
