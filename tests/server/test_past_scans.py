"""`dataset.*`: what a scan left behind is told as it is; damaged folders harm nobody."""

from __future__ import annotations

import asyncio
import json
import os
import random
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tifffile
from lab import Process, fly_script, twin

import flexdt as fx
from flexdt.clients.client.client import TwinClient
from flexdt.protocol import Codec, RpcError
from flexdt.protocol.fields import Params
from flexdt.protocol.methods.calibration_messages import (
    DatasetFrame,
    DatasetFrameResult,
    DatasetGet,
    DatasetList,
)
from flexdt.runtime.wire_errors import explain, from_root, is_user_error
from flexdt.server.storage import past_scans
from flexdt.server.storage.past_scans import PastScans, TwinContext, work
from flexdt.twin.machine.description import builtin_machine, profile_of

FRAMES = 7
MACHINE = builtin_machine("flexray")
PROFILE = profile_of(MACHINE, None)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def server(rays: Process, data: Path) -> Iterator[Process]:
    process = twin(rays.port, data, "--sample", "lego", "--speed-up", "max")
    with TwinClient(port=process.port) as client:
        client.submit_script(fly_script(frames=FRAMES), "first scan")
        assert client.wait_job().state == "done"
    yield process
    process.end()


def asked(root: Path, params: Params, running: str = "") -> Any:
    """In this process, what a worker does; the wire's error where it is one for a user."""
    machine = MACHINE.model_dump(mode="json", by_alias=True)
    around = TwinContext(running, machine, PROFILE.model_dump(mode="json"))
    try:
        return json.loads(b"".join(work(root, params, around, Codec.JSON)))
    except Exception as error:
        if not is_user_error(error):
            raise
        raise explain(error) from None


def listed(root: Path, **how: Any) -> list[dict[str, Any]]:
    return list(asked(root, DatasetList(**how))["datasets"])


