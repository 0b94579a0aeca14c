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
from flexdt.server.twin.handlers.handler import Handler

HANDLERS: Mapping[str, Handler] = {
    "session.hello": sessions.hello,
    "session.control": sessions.control,
    "session.ping": sessions.ping,
    "state.get": sessions.get_state,
    "state.subscribe": sessions.subscribe,
    "state.unsubscribe": sessions.unsubscribe,
    "rpc.discover": sessions.discover,
    "axes.move": motion.move,
    "axes.jog": motion.jog,
    "axes.stop": motion.stop,
    "safety.estop": motion.estop,
    "safety.reset": motion.reset,
    "clock.set": settings.set_clock,
    "tube.set": settings.set_tube,
    "camera.set": settings.set_camera,
    "axes.set": settings.set_axis,
    "sample.set": samples.set_sample,
    "sample.list": samples.list_samples,
    "sample.mesh": samples.mesh,
    "sample.upload": samples.upload,
    "projection.get": images.get_projection,
    "projection.ray": images.ray,
    "geometry.get": images.get_geometry,
    "exposure.predict": images.predict,
    "script.check": jobs.check_script,
    "script.submit": jobs.submit_script,
    "trajectory.check": jobs.check_trajectory,
    "trajectory.submit": jobs.submit_trajectory,
    "job.status": jobs.status,
    "job.pause": jobs.pause,
    "job.resume": jobs.resume,
    "job.step": jobs.step,
    "job.abort": jobs.abort,
    "job.list": jobs.list_jobs,
    "dataset.list": datasets.answer,
    "dataset.get": datasets.answer,
    "dataset.frame": datasets.answer,
    "calibration.apply": calibration.apply,
    "calibration.get": calibration.get,
    "calibration.list": calibration.list_all,
    "calibration.revert": calibration.revert,
    "calibration.fit": datasets.answer,
    "calibration.align": datasets.answer,
    "scene.save": scenes.save,
    "scene.load": scenes.load,
}
"""Method name -> what answers it."""

NOT_DURING_A_SCAN = (
    "axes.move", "axes.jog", "axes.set", "tube.set", "camera.set", "sample.set", "scene.load",
)  # fmt: skip
"""Methods that are an error while a job runs, and allowed while it is paused."""
