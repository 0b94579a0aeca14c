"""Attacks on real processes, and what each got: `python tests/studies/attacks.py [NAME...]`.

What no well-formed message tries: broken and vast frames, clients that never end, guessed
tokens, files that are not what they say, links and names that lead elsewhere. Starts a
projector and a twin, tries each, checks that the servers live on and that no line of their logs
is an unhandled exception, and prints a table. Exit code 1 when one got through. Well-formed
messages: see fuzz_schema.py.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from lab import Plain, Refused, Wire, fly_script, machine, projector, twin

Attack = Callable[["Ground"], str]
ATTACKS: list[tuple[str, Attack]] = []
PATIENCE_S = 60.0
"""For what happens a moment later, on a machine that may be busy."""


class Ground:
    """The servers under attack."""

    def __init__(self, folder: Path) -> None:
        """Start a projector and a twin in a folder, with another folder outside the data
        directory.
        """
        self.root = folder
        self.data = folder / "data"
        self.data.mkdir(parents=True)
        self.outside = folder / "outside"
        self.outside.mkdir()
        self.projector = projector(log=folder / "projector.log")
        self.twin = twin(
            self.projector.port, self.data, "--speed-up", "max", log=folder / "twin.log"
        )

    def wire(self) -> Wire:
        return Wire(self.twin.port)

    def raw(self, data: bytes, *, port: int | None = None, wait_s: float = 20.0) -> bytes:
        """Send bytes over a connection of its own, then read until a line, an end or a
        timeout.

        Args:
            data: to send.
            port: of the twin where it is None.
            wait_s: for each part.

        Returns:
            What came, perhaps nothing.
        """
        with socket.create_connection(
            ("127.0.0.1", port or self.twin.port), timeout=wait_s
        ) as s:
            with contextlib.suppress(ConnectionError):
                s.sendall(data)
            got = b""
            with contextlib.suppress(TimeoutError, ConnectionError):
                while not got.endswith(b"\n"):
                    part = s.recv(65536)
                    if not part:
                        break
                    got += part
            return got

    def free(self) -> None:
        """Nobody holds control, whatever the last attack's connections still did."""
        wire = self.wire()
        wire.call("session.control", action="force")
        wire.call("session.control", action="release")
        wire.close()

    def close(self) -> None:
        self.twin.end()
        self.projector.end()


def attack(name: str) -> Callable[[Attack], Attack]:
    """Make a function one of the attacks, called so in the table."""

    def note(run: Attack) -> Attack:
        ATTACKS.append((name, run))
        return run

    return note


def eventually(holds: Callable[[], bool], what: str) -> None:
    """Wait until `holds`, or fail saying `what`."""
    until = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < until, what
        time.sleep(0.02)


def code_of(answer: bytes | dict[str, Any]) -> int:
    document = json.loads(answer) if isinstance(answer, bytes) else answer
    return int(document["error"]["code"])


def refused(wire: Wire, method: str, **params: object) -> Refused:
    """Call a method that has to be refused, and return the error.

    Raises:
        AssertionError: it was answered.
    """
    try:
        result = wire.call(method, **params)
    except Refused as error:
        return error
    raise AssertionError(f"{method} was answered: {str(result)[:200]}")


def upload(wire: Wire, name: str, raw: bytes, **more: Plain) -> dict[str, Any]:
    """Upload bytes as a sample, in parts of 6 MiB; the answer to the last part or the
    first refused.
    """
    answer: dict[str, Any] = {}
    for start in range(0, max(1, len(raw)), 6 << 20):
        part = raw[start : start + (6 << 20)]
        answer = wire.ask(
            "sample.upload", name=name, total=len(raw), start=start,
            data=base64.b64encode(part).decode(), **more,
        )  # fmt: skip
        if "error" in answer:
            break
    return answer


def stl(faces: int, claimed: int | None = None) -> bytes:
    """A binary STL with `faces` triangles of rubbish (12: a cube)."""
    head = b"\0" * 80 + struct.pack("<I", faces if claimed is None else claimed)
    if faces == 12:
        corner = [(x, y, z) for x in (0, 9) for y in (0, 9) for z in (0, 9)]
        quads = [
            (0, 1, 3, 2),
            (4, 6, 7, 5),
            (0, 4, 5, 1),
            (2, 3, 7, 6),
            (0, 2, 6, 4),
            (1, 5, 7, 3),
        ]
        tris = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
        body = b"".join(
            struct.pack("<12fH", 0, 0, 0, *corner[a], *corner[b], *corner[c], 0)
            for a, b, c in tris
        )
        return head + body
    return head + np.random.default_rng(0).bytes(50 * faces)


