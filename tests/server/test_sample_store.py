"""Names that uploads may have, now and when a data directory is opened again."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flexdt.phantoms import load_phantom
from flexdt.server.samples import EMPTY, SampleStore, UploadHead
from flexdt.twin.errors import LimitError

TAKEN = [EMPTY, "lego", "normal", "normal-3", "tall-12", "shepp-logan"]


def head(name: str) -> UploadHead:
    return UploadHead(name, "voxels", "raw", 4, shape=(1, 1, 1), voxel_mm=(1.0, 1.0, 1.0))


@pytest.mark.parametrize("name", TAKEN)
def test_an_upload_does_not_stand_for_something_else(tmp_path: Path, name: str) -> None:
    store = SampleStore(tmp_path)
    with pytest.raises(LimitError, match="choose another") as refused:
        store.receive(head(name), 0, b"\0" * 4)
    assert refused.value.data["asked"] == name
    assert EMPTY in refused.value.data["taken"]


@pytest.mark.parametrize("name", TAKEN)
def test_nor_one_that_lies_there_already(tmp_path: Path, name: str) -> None:
    fields = {"schema": 1, **head(name).__dict__}
    (tmp_path / "x.json").write_text(json.dumps(fields))
    (tmp_path / "x.bin").write_bytes(b"\0" * 4)
    store = SampleStore(tmp_path)
    assert store.uploads == ()
    if name != EMPTY:
        assert store.load(name) == load_phantom(name)


@pytest.mark.parametrize("name", ["normal-0", "normal-x", "Empty", "emptiness", "lego-2"])
def test_others_may_be_near(tmp_path: Path, name: str) -> None:
    store = SampleStore(tmp_path)
    assert store.receive(head(name), 0, b"\0" * 4) == 4
    store.complete(name)
    assert SampleStore(tmp_path).uploads == (name,)
