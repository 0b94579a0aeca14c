"""A process that may have few descriptors keeps some for a newcomer's E-stop."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from contextlib import ExitStack

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexdt.runtime.descriptors import KEPT, fitted

SERVER = """
import asyncio, resource, sys
from flexdt.server.network.tcp import serve

resource.setrlimit(resource.RLIMIT_NOFILE, (int(sys.argv[1]),) * 2)

class Session:
    async def handle(self, method, params):
        return {"method": method.name}
    def close(self):
        pass

async def main():
    server = await serve(lambda peer: Session())
    await server.serve()
    print(server.port, flush=True)
    await asyncio.sleep(60.0)

asyncio.run(main())
"""


@given(st.integers(1, 5000), st.integers(1, 600), st.integers(150, 9000) | st.none())
def test_places_leave_room_for_what_is_kept(clients, waiting, most):
    few, strangers = fitted(clients, waiting, 16, most)
    assert 1 <= few <= clients
    assert 1 <= strangers <= waiting
    if most is None or clients + waiting + 16 + KEPT <= most:
        assert (few, strangers) == (clients, waiting)
    else:
        assert few + strangers + 16 + KEPT <= most


def asked(connection: socket.socket, method: str) -> dict[str, object]:
    """The answer to one request."""
    params = {"protocol": "1.0", "client": "test"} if method == "session.hello" else {}
    request = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
    connection.sendall(json.dumps(request).encode() + b"\n")
    with connection.makefile("rb") as lines:
        answer: dict[str, object] = json.loads(lines.readline() or b"{}")
    return answer


@pytest.mark.slow
def test_a_newcomer_stops_the_machine_beside_more_clients_than_descriptors():
    """Each of 300 clients keeps its connection; 230 descriptors is all that there are."""
    with ExitStack() as stack:
        server = subprocess.Popen(
            [sys.executable, "-c", SERVER, "230"], stdout=subprocess.PIPE, text=True
        )
        stack.callback(server.wait)
        stack.callback(server.kill)
        assert server.stdout is not None
        address = ("127.0.0.1", int(server.stdout.readline()))

        def dial() -> socket.socket:
            return stack.enter_context(socket.create_connection(address, timeout=20.0))

        held = [asked(one, "session.hello") for one in (dial() for _ in range(300))]
        assert sum("result" in answer for answer in held) >= 64
        assert asked(dial(), "safety.estop") == {
            "jsonrpc": "2.0", "id": 1, "result": {"method": "safety.estop"},
        }  # fmt: skip
