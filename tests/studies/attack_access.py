"""Attacks on what is closed: other addresses, tokens, folders outside the data directory."""

from __future__ import annotations

import base64
import contextlib
import os
import subprocess
import sys
import time
from pathlib import Path

from attack_ground import Ground, attack, code_of, refused, stl
from lab import Wire, fly_script, twin


@attack("listening beyond the loopback without a token")
def open_bind(g: Ground) -> str:
    env = {**os.environ, "FLEXDT_TOKEN": ""}
    started = {
        server: subprocess.Popen(
            [sys.executable, "-m", f"flexdt.server.{server}_main", "--port=0", "--host=0.0.0.0"],
            env=env, cwd=g.outside, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for server in ("twin", "projector", "viewer", "gateway")
    }  # fmt: skip
    try:
        for server, process in started.items():
            out, err = process.communicate(timeout=300)
            assert process.returncode == 2, (server, process.returncode, err)
            assert "token" in err, err
            assert '"ready"' not in out
    finally:
        for process in started.values():
            process.kill()
    assert not list(g.outside.iterdir())
    return "twin, projector, viewer and gateway refuse to start, exit code 2"


@attack("guessing the token")
def guessing(g: Ground) -> str:
    token = g.root / "token"
    token.write_text("a-long-secret-token-for-tests\n")
    server = twin(g.projector.port, g.root / "locked", "--token-file", token)
    try:
        begun, tries = time.monotonic(), 0
        for guess in ("", "a-long-secret-token-for-testz", "x" * 4096, "é" * 20):
            with contextlib.suppress(ConnectionError):
                wire = Wire(server.port)
                assert code_of(wire.ask("state.get")) == -32004
                for _ in range(5):
                    answer = wire.ask("session.hello", protocol="1.0", client="x", token=guess)
                    tries += 1
                    assert code_of(answer) == -32004
        took = time.monotonic() - begun
        wire = Wire(server.port)
        wire.call(
            "session.hello", protocol="1.0", client="x", token="a-long-secret-token-for-tests"
        )
        assert wire.call("session.ping")
        assert "a-long-secret" not in server.log.read_text()
    finally:
        server.end()
    return f"-32004; {tries} guesses took {took:.1f} s, three a connection, growing delays"


ESCAPES = ["../evil", "..", ".", "/tmp/evil", "\\\\host\\share\\evil", "C:\\evil", "C:evil",
           "a/../../evil", "a\\..\\..\\evil", "evil\x00.tif", "NUL", "con.txt", "", " ", "x" * 500,
           "evil\n", "~root", "jobs", "samples", "corrections", "state", "é" * 200]  # fmt: skip


@attack("names of data sets that lead elsewhere")
def escape_names(g: Ground) -> str:
    wire = g.wire()
    text = fly_script(3)
    allowed = []
    for name in ESCAPES:
        answer = wire.ask("script.submit", text=text, name=name)
        if "error" in answer:
            assert answer["error"]["code"] in (-32602, -32001), answer
        else:
            wire.wait(answer["result"]["job"], "done", "failed", "incomplete")
            allowed.append(name)
    stray = [p for p in g.root.rglob("*evil*") if g.data not in p.parents]
    assert not stray, stray
    assert all((g.data / name).is_dir() for name in allowed), allowed
    kept = ", ".join(f"`{name}`" for name in allowed)
    return f"-32602 for {len(ESCAPES) - len(allowed)}; {kept} are plain names in the data directory"


@attack("paths in scripts: drives, shares, parents")
def escape_scripts(g: Ground) -> str:
    wire = g.wire()
    for i, path in enumerate(["..\\..\\evil_", "E:\\..\\..\\evil_", "\\\\host\\share\\evil_",
                              "/etc/evil_", "../../../evil_", "a/b/../../../evil_"]):  # fmt: skip
        text = fly_script(3).replace("\tscan_\t", f"\t{path}\t")
        answer = wire.ask("script.submit", text=text, name=f"paths{i}")
        if "error" not in answer:
            wire.wait(answer["result"]["job"], "done", "failed")
    stray = [p for p in g.root.rglob("evil*") if g.data not in p.parents]
    assert not stray, stray
    assert not Path("/etc/evil_000000.tif").exists()
    return "only the last part is used, inside the data set's folder"


@attack("links planted in the data directory")
def links(g: Ground) -> str:
    wire = g.wire()
    (g.data / "linked").symlink_to(g.outside, target_is_directory=True)
    error = refused(wire, "script.submit", text=fly_script(3), name="linked")
    assert error.code == -32602, error
    job = wire.call("script.submit", text=fly_script(3), name="honest")["job"]
    wire.wait(job, "done")
    (g.outside / "precious").write_text("mine")
    folder = g.data / "planted"
    folder.mkdir()
    (folder / "scan_000000.tif").symlink_to(g.outside / "precious")
    answer = wire.ask("script.submit", text=fly_script(3), name="planted")
    assert "error" in answer
    assert (g.outside / "precious").read_text() == "mine"
    assert sorted(p.name for p in g.outside.iterdir()) == ["precious"]
    return "-32602; nothing is written through a link"


@attack("sample names that lead elsewhere")
def escape_samples(g: Ground) -> str:
    wire = g.wire()
    data = base64.b64encode(stl(12)).decode()
    got = []
    for name in ("../evil", "..", "a/b", "C:\\evil", "x\x00y", "~", "evil.json", "%2e%2e%2fevil"):
        answer = wire.ask("sample.upload", name=name, format="stl", total=len(stl(12)), data=data)
        got.append("error" in answer)
    stray = [p for p in g.root.rglob("*evil*") if g.data / "samples" not in p.parents]
    stray = [p for p in stray if g.data not in p.parents]
    assert not stray, stray
    return f"{sum(got)} of {len(got)} refused with -32602, the others are file names in samples/"
