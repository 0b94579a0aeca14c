"""The twin's clock: virtual seconds that run at a multiple of real ones, or as fast as
possible.

With a number for `speed_up` time flows; with "max" it stops while any task works and
jumps to the next awaited moment. Work that must not be outrun (a scan whose frames are
not yet computed) holds the clock meanwhile, so twin time, not correctness, gives way: the
real-time factor that results is measured. One event loop owns it.
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal

from flexdt.protocol.fields import MAX_SPEED_UP
from flexdt.twin.errors import LimitError
from flexdt.twin.motion.profiles import LATE_S

SpeedUp = float | Literal["max"]

WINDOW_S = 5.0
"""Interval over which the real-time factor is measured [real s]."""
SAMPLE_S = 0.25
WAKE_ROUNDS = 3
"""Rounds of the event loop for the tasks just woken, before time jumps again."""


def check_speed_up(value: float | str) -> SpeedUp:
    """Return `value` if it is "max" or a number the clock can run at.

    A number is returned as float; it is above 0 and at most `MAX_SPEED_UP`.

    Raises:
        LimitError: names the allowed values.
    """
    if value == "max":
        return "max"
    if (
        isinstance(value, (int, float))
        and not isinstance(value, bool)
        and 0 < value <= MAX_SPEED_UP
    ):
        return float(value)
    raise LimitError(
        f'speed-up {value!r} is not a number in (0, {MAX_SPEED_UP:g}] and not "max"',
        {"asked": str(value), "allowed": [0.0, MAX_SPEED_UP, "max"]},
    )


class TwinClock:
    """Virtual time, beginning at 0.

    Args:
        speed_up: twin seconds a real second, or "max".
        wall: real time [s]; monotonic.
    """

    def __init__(
        self, speed_up: SpeedUp = 1.0, wall: Callable[[], float] = time.monotonic
    ) -> None:
        """Start at twin time 0, flowing at `speed_up` times the seconds of `wall`.

        With "max" it does not flow, but jumps to awaited moments.

        `speed_up`: "max", or above 0 and at most `MAX_SPEED_UP`; `wall`: real time [s],
        monotonic.
        Raises LimitError: another speed-up.
        """
        self._wall = wall
        self._speed_up = check_speed_up(speed_up)
        self._base = 0.0
        self._base_wall = wall()
        self._hold_count = 0
        self._waiting: list[tuple[float, int, asyncio.Future[None]]] = []
        self._order = itertools.count()
        self._timer: asyncio.Handle | None = None
        self._samples: deque[tuple[float, float]] = deque([(self._base_wall, 0.0)])

    @property
    def speed_up(self) -> SpeedUp:
        """Requested twin seconds a real second, or "max"."""
        return self._speed_up

    def set_speed_up(self, speed_up: SpeedUp) -> None:
        """Run faster or slower from now on, without a jump.

        Raises LimitError.
        """
        checked = check_speed_up(speed_up)
        self._rebase()
        self._speed_up = checked
        self._set_timer()

    def now(self) -> float:
        """Return the twin time [s]; every `SAMPLE_S` of real time a sample for its rate is kept."""
        now = self._time()
        wall = self._wall()
        if wall - self._samples[-1][0] >= SAMPLE_S:
            self._sample(wall, now)
        return now

    @property
    def real_time_factor(self) -> float | None:
        """Measured twin seconds a real second over the last few seconds; None until
        samples span more than `SAMPLE_S`.
        """
        wall = self._wall()
        now = self._time()
        self._sample(wall, now)
        first_wall, first = self._samples[0]
        if wall - first_wall > SAMPLE_S:
            return (now - first) / (wall - first_wall)
        return None

    def at(self, moment: float) -> asyncio.Future[None]:
        """Return a future that is done once the clock has reached `moment` [s].

        Futures of equal moments end in the order of the calls. One that its owner
        finishes early is dropped.
        """
        future: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        if self._time() >= moment:
            future.set_result(None)
            return future
        heapq.heappush(self._waiting, (moment, next(self._order), future))
        self._set_timer()
        return future

    async def sleep_until(self, moment: float) -> None:
        """Wait until the clock has reached `moment` [s]; always lets others run once."""
        await self.at(moment)
        await asyncio.sleep(0)

    async def at_rest(self, rest_time: Callable[[float], float]) -> None:
        """Wait until the motion under way has ended; `rest_time` of now may grow meanwhile."""
        while (rest := rest_time(self.now())) > self.now():
            await self.sleep_until(rest)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Stop twin time within the context; contexts nest, and it goes on after the outermost."""
        self._rebase()
        self._hold_count += 1
        self._set_timer()
        try:
            yield
        finally:
            self._rebase()
            self._hold_count -= 1
            self._set_timer()

    def _time(self) -> float:
        """Compute the twin's time now [s].

        It does not change while held, and at speed "max" only by jumps to awaited
        moments. From twin time `LATE_S` on it runs at most at real time, also at "max".
        """
        if self._hold_count or self._jumps:
            return self._base
        passed = self._wall() - self._base_wall
        if self._speed_up == "max":
            return self._base + passed
        quick = min(passed, max(0.0, LATE_S - self._base) / self._speed_up)
        return (
            self._base
            + quick * self._speed_up
            + (passed - quick) * min(1.0, self._speed_up)
        )

    @property
    def _jumps(self) -> bool:
        """Whether time jumps to awaited moments: at speed "max", before `LATE_S`."""
        return self._speed_up == "max" and self._base < LATE_S

    def _rebase(self) -> None:
        self._base = self._time()
        self._base_wall = self._wall()

    def _sample(self, wall: float, now: float) -> None:
        """Keep a sample of real and twin time [s]; drop those older than `WINDOW_S`, but two."""
        self._samples.append((wall, now))
        while len(self._samples) > 2 and wall - self._samples[1][0] > WINDOW_S:
            self._samples.popleft()

    def _set_timer(self) -> None:
        """Schedule the wake-up for the first future that waits, in place of the one
        scheduled before.

        Nothing is scheduled while time is held or nobody waits. At speed "max" it comes
        after `WAKE_ROUNDS` rounds of the loop, else after at most an hour of real time.
        Futures that are done are dropped.
        """
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        while self._waiting and self._waiting[0][2].done():
            heapq.heappop(self._waiting)
        if self._hold_count or not self._waiting:
            return
        loop = asyncio.get_running_loop()
        if self._jumps:
            self._timer = loop.call_soon(self._jump_to_next, WAKE_ROUNDS)
        else:
            now = self._time()
            pace = 1.0 if self._speed_up == "max" else self._speed_up
            if now >= LATE_S:
                pace = min(1.0, pace)
            wait = max(0.0, self._waiting[0][0] - now) / pace
            self._timer = loop.call_later(min(wait, 3600.0), self._wake_due)

    def _jump_to_next(self, patience: int) -> None:
        """Set the time to the first awaited moment and finish that one future; for speed
        "max".

        Futures that are done are skipped; time never goes back. It jumps no farther than
        `LATE_S`; what waits for a later moment waits in real time from then on. Then the
        next wake-up is scheduled.

        Args:
            patience: number of loop rounds to wait first, in which tasks that are ready
                may still ask for earlier moments.
        """
        if patience > 0:
            self._timer = asyncio.get_running_loop().call_soon(
                self._jump_to_next, patience - 1
            )
            return
        self._timer = None
        while self._waiting:
            moment, _, future = self._waiting[0]
            if not future.done():
                self._base = max(self._base, min(moment, LATE_S))
                self._base_wall = self._wall()
                if moment > LATE_S:
                    break
                future.set_result(None)
                heapq.heappop(self._waiting)
                break
            heapq.heappop(self._waiting)
        self._set_timer()

    def _wake_due(self) -> None:
        """Finish the futures that are due within a microsecond of real time, and schedule
        the next wake-up.

        Time is set forward to the moment of a future that the timer woke early.
        """
        self._timer = None
        now = self._time()
        # The loop's timer may fire a hair early; what is due within a microsecond is due.
        slack = 1e-6 * (1.0 if self._speed_up == "max" else self._speed_up)
        while self._waiting and self._waiting[0][0] <= now + slack:
            moment, _, future = heapq.heappop(self._waiting)
            if not future.done():
                if moment > now and math.isfinite(moment):
                    self._base = moment
                    self._base_wall = self._wall()
                future.set_result(None)
        self._set_timer()
