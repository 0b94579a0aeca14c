"""Links under every name that a twin opens in its data directory: none is ever followed.

A short life of a twin (an upload, corrections, a scan, a restart in the middle of another, its
resumption, readings of past scans) is traced, and lived again with links in place of what it
opened or changed: to a file that would be taken for the right one, to a directory that would,
to nothing. The witness looks at what the system opened, not at what the twin says.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import simulated_disk
from in_process import M, P, script
from simulation import Simulation
from whole_run import voxels

from flexdt.protocol import Codec, RpcError
from flexdt.protocol.methods.calibration_messages import (
    CalibrationAlign,
    CalibrationFit,
    DatasetFrame,
    DatasetGet,
    DatasetList,
)
from flexdt.runtime.files import directory
from flexdt.server.storage.past_scans import TwinContext, work
from flexdt.twin.errors import TwinError

SECRET = "nobody is to see this"
DATED = re.compile(r"\d{4}-\d\d-\d\dT\d{6} ")
NUMBERED = re.compile(r"(?<=\.part-)\d+-\d+-\d+$")
ENDED_PHASES = ("done", "failed", "aborted", "incomplete", "paused")
FRAMES = 3
PATHS = {
    "open",
    "os.listdir",
    "os.scandir",
    "os.mkdir",
    "os.rename",
    "os.remove",
    "os.rmdir",
}
"""Events of the interpreter whose first argument is a path."""
OPENED: list[str] = []
"""Paths that were used whole, while `WATCHED` is the data directory."""
WATCHED: list[Path] = []


def heard(event: str, arguments: tuple[Any, ...]) -> None:
    if WATCHED and event in PATHS and isinstance(arguments[0], str | bytes | os.PathLike):
        path = Path(os.fsdecode(arguments[0]))
        if path.is_absolute() and path != WATCHED[0] and path.is_relative_to(WATCHED[0]):
            OPENED.append(f"{event} {path}")


@pytest.fixture(scope="module", autouse=True)
def listening() -> Iterator[None]:
    sys.addaudithook(
        heard
    )  # for the rest of the process: without `WATCHED` it does nothing
    yield
    WATCHED.clear()


class Life:
    """One twin's, told by `first` and `second`; whatever is refused, it goes on.

    Attributes:
        said: answers, errors and log lines.
        landed: names of those of `victims` (inodes) that were opened.
        refused: errors of requests.
    """

    def __init__(self, root: Path, victims: Path) -> None:
        self.sim = Simulation(root, speed_up="max")
        self.data = self.sim.data.absolute()
        self.victims = victims
        self.said: list[str] = []
        self.refused: list[str] = []
        self.landed: list[str] = []

    @contextmanager
    def watched(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
        inodes = {f.stat().st_ino: str(f) for f in self.victims.rglob("*")} | {
            self.victims.stat().st_ino: str(self.victims)
        }
        real = os.open

        def opened(*args: Any, **options: Any) -> int:
            fd = real(*args, **options)
            if (inode := os.fstat(fd).st_ino) in inodes:
                self.landed.append(f"{args[0]} -> {inodes[inode]}")
            return fd

        monkeypatch.setitem(simulated_disk.REAL, "open", opened)
        OPENED.clear()
        WATCHED[:] = [self.data]
        try:
            with self.sim:
                yield
        finally:
            WATCHED.clear()
            self.said += [r.getMessage() + str(vars(r)) for r in self.sim.log]

    def ask(self, method: str, **params: Any) -> Any:
        try:
            answer = self.sim.call(self.client, method, **params)
        except RpcError as error:
            if error.code == -32603:
                raise
            self.refused.append(f"{method}: {error.message} {error.data}")
            return {}
        self.said.append(json.dumps(answer))
        return answer

    def ended(self, name: str) -> None:
        for _ in range(400):
            jobs = [j for j in self.ask("job.list")["jobs"] if j["name"] == name]
            if not jobs or jobs[0]["state"] in ENDED_PHASES:
                return
            self.sim.advance(0.05)
        raise AssertionError(jobs)

    def first(self) -> None:
        self.sim.start()
        self.client = self.sim.client()
        self.ask("sample.upload", **voxels(0.01))
        self.ask("sample.upload", **voxels(0.02))
        self.ask("sample.set", name="cube")
        self.ask("calibration.apply", parameters={"dD_x": 0.5}, name="one")
        self.ask("calibration.apply", parameters={"dD_x": 0.75}, name="two")
        self.ask("script.submit", text=script(FRAMES), name="first", seed=3)
        self.ended("first")
        rays = self.sim.projector
        rays.limit = rays.views + 1
        self.ask("script.submit", text=script(FRAMES), name="second", seed=3)
        self.sim.advance(1.0)
        self.sim.kill()
        rays.limit = None

    def second(self) -> None:
        self.sim.start()
        self.client = self.sim.client()
        self.ask("sample.set", name="cube")
        self.ask("calibration.revert")
        for job in self.ask("job.list")["jobs"]:
            self.ask("job.resume", job=job["job"])
        self.ended("second")
        self.ask("script.submit", text=script(FRAMES), name="second", seed=3)
        self.ended("second")
        self.ask("tube.set", kV=70.0)
        self.past()
        self.sim.advance(1.0)
        assert self.ask("state.get")["axes"]
        self.sim.stop()

    def past(self) -> None:
        """What worker processes do, here."""
        around = TwinContext(
            "", M.model_dump(mode="json", by_alias=True), P.model_dump(mode="json")
        )
        asked: list[Any] = [DatasetList(thumbnail=32)]
        for name in ("first", "second"):
            asked.append(DatasetGet(name=name, measure=True, script=True))
            asked += [DatasetFrame(name=name, index=i) for i in range(FRAMES + 1)]
            asked.append(DatasetFrame(name=name, index=1, kind="line_integral"))
            asked.append(CalibrationFit(datasets=[name], phantom="normal-3"))
            asked.append(CalibrationAlign(name=name))
        asked.append(CalibrationFit(datasets=["first"], phantom="beads.toml"))
        for params in asked:
            try:
                self.said.append(
                    b"".join(work(self.data, params, around, Codec.JSON)).decode()
                )
            except (TwinError, RpcError) as error:
                self.refused.append(str(error))


def content(folder: Path) -> dict[str, tuple[object, ...]]:
    return {
        str(f.relative_to(folder)): (
            f.read_bytes() if f.is_file() else None,
            f.lstat().st_nlink,
        )
        for f in sorted(folder.rglob("*"))
    }


def candidates(name: str) -> list[str]:
    """The names that `name` of a traced life may be in another: dates and numbers are not
    known."""
    now = datetime.now(UTC)
    if DATED.search(name):
        moments = (now + timedelta(seconds=s) for s in range(60))
        return [DATED.sub(f"{m:%Y-%m-%dT%H%M%S} ", name) for m in moments]
    if NUMBERED.search(name):
        start, who = (
            next(directory._TEMPORARY_NUMBERS),
            f"{os.getpid()}-{name.split('-')[-2]}",
        )
        return [NUMBERED.sub(f"{who}-{start + i}", name) for i in range(200)]
    return [name]


class Trace:
    """What an undisturbed life opened and left.

    Attributes:
        folders, files: names of directories and of all others, from the data directory.
        half, whole: data directories after the first part and in the end.
    """

    def __init__(self, root: Path) -> None:
        nothing = root / "nothing"
        nothing.mkdir()
        life = Life(root, nothing)
        self.half, self.whole = root / "half", life.data
        with pytest.MonkeyPatch.context() as patch, life.watched(patch):
            life.first()
            WATCHED.clear()
            shutil.copytree(life.data, self.half)
            WATCHED[:] = [life.data]
            life.second()
        assert OPENED == []
        assert [
            r for r in life.refused if not r.startswith("calibration")
        ] == life.refused
        self.life = life
        named = life.sim.disk.named | {"beads.toml"}
        self.folders = sorted(n for n in named - {"."} if (self.whole / n).is_dir())
        files = sorted(named - {"."} - set(self.folders))
        self.files = list(
            {NUMBERED.sub("N", DATED.sub("D ", n)): n for n in files}.values()
        )


@pytest.fixture(scope="module")
def trace(tmp_path_factory: pytest.TempPathFactory) -> Trace:
    return Trace(tmp_path_factory.mktemp("trace"))


def plant(
    trace: Trace, data: Path, victims: Path, names: Sequence[str], kind: str
) -> list[str]:
    """Links under these names; returns what was planted."""
    planted = []
    for number, traced in enumerate(names):
        victim = victims / f"{number}-{kind}"
        right = trace.whole / traced
        if kind == "directory":
            shutil.copytree(right if right.is_dir() else trace.whole / "first", victim)
        elif kind == "file":
            told = SECRET.encode() if not right.is_file() else right.read_bytes()
            victim.write_bytes(told + b" " * (traced.endswith(".json")))
        for name in candidates(traced):
            link = data / name
            if link.is_dir() and not link.is_symlink():
                shutil.rmtree(link)
            link.unlink(missing_ok=True)
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(victim)
            planted.append(name)
    return planted


def live(trace: Trace, root: Path, names: Sequence[str], kind: str, when: str) -> Life:
    """A life with links under `names`, from the beginning or from the restart on."""
    victims = root / "victims"
    victims.mkdir(parents=True)
    if when == "restart":
        shutil.copytree(trace.half, root / "data", symlinks=True)
    else:
        (root / "data").mkdir()
    plant(trace, root / "data", victims, names, kind)
    before = content(victims)
    life = Life(root, victims)
    with pytest.MonkeyPatch.context() as patch, life.watched(patch):
        if when == "begin":
            life.first()
        life.second()
    assert life.landed == []
    assert OPENED == []
    assert content(victims) == before
    assert SECRET not in "".join(life.said + life.refused)
    if when == "restart":  # what was there and not replaced is there yet
        for file in trace.half.rglob("*.tif"):
            name = str(file.relative_to(trace.half))
            if name not in names and str(Path(name).parent) not in names:
                assert (life.data / name).read_bytes() == file.read_bytes()
    return life


def test_an_undisturbed_life_does_all_of_it(trace: Trace) -> None:
    """Otherwise the test below would plant too little."""
    said = " ".join(trace.files)
    for wanted in ("journal", "state.json", "samples/cube.json", ".bin", "jobs/first.json",
                   " one.json", "first/scan_000000.tif", "first/flexdt.json", "first/script.txt",
                   "second/flexdt.json", ".part-", ".before-"):  # fmt: skip
        assert wanted in said, wanted
    assert trace.folders == [
        "corrections",
        "first",
        "jobs",
        "jobs/status",
        "samples",
        "second",
    ]
    assert (trace.whole / "second" / "scan_000002.tif").exists()


@pytest.mark.parametrize("when", ["begin", "restart"])
@pytest.mark.parametrize("kind", ["file", "directory", "nothing"])
def test_no_link_is_followed(trace: Trace, tmp_path: Path, kind: str, when: str) -> None:
    inner = [
        n for n in trace.folders if "/" in n
    ]  # none below a link in the outer one's place
    outer = [n for n in trace.folders if n not in inner]
    for what, names in (("files", trace.files), ("outer", outer), ("inner", inner)):
        live(trace, tmp_path / what, names, kind, when)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("when", ["begin", "restart"])
@pytest.mark.campaign(1)
def test_no_single_link_is_followed_or_disturbs_the_rest(
    trace: Trace, tmp_path: Path, when: str
) -> None:
    """One name at a time, every fourth, so that the life goes as far as it can."""
    kinds = ("file", "directory", "nothing")
    for number, name in enumerate((*trace.files, *trace.folders)[::4]):
        live(trace, tmp_path / str(number), [name], kinds[number % 3], when)
        shutil.rmtree(tmp_path / str(number))
