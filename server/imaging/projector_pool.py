"""One or several projector servers behind one twin: each request goes to one that is free.

Each of several projectors holds at most `MAX_OPEN_REQUESTS`, so a fast one, which is free
more often, gets more of them. One that is lost rests for `REST_S`, and its requests go to
others, or to itself after that. One that is much slower than usual is not given up, but a
second one is asked as well, and the first answer counts: all projectors of one kind give
the same bytes. When the pool's patience ends, it raises `ProjectorUnavailable`.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

from flexdt.protocol import Code, RpcError
from flexdt.runtime.log import Sparing, log
from flexdt.runtime.wire_errors import ProjectorUnavailable
from flexdt.server.imaging.projector_client import ProjectorClient
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection import Body
from flexdt.twin.projection.pixel_areas import Need, Within

MAX_OPEN_REQUESTS: Final = 2
"""Largest number of requests that a projector has: one is computed while the other travels."""
REST_S: Final = 1.0
"""Time for which a projector that did not answer gets no requests [s]."""
LATE_S: Final = 1.0
"""Time after which a request may count as late [s]."""
LATE_FACTOR: Final = 6.0
"""Multiple of the usual time, after `LATE_S`, at which another projector is asked as well."""


Work = Callable[[ProjectorClient, Body | None], Awaitable[Any]]
"""What is asked of a projector's client about a body."""


@dataclass(eq=False)
class _Member:
    """A projector of the pool.

    Attributes:
        client: its client.
        open: requests under way.
        pace_s: for a view, lately; None before the first.
        rests_until: end of its rest, on the loop's clock.
        kind: version and backend; None while unknown.
        views: made so far.
    """

    client: ProjectorClient
    open: int = 0
    pace_s: float | None = None
    rests_until: float = 0.0
    kind: tuple[str, str] | None = None
    views: int = 0


@dataclass(eq=False)
class _Asked:
    """Whom one request has been sent to.

    Attributes:
        deadline: end of the patience, on the loop's clock.
        late: time at which another projector is asked as well.
        running: requests under way -> their projectors.
        members: projectors asked since none ran.
        refused: projectors that answered with an error.
    """

    deadline: float
    late: float = 0.0
    running: dict[asyncio.Future[Any], _Member] = field(default_factory=dict)
    members: set[_Member] = field(default_factory=set)
    refused: set[_Member] = field(default_factory=set)

    def answers(self, task: asyncio.Future[Any], now: float, size: int) -> bool:
        """Take out a request that has ended, and return whether it has the answer.

        Args:
            task: of `running`, done.
            now: on the loop's clock.
            size: number of projectors.

        Raises:
            ProjectorUnavailable, RpcError: its failure, where no other projector can
                answer in its place.
        """
        member = self.running.pop(task)
        try:
            task.result()
        except ProjectorUnavailable:
            # While another one works, its answer may come however late.
            if not self.running and now >= self.deadline:
                raise
            return False
        except RpcError as error:
            self.refused.add(member)
            # The request itself is wrong, and so it is for all.
            if error.code == Code.INVALID_PARAMS or len(self.refused) == size:
                raise
            return False
        return True


