"""What the projector's methods work with: the compute thread, the volumes, the clients.

Jobs are started and results are sent from here, in one piece or in parts. The methods are in
`projector_methods`, the connections in `service`.
"""

from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.protocol import MAX_FRAME, Correlation, Notification, Role, image
from flexdt.protocol.messages import Id
from flexdt.protocol.rpc_errors import superseded
from flexdt.runtime.log import Sparing
from flexdt.server.network.shell_parts import TokenCheck
from flexdt.server.projector.compute import ComputeJob, ComputeThread, Customer
from flexdt.server.projector.volumes import VolumeStore
from flexdt.server.projector.wire import FrameLink

PART_BYTES: Final = 8 * 2**20
"""Payload of a part of what does not fit into one frame."""
SPARE: Final = 4096
"""Room for everything but the payload in a frame."""


class JobClient(Customer):
    """One connection, its jobs and its requests that are under way."""

    def __init__(self, link: FrameLink, token: str | None, lines: Sparing) -> None:
        super().__init__()
        self.link, self.let_in = link, token is None
        self.jobs: dict[Id, ComputeJob] = {}
        self.calls: Correlation[None] = Correlation(Role.SERVER)
        self.tasks: set[asyncio.Task[None]] = set()
        self.pending_bytes = 0
        self.token_check = TokenCheck(token, self._close_soon, lines)

    def _close_soon(self) -> None:
        """End the connection once its last answer has gone out."""
        asyncio.get_running_loop().call_later(0.1, self.link.transport.close)


@dataclass(eq=False, repr=False)
class Context:
    """The projector's state.

    Attributes:
        compute: the thread that computes.
        store: named volumes.
        token: clients must bring it.
        facts: backend and threads, for `health`.
        clients: by connection.
        instance: names this start of the server.
        started: when it was [s], monotonic.
        views: projected so far.
        superseded: requests that newer ones have replaced.
        lines: of the log about connections.
    """

    compute: ComputeThread
    store: VolumeStore
    token: str | None
    facts: Mapping[str, object]
    clients: dict[FrameLink, JobClient] = field(default_factory=dict)
    instance: str = field(default_factory=lambda: uuid.uuid4().hex)
    started: float = field(default_factory=time.monotonic)
    views: int = 0
    superseded: int = 0
    lines: Sparing = field(default_factory=Sparing)

    def start(self, client: JobClient, id: Id, job: ComputeJob) -> ComputeJob:
        """Submit a job, known by its request's id until that is answered."""
        client.jobs[id] = job
        return self.compute.submit(job)

    async def run(self, client: JobClient, id: Id, step: Callable[[], object]) -> object:
        """One step in the compute thread; returns its value.

        Raises:
            RpcError: the step failed or was cancelled.
        """
        return await self.start(client, id, ComputeJob(client, iter((step,)))).next()

    def took(self, client: JobClient, job: ComputeJob) -> None:
        """A client has taken a block: the next may be computed."""
        client.took(job)
        self.compute.queue.wake()

    def finish(self, client: JobClient, id: Id) -> None:
        """A request has been answered."""
        job = client.jobs.pop(id, None)
        if job is not None:
            client.finish(job)
            self.compute.queue.wake()

    def supersede(self, client: JobClient, key: str) -> None:
        """End this client's interactive jobs of that key that have not been computed."""
        self.superseded += self.compute.give_up(
            lambda job: job.customer is client and job.key == key, superseded(key)
        )

    async def send_array(
        self, client: JobClient, id: Id, array: npt.NDArray[np.generic]
    ) -> dict[str, object]:
        """An array as the result of a request; what does not fit has gone before, in parts."""
        if array.nbytes + SPARE <= MAX_FRAME:
            return image.encode(array)
        parts = await self.send_parts(client, id, array, 0)
        return {"dtype": array.dtype.name, "shape": list(array.shape), "parts": parts}

    async def send_parts(
        self, client: JobClient, id: Id, array: npt.NDArray[np.generic], start: int
    ) -> int:
        """Send an array as parts of a result, from its element `start` on; how many."""
        flat = np.ascontiguousarray(array).reshape(-1)
        step = PART_BYTES // flat.itemsize
        parts = 0
        for at in range(0, flat.size, step):
            data = flat[at : at + step].view(np.uint8).data.toreadonly()
            part = {"request": id, "start": start + at, "data": data}
            await client.link.send(Notification("part", part))
            parts += 1
        return parts
