"""The table of the twin server's methods: parameters, result, and how each may be called.

`METHODS` is the one list that server, client and the OpenRPC document share.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Final, TypeVar

from pydantic import BaseModel, ValidationError

from flexdt.protocol import params as p
from flexdt.protocol import results as r
from flexdt.protocol import state_model as s
from flexdt.protocol.codec import Codec
from flexdt.protocol.connection import MAX_ANSWER
from flexdt.protocol.fields import Empty, Nothing, Params, Result
from flexdt.protocol.rpc_errors import Code, RpcError, clip, invalid_params, method_not_found

PROTOCOL: Final = "1.0"
"""Version of the wire: a server serves every client of the same major number (before the dot)."""

_R = TypeVar("_R", bound=BaseModel)


@dataclass(frozen=True)
class Method:
    """One method of the wire.

    Attributes:
        name: as on the wire.
        params, result: their models.
        summary: one line for people.
        control: only the controller may call it (it is taken where nobody holds it).
        safe: reads only, so a client may repeat it after a lost connection.
        urgent: handled on arrival, ahead of the connection's earlier requests.
        limits: on what one call may cost, by name with its unit; beyond them is -32008.
    """

    name: str
    params: type[Params]
    result: type[Result]
    summary: str
    control: bool = False
    safe: bool = False
    urgent: bool = False
    limits: Mapping[str, float] = field(default_factory=dict)


CHECK_LIMITS: Final[Mapping[str, float]] = {
    "seconds": 120,
    "memory_bytes": 4 << 30,
    "report_bytes_json": MAX_ANSWER[Codec.JSON],
    "report_bytes_msgpack": MAX_ANSWER[Codec.MSGPACK],
}
"""What parsing, planning and sweeping a script or poses may cost."""

PREDICTION_LIMITS: Final[Mapping[str, float]] = {"seconds": 60, "memory_bytes": 4 << 30}
"""What a prediction of image quality may cost."""
FIT_LIMITS: Final[Mapping[str, float]] = {"seconds": 300, "memory_bytes": 6 << 30}
"""What a calibration from images may cost."""


_read = partial(Method, safe=True)
_move = partial(Method, control=True)
_check = partial(_read, limits=CHECK_LIMITS)
_submit = partial(_move, limits=CHECK_LIMITS)
_fit = partial(_read, limits=FIT_LIMITS)


def _table(*methods: Method) -> Mapping[str, Method]:
    return {m.name: m for m in methods}


METHODS: Final = _table(
    _read("session.hello", p.Hello, r.HelloResult, "introduce the client; bring the token"),
    Method("session.control", p.Control, r.ControlResult, "acquire, release or force control"),
    Method("session.ping", Empty, r.Pong, "a heartbeat", safe=True, urgent=True),
    _read("state.get", Empty, s.State, "everything, as one snapshot"),
    _read("state.subscribe", p.Subscribe, Nothing, "send events of these topics"),
    _read("state.unsubscribe", p.Unsubscribe, Nothing, "send them no longer"),
    _move("axes.move", p.Move, r.MoveResult, "move axes to targets, starting together"),
    _move("axes.jog", p.Jog, r.MoveResult, "move at a velocity until the lease runs out"),
    _move("axes.set", p.AxisSet, r.AxisSetResult, "set an axis's speed and acceleration"),
    Method("axes.stop", Empty, s.Stopped, "bring all axes to rest", urgent=True),
    Method("safety.estop", Empty, s.Stopped, "emergency stop; X-rays off", urgent=True),
    _move("safety.reset", p.Reset, s.State, "leave the emergency stop"),
    _move("clock.set", p.ClockSet, s.ClockState, "set how fast the twin's time runs"),
    _move("tube.set", p.TubeSet, s.TubeState, "set kV, power and X-rays on or off"),
    _move("camera.set", p.CameraSet, s.CameraState, "set exposure, mode, ROI, averages, frames"),
    _move("sample.set", p.SampleSet, r.SampleResult, "put a sample on the stage"),
    _read("sample.list", Empty, r.SampleListResult, "the samples there are"),
    _read("sample.mesh", p.SampleMesh, r.SampleMeshResult, "the shape of the sample on the stage"),
    Method("sample.upload", p.SampleUpload, r.UploadResult,
           "send a mesh, voxels or a scene in chunks"),
    _read("projection.get", p.ProjectionGet, r.Projection,
          "an image at the current pose, or another"),
    _read("projection.ray", p.RayGet, r.RayResult, "paths through materials on the ray of a pixel"),
    _read("geometry.get", Empty, s.GeometryResult, "cone_vec, detector shape and pixel pitch"),
    _read("exposure.predict", p.ExposurePredict, r.ExposurePrediction,
          "transmission, contrast to noise and dose of a scan", limits=PREDICTION_LIMITS),
    _check("script.check", p.ScriptInput, r.CheckResult, "parse, plan and check a script"),
    _submit("script.submit", p.ScriptInput, r.SubmitResult, "run a script as a job"),
    _check("trajectory.check", p.TrajectoryInput, r.CheckResult, "plan and check poses"),
    _submit("trajectory.submit", p.TrajectoryInput, r.SubmitResult, "run poses as a job"),
    _read("job.status", p.JobRef, s.JobStatus, "how far a job is"),
    _move("job.pause", p.JobRef, s.JobStatus, "pause a job; a frame under exposure is taken again"),
    _move("job.resume", p.JobRef, s.JobStatus, "return to the pose of the pause and go on"),
    _move("job.step", p.JobRef, s.JobStatus, "run a paused job for one step"),
    Method("job.abort", p.JobRef, s.JobStatus, "end a job, its data set incomplete", urgent=True),
    _read("job.list", Empty, r.JobListResult, "all jobs, oldest first"),
    _read("dataset.list", p.DatasetList, r.DatasetListResult, "data sets, the newest first"),
    _read("dataset.get", p.DatasetGet, r.DatasetResult, "a data set: settings, poses over time"),
    _read("dataset.frame", p.DatasetFrame, r.DatasetFrameResult, "an image of a data set"),
    _move("calibration.apply", p.CalibrationApply, r.CorrectionResult, "put a correction in force"),
    _read("calibration.get", p.CalibrationGet, r.CorrectionResult, "the correction in force"),
    _read("calibration.list", Empty, r.CorrectionListResult, "all corrections"),
    _move("calibration.revert", Empty, r.CorrectionResult, "back to the correction before"),
    _fit("calibration.fit", p.CalibrationFit, r.CalibrationFitResult, "calibrate from data sets"),
    _fit("calibration.align", p.CalibrationAlign, r.CalibrationAlignResult, "align without beads"),
    _read("scene.save", p.SceneSave, r.SceneResult, "whole state as one versioned document"),
    _move("scene.load", p.SceneLoad, s.State, "restore such a document"),
    _read("rpc.discover", Empty, r.Discovery, "this table as an OpenRPC document"),
)  # fmt: skip
"""Every method of the twin server, by name."""


def find(name: str, methods: Mapping[str, Method] = METHODS) -> Method:
    """The method called `name`.

    Raises:
        RpcError: -32601, listing the methods.
    """
    if name not in methods:
        raise method_not_found(name, methods)
    return methods[name]


def compatible(protocol: str) -> bool:
    """Whether a server of this version serves a client that speaks `protocol`."""
    return protocol.split(".")[0] == PROTOCOL.split(".")[0]


def require_compatible(protocol: str) -> None:
    """Refuse a client of another protocol.

    Raises:
        RpcError: -32602, says what is spoken here.
    """
    if not compatible(protocol):
        raise invalid_params(
            f"protocol {protocol!r} is not spoken here; this server speaks {PROTOCOL}",
            [{"path": "protocol", "message": "another version", "asked": protocol}],
            PROTOCOL,
        )


def parse_params(method: Method, given: Mapping[str, object] | list[object] | None) -> Params:
    """Validated parameters of a call, given by name, by position, or not at all.

    Raises:
        RpcError: -32602, every problem with its path and what was asked.
    """
    fields = method.params.model_fields
    if isinstance(given, list):
        if len(given) > len(fields):
            raise invalid_params(
                f"{method.name} takes {len(fields)} parameters, got {len(given)}",
                allowed=list(fields),
            )
        given = dict(zip(fields, given, strict=False))
    try:
        return method.params.model_validate({} if given is None else dict(given))
    except ValidationError as error:
        raise _explain(method.name, error, list(fields)) from None


def parse_result(model: type[_R], given: object) -> _R:
    """A result as its model (for clients).

    Raises:
        RpcError: -32603, the server answered something else than the protocol says.
    """
    try:
        return model.model_validate(given)
    except ValidationError as error:
        message = f"the server's answer is no {model.__name__}: {error}"
        raise RpcError(Code.INTERNAL, message) from None


def _explain(method: str, error: ValidationError, allowed: list[str]) -> RpcError:
    problems: list[dict[str, object]] = []
    for e in error.errors()[:50]:
        problem: dict[str, object] = {
            "path": ".".join(clip(str(part), 80) for part in e["loc"]) or "params",
            "message": e["msg"].removeprefix("Value error, "),
            "asked": clip(e["input"], 80),
        }
        limits = {k: v for k, v in e.get("ctx", {}).items() if isinstance(v, (int, float, str))}
        if limits:
            problem["allowed"] = limits
        problems.append(problem)
    first = problems[0]
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    return invalid_params(f"{method}: {first['path']}: {first['message']}{more}", problems, allowed)