@pytest.mark.slow
def test_a_scan_is_told_as_its_folder_says(server: Process, data: Path) -> None:
    """Against its own files, read here by json and tifffile alone."""
    folder = data / "first scan"
    document = json.loads((folder / "flexdt.json").read_text("utf-8"))
    frames = document["frames"]
    with TwinClient(port=server.port) as client:
        [info] = client.datasets().datasets
        assert (info.name, info.state, info.machine) == (
            "first scan",
            "complete",
            "flexray",
        )
        assert (info.projections, info.present) == (FRAMES, FRAMES)
        assert (info.kV, info.sample) == (
            document["tube"]["kV"],
            document["sample"]["name"],
        )
        told = client.dataset("first scan", measure=True, script=True)
        assert told.info == info
        assert told.same_machine
        made = told.made.model_dump()
        assert made.pop("correction") == (document["correction"] or {}).get("name")
        sample = document["sample"]
        assert made.pop("sample") == sample["name"]
        assert made == {key: sample[key] for key in made}
        assert told.images == len(frames)
        assert told.indices == list(range(len(frames)))
        assert told.files == [f["file"] for f in frames]
        assert told.kinds == [f["kind"] for f in frames]
        assert told.times_s == [f["time_s"] for f in frames]
        for motor, values in told.positions.items():
            assert values == [f["positions"][motor] for f in frames]
        assert told.script is not None
        assert told.script.encode() == (folder / "script.txt").read_bytes()
        images = [tifffile.imread(folder / f["file"]) for f in frames]
        assert told.counts == pytest.approx([float(i.mean()) for i in images], rel=1e-6)
        assert told.clearance_mm is not None
        assert min(told.clearance_mm) > 0
        assert told.clearance_of == "the machine and the cylinder around the sample"
        for index in (0, 1, len(frames) - 1):
            pixels, about = client.dataset_frame("first scan", index)
            assert np.array_equal(pixels, images[index])
            assert about.cone_vec == frames[index]["cone_vec"]
            assert about.positions == frames[index]["positions"]
            assert (about.image, about.file) == (
                frames[index]["kind"],
                frames[index]["file"],
            )
            number = int(about.file[5:11]) if about.file.startswith("scan_") else None
            assert about.projection == number
        dark, flat = (
            np.mean(
                [i for i, f in zip(images, frames, strict=True) if f["kind"] == kind],
                axis=0,
            )
            for kind in ("dark", "flat")
        )
        integrals, _ = client.dataset_frame(
            "first scan", len(frames) - 1, "line_integral"
        )
        lit = images[-1] > dark + 1
        expected = -np.log((images[-1] - dark)[lit] / (flat - dark)[lit])
        assert np.asarray(integrals)[lit] == pytest.approx(expected, abs=1e-5)
        halved, _ = client.dataset_frame("first scan", 1, binning=2)
        rows, cols = (2 * (n // 2) for n in images[1].shape)
        mean = (
            images[1][:rows, :cols].reshape(rows // 2, 2, cols // 2, 2).mean(axis=(1, 3))
        )
        assert np.abs(np.asarray(halved, dtype=float) - mean).max() <= 0.5


def test_a_scanner_s_own_texts_tell_the_poses(server: Process, data: Path) -> None:
    """Against flexdt.json of the same scan, which is taken away. The texts have fewer
    digits."""
    whole = json.loads((data / "first scan" / "flexdt.json").read_text("utf-8"))
    shots = [f for f in whole["frames"] if f["kind"] == "projection"]
    shutil.copytree(data / "first scan", data / "texts")
    (data / "texts" / "flexdt.json").unlink()
    try:
        told = asked(data, DatasetGet(name="texts"))
        assert told["same_machine"]
        assert told["times_s"] is None
        assert (told["info"]["kV"], told["info"]["state"]) == (
            whole["tube"]["kV"],
            "complete",
        )
        assert told["kinds"].count("projection") == FRAMES
        first = told["kinds"].index("projection")
        for motor, values in told["positions"].items():
            assert values[:first] == [None] * first
            stated = [f["positions"][motor] for f in shots]
            assert values[first:] == pytest.approx(stated, abs=2e-3)
        for index, shot in enumerate(shots):
            frame = asked(data, DatasetFrame(name="texts", index=first + index))
            assert frame["cone_vec"] == pytest.approx(shot["cone_vec"], abs=2e-2)
            assert frame["tube"] == {**whole["tube"], "on": True}
            there = {n: shot[n] for n in ("exposure_ms", "mode", "averages", "roi")}
            assert frame["camera"] == there
            there = asked(data, DatasetFrame(name="first scan", index=first + index))
            assert frame["camera"] == there["camera"]
        (
            data / "texts" / "io000000.tif"
        ).unlink()  # a link among the files is none of them
        (data / "texts" / "io000000.tif").symlink_to(data / "first scan" / "io000000.tif")
        told = asked(data, DatasetGet(name="texts"))
        assert "io000000.tif" not in told["files"]
        assert (told["kinds"].count("projection"), told["same_machine"]) == (FRAMES, True)
    finally:
        shutil.rmtree(data / "texts")


def test_the_nearest_parts_are_those_the_check_finds(server: Process, data: Path) -> None:
    """The dry run's least clearance is of the whole motion, so no image is nearer than it; and
    of the sample's own shape, which the cylinder contains, so images of the scan may say
    less."""
    with TwinClient(port=server.port) as client:
        near = client.dataset("first scan", measure=True).clearance_mm
        checked = client.check_script(fly_script(frames=FRAMES)).min_clearance_mm
    assert near is not None
    assert checked is not None
    bare = asked(data, DatasetGet(name="first scan", measure=True))["clearance_mm"]
    assert bare == near
    assert all(mm is not None for mm in near)
    assert min(mm for mm in near if mm is not None) > 0.2 * checked


def test_mean_counts_that_were_late_are_read_the_next_time(
    server: Process, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(data / "first scan", tmp_path / "scan")
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now)

    def slow(path: Path) -> Any:
        clock.now += past_scans.MEASURE_S / 2
        return tifffile.imread(path)

    monkeypatch.setattr(past_scans, "time", clock)
    monkeypatch.setattr(past_scans.files, "read_image", slow)
    known = [0]
    while True:
        told = asked(tmp_path, DatasetGet(name="scan", measure=True))
        there = [mean for mean in told["counts"] if mean is not None]
        assert len(there) > known[-1]
        known.append(len(there))
        if len(there) == told["images"]:
            break
    assert len(known) > 3
    images = [tifffile.imread(tmp_path / "scan" / file) for file in told["files"]]
    assert there == pytest.approx([float(image.mean()) for image in images], rel=1e-6)


@pytest.mark.parametrize(
    "name",
    ["..", ".", "../data", "first scan/..", "jobs", "no such", "con", "a:b", "/etc"],
)
def test_no_name_leads_anywhere_else(server: Process, name: str) -> None:
    with TwinClient(port=server.port) as client:
        for call in (lambda: client.dataset(name), lambda: client.dataset_frame(name, 0)):
            with pytest.raises(RpcError) as refused:
                call()
            assert refused.value.code == -32602


# Damage -------------------------------------------------------------------------------------------


def cut(folder: Path, rng: random.Random) -> None:
    """A file ends early."""
    file = rng.choice(sorted(f for f in folder.iterdir() if f.is_file()))
    file.write_bytes(file.read_bytes()[: rng.randrange(file.stat().st_size)])


def garbled(folder: Path, rng: random.Random) -> None:
    """Some bytes of a file are others."""
    file = rng.choice(sorted(f for f in folder.iterdir() if f.is_file()))
    raw = bytearray(file.read_bytes())
    for _ in range(rng.randrange(1, 40)):
        raw[rng.randrange(min(len(raw), rng.choice([200, len(raw)])))] = rng.randrange(
            256
        )
    file.write_bytes(raw)


def lost(folder: Path, rng: random.Random) -> None:
    """A file is not there."""
    rng.choice(sorted(f for f in folder.iterdir() if f.is_file())).unlink()


@pytest.mark.parametrize(
    "file", ["flexdt.json", "io000000.tif", "scan_000001.tif", "none of all"]
)
@pytest.mark.daily(1)
def test_replies_do_not_say_where_the_data_lie(
    server: Process, data: Path, file: str
) -> None:
    """Errors and warnings about damaged files name them below the data directory."""
    folder = data / "spoilt"
    shutil.copytree(data / "first scan", folder)
    try:
        if (folder / file).exists():
            (folder / file).write_bytes((folder / file).read_bytes()[:400])
        else:
            (folder / "scan settings.txt").write_text("SOD : x\n")
        told: list[str] = []
        with TwinClient(port=server.port) as client:
            for ask in (
                lambda: client.dataset("spoilt", measure=True),
                lambda: client.dataset_frame("spoilt", 3, "line_integral"),
                lambda: client.fit_calibration(["spoilt"], "lego", tracks=True),
                lambda: client.align_dataset("spoilt"),
                lambda: client.submit_script(fly_script(frames=FRAMES), "spoilt"),
            ):
                try:
                    told.append(repr(ask()))
                except RpcError as error:
                    told.append(f"{error.message} {error.data}")
        assert f"spoilt/{file}" in " ".join(told) or file == "none of all"
        for part in (data, data.parent):
            assert str(part) not in " ".join(told)
    finally:
        shutil.rmtree(folder)


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ("/d/a/x/y.tif is bad", "x/y.tif is bad"),
        ("nothing in /d/a.", "nothing in the data directory."),
        ("/d/a: full", "the data directory: full"),
        ("/d/a2/x, /d/a.old/x", "/d/a2/x, /d/a.old/x"),
        ({"asked": ["/d/a/x", 3]}, {"asked": ["x", 3]}),
    ],
)
def test_paths_are_told_from_the_data_directory(said: object, told: object) -> None:
    assert from_root(said, Path("/d/a")) == told


def strange(folder: Path, rng: random.Random) -> None:
    """A file is a folder, a link to elsewhere, a pipe, or of another kind."""
    file = rng.choice(sorted(f for f in folder.iterdir() if f.is_file()))
    elsewhere = folder.parent.parent / "elsewhere"
    raw = file.read_bytes()
    elsewhere.write_bytes(raw)
    file.unlink()
    rng.choice([
        file.mkdir,
        lambda: file.symlink_to(elsewhere),
        lambda: os.mkfifo(file),
        lambda: tifffile.imwrite(file, np.zeros((3, 5, 4), np.uint8)),
        lambda: tifffile.imwrite(file, np.zeros((30, 40), np.uint16)),
    ])()  # fmt: skip


def other(folder: Path, rng: random.Random) -> None:
    """flexdt.json says something else."""
    path = folder / "flexdt.json"
    document = json.loads(path.read_text("utf-8"))
    frames = document["frames"]
    frame = rng.choice(frames)
    rng.choice([
        lambda: document.update(schema=2),
        lambda: document.update(frames=[]),
        lambda: document.update(machine={"name": 7}),
        lambda: document.update(profile={}),
        lambda: document.update(name="../../etc", operator="<script>alert(1)</script>"),
        lambda: document["sample"].update(diameter_mm=1e308, height_mm=1e308),
        lambda: document["detector"].update(rows=2**40),
        lambda: frame.update(file="../../elsewhere"),
        lambda: frame.update(mode="no such mode"),
        lambda: frame.update(roi=[5, 5, 1, 1]),
        lambda: frame["positions"].pop("mag_obj"),
        lambda: frame["positions"].update(mag_obj=1e300),
        lambda: frames.extend(frames * 400),
        lambda: document.update(correction={"name": "c", "date": "x", "parameters": {"no": 1.0}}),
    ])()  # fmt: skip
    path.write_text(json.dumps(document), "utf-8")


FOR_USERS = (-32602, -32001, -32008)


def answers(root: Path) -> list[dict[str, Any]]:
    """Everything that can be asked, each answered by a result or an error for users."""
    found = listed(root, thumbnail=64)
    for name in ["scan", *(info["name"] for info in found)]:
        try:
            told = asked(root, DatasetGet(name=name, measure=True))
        except RpcError as error:
            if error.code not in FOR_USERS:
                raise
            continue
        for index in {0, told["images"] // 2, max(0, told["images"] - 1)}:
            for kind in ("counts", "line_integral"):
                try:
                    frame = asked(root, DatasetFrame(name=name, index=index, kind=kind))  # type: ignore[arg-type]
                except RpcError as error:
                    if error.code not in FOR_USERS:
                        raise
                else:
                    DatasetFrameResult.model_validate(frame)
    return found


@pytest.mark.parametrize("seed", range(40))
def test_damage_is_said_and_nothing_else_is(
    server: Process, data: Path, tmp_path: Path, seed: int
) -> None:
    """A damaged data set never hides the one beside it, nor is it said to be what it is not."""
    rng = random.Random(seed)
    root = tmp_path / "data"
    for name in ("scan", "sound"):
        shutil.copytree(data / "first scan", root / name)
    done = [
        rng.choice([cut, garbled, lost, strange, other])
        for _ in range(rng.choice([1, 1, 3]))
    ]
    for damage in done:
        try:
            damage(root / "scan", rng)
        except (OSError, ValueError):
            continue  # what it would damage has been damaged before
    found = answers(root)
    sound = next(info for info in found if info["name"] == "sound")
    assert (sound["state"], sound["present"], sound["problem"]) == (
        "complete",
        FRAMES,
        "",
    )
    for info in found:
        there = [f for f in (root / info["name"]).glob("scan_*.tif") if f.is_file()]
        assert info["present"] <= len(there)
        if info["state"] == "complete":
            assert not info["problem"]
            assert info["present"] == info["projections"]


def test_a_huge_document_is_listed_unread_and_refused(
    data: Path, server: Process, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(data / "first scan", tmp_path / "big")
    with (tmp_path / "big" / "flexdt.json").open("ab") as file:
        file.truncate(past_scans.MAX_DOCUMENT_BYTES + 1)
    [info] = listed(tmp_path)
    assert info["state"] == "unknown"
    assert "allowed: " in info["problem"]
    told = asked(tmp_path, DatasetGet(name="big"))
    assert told["times_s"] is None
    assert not told["same_machine"]
    assert told["positions"] == {}
    assert told["images"] == FRAMES + 2
    monkeypatch.setattr(past_scans, "MAX_SCRIPT_BYTES", 10)
    with pytest.raises(RpcError) as refused:
        asked(tmp_path, DatasetGet(name="big", script=True))
    assert refused.value.code == -32008


def test_odd_names_and_other_folders_are_no_data_sets(
    data: Path, server: Process, tmp_path: Path
) -> None:
    for name in ("<b>", "a\nb", ".hidden", "jobs", "ünïcode ✓", "a" * 129):
        (tmp_path / name).mkdir()
    for name in ("ünïcode ✓", "<b>"):
        shutil.copytree(data / "first scan", tmp_path / name, dirs_exist_ok=True)
    os.mkdir(os.fsencode(tmp_path) + b"/\xff\xfe")
    (tmp_path / "link").symlink_to(data / "first scan")
    told = asked(tmp_path, DatasetList())
    assert [info["name"] for info in told["datasets"]] == ["ünïcode ✓"]
    assert told["left_out"] == 4  # <b>, a\nb, the long one, and bytes that are no text
    with pytest.raises(RpcError):
        asked(tmp_path, DatasetGet(name="link"))


def test_search_pages_and_what_is_running(
    data: Path, server: Process, tmp_path: Path
) -> None:
    for k in range(5):
        shutil.copytree(data / "first scan", tmp_path / f"set-{k}")
        os.utime(tmp_path / f"set-{k}", (k, k))
    told = asked(tmp_path, DatasetList(count=2, start=1))
    assert [d["name"] for d in told["datasets"]] == ["set-3", "set-2"]
    assert told["total"] == 5
    assert [d["name"] for d in listed(tmp_path, search="LEGO set-4 complete")] == [
        "set-4"
    ]
    assert [d["name"] for d in listed(tmp_path, search="90kV set")][:1] == ["set-4"]
    assert listed(tmp_path, search="no such word") == []
    states = {
        d["name"]: d["state"] for d in asked(tmp_path, DatasetList(), "set-1")["datasets"]
    }
    assert states == {f"set-{k}": "running" if k == 1 else "complete" for k in range(5)}


def test_a_list_without_time_says_what_it_has_not_read(
    data: Path, server: Process, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for k in range(3):
        shutil.copytree(data / "first scan", tmp_path / f"late {k}")
    monkeypatch.setattr(past_scans, "LIST_S", -1.0)
    told = asked(tmp_path, DatasetList(thumbnail=64))
    assert told["unread"] == 3
    assert {d["problem"] for d in told["datasets"]} == {"not read yet"}
    monkeypatch.undo()
    told = asked(tmp_path, DatasetList(thumbnail=32))
    assert told["unread"] == 0
    assert {d["problem"] for d in told["datasets"]} == {""}
    assert {tuple(d["thumbnail"]["shape"]) for d in told["datasets"]} == {(32, 32)}


def test_folders_that_come_and_go_disturb_no_list(
    data: Path, server: Process, tmp_path: Path
) -> None:
    root, over = tmp_path / "data", threading.Event()
    shutil.copytree(data / "first scan", root / "stays")

    def unrest() -> None:
        k = 0
        while not over.is_set():
            shutil.copytree(
                data / "first scan", root / f"goes {k % 3}", dirs_exist_ok=True
            )
            shutil.rmtree(root / f"goes {k % 3}")
            k += 1

    thread = threading.Thread(target=unrest)
    thread.start()
    try:
        for _ in range(25):
            names = [info["name"] for info in answers(root)]
            assert names.count("stays") == 1
            assert len(set(names)) == len(names)
    finally:
        over.set()
        thread.join()


def test_the_loop_goes_on_while_something_is_read(data: Path, server: Process) -> None:
    async def both() -> tuple[int, bytes]:
        scans, turns = PastScans(data, MACHINE, PROFILE), 0
        try:
            params = DatasetGet(name="first scan", measure=True)
            answer = asyncio.create_task(scans.ask(params, "", Codec.JSON))
            while not answer.done():
                await asyncio.sleep(0.001)
                turns += 1
            return turns, b"".join((await answer).pieces)
        finally:
            scans.close()

    turns, answer = asyncio.run(both())
    assert turns > 20
    assert json.loads(answer)["info"]["state"] == "complete"


def test_work_that_takes_too_long_is_ended_and_the_next_is_done(
    data: Path, server: Process, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a disk that does not answer: the worker is killed, its client gets an error."""

    async def asks() -> str:
        scans = PastScans(data, MACHINE, PROFILE)
        try:
            scans._workers.seconds = 0.001
            with pytest.raises(RpcError) as refused:
                await scans.ask(DatasetList(), "", Codec.JSON)
            assert refused.value.code == -32008
            scans._workers.seconds = past_scans.MAX_WORK_S * 10
            answer = await scans.ask(DatasetList(), "", Codec.JSON)
            return str(json.loads(b"".join(answer.pieces))["datasets"][0]["name"])
        finally:
            scans.close()

    assert asyncio.run(asks()) == "first scan"


def test_another_makers_scan_tells_what_became_of_its_values(tmp_path: Path) -> None:
    folder = tmp_path / "theirs"
    folder.mkdir()
    for i in range(4):
        tifffile.imwrite(folder / f"p_{i + 1}.tif", np.full((6, 9), 500, np.uint16))
    said = {
        "Projections": 4, "WhiteLevel": 1000, "DetectorPixelsX": 9, "DetectorPixelsY": 6,
        "DetectorPixelSizeX": 0.2, "DetectorPixelSizeY": 0.2, "SrcToObject": 100,
        "SrcToDetector": 400, "AngularStep": 90, "unknown_thing": 7,
    }  # fmt: skip
    text = "".join(f"{key}={value}\n" for key, value in said.items())
    (folder / "p.xtekct").write_text(text)
    fx.open(folder).save(tmp_path / "data" / "bought")
    told = asked(tmp_path / "data", DatasetGet(name="bought"))
    assert [one["field"] for one in told["provenance"]] == list(said)
    assert told["provenance"][-1] == {
        "field": "unknown_thing",
        "value": "7",
        "use": "ignored",
        "consequence": "not known to flexdt",
    }
