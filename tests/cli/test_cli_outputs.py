"""Output paths are tried before the work: nothing computed is lost to a folder that is none."""

from __future__ import annotations

from pathlib import Path

import pytest

from flexdt.clients.cli.command_tree import run
from flexdt.runtime.files.writable import require_writable

COMMANDS = {
    "calibrate": ["calibrate", "nothing", "--phantom", "lego", "--report"],
    "align": ["align", "nothing", "--out"],
    "reconstruct": ["reconstruct", "nothing", "--out"],
    "export": ["export", "nothing", "--format", "astra", "--out"],
    "check": ["check", "{script}", "--html"],
    "script new": ["script", "new", "--kind", "fly", "--out"],
    "machine new": ["machine", "new", "mine", "--out"],
    "machine fit": ["machine", "fit", "{script}", "--out"],
}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_path_below_a_file_is_refused_before_the_work(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The data set does not exist either: that the path is named shows that it came first."""
    script, below = tmp_path / "script.txt", tmp_path / "file" / "out.json"
    script.write_text("rot_obj move absolute 90 ACK\n")
    (tmp_path / "file").write_text("in the way")
    words = [word.format(script=script) for word in COMMANDS[name]]
    assert run([*words, str(below)]) == 1
    told = capsys.readouterr().err
    assert str(below) in told
    assert "nothing" not in told
    assert "Traceback" not in told


def test_a_path_that_can_be_written_leaves_nothing_behind(tmp_path: Path) -> None:
    require_writable(tmp_path / "new" / "deep" / "file.json")
    require_writable(tmp_path / "file.json")
    require_writable(tmp_path)
    require_writable(None)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_takes_no_files_is_named() -> None:
    with pytest.raises(OSError, match="/proc/flexdt/report") as caught:
        require_writable(Path("/proc/flexdt/report.html"))
    assert caught.value.strerror
