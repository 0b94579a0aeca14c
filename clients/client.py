"""`TwinClient`: the twin server's methods as blocking, typed Python calls.

One method per method of the wire, with the protocol's own models as results and NumPy arrays as
images; errors are `RpcError` with code, message and data, or `ConnectionLost`. Usable from several
threads. It refuses to know sockets (see `transport`) and retries (see `caller`).
"""

from __future__ import annotations

import base64
import ssl as tls
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from flexdt.clients import uploads
from flexdt.clients.caller import Caller
from flexdt.clients.events import Projection, Subscription
from flexdt.clients.transport import TcpTransport, Transport
from flexdt.protocol import results as r
from flexdt.protocol import state as s
from flexdt.protocol.fields import Result
from flexdt.protocol.results import Projection as WireProjection

Topic = Literal["state", "projection", "job", "log"]
Kind = Literal["line_integral", "counts"]
SpeedUp = float | Literal["max"]
Positions = Mapping[str, float]

FINAL_STATES = ("done", "failed", "aborted", "incomplete")
"""States in which a job has ended."""


class TwinClient:
    """A connection to a twin server; a context manager.

    Args:
        host, port: of the server.
        token: where the server wants one.
        transport: another way to the server (tests); host, port and ssl are not used then.
        name: of this program, for people who look at the server.
        timeout_s: for an answer; calls that wait for a motion or a job have none.
        reconnect_s: how long to try after the connection was lost.
        wait_s: how long to try at first.
        ssl: TLS context.

    Raises:
        ConnectionLost: nobody answers.
        RpcError: the server does not let us in (-32004), or is another version.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 55000,
        token: str | None = None,
        transport: Transport | None = None,
        *,
        name: str = "flexdt.clients",
        timeout_s: float = 30.0,
        reconnect_s: float = 10.0,
        wait_s: float = 0.0,
        ssl: tls.SSLContext | None = None,
    ) -> None:
        way = transport if transport is not None else TcpTransport(host, port, ssl=ssl)
        self._caller = Caller(
            way, name=name, token=token, timeout_s=timeout_s,
            reconnect_s=reconnect_s, wait_s=wait_s,
        )  # fmt: skip

    def __enter__(self) -> TwinClient:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the connection; control is given back with it."""
        self._caller.close()

    @property
    def server(self) -> r.HelloResult:
        """What the server said of itself when the connection was made."""
        return self._caller.hello

    # -- session -----------------------------------------------------------------------------

    def control(self, action: Literal["acquire", "release", "force"]) -> r.ControlResult:
        """Take control, give it back, or take it from whoever has it."""
        return self._caller.call("session.control", {"action": action}, r.ControlResult)

    def ping(self) -> float:
        """Ask for a sign of life; returns the twin's clock [s]."""
        return self._caller.call("session.ping", {}, r.Pong).time

    def discover(self) -> dict[str, Any]:
        """The server's methods as an OpenRPC document."""
        return self._caller.call("rpc.discover", {}, Result).model_dump(mode="python")

    def subscribe(
        self,
        *topics: Topic,
        max_rate_hz: float | None = None,
        projection_kind: Kind | None = None,
        projection_binning: int | None = None,
        max_queue: int = 256,
    ) -> Subscription:
        """Events of `topics` (default: state), to iterate over.

        Args:
            topics: state, projection, job, log.
            max_rate_hz: at most so many a second and topic.
            projection_kind, projection_binning: of the topic projection.
            max_queue: events kept while nobody iterates; the oldest go first.
        """
        options = {
            "max_rate_hz": max_rate_hz,
            "projection_kind": projection_kind,
            "projection_binning": projection_binning,
        }
        return self._caller.subscribe(topics or ("state",), options, max_queue)

    # -- state and motion --------------------------------------------------------------------

    def state(self) -> s.State:
        """Everything, as one snapshot."""
        return self._caller.call("state.get", {}, s.State)

    def move(
        self,
        targets: Positions,
        *,
        relative: bool = False,
        wait: bool = False,
        plan: bool = False,
        shortest: bool = False,
    ) -> r.MoveResult:
        """Move axes [mm, deg, script's sign]; they start together.

        Args:
            targets: axis -> position, or displacement if `relative`.
            wait: return when the motion has ended.
            plan: go around obstacles.
            shortest: rot_obj by the shortest way instead of to the accumulated angle.

        Raises:
            RpcError: -32001 limit, -32002 collision, -32003 busy or not the controller.
        """
        params = {
            "targets": dict(targets), "relative": relative, "wait": wait, "plan": plan,
            "shortest": shortest,
        }  # fmt: skip
        patience = None if wait else -1.0
        return self._caller.call("axes.move", params, r.MoveResult, patience)

    def jog(self, axis: str, velocity: float, lease_s: float = 0.5) -> r.MoveResult:
        """Move at `velocity` [mm/s, deg/s] until the lease [s] runs out or is renewed."""
        params = {"axis": axis, "velocity": velocity, "lease_s": lease_s}
        return self._caller.call("axes.jog", params, r.MoveResult)

    def set_axis(
        self, axis: str, *, speed: float | None = None, acceleration: float | None = None
    ) -> r.AxisSetResult:
        """Set speed [unit/s] and acceleration [unit/s2] of later moves."""
        params = {"axis": axis, "speed": speed, "acceleration": acceleration}
        return self._caller.call("axes.set", params, r.AxisSetResult)

    def stop(self) -> s.State:
        """Brake all axes."""
        return self._caller.call("axes.stop", {}, s.State)

    def estop(self) -> s.State:
        """Emergency stop."""
        return self._caller.call("safety.estop", {}, s.State)

    def reset(self) -> s.State:
        """Leave the emergency stop."""
        return self._caller.call("safety.reset", {}, s.State)

    # -- settings ----------------------------------------------------------------------------

    def set_clock(self, speed_up: SpeedUp) -> s.ClockState:
        """Set how many twin seconds a real second has, or "max"."""
        return self._caller.call("clock.set", {"speed_up": speed_up}, s.ClockState)

    def set_tube(
        self, *, kV: float | None = None, power_W: float | None = None, on: bool | None = None
    ) -> s.TubeState:
        """Set the X-ray tube; what is left out stays."""
        return self._caller.call("tube.set", {"kV": kV, "power_W": power_W, "on": on}, s.TubeState)

    def set_camera(
        self,
        *,
        exposure_ms: float | None = None,
        mode: str | None = None,
        roi: tuple[int, int, int, int] | None = None,
        averages: int | None = None,
        frames: int | None = None,
    ) -> s.CameraState:
        """Set the camera; what is left out stays. `roi`: left, top, right, bottom, unbinned."""
        params = {
            "exposure_ms": exposure_ms, "mode": mode, "roi": None if roi is None else list(roi),
            "averages": averages, "frames": frames,
        }  # fmt: skip
        return self._caller.call("camera.set", params, s.CameraState)

    # -- samples -----------------------------------------------------------------------------

    def samples(self) -> r.SampleListResult:
        """The samples there are."""
        return self._caller.call("sample.list", {}, r.SampleListResult)

    def set_sample(
        self,
        name: str | None = None,
        *,
        file: str | None = None,
        material: str | None = None,
        offset: Mapping[str, float] | None = None,
    ) -> r.SampleResult:
        """Put a phantom (`name`) or an upload (`file`) on the stage.

        Args:
            name: as listed.
            file: name of an upload.
            material: of a mesh.
            offset: x, y, z [mm] and rx, ry, rz [deg] in the object's frame.
        """
        params = {
            "name": name, "file": file, "material": material,
            "offset": None if offset is None else dict(offset),
        }  # fmt: skip
        return self._caller.call("sample.set", params, r.SampleResult)

    def upload_mesh(
        self,
        source: str | Path | bytes,
        name: str | None = None,
        *,
        format: str | None = None,
        unit: Literal["um", "mm", "cm", "m", "inch"] = "mm",
        material: str | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> r.UploadResult:
        """Send a mesh, in chunks; afterwards `set_sample(file=name)` puts it on the stage.

        Args:
            source: a file, or its bytes (then `name` and `format` are needed).
            name: it gets; the file's own if left out.
            format: stl, obj, ply, glb or off; the file's ending if left out.
            unit: of the mesh's coordinates.
            material: it is made of.
            progress: called with bytes sent and bytes in all.

        Raises:
            ValueError: no name or format.
            OSError: the file cannot be read.
        """
        return self._upload(uploads.mesh(source, name, format, unit, material), progress)

    def upload_voxels(
        self,
        data: npt.NDArray[np.floating[Any]],
        voxel_mm: float | tuple[float, float, float],
        name: str,
        *,
        material: str | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> r.UploadResult:
        """Send voxels [z, y, x] of attenuation [1/mm], in chunks."""
        return self._upload(uploads.voxels(data, voxel_mm, name, material), progress)

    def _upload(
        self, upload: uploads.Upload, progress: Callable[[int, int], None] | None
    ) -> r.UploadResult:
        done = None
        for chunk in upload.chunks():
            done = self._caller.call("sample.upload", chunk, r.UploadResult)
            if progress is not None:
                progress(done.received, len(upload.data))
        assert done is not None
        return done

    # -- images ------------------------------------------------------------------------------

    def projection(self, kind: Kind = "line_integral", binning: int = 1) -> Projection:
        """An X-ray image at the current pose; `binning` averages pixels for a quick look."""
        params = {"kind": kind, "binning": binning}
        answer = self._caller.call("projection.get", params, WireProjection)
        return Projection.from_wire(answer)

    def geometry(self) -> s.GeometryResult:
        """cone_vec, detector shape and pixel pitch: nominal plus the correction in force."""
        return self._caller.call("geometry.get", {}, s.GeometryResult)

    # -- scripts and jobs --------------------------------------------------------------------

    def check_script(self, script: str | bytes, name: str | None = None) -> r.CheckResult:
        """Parse, plan and check a script; nothing moves."""
        params = {**_script(script), "name": name}
        return self._caller.call("script.check", params, r.CheckResult, None)

    def submit_script(
        self,
        script: str | bytes,
        name: str | None = None,
        speed_up: SpeedUp | None = None,
        *,
        seed: int | None = None,
        motion_samples: int = 1,
    ) -> r.SubmitResult:
        """Run a script as a job; bytes travel byte for byte.

        Args:
            script: its text or bytes.
            name: of the data set; an interrupted one of that name and script is taken up.
            speed_up: for this job.
            seed: of the noise; the same scan with the same seed has the same bytes.
            motion_samples: moments averaged within the exposure of an image taken in motion.

        Raises:
            RpcError: -32005, all problems with line and column; -32003, a job runs.
        """
        params = {
            **_script(script), "name": name, "speed_up": speed_up, "seed": seed,
            "motion_samples": motion_samples,
        }  # fmt: skip
        return self._caller.call("script.submit", params, r.SubmitResult, None)

    def check_trajectory(
        self, poses: Sequence[Positions], exposure_ms: float | None = None
    ) -> r.CheckResult:
        """Plan and check poses, one image each; nothing moves."""
        params = {"poses": [dict(p) for p in poses], "exposure_ms": exposure_ms}
        return self._caller.call("trajectory.check", params, r.CheckResult, None)

    def submit_trajectory(
        self,
        poses: Sequence[Positions],
        exposure_ms: float | None = None,
        name: str | None = None,
        speed_up: SpeedUp | None = None,
    ) -> r.SubmitResult:
        """Run poses as a job, one image each."""
        params = {
            "poses": [dict(p) for p in poses], "exposure_ms": exposure_ms, "name": name,
            "speed_up": speed_up,
        }  # fmt: skip
        return self._caller.call("trajectory.submit", params, r.SubmitResult, None)

    def jobs(self) -> r.JobListResult:
        """All jobs, oldest first."""
        return self._caller.call("job.list", {}, r.JobListResult)

    def job_status(self, job: str | None = None) -> s.JobStatus:
        """How far a job is (the current or last one if left out)."""
        return self._job("status", job)

    def pause_job(self, job: str | None = None) -> s.JobStatus:
        """Pause after the current frame."""
        return self._job("pause", job)

    def resume_job(self, job: str | None = None) -> s.JobStatus:
        """Return to the pose of the pause and go on."""
        return self._job("resume", job)

    def step_job(self, job: str | None = None) -> s.JobStatus:
        """Run a paused job for one step."""
        return self._job("step", job)

    def abort_job(self, job: str | None = None) -> s.JobStatus:
        """End a job; its data set stays, marked incomplete."""
        return self._job("abort", job)

    def _job(self, action: str, job: str | None) -> s.JobStatus:
        return self._caller.call(f"job.{action}", {"job": job}, s.JobStatus)

    def wait_job(
        self,
        job: str | None = None,
        progress: Callable[[s.JobStatus], None] | None = None,
        *,
        poll_s: float = 0.2,
        timeout_s: float | None = None,
    ) -> s.JobStatus:
        """Wait until a job has ended; goes on over a lost connection.

        Args:
            job: which one; the current one if left out.
            progress: called with each status.
            poll_s: how often to ask.
            timeout_s: give up waiting (the job goes on).

        Returns:
            The last status; its `state` says how the job ended.

        Raises:
            TimeoutError: the job has not ended in time.
        """
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            status = self.job_status(job)
            job = status.job
            if progress is not None:
                progress(status)
            if status.state in FINAL_STATES:
                return status
            if deadline is not None and time.monotonic() > deadline:
                raise TimeoutError(f"job {job} is {status.state} after {timeout_s:g} s")
            time.sleep(poll_s)

    # -- calibration and scenes --------------------------------------------------------------

    def apply_calibration(
        self,
        parameters: Mapping[str, float],
        name: str | None = None,
        *,
        comment: str | None = None,
        source: str | None = None,
    ) -> r.CorrectionResult:
        """Put a correction (mm, deg; true minus nominal) in force; it replaces the last."""
        params = {
            "parameters": dict(parameters), "name": name, "comment": comment, "source": source,
        }  # fmt: skip
        return self._caller.call("calibration.apply", params, r.CorrectionResult)

    def calibration(self, name: str | None = None) -> s.Correction | None:
        """The correction in force, or the one called `name`."""
        return self._caller.call("calibration.get", {"name": name}, r.CorrectionResult).correction

    def calibrations(self) -> r.CorrectionListResult:
        """All corrections, oldest first."""
        return self._caller.call("calibration.list", {}, r.CorrectionListResult)

    def revert_calibration(self) -> r.CorrectionResult:
        """Go back to the correction before."""
        return self._caller.call("calibration.revert", {}, r.CorrectionResult)

    def save_scene(self, name: str | None = None) -> dict[str, Any]:
        """The whole state as one versioned document."""
        return dict(self._caller.call("scene.save", {"name": name}, r.SceneResult).document)

    def load_scene(self, document: Mapping[str, Any]) -> s.State:
        """Restore what `save_scene` made."""
        return self._caller.call("scene.load", {"document": dict(document)}, s.State)


def _script(script: str | bytes) -> dict[str, object]:
    if isinstance(script, str):
        return {"text": script}
    return {"data_base64": base64.b64encode(script).decode("ascii")}


__all__ = ["FINAL_STATES", "TwinClient"]
