"""The projector's own link beside the twin's TCP shell: `projector_link.py [TURNS]`.

Two processes on this machine answer the same requests, one over `server/projector/wire.py`, the
other over `server/network/tcp.py`, in turns of ten. Prints round trips and the processor time
of both ends. See docs/decisions/0017-two-shells.md.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import sys
import time
from collections import defaultdict
from typing import Any

import numpy as np

from flexdt.clients.client.transport import Link, TcpTransport
from flexdt.protocol import Response, image
from flexdt.protocol import connection as frames
from flexdt.protocol.projector import PROJECTOR_METHODS
from flexdt.runtime.access import ConnectionLimits
from flexdt.server.network import tcp
from flexdt.server.projector.wire import FrameLink, ProjectorLink

VIEWS = {"one image": 1, "five images": 5}
ARRAYS = {
    name: np.random.default_rng(0).random((n, 760, 956), dtype=np.float32)
    for name, n in VIEWS.items()
}
CHUNK = (
    np.random.default_rng(1).integers(0, 255, 8 << 20, dtype=np.uint8).data.toreadonly()
)
GRID = {"shape": [128, 128, 128], "voxel_mm": [1.0, 1.0, 1.0]}
CONE = np.zeros((1, 12)).tolist()
CASES = {
    name: ("project", {"volume": name, "cone_vec": CONE, "detector": [760, 956]})
    for name in VIEWS
} | {"8 MiB up": ("volume.put", {"name": "v", "grid": GRID, "start": 0, "data": CHUNK})}


def own_link(port: Any) -> None:
    """Serve over the projector's link."""
    tasks = set()

    async def serve(link: FrameLink, body: Any) -> None:
        """Answer one request as the projector would."""
        asked: Any = frames.unpack(body)
        if asked.method == "project":
            answer: Any = image.encode(ARRAYS[asked.params["volume"]])
        elif asked.method == "health":
            answer = {"cpu": time.process_time()}
        else:
            answer = {"n": len(image.payload(asked.params["data"]))}
        await link.send(Response(asked.id, answer))

    def on_frame(link: FrameLink, body: Any) -> None:
        task = asyncio.create_task(serve(link, body))
        tasks.add(task)
        task.add_done_callback(tasks.discard)

    async def main() -> None:
        """Listen on a free port, tell it, and serve without an end."""
        made = await asyncio.get_running_loop().create_server(
            lambda: FrameLink(on_frame, lambda *_: None, lambda *_: None), "127.0.0.1", 0
        )
        port.put(made.sockets[0].getsockname()[1])
        await asyncio.Event().wait()

    asyncio.run(main())


class Answers:
    """An application of the twin's shell, and its session."""

    def open(self, peer: object) -> Answers:
        return self

    async def handle(self, method: Any, params: Any) -> Any:
        """Answer as the projector would: an array, its processor time, or how much was
        sent.
        """
        if method.name == "project":
            return image.encode(ARRAYS[params.volume])
        if method.name == "health":
            return {"cpu": time.process_time()}
        return {"n": len(params.data)}

    def close(self) -> None:
        pass


def shell(port: Any) -> None:
    """Serve over the twin's shell."""

    async def main() -> None:
        """Listen on a free port with the twin's shell, tell it, and serve without an end."""
        limits = ConnectionLimits(requests_per_s=None)
        app: Any = Answers()
        made = await tcp.serve(app.open, limits=limits, methods=PROJECTOR_METHODS)
        port.put(made.port)
        await asyncio.Event().wait()

    asyncio.run(main())


async def main(turns: int) -> None:
    """Time both links on each case, and print them.

    Args:
        turns: of ten requests on each link.
    """
    found: Any = multiprocessing.Queue()
    ports = []
    for serve in (own_link, shell):
        multiprocessing.Process(target=serve, args=(found,), daemon=True).start()
        ports.append(found.get())
    own = await ProjectorLink.connect("127.0.0.1", ports[0])
    transport = TcpTransport("127.0.0.1", ports[1])
    await transport.open()
    other = Link(transport, lambda _: None, lambda: None)
    ways: dict[str, Any] = {
        "own link": own.ask,
        "shell": lambda m, p: other.request(m, p, 600.0),
    }
    for name, (method, params) in CASES.items():
        taken, used = defaultdict[str, list[float]](list), defaultdict[str, float](float)
        for _ in range(turns):
            for way, ask in ways.items():
                before = time.process_time() + (await ask("health", {}))["cpu"]
                for _ in range(10):
                    begun = time.perf_counter()
                    answer = await ask(method, params)
                    if method == "project":
                        assert image.decode(answer).shape == ARRAYS[name].shape
                    taken[way].append(1e3 * (time.perf_counter() - begun))
                used[way] += (
                    time.process_time() + (await ask("health", {}))["cpu"] - before
                )
        for way, each in taken.items():
            print(f"{name:12} {way:9} least {min(each):6.2f} ms, median {np.median(each):6.2f} ms, "
                  f"processor time {1e3 * used[way] / len(each):6.2f} ms")  # fmt: skip


if __name__ == "__main__":
    asyncio.run(main(int(sys.argv[1]) if len(sys.argv) > 1 else 12))
