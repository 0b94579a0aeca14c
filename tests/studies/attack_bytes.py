"""Attacks by bytes: broken, vast, nested, half."""

from __future__ import annotations

import json
import socket
import struct

from attack_ground import Ground, attack, code_of, eventually, refused


@attack("broken JSON")
def broken_json(g: Ground) -> str:
    codes = {code_of(g.raw(line + b"\n")) for line in (b"{", b"nonsense", b'{"a":1,}', b"\xff\xfe")}
    assert codes == {-32700}, codes
    return "-32700, the connection goes on"


@attack("wrong types in a request")
def wrong_types(g: Ground) -> str:
    wire = g.wire()
    bad = [{"targets": "mag_obj"}, {"targets": {"mag_obj": "5"}}, {"targets": {"mag_obj": True}},
           {"targets": []}, {"targets": {"mag_obj": None}}, {"target": {"mag_obj": 5}}]  # fmt: skip
    codes = {refused(wire, "axes.move", **params).code for params in bad}
    assert codes == {-32602}, codes
    return "-32602 with the path of each"


@attack("a line of 100 MB without an end, then with one")
def huge_line(g: Ground) -> str:
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
    n = 100_000
    assert code_of(g.raw(b"[" * n + b"]" * n + b"\n")) == -32700
    assert code_of(g.raw(b'{"a":' * n + b"1" + b"}" * n + b"\n")) == -32700
    return "-32700"


@attack("MessagePack nested 100 000 deep, and lists that claim 4 billion members")
def deep_msgpack(g: Ground) -> str:
    for port in (g.twin.port, g.projector.port):
        for body in (b"\x91" * 100_000 + b"\xc0", b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff",
                     b"\xc6\xff\xff\xff\xf0"):  # fmt: skip
            with socket.create_connection(("127.0.0.1", port), timeout=20) as s:
                s.sendall(struct.pack(">I", len(body)) + body)
                head = s.recv(4, socket.MSG_WAITALL)
                assert len(head) == 4
                assert b"error" in s.recv(struct.unpack(">I", head)[0], socket.MSG_WAITALL)
    return "-32700 from both servers"


@attack("a MessagePack frame that claims 4 GB")
def huge_frame(g: Ground) -> str:
    for port in (g.twin.port, g.projector.port):
        # The first byte chooses the codec; a second frame announces more than can be.
        body = b"\x00\x00\x00\x01\xc0" + struct.pack(">I", 0xFFFFFFF0) + b"x" * 1000
        got = g.raw(body, port=port)
        assert b"32008" in got or b"larger" in got or b"error" in got, got[:200]
    return "-32008 and the end of that connection"


@attack("an integer of 5 000 digits, NaN, 1e999")
def hostile_numbers(g: Ground) -> str:
    line = (
        b'{"jsonrpc":"2.0","id":1,"method":"axes.jog","params":{"axis":"mag_obj","velocity":%s}}\n'
    )
    codes = [code_of(g.raw(line % v)) for v in (b"9" * 5000, b"NaN", b"1e999", b"-Infinity")]
    assert set(codes) <= {-32700, -32602}, codes
    wire = g.wire()
    assert not any(a["moving"] for a in wire.call("state.get")["axes"].values())
    return "-32700 or -32602, nothing moves"


@attack("half a frame, then gone; 300 times")
def half_frames(g: Ground) -> str:
    before = g.twin.descriptors()
    for i in range(300):
        with socket.create_connection(("127.0.0.1", g.twin.port)) as s:
            s.sendall(b"\x00\x00\x10\x00abc" if i % 2 else b'{"jsonrpc":"2.0","id":1,"meth')
    eventually(lambda: g.twin.descriptors() <= before + 2, "descriptors are left")
    return "nothing; no descriptor is left"


@attack("a browser posting JSON lines to the loopback port")
def browser(g: Ground) -> str:
    body = b'{"jsonrpc":"2.0","id":1,"method":"safety.estop"}\n'
    head = b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n" % len(body)
    got = g.raw(head + body)
    assert code_of(got) == -32600, got
    assert g.wire().call("state.get")["safety"]["state"] == "ok"
    return "-32600 and the end of that connection; the request in its body is not read"