@attack("broken JSON")
def broken_json(g: Ground) -> str:
    """Lines that are no JSON get -32700, all on connections that go on."""
    codes = {
        code_of(g.raw(line + b"\n"))
        for line in (b"{", b"nonsense", b'{"a":1,}', b"\xff\xfe")
    }
    assert codes == {-32700}, codes
    return "-32700, the connection goes on"


@attack("a line of 100 MB without an end, then with one")
def huge_line(g: Ground) -> str:
    """Send a line of 100 MB: an error, the next line is served, and memory grows by less
    than 64 MB.
    """
    before = g.twin.memory_mb()
    with socket.create_connection(("127.0.0.1", g.twin.port), timeout=30) as s:
        block = b"x" * 2**20
        for _ in range(100):
            s.sendall(block)
        s.sendall(b'\n{"jsonrpc":"2.0","id":1,"method":"session.ping"}\n')
        file = s.makefile("rb")
        first, second = json.loads(file.readline()), json.loads(file.readline())
    assert first["error"]["code"] == -32008
    assert second["result"]["time"] >= 0.0
    grown = g.twin.memory_mb() - before
    assert grown < 64, grown
    return f"-32008, the next line is served; {max(0.0, grown):.0f} MB more memory"


@attack("JSON nested 100 000 deep")
def deep_json(g: Ground) -> str:
    """Deeply nested lists and objects get -32700."""
    n = 100_000
    assert code_of(g.raw(b"[" * n + b"]" * n + b"\n")) == -32700
    assert code_of(g.raw(b'{"a":' * n + b"1" + b"}" * n + b"\n")) == -32700
    return "-32700"


@attack("MessagePack nested 100 000 deep, and lists that claim 4 billion members")
def deep_msgpack(g: Ground) -> str:
    """Deeply nested messages and false sizes get an error from both servers."""
    for port in (g.twin.port, g.projector.port):
        for body in (b"\x91" * 100_000 + b"\xc0", b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff",
                     b"\xc6\xff\xff\xff\xf0"):  # fmt: skip
            with socket.create_connection(("127.0.0.1", port), timeout=20) as s:
                s.sendall(struct.pack(">I", len(body)) + body)
                head = s.recv(4, socket.MSG_WAITALL)
                assert len(head) == 4
                assert b"error" in s.recv(
                    struct.unpack(">I", head)[0], socket.MSG_WAITALL
                )
    return "-32700 from both servers"


@attack("a MessagePack frame that claims 4 GB")
def huge_frame(g: Ground) -> str:
    """A second frame that claims 4 GB gets an error from both servers."""
    for port in (g.twin.port, g.projector.port):
        # The first byte chooses the codec; a second frame announces more than can be.
        body = b"\x00\x00\x00\x01\xc0" + struct.pack(">I", 0xFFFFFFF0) + b"x" * 1000
        got = g.raw(body, port=port)
        assert b"32008" in got or b"larger" in got or b"error" in got, got[:200]
    return "-32008 and the end of that connection"


@attack("half a frame, then gone; 300 times")
def half_frames(g: Ground) -> str:
    """Connections that end within a message leave no descriptors."""
    before = g.twin.descriptors()
    for i in range(300):
        with socket.create_connection(("127.0.0.1", g.twin.port)) as s:
            s.sendall(
                b"\x00\x00\x10\x00abc" if i % 2 else b'{"jsonrpc":"2.0","id":1,"meth'
            )
    eventually(lambda: g.twin.descriptors() <= before + 2, "descriptors are left")
    return "nothing; no descriptor is left"


@attack("a browser posting JSON lines to the loopback port")
def browser(g: Ground) -> str:
    """A browser's request ends its connection, and its body is not carried out."""
    body = b'{"jsonrpc":"2.0","id":1,"method":"safety.estop"}\n'
    head = b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n" % len(body)
    got = g.raw(head + body)
    assert code_of(got) == -32600, got
    assert g.wire().call("state.get")["safety"]["state"] == "ok"
    return "-32600 and the end of that connection; the request in its body is not read"


