"""One rule for wrong tokens at every port: later and later by address, with a log line."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from flexdt.protocol.rpc_errors import RpcError
from flexdt.runtime import http_pages
from flexdt.runtime import waiting_room as module
from flexdt.runtime.waiting_room import MAX_ADDRESSES, MAX_DELAY_S, STEP_S, Guesses
from flexdt.server.network.admission import TokenCheck

TOKEN = "a-token-of-some-length"


class Lines:
    """Keeps the lines of a log."""

    def __init__(self) -> None:
        self.told: list[tuple[str, object]] = []

    def log(self, event: str, level: int, **facts: Any) -> None:
        self.told.append((event, facts["count"]))


def at(times: list[float]) -> tuple[Guesses, Lines]:
    lines = Lines()
    return Guesses(lines, lambda: times[0]), lines  # type: ignore[arg-type]


def test_delays_grow_by_address_and_end_with_patience() -> None:
    times = [0.0]
    guesses, lines = at(times)
    delays = [guesses.wrong(f"a#{i}", "192.0.2.1") for i in range(40)]
    assert delays == [min(STEP_S * (i + 1), MAX_DELAY_S) for i in range(40)]
    assert lines.told == [("wrong token", i + 1) for i in range(40)]
    assert guesses.wrong("b", "192.0.2.2") == STEP_S
    v6 = [guesses.wrong("c", f"2001:db8::{i}") for i in range(1, 4)]
    assert v6 == pytest.approx([STEP_S, 2 * STEP_S, 3 * STEP_S])  # one owner's network
    times[0] += module.FORGOTTEN_S + 1.0
    assert guesses.wrong("a", "192.0.2.1") == STEP_S


def test_addresses_are_bounded() -> None:
    guesses, _ = at([0.0])
    for i in range(MAX_ADDRESSES + 500):
        guesses.wrong("x", f"10.{i >> 16}.{(i >> 8) & 255}.{i & 255}")
    assert len(guesses._counts) == MAX_ADDRESSES


def test_a_new_connection_does_not_begin_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []

    async def sleep(seconds: float) -> None:
        slept.append(seconds)

    monkeypatch.setattr(asyncio, "sleep", sleep)

    async def body() -> None:
        guesses, lines = at([0.0])
        for number in range(6):
            check = TokenCheck(TOKEN, lambda: None, guesses)
            with pytest.raises(RpcError):
                await check.check("wrong", f"192.0.2.1:{number}", "192.0.2.1")
        check = TokenCheck(TOKEN, lambda: None, guesses)
        await check.check(TOKEN, "192.0.2.1:9", "192.0.2.1")  # at once
        assert slept == pytest.approx([STEP_S * (i + 1) for i in range(6)])
        assert len(lines.told) == 6

    asyncio.run(body())


def test_metrics_answer_guesses_late_and_log_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    lines, slept = Lines(), list[float]()
    monkeypatch.setattr(http_pages, "Guesses", lambda: Guesses(lines))  # type: ignore[arg-type]
    monkeypatch.setattr(http_pages.time, "sleep", slept.append)

    async def body() -> list[int]:
        page = http_pages.HttpResponse("fine")
        application = http_pages._application(
            {"/metrics": lambda: page}, TOKEN, loopback=False
        )

        def ask(bearer: str | None) -> int:
            asked: dict[str, Any] = {
                "PATH_INFO": "/metrics",
                "REQUEST_METHOD": "GET",
                "REMOTE_ADDR": "192.0.2.7",
                http_pages.ADMIT: lambda: None,
            }
            if bearer is not None:
                asked["HTTP_AUTHORIZATION"] = f"Bearer {bearer}"
            status: list[str] = []
            application(asked, lambda line, head: status.append(line))
            return int(status[0][:3])

        given = ["wrong", "wrong", None, TOKEN, "wrong"]
        return [await asyncio.to_thread(ask, bearer) for bearer in given]

    assert asyncio.run(body()) == [401, 401, 401, 200, 401]
    assert slept == pytest.approx([STEP_S, 2 * STEP_S, 3 * STEP_S])
    assert lines.told == [("wrong token", i) for i in (1, 2, 3)]
