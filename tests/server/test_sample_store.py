"""Names that uploads may have, now and when a data directory is opened again."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from stored_upload import completed

from flexdt.phantoms import Phantom, load_phantom
from flexdt.runtime.files.directory import open_data
from flexdt.server.storage import stored_samples as samples
from flexdt.server.storage.sample_uploads import UploadHead
from flexdt.server.storage.stored_samples import MAX_CACHED_PHANTOMS, SampleStore
from flexdt.twin.errors import LimitError
from flexdt.twin.scanner.state import EMPTY_STAGE

TAKEN = [EMPTY_STAGE, "lego", "normal", "normal-3", "tall-12", "shepp-logan"]


def head(name: str) -> UploadHead:
    return UploadHead(
        name=name, kind="voxels", format="raw", total=4,
        shape=(1, 1, 1), voxel_mm=(1.0, 1.0, 1.0),
    )  # fmt: skip


@pytest.mark.parametrize("name", TAKEN)
def test_an_upload_does_not_stand_for_something_else(tmp_path: Path, name: str) -> None:
    store = SampleStore(open_data(tmp_path))
    with pytest.raises(LimitError, match="choose another") as refused:
        store.receive(head(name), 0, b"\0" * 4)
    assert refused.value.data["asked"] == name
    assert EMPTY_STAGE in refused.value.data["taken"]


@pytest.mark.parametrize("name", TAKEN)
def test_nor_one_that_lies_there_already(tmp_path: Path, name: str) -> None:
    (tmp_path / "x.json").write_text(head(name).model_dump_json(by_alias=True))
    (tmp_path / "x.bin").write_bytes(b"\0" * 4)
    store = SampleStore(open_data(tmp_path))
    assert store.uploads == ()
    if name != EMPTY_STAGE:
        assert store.load(name) == load_phantom(name)


@pytest.mark.parametrize("name", ["normal-0", "normal-x", "Empty", "emptiness", "lego-2"])
def test_others_may_be_near(tmp_path: Path, name: str) -> None:
    store = SampleStore(open_data(tmp_path))
    assert store.receive(head(name), 0, b"\0" * 4)[0] == 4
    completed(store, name)
    assert SampleStore(open_data(tmp_path)).uploads == (name,)


def test_an_older_file_that_was_being_read_does_not_come_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another file comes under the name while the first is still being read by somebody
    else."""
    first = SampleStore(open_data(tmp_path))
    first.receive(head("a"), 0, np.float32(1.0).tobytes())
    old = completed(first, "a")
    store = SampleStore(open_data(tmp_path))  # knows the name, has read nothing
    honest = samples._parse
    made = []

    def parse(of: UploadHead, raw: bytes, material: str | None) -> Phantom:
        phantom = honest(of, raw, material)
        if not made:
            made.append(phantom)
            store.receive(head("a"), 0, np.float32(2.0).tobytes())
            made.append(completed(store, "a"))
        return phantom

    monkeypatch.setattr(samples, "_parse", parse)
    assert store.load("a") == old  # what was asked for when it was asked
    assert store.load("a") is made[1] != old
    assert store.revision("a") != first.revision("a")


def test_many_threads_may_load(tmp_path: Path) -> None:
    store = SampleStore(open_data(tmp_path))
    names = [f"normal-{k}" for k in range(1, 2 * MAX_CACHED_PHANTOMS)]
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda i: store.load(names[i % len(names)]), range(600)))
    assert [p.name for p in found] == [names[i % len(names)] for i in range(600)]
