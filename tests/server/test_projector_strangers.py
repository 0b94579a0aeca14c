"""Connections to a projector without a place: a drawn flood beside users of it."""

from __future__ import annotations

import asyncio
import random

import pytest
from strangers import draw, play

from flexdt.protocol import Code, RpcError, hello_params
from flexdt.runtime import waiting_room
from flexdt.runtime.access import ConnectionLimits
from flexdt.server.projector.service import ProjectorServer, serve_projector
from flexdt.server.projector.wire import LinkLost, ProjectorLink

TOKEN = "sixteen letters or more"
PEER = "127.0.0.2"


async def user(server: ProjectorServer, token: str | None = TOKEN) -> ProjectorLink:
    """A user that has introduced itself."""
    link = await ProjectorLink.connect("127.0.0.1", server.port)
    await link.ask("session.hello", hello_params("test", token))
    return link


@pytest.mark.parametrize("token", [TOKEN, None])
@pytest.mark.parametrize("seed", range(2))
def test_users_are_served_whatever_other_peers_do(
    seed: int, token: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(waiting_room, "MAX_WAITING", 12)
    rng = random.Random(seed)

    async def main() -> None:
        limits = ConnectionLimits(max_clients=3)
        server = await serve_projector(memory_limit=2**20, token=token, limits=limits)
        first, playing = await user(server, token), list[asyncio.Task[bytes]]()
        for _ in range(150):
            peer = play(draw(rng), "127.0.0.1", server.port, PEER)
            playing.append(asyncio.create_task(peer))
            if rng.random() < 0.2:
                late = await user(server, token)
                await late.ask("health", {})
                late.close()
            await first.ask("health", {})
            await asyncio.sleep(0.001)
            assert len(server.waiting.guests) <= 12
        assert len(server.seated) <= 3
        first.close()
        await server.close()
        heard = await asyncio.gather(*playing)
        assert not any(b"instance" in said for said in heard)  # no peer was greeted

    asyncio.run(asyncio.wait_for(main(), 120))


def test_a_place_is_free_again_and_one_too_many_is_told() -> None:
    async def main() -> None:
        limits = ConnectionLimits(max_clients=2)
        server = await serve_projector(memory_limit=2**20, token=TOKEN, limits=limits)
        first, second = await user(server), await user(server)
        with pytest.raises(RpcError, match="too many clients") as told:
            await user(server)
        assert told.value.code == Code.BUSY
        second.close()
        while len(server.seated) == 2:
            await asyncio.sleep(0)
        third = await user(server)
        for link in (first, third):
            await link.ask("health", {})
            link.close()
        await server.close()

    asyncio.run(asyncio.wait_for(main(), 60))


def test_little_is_taken_from_a_peer_without_the_token() -> None:
    """A large frame is refused by its length, and of many small ones the connection ends."""

    async def main() -> None:
        server = await serve_projector(memory_limit=2**20, token=TOKEN)
        link = await ProjectorLink.connect("127.0.0.1", server.port)
        with pytest.raises((LinkLost, RpcError)):
            await link.ask("volume.put", {"name": "x", "data": bytes(40_000)})
        link = await ProjectorLink.connect("127.0.0.1", server.port)
        for _ in range(10):
            with pytest.raises(RpcError) as refused:
                await link.ask("health", {})
            assert refused.value.code == Code.NOT_AUTHORISED
        with pytest.raises(LinkLost):
            await link.ask("health", {})
        large = await user(server)
        with pytest.raises(RpcError) as told:  # read, whatever it holds
            await large.ask("volume.put", {"name": "x", "data": bytes(40_000)})
        assert told.value.code == Code.INVALID_PARAMS
        large.close()
        await server.close()

    asyncio.run(asyncio.wait_for(main(), 60))
