"""Settings of processes: words and back; and what a system without POSIX calls does instead."""

from __future__ import annotations

import os
from dataclasses import asdict, fields, replace
from pathlib import Path

import pytest

from flexdt.runtime.files import directory
from flexdt.runtime.files.directory import Directory
from flexdt.runtime.files.own_documents import lock_folder
from flexdt.runtime.process_settings import (
    Address,
    GatewaySettings,
    ProcessSettings,
    ProjectorSettings,
    TwinSettings,
    UpSettings,
    ViewerSettings,
)
from flexdt.runtime.settings import parse, shared, words
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
    assert (found.projector, found.data, found.fresh) == (
        Address("::1", 7),
        Path("d"),
        True,
    )
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


def test_a_data_directory_is_locked_without_a_file_in_it(tmp_path: Path) -> None:
    """Nothing there can be deleted, or be a link to another file, of which `.lock` once was
    one."""
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
    assert directory.memory_bytes() == directory.FALLBACK_MEMORY_BYTES