@attack("1 000 connections at once")
def many(g: Ground) -> str:
    """Of 1 000 connections at most 512 are served, the others refused, and a later client
    is served.
    """
    ping = b'{"jsonrpc":"2.0","id":1,"method":"session.ping"}\n'
    open_ = [
        socket.create_connection(("127.0.0.1", g.twin.port), timeout=30)
        for _ in range(1000)
    ]
    served, turned_away = 0, 0
    for s in open_:
        with contextlib.suppress(ConnectionError):
            s.sendall(ping.replace(b"session.ping", b"state.get"))
    for s in open_:
        with contextlib.suppress(ConnectionError), s.makefile("rb") as answers:
            line = answers.readline()
            if line and "result" in json.loads(line):
                served += 1
            elif line:
                assert code_of(line) == -32003
                turned_away += 1
    for s in open_:
        s.close()
    until = time.monotonic() + 30.0
    while "error" in (answer := json.loads(g.raw(ping))) and time.monotonic() < until:
        time.sleep(0.05)
    assert answer["result"]["time"] >= 0.0
    assert served <= 512, served
    assert served + turned_away == 1000, (served, turned_away)
    return f"{served} served, {turned_away} turned away with -32003; a later client is served"


@attack("a subscriber of every topic that never reads")
def deaf(g: Ground) -> str:
    """A subscriber that never reads costs less than 100 MB; others are answered
    meanwhile.
    """
    s = socket.create_connection(("127.0.0.1", g.twin.port))
    s.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    topics = ["state", "projection", "job", "log"]
    request = {
        "jsonrpc": "2.0",
        "id": 1,
        "method": "state.subscribe",
        "params": {"topics": topics},
    }
    s.sendall(json.dumps(request).encode() + b"\n")
    wire = g.wire()
    wire.call("session.control", action="force")
    worst, before = 0.0, g.twin.memory_mb()
    wire.call("clock.set", speed_up=1)
    wire.call("axes.move", targets={"rot_obj": 3600}, relative=False)
    until = time.monotonic() + 3.0
    while time.monotonic() < until:
        begun = time.perf_counter()
        wire.call("state.get")
        worst = max(worst, time.perf_counter() - begun)
        time.sleep(0.01)
    wire.call("axes.stop")
    wire.call("clock.set", speed_up="max")
    grown = g.twin.memory_mb() - before
    s.close()
    assert grown < 100, grown
    return f"others go on (slowest state.get {1000 * worst:.0f} ms); {max(0, grown):.0f} MB more"


@attack("slowloris: 200 connections, a byte at a time, never a message")
def slowloris(g: Ground) -> str:
    """On a twin that wants a message whole within 3 s instead of 60."""
    server = twin(g.projector.port, g.root / "slow", "--limit", "message_timeout_s=3")
    try:
        honest = Wire(server.port)
        begun = time.monotonic()
        links = {socket.create_connection(("127.0.0.1", server.port)) for _ in range(200)}
        for s in links:
            s.settimeout(0.0)
        asked, cut = 0, 0
        while links and time.monotonic() < begun + 3.0 + PATIENCE_S:
            for s in list(links):
                try:
                    s.send(b"{")
                    over = s.recv(1) == b""
                except BlockingIOError:
                    over = False
                except OSError:
                    over = True
                if over:
                    s.close()
                    links.remove(s)
                    cut += 1
            honest.call("state.get")  # whoever ends its messages is served all the time
            asked += 1
            time.sleep(0.1)
        took = time.monotonic() - begun
        assert not links, f"{len(links)} are still open after {took:.0f} s"
        assert asked > 10
        assert not server.logged("error", "critical", "unstructured")
    finally:
        server.end()
    return f"all {cut} cut off after `message_timeout_s` (3 s here, else 60); others are served"


