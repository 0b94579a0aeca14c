"""Batches by lane: urgent items overtake, their neighbours keep their turn, answers their
order."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from flexdt.protocol import METHODS, AnyMethod
from flexdt.protocol.fields import Params
from flexdt.runtime.access import ConnectionLimits
from flexdt.server.network.shell_parts import Peer
from flexdt.server.network.tcp import TcpServer, _Link

ORDINARY, URGENT = "job.pause", "job.abort"
"""Methods whose parameter, a job, tells a test which request it is."""


class Wire(asyncio.Transport):
    """Takes everything, and remembers it."""

    def __init__(self) -> None:
        super().__init__()
        self.written = bytearray()

    def set_write_buffer_limits(
        self, high: int | None = None, low: int | None = None
    ) -> None:
        pass

    def write(self, data: Any) -> None:
        self.written += data

    def is_closing(self) -> bool:
        return False

    def pause_reading(self) -> None:
        pass

    resume_reading = pause_reading

    def answers(self) -> list[Any]:
        return [json.loads(line) for line in self.written.splitlines()]


class Gated:
    """An application that serves ordinary requests only while its gate is open.

    Attributes:
        record: what began and ended, in this order: (event, job).
    """

    def __init__(self) -> None:
        self.gate = asyncio.Event()
        self.record: list[tuple[str, str]] = []

    def open(self, peer: Peer) -> Gated:
        return self

    async def handle(self, method: AnyMethod, params: Params) -> object:
        job = str(getattr(params, "job"))  # noqa: B009
        self.record.append(("begins", job))
        if method.name == ORDINARY:
            await self.gate.wait()
            await asyncio.sleep(0)
        self.record.append(("ends", job))
        return {"job": job}

    def close(self) -> None:
        pass


Item = tuple[str, bool]
"""Method, and whether it wants an answer."""
items = st.tuples(st.sampled_from([ORDINARY, URGENT]), st.booleans())
messages = st.lists(
    st.one_of(items, st.lists(items, min_size=1, max_size=5)), min_size=1, max_size=8
)


def numbered(drawn: list[Item | list[Item]]) -> Iterator[list[dict[str, Any]]]:
    """The requests of each message: those of a batch, or a single one."""
    number = 0
    for message in drawn:
        requests = list[dict[str, Any]]()
        for method, wants in message if isinstance(message, list) else [message]:
            number += 1
            request = {"jsonrpc": "2.0", "method": method, "params": {"job": str(number)}}
            requests.append(request | ({"id": number} if wants else {}))
        yield requests


async def turns(count: int = 300) -> None:
    for _ in range(count):
        await asyncio.sleep(0)


@given(messages, st.lists(st.integers(1, 200), max_size=3))
@settings(max_examples=150, deadline=None)
def test_urgent_items_overtake_and_ordinary_ones_keep_their_turn(
    drawn: list[Item | list[Item]], cuts: list[int]
) -> None:
    async def main() -> None:
        app = Gated()
        server = TcpServer(app.open, ConnectionLimits(), None, METHODS)
        link, transport = _Link(server), Wire()
        link.connection_made(transport)
        sent = list(numbered(drawn))
        lines = [
            json.dumps(requests if isinstance(message, list) else requests[0]).encode()
            + b"\n"
            for message, requests in zip(drawn, sent, strict=True)
        ]
        data = b"".join(lines)
        for cut in cuts:
            link.data_received(data[:cut])
            data = data[cut:]
            await turns(3)
        if data:
            link.data_received(data)
        await turns()

        flat = [request for requests in sent for request in requests]
        ordinary = [r["params"]["job"] for r in flat if r["method"] == ORDINARY]
        urgent = {r["params"]["job"] for r in flat if r["method"] == URGENT}
        # The gate is closed: what is urgent has been served, and one ordinary request has
        # begun.
        served = {job for event, job in app.record if event == "ends"}
        begun = [
            job for event, job in app.record if event == "begins" and job not in urgent
        ]
        assert served == urgent
        assert begun == ordinary[:1]

        app.gate.set()
        await turns()
        ran = [each for each in app.record if each[1] not in urgent]
        assert ran == [(event, job) for job in ordinary for event in ("begins", "ends")]
        assert len(app.record) == 2 * len(flat)  # each was served once

        wanted = []
        for message, requests in zip(drawn, sent, strict=True):
            ids = [request["id"] for request in requests if "id" in request]
            wanted += [ids if isinstance(message, list) else ids[0]] if ids else []
        answers = [
            [one["id"] for one in said] if isinstance(said, list) else said["id"]
            for said in transport.answers()
        ]
        assert sorted(map(str, answers)) == sorted(map(str, wanted))
        with_ordinary = [
            str(ids if isinstance(message, list) else ids[0])
            for message, requests in zip(drawn, sent, strict=True)
            if (ids := [r["id"] for r in requests if "id" in r])
            and any(r["method"] == ORDINARY for r in requests)
        ]
        assert [str(a) for a in answers if str(a) in with_ordinary] == with_ordinary
        link.connection_lost(None)

    asyncio.run(main())
