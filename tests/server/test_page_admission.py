"""The pages for monitoring: who is served where many come, and for which Host."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexdt.runtime import http_pages
from flexdt.runtime.http_pages import HttpResponse, served_pages
from flexdt.runtime.process_settings import ServerSettings

PAGES = {
    "/healthz": lambda: HttpResponse("well"),
    "/metrics": lambda: HttpResponse("figures"),
}
TOKEN = "a-token-of-some-length"


def with_pages(work: Callable[[int], Awaitable[None]], **more: object) -> None:
    async def main() -> None:
        settings = ServerSettings(http_port=0, **more)  # type: ignore[arg-type]
        async with served_pages(PAGES, settings) as ready:
            await asyncio.wait_for(work(int(str(ready["http_port"]))), 120)

    asyncio.run(main())


async def ask(port: int, head: bytes) -> int:
    """The status of the answer; 0 where there is none."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(head)
    answer = await reader.read()
    writer.close()
    return int(answer.split(b" ")[1]) if answer else 0


hosts = st.tuples(
    st.sampled_from([("127.0.0.1", 200), ("localhost", 200), ("[::1]", 200), ("127.9.8.7", 200),
                     ("evil.example", 403), ("127.0.0.1.evil.example", 403), ("localhost.x", 403),
                     ("10.0.0.7", 403), ("", 403), ("[::", 403)]),
    st.sampled_from(["", ":9101", ":80"]),
    st.sampled_from(["Host", "host", "HOST"]),
    st.sampled_from(["/healthz", "/metrics"]),
)  # fmt: skip


@given(st.lists(hosts, min_size=40, max_size=40))
@settings(max_examples=2, deadline=None)
def test_pages_of_other_sites_read_nothing(
    drawn: list[tuple[tuple[str, int], str, str, str]],
) -> None:
    """A name that its owner has rebound to the loopback is told by the Host that it comes
    with."""

    async def work(at: int) -> None:
        for (name, status), port, field, path in drawn:
            head = f"GET {path} HTTP/1.1\r\n{field}: {name}{port}\r\n\r\n".encode()
            assert await ask(at, head) == status
            assert (
                await ask(at, f"GET {path} HTTP/1.0\r\n\r\n".encode()) == 200
            )  # no browser's

    with_pages(work)


def test_peers_that_hold_connections_keep_nobody_out(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Neither silent ones, nor halves of requests, nor requests without the token."""
    monkeypatch.setattr(http_pages, "MAX_UNADMITTED", 8)
    monkeypatch.setattr(http_pages, "MAX_ANSWERED", 2)
    token = tmp_path / "token"
    token.write_text(TOKEN)
    honest = (
        b"GET /metrics HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer %b\r\n\r\n"
        % TOKEN.encode()
    )

    async def work(port: int) -> None:
        with contextlib.ExitStack() as stack:
            for said in (b"", b"GET /metrics HTTP/1.1\r\nHost:", b"\x00\xff\xfe") * 20:
                one = stack.enter_context(socket.create_connection(("127.0.0.1", port)))
                one.sendall(said)
                assert await ask(port, b"GET /metrics HTTP/1.1\r\nHost: x\r\n\r\n") == 401
                assert await ask(port, honest) == 200
        threads = [t for t in threading.enumerate() if "request" in t.name]
        assert len(threads) <= 8 + 2 + 4  # those of displaced ones end at once

    with_pages(work, http_host="0.0.0.0", token_file=token)


@pytest.mark.parametrize(
    "error", [RuntimeError, NotImplementedError, TimeoutError, KeyError]
)
def test_what_a_page_raises_is_no_held_loop(error: type[Exception]) -> None:
    def broken() -> HttpResponse:
        raise error("mine")

    async def body() -> None:
        application = http_pages._application({"/metrics": broken}, None, loopback=False)
        asked = {
            "PATH_INFO": "/metrics",
            "REQUEST_METHOD": "GET",
            http_pages.ADMIT: lambda: None,
        }
        with pytest.raises(error, match="mine"):
            await asyncio.to_thread(application, asked, lambda line, head: None)

    asyncio.run(body())