@attack("listening beyond the loopback without a token")
def open_bind(g: Ground) -> str:
    """No server listens beyond the loopback without a token: exit code 2, and nothing is
    written.
    """
    env = {**os.environ, "FLEXDT_TOKEN": ""}
    started = {
        server: subprocess.Popen(
            [sys.executable, "-m", f"flexdt.{server}.main", "--port=0", "--host=0.0.0.0"],
            env=env, cwd=g.outside, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for server in ("server.twin", "server.projector", "clients.viewer", "clients.gateway")
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
    """Each guess of the token is refused, the right one still served, and the log does
    not hold it.
    """
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
                    answer = wire.ask(
                        "session.hello", protocol="1.0", client="x", token=guess
                    )
                    tries += 1
                    assert code_of(answer) == -32004
        took = time.monotonic() - begun
        wire = Wire(server.port)
        wire.call(
            "session.hello",
            protocol="1.0",
            client="x",
            token="a-long-secret-token-for-tests",
        )
        assert wire.call("session.ping")
        assert "a-long-secret" not in server.log.read_text()
    finally:
        server.end()
    return (
        f"-32004; {tries} guesses took {took:.1f} s, three a connection, growing delays"
    )


ESCAPES = ["../evil", "..", ".", "/tmp/evil", "\\\\host\\share\\evil", "C:\\evil", "C:evil",
           "a/../../evil", "a\\..\\..\\evil", "evil\x00.tif", "NUL", "con.txt", "", " ", "x" * 500,
           "evil\n", "~root", "jobs", "samples", "corrections", "state", "é" * 200]  # fmt: skip


@attack("names of data sets that lead elsewhere")
def escape_names(g: Ground) -> str:
    """Names of data sets lead nowhere outside the data directory."""
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
    """Paths in scripts lead nowhere outside the data set's folder."""
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
    """Links in the data directory are neither written through nor followed to other
    folders.
    """
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


@attack("hostile STL: random bytes, a false count, not a number, huge coordinates")
def hostile_stl(g: Ground) -> str:
    """Broken STL files are refused, and no sample is left of them."""
    wire = g.wire()
    nan = bytearray(stl(12))
    nan[96:100] = struct.pack("<f", float("nan"))
    big = bytearray(stl(12))
    big[96:100] = struct.pack("<f", 3e38)
    raws = [
        stl(1000),
        stl(12, claimed=0xFFFFFFFF),
        bytes(nan),
        bytes(big),
        b"solid x\n" * 100_000,
        b"solid x\nfacet normal 0 0 0\nouter loop\nvertex a b c\n" * 10,
        b"\0" * 84,
        b"x",
    ]
    codes = [
        code_of(upload(wire, f"bad{i}", raw, format="stl")) for i, raw in enumerate(raws)
    ]
    assert set(codes) <= {-32602, -32001, -32008}, codes
    assert not [
        n for n in wire.call("sample.list")["samples"] if n["name"].startswith("bad")
    ]
    return "-32602, nothing is kept"


def glb(count: int, nodes: int = 1, corners: int = 0, **accessor: Plain) -> bytes:
    """A GLB file whose mesh claims `count` vertices, has `corners` and stands `nodes` times."""
    binary = np.random.default_rng(3).random(3 * corners).astype("<f4").tobytes()
    document = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": list(range(nodes))}],
        "nodes": [{"mesh": 0}] * nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"componentType": 5126, "count": count, "type": "VEC3", **accessor}],
        "bufferViews": [{"buffer": 0, "byteLength": len(binary)}],
        "buffers": [{"byteLength": len(binary)}],
    }  # fmt: skip
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text
    body += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


@attack(
    "hostile GLB, PLY and OFF: counts without bytes, a mesh in 10 000 places, other files"
)
def hostile_meshes(g: Ground) -> str:
    """Broken meshes are refused with less than 1 GB in their readers, and no sample is
    left of them.
    """
    ply = b"ply\nformat %s 1.0\nelement vertex 4000000000\nproperty float x\nend_header\n1\n"
    raws = [
        ("glb", glb(30_000_000)),
        ("glb", glb(30_000_000, corners=3, bufferView=0)),
        ("glb", glb(300_000, nodes=10_000, corners=300_000, bufferView=0)),
        (
            "glb",
            glb(3, corners=3, bufferView=0).replace(b'"bufferView"', b'"bufferVuew"'),
        ),
        ("glb", b"glTF" + b"\xff" * 100),
        ("ply", ply % b"ascii"),
        ("ply", ply % b"binary_little_endian"),
        ("ply", b"ply\n" * 100_000),
        ("off", b"OFF\n4000000000 4000000000 0\n0 0 0\n"),
        ("off", b"OFF\n1 1 0\n0 0 0\n1000000000 0\n"),
    ]
    worst, done = 0.0, threading.Event()

    def watch() -> None:
        """Keep the most memory of the twin's children until all is done."""
        nonlocal worst
        while not done.is_set():
            worst = max(worst, g.twin.children_mb())
            time.sleep(0.01)

    thread = threading.Thread(target=watch)
    thread.start()
    wire = g.wire()
    try:
        codes = [
            code_of(upload(wire, f"bad{i}", raw, format=form))
            for i, (form, raw) in enumerate(raws)
        ]
    finally:
        done.set()
        thread.join()
    assert set(codes) == {-32602}, codes
    assert not [
        n for n in wire.call("sample.list")["samples"] if n["name"].startswith("bad")
    ]
    assert 0.0 < worst < 1000.0, worst
    return f"-32602, nothing is kept; their readers took {worst:.0f} MB at most"


