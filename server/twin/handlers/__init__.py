"""The table of methods: each has a short function that translates between wire and twin."""

from __future__ import annotations

from collections.abc import Mapping

from flexdt.server.twin.handlers import calibration_methods as calibration
from flexdt.server.twin.handlers import dataset_methods as datasets
from flexdt.server.twin.handlers import image_methods as images
from flexdt.server.twin.handlers import job_methods as jobs
from flexdt.server.twin.handlers import motion_methods as motion
from flexdt.server.twin.handlers import sample_methods as samples
from flexdt.server.twin.handlers import scene_methods as scenes
from flexdt.server.twin.handlers import session_methods as sessions
from flexdt.server.twin.handlers import setting_methods as settings
from flexdt.server.twin.handlers.handler import Client, Handler

HANDLERS: Mapping[str, Handler] = {
    **sessions.TABLE,
    **motion.TABLE,
    **settings.TABLE,
    **samples.TABLE,
    **images.TABLE,
    **jobs.TABLE,
    **datasets.TABLE,
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
"""Methods that are an error while a job runs, and allowed while it is paused."""

__all__ = ["HANDLERS", "NOT_DURING_A_SCAN", "Client", "Handler"]