class ProjectorPool:
    """Projector servers behind one twin.

    Args:
        clients: of the servers.
        patience_s: how long a call goes on when every server fails [s].
    """

    def __init__(
        self, clients: Sequence[ProjectorClient], patience_s: float = 5.0
    ) -> None:
        """Take one member for each client; nothing is connected or sent yet.

        `patience_s` is how long a call goes on while every projector fails [s].
        """
        self._members = [_Member(client) for client in clients]
        self.patience_s = patience_s
        self._values: dict[str, Body] = {}
        self._turn: asyncio.Future[None] | None = None
        self._open: set[asyncio.Task[Float32Array | None]] = set()
        self._lines = Sparing()

    def __len__(self) -> int:
        return len(self._members)

    @property
    def connected(self) -> bool:
        """Whether there is a connection to any projector now."""
        return any(member.client.connected for member in self._members)

    @property
    def views(self) -> Mapping[str, int]:
        """Views that each projector has made, by its address."""
        return {f"{m.client.host}:{m.client.port}": m.views for m in self._members}

    async def close(self) -> None:
        """Cancel the open requests, then close every client's connection for good, one by
        one.
        """
        for task in self._open:
            task.cancel()
        for member in self._members:
            await member.client.close()

    async def room(self) -> int | None:
        """Return the memory that the largest projector can have for one sample [bytes].

        All are asked at once, each for at most `LATE_S`. None if no projector's is
        known (`_room_of`)."""
        found = await asyncio.gather(*map(_room_of, self._members))
        return max((room for room in found if room is not None), default=None)

    async def put(self, name: str, body: Body) -> None:
        """Keep a body under a name, and send it to one projector, which shows that it
        fits.

        Others get it with their first request for it. It stays kept if sending fails.
        Raises as `_request`."""
        self._values[name] = body
        await self._request(name, 0, None)

    async def remove(self, name: str) -> None:
        """Forget a body and have all projectors remove it; their failures are ignored.

        Those that do not answer lose it when they restart."""
        self._values.pop(name, None)
        removals = (member.client.remove(name) for member in self._members)
        await asyncio.gather(*removals, return_exceptions=True)

    async def project(
        self, name: str, cone_vec: ConeVec, shape: tuple[int, int]
    ) -> Float32Array:
        """Compute line integrals on one of the projectors.

        `name`: of a body that `put` has kept; `cone_vec`: n views, object frame; `shape`:
        detector (rows, cols).
        Returns float32 (n, rows, cols).
        Raises ProjectorUnavailable, RpcError: as `_request`."""
        images: Float32Array = await self._request(
            name,
            len(cone_vec),
            lambda client, body: client.project(name, body, cone_vec, shape),
        )
        return images

    async def rays_needed(
        self,
        name: str,
        cone_vec: ConeVec,
        shape: tuple[int, int],
        need: tuple[Need, float],
    ) -> Within:
        """Find the pixels that need several rays, as `ProjectorClient.rays_needed`."""
        within: Within = await self._request(
            name,
            0,
            lambda client, body: client.rays_needed(name, body, cone_vec, shape, need),
        )
        return within

    async def paths_within(
        self, name: str, cone_vec: ConeVec, shape: tuple[int, int], within: Within
    ) -> Float32Array:
        """Compute line integrals along several rays of some pixels, as
        `ProjectorClient.paths_within`."""
        paths: Float32Array = await self._request(
            name,
            0,
            lambda client, body: client.paths_within(name, body, cone_vec, shape, within),
        )
        return paths

    async def _request(self, name: str, views: int, work: Work | None) -> Any:
        """Request something of a free projector, and of another one if it is late; take the
        first answer.

        A request is late after `LATE_S` and `LATE_FACTOR` times the time that its views
        usually take. A projector that fails rests (`_ask`), and the request goes to the
        next. Waits without a limit while all are busy; failures count only once none of
        its requests runs. Requests that lose are canceled only if this one ends with
        an error; else they keep their place until answered.

        Args:
            name: of the body.
            views: number of views that are projected, of which the pace is kept; 0 for
                work whose pace is not.
            work: what is asked of a projector's client, with the body; None sends the
                body alone.

        Returns:
            The value of `work`, or None without.

        Raises:
            ProjectorUnavailable: a projector has failed after `patience_s`, with none
                left running.
            RpcError: invalid parameters, at once; another error once every projector
                has refused.
        """
        loop = asyncio.get_running_loop()
        ask = partial(
            self._ask, name=name, value=self._values.get(name), views=views, work=work
        )
        asked = _Asked(loop.time() + self.patience_s)
        try:
            while True:
                now = loop.time()
                # All that wait share one future; a done one has woken those of before.
                if self._turn is None or self._turn.done():
                    self._turn = loop.create_future()
                self._ask_another(asked, ask, views, now)
                done, _ = await asyncio.wait(
                    {*asked.running, self._turn},
                    timeout=self._until_wake(asked.late, now),
                    return_when=asyncio.FIRST_COMPLETED,
                )
                for task in asked.running.keys() & done:
                    if asked.answers(task, loop.time(), len(self)):
                        asked.running.clear()  # late requests keep their place until answered
                        return task.result()
                # All have failed: after their rest each is asked again, until the patience
                # ends.
                if not asked.running:
                    asked.members.clear()
        finally:
            # There are some only after an error, or where the requester has gone.
            for task in asked.running:
                task.cancel()

    def _ask_another(
        self,
        asked: _Asked,
        ask: Callable[[_Member], Coroutine[Any, Any, Any]],
        views: int,
        now: float,
    ) -> None:
        """Ask a free projector if none is asked, or if the one asked last is late; nothing
        happens while all others are busy.

        `asked`: whom the request has been sent to; changed. `ask`: sends it. `views`: how many
        it asks for. `now`: on the loop's clock.
        """
        if asked.running and now < asked.late:
            return
        # One that is late keeps the request, and one that refused it would refuse it again.
        member = self._free_member(asked.members | asked.refused, now)
        if member is None:
            return
        asked.members.add(member)
        asked.running[self._start_request(member, ask(member))] = member
        # By its own pace: a slow projector that works as usual is not late.
        asked.late = now + LATE_S + LATE_FACTOR * (member.pace_s or 0.0) * views

    def _until_wake(self, late: float, now: float) -> float | None:
        """Return the time until a request is late or a projector has rested [s]; None if
        neither is to come.
        """
        wakes = [m.rests_until for m in self._members if m.rests_until > now]
        if late > now:
            wakes.append(late)
        return min(wakes) - now if wakes else None

    def _free_member(self, asked: set[_Member], now: float) -> _Member | None:
        """Choose the next projector: of the free ones that with least to do, then the
        fastest; None if none is free.

        Those in `asked` and those that rest are not free; a single projector has no limit
        of open requests. Unknown pace counts as fastest.
        """
        # A single projector queues by itself; the limit is for dealing out among several.
        limit = MAX_OPEN_REQUESTS if len(self) > 1 else math.inf
        free = (
            m
            for m in self._members
            if m not in asked and m.open < limit and m.rests_until <= now
        )
        # One of unknown pace is taken for the fastest, so that it is measured soon.
        return min(free, key=lambda m: (m.open, m.pace_s or 0.0), default=None)

    def _start_request(
        self, member: _Member, asking: Coroutine[Any, Any, Any]
    ) -> asyncio.Task[Float32Array | None]:
        """Start a request in a task that counts as open until it ends, and then wakes a
        waiting request.

        Args:
            member: the projector, whose open requests are counted.
            asking: the request.

        Returns:
            The task, at once.
        """

        def ended(task: asyncio.Task[Float32Array | None]) -> None:
            """Release the projector of an ended request, and wake a waiting one.

            The request's error is marked as seen, so that asyncio does not log it.
            """
            self._open.discard(task)
            member.open -= 1
            if not task.cancelled():
                task.exception()  # retrieved, so that asyncio does not log it
            if self._turn is not None and not self._turn.done():
                self._turn.set_result(None)

        member.open += 1
        task = asyncio.create_task(asking)
        self._open.add(task)
        task.add_done_callback(ended)
        return task

    async def _ask(
        self,
        member: _Member,
        name: str,
        value: Body | None,
        views: int,
        work: Work | None,
    ) -> Any:
        """Send a request to one projector; measure its pace, or let it rest after a
        failure.

        A member whose version and backend are unknown is asked for them first, and they
        are compared with the others' (`_compare`). A member that does not answer rests
        for `REST_S`, is logged, and is asked for its version again later; so it is
        after an error answer, unless it is the only member. Its pace is a running mean,
        a quarter of it the latest request [s a view]; its views are counted.

        Args:
            member: the projector.
            name: of the body.
            value: the body, sent unless it is there; None for a request that sends
                none.
            views: number of views that are projected; 0 for other work.
            work: what is asked of it; None for nothing.

        Returns:
            The value of `work`; None without.

        Raises:
            ProjectorUnavailable, RpcError: the projector's failure.
        """
        loop = asyncio.get_running_loop()
        try:
            if member.kind is None:
                health = await member.client.health()
                member.kind = (health.version, health.backend)
                self._compare()
            if value is not None:
                await member.client.give(name, value)
            if work is None:
                return None
            begun = loop.time()
            answer = await work(member.client, value)
        except (ProjectorUnavailable, RpcError) as error:
            if isinstance(error, ProjectorUnavailable) or len(self) > 1:
                member.rests_until = loop.time() + REST_S
                # What listens there when it is back may be of another version.
                member.kind = None
                self._lines.log(
                    "a projector gave no answer", logging.WARNING, reason=str(error)
                )
            raise
        if not views:
            return answer
        taken = (loop.time() - begun) / views
        if member.pace_s is None:
            member.pace_s = taken
        else:
            member.pace_s = (3 * member.pace_s + taken) / 4
        member.views += views
        return answer

    def _compare(self) -> None:
        """Log a warning if known projectors differ in version or backend; at every call."""
        kinds = sorted({m.kind for m in self._members if m.kind is not None})
        if len(kinds) > 1:
            kept = "; ".join(" ".join(kind) for kind in kinds)
            log(
                "projectors differ: so may the last digits of frames",
                logging.WARNING,
                kinds=kept,
            )


async def _room_of(member: _Member) -> int | None:
    """Return the memory that a projector can have for a sample [bytes]: free or
    evictable.

    None if it does not answer within `LATE_S`, answers with an error, or evicts no
    volumes.
    """
    try:
        async with asyncio.timeout(LATE_S):
            health = await member.client.health()
    except (ProjectorUnavailable, RpcError, TimeoutError):
        return None  # it may answer when the scan runs
    if health.memory_evictable is None:
        return None
    return health.memory_limit - health.memory_used + health.memory_evictable