@attack("a 100 MB text file as a mesh, while others ask")
def big_mesh(g: Ground) -> str:
    """A 100 MB text file is refused; how long another client waited meanwhile is told,
    not limited.
    """
    worst, done = 0.0, threading.Event()

    def watch() -> None:
        """Keep the longest time of a ping by another client until all is done."""
        nonlocal worst
        other = g.wire()
        while not done.is_set():
            begun = time.perf_counter()
            other.call("session.ping")
            worst = max(worst, time.perf_counter() - begun)
            time.sleep(0.01)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        rng = np.random.default_rng(1)
        line = "".join(f"v {a} {b} {c}\n" for a, b, c in rng.integers(0, 99, (1000, 3)))
        faces = "".join(f"f {a} {b} {c}\n" for a, b, c in rng.integers(1, 999, (1000, 3)))
        raw = (line + faces).encode() * (100_000_000 // len(line + faces))
        wire = Wire(g.twin.port, timeout_s=300)
        begun = time.monotonic()
        answer = upload(wire, "large", raw, format="obj")
        took = time.monotonic() - begun
    finally:
        done.set()
        thread.join()
    assert code_of(answer) in (-32602, -32008), answer
    return (
        f"{code_of(answer)} after {took:.0f} s; twin now {g.twin.memory_mb():.0f} MB; "
        f"slowest ping of another client {1000 * worst:.0f} ms"
    )


@attack("pickles as meshes and voxels")
def pickles(g: Ground) -> str:
    """Pickles sent as meshes or voxels are refused and not executed."""
    import pickle

    mark = g.root / "executed"

    class Bomb:
        def __reduce__(self) -> Any:
            return (os.mkdir, (str(mark),))

    wire = g.wire()
    raw = pickle.dumps(Bomb())
    for form in ("stl", "obj", "ply", "glb", "off"):
        assert "error" in upload(wire, "bomb", raw, format=form)
    voxels = {"kind": "voxels", "format": "raw", "shape": [1, 1, len(raw) // 4 + 1],
              "voxel_mm": [1.0, 1.0, 1.0]}  # fmt: skip
    assert "error" in upload(wire, "bomb", raw, **voxels)
    assert not mark.exists()
    return "-32602, nothing runs"


def retag(raw: bytearray, values: dict[int, int]) -> None:
    """Give tags of a small little-endian TIFF other values."""
    for tag, value in values.items():
        at = next(
            i for t in (3, 4) if (i := raw.find(struct.pack("<HHI", tag, t, 1))) >= 0
        )
        raw[at : at + 12] = struct.pack("<HHII", tag, 4, 1, value)


@attack("TIFF files: claims of 10^10 pixels, decompression bombs, cut off, rubbish")
def hostile_tiff(g: Ground) -> str:
    """Broken TIFF files are refused with less than 200 MB more memory of this process."""
    import io
    import resource
    import zlib

    import tifffile

    from flexdt.runtime.files.dataset_folder import read_image
    from flexdt.twin.dataset.dataset_errors import DatasetError

    honest = io.BytesIO()
    tifffile.imwrite(honest, np.zeros((64, 64), np.uint16), metadata=None)
    whole = honest.getvalue()
    vast = io.BytesIO()  # the head of a huge image without its pixels
    tifffile.imwrite(vast, np.zeros((3, 5), np.uint16), metadata=None)
    claims = bytearray(vast.getvalue())
    retag(claims, {256: 100_000, 257: 100_000})  # width and length
    bomb = io.BytesIO()
    tifffile.imwrite(
        bomb, np.zeros((64, 64), np.uint16), metadata=None, compression="zlib"
    )
    packed = bytearray(bomb.getvalue())
    evil = zlib.compress(b"\0" * (1 << 30), 9)
    retag(packed, {279: len(evil), 273: len(packed)})  # the strip's length and place
    files = {"claims": bytes(claims), "bomb": bytes(packed) + evil, "cut": whole[:200],
             "rubbish": np.random.default_rng(2).bytes(5000), "empty": b""}  # fmt: skip
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for name, raw in files.items():
        path = g.root / f"{name}.tif"
        path.write_bytes(raw)
        try:
            read_image(path)
        except DatasetError:
            continue
        raise AssertionError(f"{name} was read")
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    assert grown < 200, grown
    kib = len(evil) >> 10
    return (
        f"refused, {kib} KiB that inflate to 1 GiB included; {grown:.0f} MB more memory"
    )


@attack("scripts that plan half a terabyte, a billion frames, or a time without an end")
def vast_scripts(g: Ground) -> str:
    """Scripts without an end or room are refused with their problems, and nothing moves."""
    wire = g.wire()
    before = wire.call("state.get")["axes"]
    long = fly_script(360_001, roi="0 0 1943 1535")
    report = wire.call("script.check", text=long)
    assert report["frames"] == 360_001
    assert report["bytes"] > 360_001 * 10**6
    disk = os.statvfs(g.data)
    if disk.f_bavail * disk.f_frsize < report["bytes"]:
        error = refused(wire, "script.submit", text=long, name="vast")
        assert error.code == -32001, error
    for text in (
        "camera\tset number of frames\t999999999\t\tACK\t\t\r\n"
        "camera\ttake and save image sequence\tscan_\t0\tACK\t\t\r\n",
        "camera\tset exposure\t1e300\t\tACK\t\t\r\n",
        "mag_obj\tmove absolute\t1e308\t\tACK\t\t\r\n",
        "mag_obj\tset speed\t1e-300\t\tACK\t\t\r\nmag_obj\tmove absolute\t500\t\tACK\t\t\r\n",
    ):
        report = wire.call("script.check", text=text)
        assert not report["ok"], text
        assert report["problems"]
        assert refused(wire, "script.submit", text=text, name="vast").code in (
            -32005,
            -32001,
        )
    assert not (g.data / "vast").exists()
    assert wire.call("state.get")["axes"] == before
    return "-32001 for the disk, -32005 with their problems; nothing moves"


@attack("200 jobs in a queue of 50")
def many_jobs(g: Ground) -> str:
    """On a twin of its own with `max_jobs=50`, whose clock hardly runs."""
    options = ("--limit", "max_jobs=50", "--speed-up", "0.001")
    server = twin(g.projector.port, g.root / "queue", *options)
    try:
        wire = Wire(server.port)
        jobs = [wire.call("script.submit", text=fly_script(3), name="first")["job"]]
        wire.wait(jobs[0], "running")
        turned_away = 0
        for i in range(199):
            answer = wire.ask("script.submit", text=fly_script(3), name=f"queued{i}")
            if "error" in answer:
                assert code_of(answer) == -32003, answer
                turned_away += 1
            else:
                assert not turned_away, "one was taken after another had been refused"
                jobs.append(answer["result"]["job"])
        assert (len(jobs), turned_away) == (51, 149)
        folders = [p for p in (g.root / "queue").iterdir() if p.name.startswith("queued")]
        assert len(folders) <= 50
        for job in reversed(jobs):
            wire.call("job.abort", job=job)
        for job in jobs:
            wire.wait(job, "aborted")
        assert wire.call("script.submit", text=fly_script(3), name="later")["job"]
    finally:
        server.end()
    return "one runs, 50 wait (`max_jobs`, 1000 by default), 149 get -32003; all can be aborted"


def main() -> int:
    """Make the attacks named on the command line, or all; print a table of what came of
    each.

    Returns:
        1 where one got through or a server logged an error that it did not handle.
    """
    wanted = sys.argv[1:]
    failed = 0
    print(f"Attacks on a twin and a projector. {machine()}.\n")
    print("| attack | got |\n|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        g = Ground(Path(folder))
        try:
            for name, run in ATTACKS:
                if wanted and run.__name__ not in wanted:
                    continue
                try:
                    g.free()
                    got = run(g)
                    assert g.twin.alive(), "the twin has died"
                    assert g.projector.alive(), "the projector has died"
                    assert g.wire().call("session.ping")["time"] >= 0.0
                except Exception as error:
                    failed += 1
                    where = traceback.extract_tb(error.__traceback__)[-1]
                    got = f"**GOT THROUGH**: {error!r:.400} at {where.name}: {where.line}"
                print(f"| {name} | {got} |", flush=True)
        finally:
            g.close()
        bad = [
            e
            for p in (g.twin, g.projector)
            for e in p.logged("error", "critical", "unstructured")
        ]
        for entry in bad[:5]:
            print("LOG:", str(entry)[-1500:])
    tried = len(wanted) or len(ATTACKS)
    print(
        f"\n{tried - failed} of {tried} attacks failed; {len(bad)} unhandled exceptions logged."
    )
    return 1 if failed or bad else 0


if __name__ == "__main__":
    sys.exit(main())
