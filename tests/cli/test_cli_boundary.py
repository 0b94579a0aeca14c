"""Every class of error leaves with its exit code, readable lines and no traceback."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from flexdt.clients.cli import boundary, command_tree
from flexdt.clients.cli.commands import process_commands as processes
from flexdt.library.failure import CommandError
from flexdt.protocol.rpc_errors import RpcError
from flexdt.runtime.settings import words
from flexdt.twin import errors as twin

HEAVY = ("numpy", "scipy", "numba", "trimesh", "fcl", "cv2", "viser", "pydantic", "tifffile",
         "msgpack", "flexdt.twin.errors", "flexdt.server", "zarr", "dask", "distributed", "bluesky",
         "ophyd_async")  # fmt: skip


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (CommandError("no"), 1),
        (CommandError("no", 5), 5),
        (twin.MachineFileError("flexray.toml: axes.x: bad"), 1),
        (twin.GeometryError("bad"), 1),
        (twin.UnknownNameError("bad"), 1),
        (twin.LimitError("bad"), 3),
        (twin.CollisionError("bad"), 3),
        (twin.NotIdentifiableError("bad"), 5),
        (RpcError(-32700, "bad"), 1),
        (RpcError(-32602, "bad"), 1),
        (RpcError(-32001, "bad"), 3),
        (RpcError(-32002, "bad"), 3),
        (RpcError(-32003, "bad"), 4),
        (RpcError(-32004, "bad"), 4),
        (RpcError(-32005, "bad"), 1),
        (RpcError(-32006, "bad"), 4),
        (RpcError(-32007, "bad"), 5),
        (RpcError(-32008, "bad"), 1),
        (ConnectionRefusedError(111, "Connection refused"), 4),
        (TimeoutError("no answer within 5 s"), 4),
        (FileNotFoundError(2, "No such file or directory", "x.txt"), 1),
        (PermissionError(13, "Permission denied", "x.txt"), 1),
        (OSError(28, "No space left on device", "x.txt"), 1),
        (ZeroDivisionError("division by zero"), 1),
    ],
)
def test_exit_codes(error: Exception, code: int) -> None:
    lines, found = boundary.describe(error)
    assert found == code
    assert lines
    assert all("\n" not in line for line in lines)


def test_positions_of_script_errors_are_printed() -> None:
    error = RpcError(-32005, "the script has 1 error", [
        {"line": 3, "column": 7, "message": "unknown command 'warp'", "code": "unknown_command"},
    ])  # fmt: skip
    lines, _ = boundary.describe(error)
    assert lines == (
        "flexdt: the script has 1 error",
        "script:3:7: unknown command 'warp'",
    )


@pytest.mark.parametrize(
    "argv",
    [
        ["no-such-command"],
        ["up", "--no-such-option"],
        ["up", "--port", "70000"],
        ["up", "--speed-up", "never"],
        ["up", "--tls-cert", "x"],
        ["up", "--log-level", "foo"],
        ["twin", "--projector", "host:1", "--projector-port", "2"],
        ["twin", "--projector", "nowhere:port"],
        ["projector", "--memory-limit", "much"],
    ],
)
def test_usage_errors_leave_with_2(
    argv: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert command_tree.run(argv) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "Traceback" not in captured.err
    assert len(captured.err.splitlines()) == 2


def test_unknown_error_is_one_line_not_a_traceback(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("first\nsecond")

    monkeypatch.delenv("FLEXDT_TRACEBACK", raising=False)
    monkeypatch.setattr(processes, "become", broken)
    assert command_tree.run(["projector"]) == 1
    err = capsys.readouterr().err
    assert err.startswith("flexdt: internal error: RuntimeError: first\n")
    assert "Traceback" not in err


def test_ctrl_c_is_clean(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(
        "flexdt.clients.cli.commands.process_commands.become", interrupted
    )
    assert command_tree.run(["projector"]) == 130
    assert capsys.readouterr().err == "flexdt: interrupted\n"


def test_help_imports_nothing_heavy() -> None:
    program = (
        "import sys\n"
        "from flexdt.clients.cli.command_tree import run\n"
        "code = run(['--help'])\n"
        f"bad = [m for m in sys.modules for h in {HEAVY!r} if f'{{m}}.'.startswith(f'{{h}}.')]\n"
        "sys.exit(str(bad) if bad else code)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "Usage: flexdt" in done.stdout


def test_version() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "flexdt.clients.cli", "--version"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.startswith("flexdt ")


def flexdt(*words: str, **environment: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "flexdt.clients.cli", *words],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**os.environ, **environment},
    )  # fmt: skip


@pytest.mark.parametrize(("volts", "code"), [(90, 0), (1000, 3)])
@pytest.mark.daily(1)
def test_a_reader_that_leaves_changes_neither_the_exit_code_nor_says_anything(
    tmp_path: Path, volts: int, code: int
) -> None:
    script = tmp_path / "s.txt"
    script.write_text(f"tube\tset kV\t{volts}\t\tACK\t\t\r\n")
    with flexdt("check", str(script)) as process:
        assert process.stdout is not None
        process.stdout.close()
        assert process.stderr is not None
        told = process.stderr.read()
    assert process.returncode == code
    assert (b"s.txt:1:1: error" in told) == (code == 3)
    assert b"pipe" not in told
    with flexdt("--help") as process:
        assert process.stdout is not None
        process.stdout.close()
        assert process.stderr is not None
        assert process.stderr.read() == b""
    assert process.returncode == 0


def test_a_reader_of_both_streams_that_leaves_keeps_the_exit_code(
    tmp_path: Path,
) -> None:
    script = tmp_path / "s.txt"
    right, wrong = ("tube\tset kV\t80\t\tACK\t\t\r\n", "tube\tset kVv\t80\t\tACK\t\t\r\n")
    script.write_text(right + 6000 * wrong)
    with subprocess.Popen(
        [sys.executable, "-m", "flexdt.clients.cli", "check", str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    ) as process:
        assert process.stdout is not None
        assert b"s.txt:2:" in process.stdout.readline()
        process.stdout.close()
    assert process.returncode == 1


def test_a_binary_file_is_one_problem(tmp_path: Path) -> None:
    rng = random.Random(5)
    for head in (b"NRRD0005\ntype: float\n\n", b"", b"tube\tset kV\t80\t\tACK\t\t\r\n"):
        file = tmp_path / "volume.nrrd"
        file.write_bytes(head + rng.randbytes(50_000))
        with flexdt("check", str(file)) as process:
            told = process.communicate()[1].decode().splitlines()
        assert process.returncode == 1
        assert [line for line in told if "binary data" in line] == told[:1]
        assert len(told) <= 2


def test_what_the_terminal_cannot_write_is_escaped(tmp_path: Path) -> None:
    script = tmp_path / "Zürich-Łódź.txt"
    script.write_text("tube\tset kV\t1000\t\tACK\t\t\r\n")
    with flexdt("check", str(script), PYTHONIOENCODING="ascii") as process:
        out, err = process.communicate()
    assert process.returncode == 3
    assert b"Z\\xfcrich-\\u0141\\xf3d\\u017a.txt: not ok" in out
    assert b"Z\\xfcrich-\\u0141\\xf3d\\u017a.txt:1:1: error" in err


@pytest.mark.parametrize(
    ("argv", "word"),
    [
        (["twin", "--projector-port", "4321"], "--projector-port 4321"),
        (["up", "--only", "projector", "--port", "4321"], "--port 4321"),
        (["projector", "--projector-port", "4321"], "--port 4321"),
        (["viewer", "--viewer-port", "4321"], "--port 4321"),
        (["viewer", "--limit", "max_pages=3", "--http-port", "0"], "--limit max_pages=3"),
    ],
)
def test_each_process_takes_its_port_by_the_name_that_up_has(
    argv: list[str], word: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[str] = []

    def become(module: str, options: Mapping[str, object]) -> None:
        given.extend(words(options))

    monkeypatch.setattr(processes, "become", become)
    assert command_tree.run(argv) == 0
    assert word in " ".join(given)


@pytest.mark.parametrize(
    ("argv", "code", "says"),
    [
        (
            ["projector", "--port", "0", "--token-file", "nope"],
            1,
            "token file nope: No such file",
        ),
    ],
)
@pytest.mark.slow
def test_a_program_of_its_own_tells_a_wrong_option_in_one_line(
    argv: list[str], code: int, says: str
) -> None:
    with flexdt(*argv) as process:
        out, err = process.communicate()
    assert (process.returncode, out) == (code, b"")
    assert says in err.decode()
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize(
    ("temporary", "asked"),
    [
        ("x.csv.part", "x.csv"),
        ("/a.part/x.csv.part", "/a.part/x.csv"),
        ("/out/.volume.tif.part.tif", "/out/volume.tif"),
        (".volume.nrrd.part.nrrd", "volume.nrrd"),
        ("/home/.hidden/part.txt", "/home/.hidden/part.txt"),
    ],
)
def test_a_file_that_cannot_be_written_is_called_as_it_was_asked_for(
    temporary: str, asked: str
) -> None:
    for number, what in ((13, "Permission denied"), (28, "No space left on device")):
        lines, code = boundary.describe(OSError(number, what, temporary))
        assert (lines, code) == ((f"flexdt: {asked}: {what}",), 1)


@pytest.mark.parametrize("name", ["backup", "restore"])
def test_a_retired_command_says_in_one_line_what_to_do(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command_tree.run([name, "data", "copy.tar"]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert "tar -cf" in said.err


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["state", "--server", "127.0.0.1:9"], 4),
        (["check", "nothere.txt"], 1),
        (["script", "new", "--kind", "fly", "--frames", "5"], 3),
        (["machine", "check", "nothere.toml"], 1),
        (["calibrate", ".", "--phantom", "lego"], 1),
        (["calibrate", "."], 2),
        (["reconstruct", ".", "--out", "nowhere/volume.tif"], 1),
        (["phantom", "make"], 2),
        (["nothing"], 2),
    ],
)
def test_json_of_a_command_that_fails_is_empty(
    words: list[str],
    code: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command_tree.run(["--json", *words]) == code
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("flexdt")


def test_json_of_a_bad_finding_is_its_document(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script = tmp_path / "bad.txt"
    script.write_text("camera set exposure fast ACK\n")
    assert command_tree.run(["--json", "check", str(script)]) == 1
    assert json.loads(capsys.readouterr().out)["ok"] is False
