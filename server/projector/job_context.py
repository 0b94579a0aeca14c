"""State of the projector for its methods: the compute thread, the volumes and the clients.

Jobs are started and results are sent from here, in one piece or in parts.
"""

from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.protocol import MAX_FRAME, Correlation, Notification, Role, image
from flexdt.protocol.messages import Id
from flexdt.protocol.rpc_errors import superseded
from flexdt.runtime.log import Sparing
from flexdt.runtime.waiting_room import Guesses, neighbourhood
from flexdt.server.network.admission import TokenCheck
from flexdt.server.projector.compute import (
    ComputeJob,
    ComputeThread,
    Lane,
    Step,
)
from flexdt.server.projector.volume_store import VolumeStore
from flexdt.server.projector.wire import FrameLink

PART_BYTES: Final = 8 * 2**20
"""Payload of a part of a result that does not fit into one frame [bytes]."""
SPARE_BYTES: Final = 4096
"""Room in a frame for everything but the payload [bytes]."""


class JobClient:
    """One connection, its jobs and its requests under way."""

    def __init__(self, link: FrameLink, token: str | None, guesses: Guesses) -> None:
        """Make the state of a connected client, with two lanes and no jobs.

        Args:
            link: its connection.
            token: that it must show; None admits it at once.
            guesses: at the port.
        """
        self.link = link
        self.let_in = token is None
        self.lanes = Lane(), Lane()
        self.jobs: dict[Id, ComputeJob] = {}
        self.calls: Correlation[None] = Correlation(Role.SERVER)
        self.tasks: set[asyncio.Task[None]] = set()
        self.received = 0
        """Number of messages so far."""
        self.pending_bytes = 0
        self.address = neighbourhood(link.peer.rpartition(":")[0])
        self.token_check = TokenCheck(token, self.close_soon, guesses)

    def begin(self, id: Id, key: str | None = None) -> ComputeJob:
        """Make the job of a request, which is known by its id until that is answered."""
        job = self.jobs[id] = ComputeJob(self.lanes[key is not None], key)
        return job

    def displace(self) -> None:
        """Abort the connection: a newer one needs the room."""
        self.link.transport.abort()

    def close_soon(self) -> None:
        """End the connection once its last answer has been sent."""
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
        guesses: wrong tokens so far.
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
    guesses: Guesses = field(default_factory=Guesses)

    @property
    def waiting(self) -> int:
        """Number of requests whose work waits for its turn."""
        return sum(
            job.waits for client in self.clients.values() for job in client.jobs.values()
        )

    async def run(self, client: JobClient, id: Id, step: Step) -> object:
        """Compute a request's one step and return its value."""
        return await client.begin(id).run(self.compute, step)

    def supersede(self, client: JobClient, key: str) -> None:
        """End this client's waiting jobs of that key with an error, and count them."""
        for job in client.jobs.values():
            if job.key == key and job.waits:
                job.end(superseded(key))
                self.superseded += 1

    async def send_array(
        self, client: JobClient, id: Id, array: npt.NDArray[np.generic]
    ) -> dict[str, object]:
        """Make an array the result of a request; one that does not fit into a frame is sent in
        parts.

        Returns {dtype, shape, data}, or {dtype, shape, parts} with the number of parts sent."""
        if array.nbytes + SPARE_BYTES <= MAX_FRAME:
            return image.encode(array)
        parts = await self.send_parts(client, id, array, 0)
        return {"dtype": array.dtype.name, "shape": list(array.shape), "parts": parts}

    async def send_parts(
        self, client: JobClient, id: Id, array: npt.NDArray[np.generic], start: int
    ) -> int:
        """Send an array as `part` notifications of at most `PART_BYTES`, and wait until each is
        written.

        `client`: that called; `id`: of its request; `array`: values, sent flat in C order;
        `start`: index of the array's first value in the whole result.
        Returns the number of parts.
        """
        flat = np.ascontiguousarray(array).reshape(-1)
        step = PART_BYTES // flat.itemsize
        parts = 0
        for at in range(0, flat.size, step):
            data = flat[at : at + step].view(np.uint8).data.toreadonly()
            part = {"request": id, "start": start + at, "data": data}
            await client.link.send(Notification("part", part))
            parts += 1
        return parts
