"""Files that appear whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from flexdt.runtime.files.whole_files import write_whole


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
