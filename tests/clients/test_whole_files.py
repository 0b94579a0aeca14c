"""Files that appear whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from flexdt.runtime.files.whole_files import bytes_of, write_whole


def test_a_file_that_cannot_be_written_whole_leaves_no_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, content: bytes) -> int:
        path.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space"):
        write_whole(tmp_path / "a.json", "{}")
    assert list(tmp_path.iterdir()) == []


def test_the_size_of_a_folder_is_that_of_its_files(tmp_path: Path) -> None:
    """As of a volume in `.zarr`, which is a folder."""
    folder = tmp_path / "v.zarr"
    (folder / "0" / "c").mkdir(parents=True)
    for name, count in (("zarr.json", 10), ("0/zarr.json", 20), ("0/c/0", 3000)):
        (folder / name).write_bytes(bytes(count))
    assert bytes_of(folder) == 3030
    assert bytes_of(folder / "0" / "c" / "0") == 3000
