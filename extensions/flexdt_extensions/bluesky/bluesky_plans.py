"""Plans for Bluesky's RunEngine that belong to this scanner. They touch no device themselves."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

import bluesky.plan_stubs as bps
import bluesky.preprocessors as bpp
from bluesky.utils import Msg, MsgGenerator

from flexdt_extensions.bluesky.flyer import FlyScan, TwinFlyer

STREAM = "primary"
FRAMES = "frames"
"""Stream of a fly scan's events: where each image was taken."""


def fly_scan(
    flyer: TwinFlyer, scan: FlyScan, *, md: Mapping[str, Any] | None = None, flush_s: float = 0.5
) -> MsgGenerator[str]:
    """One smooth scan as a run; its images are announced while it goes on.

    The stream `frames` then has an event for each image with the stage's angle, in their order,
    also where the scan did not end well.

    Args:
        flyer: `lab.scan`.
        scan: what to do.
        md: for the start document.
        flush_s: real seconds between announcements.

    Returns:
        The run's uid.
    """
    start = {"plan_name": "fly_scan", "detectors": [flyer.name], **(md or {})}

    def inner() -> MsgGenerator[None]:
        prepared = yield from bps.prepare(flyer, scan, wait=True)
        # A replay would begin the scan again, and number images as those before. Without one, the
        # message that was interrupted is lost: what follows asks again where it may have been.
        yield from bpp.rewindable_wrapper(flight(prepared is not None), False)  # type: ignore[no-untyped-call]

    def flight(live: bool) -> MsgGenerator[None]:
        for device, name in ((flyer, STREAM), (flyer.frames, FRAMES)):
            declared = None
            while declared is None:
                declared = yield from bps.declare_stream(device, name=name, collect=True)
                if not live:
                    break  # nothing answers a simulator
        started = yield from bps.kickoff(flyer)
        while not (yield from _done(started)):
            pass
        yield from bpp.finalize_wrapper(  # type: ignore[no-untyped-call]
            images(), lambda: bps.collect(flyer.frames, name=FRAMES, return_payload=False)
        )

    def images() -> MsgGenerator[None]:
        ending, done = (yield from bps.complete(flyer)), False
        while not done:
            yield from bps.checkpoint()  # where a deferred pause begins
            done = yield from _done(ending, flush_s)
            yield from bps.collect(flyer, name=STREAM)

    run = bpp.run_wrapper(inner(), md=start)  # type: ignore[no-untyped-call]
    uid: str = yield from bpp.stage_wrapper(run, [flyer])  # type: ignore[no-untyped-call]
    return uid


def checkpoint_before_close(plan: MsgGenerator[Any]) -> MsgGenerator[Any]:
    """For `RunEngine.preprocessors`: after a run's end an interruption repeats nothing of it.

    The RunEngine sets no checkpoint when a run ends, and would measure the last point once more.
    """

    def close(message: Msg) -> tuple[MsgGenerator[Any] | None, None]:
        return (both(message) if message.command == "close_run" else None), None

    def both(message: Msg) -> MsgGenerator[Any]:
        yield from bps.checkpoint()
        return (yield message)

    return bpp.plan_mutator(plan, close)  # type: ignore[no-any-return, no-untyped-call]


def _done(status: Any, seconds: float | None = None) -> MsgGenerator[bool]:
    """Wait for a status, at most so long, or until an interruption; whether it is done.

    `bps.wait` cannot be repeated: what it waits for is forgotten when it is interrupted.
    """
    if status is None:
        return True
    yield from bps.wait_for([lambda: asyncio.wait([status.task], timeout=seconds)])
    return bool(status.done)
