"""Attacks by numbers: many connections, and clients that do not read or do not end."""

from __future__ import annotations

import contextlib
import json
import socket
import time

from attack_ground import PATIENCE_S, Ground, attack, code_of
from lab import Wire, twin


@attack("1 000 connections at once")
def many(g: Ground) -> str:
    ping = b'{"jsonrpc":"2.0","id":1,"method":"session.ping"}\n'
    open_ = [socket.create_connection(("127.0.0.1", g.twin.port), timeout=30) for _ in range(1000)]
    served, turned_away = 0, 0
    for s in open_:
        with contextlib.suppress(ConnectionError):
            s.sendall(ping)
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
    s = socket.create_connection(("127.0.0.1", g.twin.port))
    s.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    topics = ["state", "projection", "job", "log"]
    request = {"jsonrpc": "2.0", "id": 1, "method": "state.subscribe", "params": {"topics": topics}}
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
