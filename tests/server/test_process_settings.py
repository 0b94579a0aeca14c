"""Settings of processes: words and back; and what a system without POSIX calls does instead."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Iterator
from dataclasses import asdict, fields, replace
from pathlib import Path

import pytest

from flexdt.process_settings import (
    Address,
    GatewaySettings,
    ProcessSettings,
    ProjectorSettings,
    TwinSettings,
    UpSettings,
    ViewerSettings,
    parse,
    shared,
    words,
)
from flexdt.runtime import process
from flexdt.runtime.files import directory
from flexdt.runtime.files.directory import Directory
from flexdt.runtime.files.own_documents import lock_folder
from flexdt.runtime.loop import ServerLoop
from flexdt.twin.dataset.dataset_errors import DatasetWriteError

PROCESSES = (UpSettings, TwinSettings, ProjectorSettings, ViewerSettings, GatewaySettings)


def as_given(settings: ProcessSettings) -> dict[str, object]:
    return {f.name: getattr(settings, f.name) for f in fields(settings)}


@pytest.mark.parametrize("kind", PROCESSES)
def test_settings_survive_the_way_over_words(kind: type[ProcessSettings]) -> None:
    assert parse(kind, []) == kind()
    assert parse(kind, words(as_given(kind()))) == kind()
    changed = replace(kind(), host="::1", port=4321)
    assert parse(kind, words(as_given(changed))) == changed


def test_each_kind_of_value_is_read() -> None:
    given = ["--projector", "[::1]:7", "--data", "d", "--fresh", "--limit", "a=1", "--limit", "b=2",
             "--http-port", "0", "--physics", "poly"]  # fmt: skip
    found = parse(TwinSettings, given)
    assert (found.projector, found.data, found.fresh) == (Address("::1", 7), Path("d"), True)
    assert (found.limit, found.http_port, found.physics) == (("a=1", "b=2"), 0, "poly")
    assert parse(ProjectorSettings, ["--memory-limit", "2KiB"]).memory_limit == 2048


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (["--port", "65536"], "--port"),
        (["--http-port", "-1"], "--http-port"),
        (["--threads", "0"], "--threads"),
        (["--log-level", "loud"], "--log-level"),
        (["--memory-limit", "much"], "--memory-limit"),
    ],
)
def test_a_wrong_option_is_reported_in_one_line(
    given: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as left:
        parse(ProjectorSettings, given)
    assert left.value.code == 2
    err = capsys.readouterr().err
    assert err.startswith("flexdt projector: Invalid value for ")
    assert says in err
    assert err.count("\n") == 1


def test_a_removed_method_of_scatter_names_its_successor(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert parse(TwinSettings, ["--scatter", "mc"]).scatter == "mc"
    with pytest.raises(SystemExit):
        parse(TwinSettings, ["--scatter", "first"])
    assert "'first' has been removed, use 'mc'" in capsys.readouterr().err


def test_a_twin_has_one_projector_at_least_and_each_once() -> None:
    def places(*words: str) -> list[str]:
        return [str(place) for place in parse(TwinSettings, words).places]

    assert places() == ["127.0.0.1:55001"]
    assert places("--projector-port", "7") == ["127.0.0.1:7"]
    assert places("--projectors", "a:1,b:2,a:1") == ["a:1", "b:2"]
    assert places("--projector", "b:2", "--projectors", "a:1,b:2") == ["b:2", "a:1"]


def test_up_leaves_the_data_directory_of_the_viewer_open() -> None:
    """Without --data the twin has its default, and the viewer has none to calibrate from."""
    assert shared(UpSettings(), TwinSettings)["data"] is None
    assert shared(UpSettings(), ViewerSettings)["data"] is None
    assert "twin" not in shared(UpSettings(), ViewerSettings)
    assert set(asdict(UpSettings())) >= set(shared(UpSettings(), TwinSettings))


@pytest.fixture
def handlers() -> Iterator[None]:
    before = [(number, signal.getsignal(number)) for number in process.SIGNALS]
    yield
    for number, handler in before:
        signal.signal(number, handler)


@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize("number", process.SIGNALS)
def test_a_loop_without_signal_handlers_is_stopped_all_the_same(
    number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on Windows."""

    def missing(*_: object) -> None:
        raise NotImplementedError

    monkeypatch.setattr(asyncio.SelectorEventLoop, "add_signal_handler", missing)

    async def scenario() -> bool:
        stop = process.stop_signal()
        os.kill(os.getpid(), number)
        async with asyncio.timeout(30.0):
            await stop.wait()
        os.kill(os.getpid(), number)  # a second one does not interrupt the stopping
        await asyncio.sleep(0.0)
        return stop.is_set()

    with asyncio.Runner(loop_factory=ServerLoop) as runner:
        assert runner.run(scenario())


@pytest.mark.usefixtures("handlers")
def test_a_loop_without_signal_handlers_wakes_up_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """On Windows a signal does not end the wait for sockets, so the loop has to turn now and then.

    The handler runs here while nothing is due, as Python runs it there once the wait has ended.
    """
    monkeypatch.setattr(process, "WAKE_S", 0.01)

    def missing(*_: object) -> None:
        raise NotImplementedError

    monkeypatch.setattr(asyncio.SelectorEventLoop, "add_signal_handler", missing)

    async def scenario() -> int:
        loop = asyncio.get_running_loop()
        process.stop_signal()
        turns = 0
        real = process._keep_waking

        def counted(loop: asyncio.AbstractEventLoop) -> None:
            nonlocal turns
            turns += 1
            real(loop)

        monkeypatch.setattr(process, "_keep_waking", counted)
        until = loop.time() + 30.0
        while turns < 3 and loop.time() < until:
            await asyncio.sleep(0.05)
        return turns

    assert asyncio.run(scenario()) >= 3


def test_a_data_directory_is_locked_without_a_file_in_it(tmp_path: Path) -> None:
    """Nothing there can be deleted, or be a link to another file, of which `.lock` once was one."""
    victim, data = tmp_path / "victim", tmp_path / "data"
    data.mkdir()
    victim.write_text("somebody's")
    (data / ".lock").symlink_to(victim)
    release = lock_folder(Directory(data))
    (data / ".lock").unlink()
    by_another_way = tmp_path / "link"
    by_another_way.symlink_to(data)
    for path in (data, by_another_way):
        with pytest.raises(DatasetWriteError, match="used by another twin server"):
            lock_folder(Directory(path))
    assert victim.read_text() == "somebody's"
    assert list(data.iterdir()) == []
    release()
    lock_folder(Directory(data))()


def test_a_system_that_does_not_say_its_memory_is_taken_to_have_some(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(os, "sysconf")
    monkeypatch.setattr(directory, "CGROUP_LIMIT", tmp_path / "none")
    assert directory.memory_bytes() == directory.FALLBACK_MEMORY
