"""Plans for Bluesky's RunEngine that belong to this scanner. They touch no device themselves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import bluesky.plan_stubs as bps
import bluesky.preprocessors as bpp
from bluesky.utils import MsgGenerator

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
        yield from bps.prepare(flyer, scan, wait=True)
        yield from bps.declare_stream(flyer, name=STREAM, collect=True)
        yield from bps.declare_stream(flyer.frames, name=FRAMES, collect=True)
        yield from bps.kickoff(flyer, wait=True)
        yield from bps.checkpoint()  # after a pause the scan goes on; it is not begun again
        images = bps.collect_while_completing(
            [flyer], [flyer], flush_period=flush_s, stream_name=STREAM
        )
        yield from bpp.finalize_wrapper(  # type: ignore[no-untyped-call]
            images, lambda: bps.collect(flyer.frames, name=FRAMES, return_payload=False)
        )

    run = bpp.run_wrapper(inner(), md=start)  # type: ignore[no-untyped-call]
    uid: str = yield from bpp.stage_wrapper(run, [flyer])  # type: ignore[no-untyped-call]
    return uid
