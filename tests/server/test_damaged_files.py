"""Files of ours that are damaged or missing: set aside, said, and the twin starts without
them."""

from __future__ import annotations

import json
import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import pytest
from faults import READS, damaged, starts
from simulation import Simulation
from whole_run import PARTS, Part, voxels

from flexdt.runtime.files.directory import Directory


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data directory after a whole run: corrections, an upload on the stage, scans."""
    before = None
    for name in PARTS:
        part = Part(name, tmp_path_factory.mktemp("part"), before)
        with part.sim:
            part.go()
        before = part.sim.data
    assert before is not None
    return before


def on(whole: Path, root: Path, damage: Callable[[Path], object]) -> dict[str, Any]:
    """What a server says that starts on a damaged copy: state, corrections, uploads, log."""
    shutil.copytree(whole, root / "data")
    damage(root / "data")
    with Simulation(root) as sim:
        sim.start()
        client = sim.client()
        for method in READS:
            sim.call(client, method)
        sim.call(client, "state.subscribe", topics=["log"])
        sim.advance(0.5)
        return {
            "state": sim.call(client, "state.get"),
            "corrections": [
                c["name"] for c in sim.call(client, "calibration.list")["corrections"]
            ],
            "uploads": [
                s["name"]
                for s in sim.call(client, "sample.list")["samples"]
                if s["uploaded"]
            ],
            "told": [e["data"]["message"] for e in client.of("log")],
            "logged": [r.getMessage() for r in sim.log if r.levelname == "ERROR"],
            "facts": [getattr(r, "facts", {}) for r in sim.log],
            "aside": sorted(
                str(f.relative_to(sim.data)) for f in sim.data.rglob("*unreadable*")
            ),
        }


def correction(data: Path, name: str) -> Path:
    return next((data / "corrections").glob(f"*{name}.json"))


@pytest.mark.slow
def test_files_that_claim_any_size_are_not_read(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sparse files of 8 GB, under every name that is read whole, take no room and no memory."""
    taken, real = list[int](), Directory.open

    def opened(folder: Directory, name: str) -> Counted:
        return Counted(real(folder, name), taken)

    def damage(data: Path) -> None:
        for name in names:
            os.truncate(data / name, 8 << 30)

    files = [f.relative_to(whole) for f in whole.rglob("*") if f.is_file()]
    names = [f for f in files if f.suffix in (".json", ".bin")]
    assert {"state.json", "corrections", "jobs", "samples"} <= {f.parts[0] for f in names}
    monkeypatch.setattr(Directory, "open", opened)
    found = on(whole, tmp_path, damage)
    assert max(taken, default=0) < 1 << 20
    assert found["state"]["sample"]["name"] is None
    assert (found["corrections"], found["uploads"]) == ([], [])
    assert {"state.unreadable.json"} < set(found["aside"])
    reasons = [said["reason"] for said in found["facts"] if "reason" in said]
    assert sum("8589934592 bytes" in reason for reason in reasons) >= 4


class Counted:
    """A file, and the sizes of what is read of it."""

    def __init__(self, file: BinaryIO, taken: list[int]) -> None:
        self.file, self.taken = file, taken

    def __enter__(self) -> Counted:
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.file, name)

    def read(self, size: int = -1) -> bytes:
        whole = os.fstat(self.file.fileno()).st_size
        self.taken.append(whole if size < 0 else min(size, whole))
        if self.taken[-1] > 1 << 30:
            raise MemoryError
        return self.file.read(size)


def test_a_damaged_correction_in_force_leaves_the_twin_nominal(
    whole: Path, tmp_path: Path
) -> None:
    found = on(whole, tmp_path, lambda data: correction(data, "scenic").write_text("{"))
    assert found["state"]["correction"] is None
    assert found["corrections"] == ["one", "two"]
    assert found["logged"] == ["a correction cannot be read; without it"]
    assert any("'scenic', is lost: none is in force" in line for line in found["told"])
    assert [a.endswith(" scenic.unreadable.json") for a in found["aside"]] == [True]


@pytest.mark.parametrize("number", ["1e999", "NaN", "-Infinity", "1e300", '"0.5"'])
def test_numbers_that_no_scanner_has_are_damage(
    number: str, whole: Path, tmp_path: Path
) -> None:
    def damage(data: Path) -> None:
        file = correction(data, "one")
        file.write_text(file.read_text().replace('"dD_x": 0.5', f'"dD_x": {number}'))

    found = on(whole, tmp_path, damage)
    assert found["state"]["correction"]["name"] == "scenic"
    assert found["corrections"] == ["two", "scenic"]
    assert found["logged"] == ["a correction cannot be read; without it"]


@pytest.mark.parametrize(
    "how", ["missing", "cut", "other bytes", "no head", "absurd pitch"]
)
def test_an_upload_that_stood_on_the_stage_and_cannot_be_read(
    how: str, whole: Path, tmp_path: Path
) -> None:
    def damage(data: Path) -> None:
        raw, head = next((data / "samples").glob("*.bin")), data / "samples" / "cube.json"
        match how:
            case "missing":
                raw.unlink()
            case "cut":
                raw.write_bytes(raw.read_bytes()[:-1])
            case "other bytes":
                raw.write_bytes(bytes(len(raw.read_bytes())))
            case "no head":
                head.unlink()
            case _:
                document = json.loads(head.read_text())
                head.write_text(json.dumps({**document, "voxel_mm": [1e160, 1.0, 1.0]}))

    found = on(whole, tmp_path, damage)
    assert found["state"]["sample"]["name"] is None
    assert found["uploads"] == []
    assert any(
        "'cube', which stood on the stage, cannot be read" in t for t in found["told"]
    )
    assert bool(found["aside"]) is (how != "no head")


def test_an_upload_may_come_again_after_it_was_set_aside(
    whole: Path, tmp_path: Path
) -> None:
    shutil.copytree(whole, tmp_path / "data")
    next((tmp_path / "data" / "samples").glob("*.bin")).unlink()
    with Simulation(tmp_path) as sim:
        sim.start()
        client = sim.client()
        sim.call(client, "sample.upload", **voxels(0.04))
        sim.call(client, "sample.set", name="cube")
        sim.kill()
        sim.start()
        assert sim.call(sim.client(), "state.get")["sample"]["name"] == "cube"


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_server_starts_whatever_bit_is_another_one(whole: Path, tmp_path: Path) -> None:
    rng = random.Random(6)
    for number in range(25):
        folder = tmp_path / str(number)
        shutil.copytree(whole, folder / "data")
        kept = [
            f for f in sorted(folder.rglob("*")) if f.is_file() and f.suffix != ".tif"
        ]
        damaged(rng.choice(kept), rng)
        starts(folder, number)
