"""What the server does for each method: a table of short functions from wire to twin and back."""

from __future__ import annotations

from collections.abc import Mapping

from flexdt.server.handlers import (
    calibration,
    images,
    jobs,
    motion,
    samples,
    scenes,
    sessions,
    settings,
)
from flexdt.server.handlers.table import Client, Handler

HANDLERS: Mapping[str, Handler] = {
    **sessions.TABLE,
    **motion.TABLE,
    **settings.TABLE,
    **samples.TABLE,
    **images.TABLE,
    **jobs.TABLE,
    **calibration.TABLE,
    **scenes.TABLE,
}
"""Method name -> what answers it."""

NOT_DURING_A_SCAN = frozenset(
    {
        "axes.move",
        "axes.jog",
        "axes.set",
        "tube.set",
        "camera.set",
        "sample.set",
        "scene.load",
    }
)
"""Methods that are refused while a job runs, and allowed while it is paused."""

__all__ = ["HANDLERS", "NOT_DURING_A_SCAN", "Client", "Handler"]
