"""The server's methods as flows, once for both clients.

One function per method of the wire, with the protocol's own models as results and NumPy arrays
as images. The clients of `client` decide how to wait for an answer. In the examples `twin` is a
`TwinClient`; with `AsyncTwinClient` the same calls are awaited.
"""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

import numpy as np
import numpy.typing as npt

from flexdt.clients.client.events import Projection
from flexdt.clients.client.flows import OWN_PATIENCE, Flow, Sleep, Tell, ask, sample_shape
from flexdt.protocol import image as wire_image
from flexdt.protocol import state_model as s
from flexdt.protocol.fields import TopicName
from flexdt.protocol.methods import calibration_messages as corrections
from flexdt.protocol.methods import document_messages as documents
from flexdt.protocol.methods import image_messages as images
from flexdt.protocol.methods import job_messages as scans
from flexdt.protocol.methods import scanner_messages as scanner
from flexdt.protocol.methods import session_messages as session
from flexdt.protocol.rpc_errors import invalid_params
from flexdt.twin import long_work
from flexdt.twin.long_work import Progress

if TYPE_CHECKING:
    from flexdt.phantoms import Phantom

Topic = TopicName
Kind = Literal["line_integral", "counts"]
SpeedUp = float | Literal["max"]
Positions = Mapping[str, float]
Job = str | scans.SubmitResult | s.JobStatus
"""A job: its name, or the result of submitting it, or its status."""

ScanProgress = Callable[[s.JobStatus], object] | bool | None
"""None or True for a bar of frames, False for silence, or a function of each status."""

CHUNK: Final = 4 * 2**20
"""Size of one message of an upload [bytes]: below a frame, also as base64."""
PAGE: Final = 200
"""Jobs or samples that are asked for at once: some 60 KB, a turn of the server's loop."""
SCENE_FORMATS: Final = get_args(scanner.SceneFormat)
MESH_FORMATS: Final = get_args(scanner.MeshFormat)
FINAL_STATES: Final[tuple[s.EndedPhase, ...]] = get_args(s.EndedPhase)
"""States in which a job has ended."""


def control(action: session.ControlAction) -> Flow[session.ControlResult]:
    """Acquire control, release it, or take it over from its holder.

    Example:
        >>> twin.control("acquire").yours
        True"""
    return ask(session.SESSION_CONTROL, action=action)


def ping() -> Flow[float]:
    """Check that the server is alive; returns the twin's clock [s].

    Example:
        >>> twin.ping() <= twin.ping()  # the twin's clock [s]
        True"""
    return (yield from ask(session.SESSION_PING)).time


def discover() -> Flow[dict[str, Any]]:
    """Return the server's methods as an OpenRPC document.

    Example:
        >>> "axes.move" in [method["name"] for method in twin.discover()["methods"]]
        True"""
    return (yield from ask(documents.RPC_DISCOVER)).model_dump(mode="python")


# -- state and motion --------------------------------------------------------------------


def state() -> Flow[s.State]:
    """Return the complete state as one snapshot.

    Example:
        >>> twin.state().axes["rot_obj"].unit
        'deg'"""
    return ask(session.STATE_GET)


def move(
    targets: Positions,
    *,
    relative: bool = False,
    wait: bool = False,
    plan: bool = False,
    shortest: bool = False,
    progress: Progress = None,
) -> Flow[scanner.MoveResult]:
    """Move axes [mm, deg, script's sign]; they start together.

    Args:
        targets: axis -> position, or displacement if `relative`.
        wait: return when the motion has ended.
        plan: go around obstacles.
        shortest: rot_obj by the shortest way instead of to the accumulated angle.
        progress: where `wait`, show after two seconds that axes move; False for silence.

    Raises:
        RpcError: -32001 limit, -32002 collision, -32003 busy or not the controller.

    Example:
        >>> twin.move({"mag_obj": 600.0, "rot_obj": 30.0}, wait=True).arrived
        True
        >>> round(twin.state().axes["rot_obj"].position, 6)
        30.0
    """
    with long_work.during("moving", progress if wait else False):
        moved = yield from ask(
            scanner.AXES_MOVE,
            None if wait else OWN_PATIENCE,
            targets=dict(targets),
            relative=relative,
            wait=wait,
            plan=plan,
            shortest=shortest,
        )
        return moved


def jog(axis: str, velocity: float, lease_s: float = 0.5) -> Flow[scanner.MoveResult]:
    """Move at `velocity` [mm/s, deg/s] until the lease [s] runs out or is renewed.

    Example:
        >>> twin.jog("rot_obj", 5.0, lease_s=0.2).warnings
        []"""
    return ask(scanner.AXES_JOG, axis=axis, velocity=velocity, lease_s=lease_s)


def set_axis(
    axis: str, *, speed: float | None = None, acceleration: float | None = None
) -> Flow[scanner.AxisSetResult]:
    """Set speed [unit/s] and acceleration [unit/s2] of later moves.

    Example:
        >>> twin.set_axis("rot_obj", speed=10.0).speed
        10.0"""
    return ask(scanner.AXES_SET, axis=axis, speed=speed, acceleration=acceleration)


def stop() -> Flow[s.Stopped]:
    """Bring all axes to rest; the result has the time and the way that this takes.

    Example:
        >>> twin.stop().safety.estop
        False"""
    return ask(scanner.AXES_STOP)


def estop() -> Flow[s.Stopped]:
    """Send an emergency stop; the result describes how the motors come to rest.

    Example:
        >>> twin.estop().safety.estop, twin.reset().safety.estop
        (True, False)"""
    return ask(scanner.SAFETY_ESTOP)


def reset(stop: int | None = None) -> Flow[s.State]:
    """Leave the emergency stop.

    Args:
        stop: `safety.stop` of the state on which this is decided; None releases any stop.

    Raises:
        RpcError: -32003, another stop has come since `stop`, or another client is the
            controller.

    Example:
        >>> twin.reset().safety.state
        'ok'
    """
    return ask(scanner.SAFETY_RESET, stop=stop)


# -- settings ----------------------------------------------------------------------------


def set_clock(speed_up: SpeedUp) -> Flow[s.ClockState]:
    """Set how many twin seconds a real second has, or "max".

    Example:
        >>> twin.set_clock("max").speed_up
        'max'"""
    return ask(scanner.CLOCK_SET, speed_up=speed_up)


def set_tube(
    *, kV: float | None = None, power_W: float | None = None, on: bool | None = None
) -> Flow[s.TubeState]:
    """Set the X-ray tube; parameters left out keep their values.

    Example:
        >>> tube = twin.set_tube(kV=80.0, power_W=20.0)
        >>> tube.kV, tube.power_W
        (80.0, 20.0)"""
    return ask(scanner.TUBE_SET, kV=kV, power_W=power_W, on=on)


def set_camera(
    *,
    exposure_ms: float | None = None,
    mode: str | None = None,
    roi: tuple[int, int, int, int] | None = None,
    averages: int | None = None,
    frames: int | None = None,
) -> Flow[s.CameraState]:
    """Set the camera; parameters left out keep their values. `roi`: left, top, right,
    bottom, unbinned.

    Example:
        >>> twin.set_camera(exposure_ms=200.0).exposure_ms
        200.0
    """
    return ask(
        scanner.CAMERA_SET,
        exposure_ms=exposure_ms,
        mode=mode,
        roi=None if roi is None else list(roi),
        averages=averages,
        frames=frames,
    )


# -- samples -----------------------------------------------------------------------------


def samples() -> Flow[scanner.SampleListResult]:
    """List all samples that may be set, and the materials of meshes.

    Example:
        >>> "lego" in [sample.name for sample in twin.samples().samples]
        True
    """
    found = yield from ask(scanner.SAMPLE_LIST, count=PAGE)
    while len(found.samples) < (found.total or 0):
        more = yield from ask(scanner.SAMPLE_LIST, start=len(found.samples), count=PAGE)
        if not more.samples or more.total != found.total:  # it changed meanwhile
            return (yield from ask(scanner.SAMPLE_LIST))
        found = found.model_copy(update={"samples": [*found.samples, *more.samples]})
    return found


def set_sample(
    name: str | None = None,
    *,
    file: str | None = None,
    material: str | None = None,
    offset: Mapping[str, float] | None = None,
) -> Flow[scanner.SampleResult]:
    """Put a phantom (`name`) or an upload (`file`) on the stage.

    Args:
        name: as listed.
        file: name of an upload.
        material: of a mesh.
        offset: x, y, z [mm] and rx, ry, rz [deg] in the object's frame.

    Example:
        >>> twin.set_sample("lego").sample.name
        'lego'
    """
    place = None if offset is None else dict(offset)
    return ask(scanner.SAMPLE_SET, name=name, file=file, material=material, offset=place)


def delete_sample(name: str) -> Flow[scanner.SampleDeleteResult]:
    """Delete an upload that is neither on the stage nor in a scan that has not ended.

    Example:
        >>> import numpy as np
        >>> sent = twin.upload_voxels(np.full((2, 2, 2), 0.02), 0.5, "grain")
        >>> twin.delete_sample("grain").bytes
        32"""
    return ask(scanner.SAMPLE_DELETE, name=name)


def sample_mesh() -> Flow[bytes]:
    """Return the shape of the sample on the stage: binary STL in mm, in the sample's own
    frame.

    Raises:
        RpcError: there is no sample, or it has too many triangles to be sent.

    Example:
        >>> twin.set_sample("normal-3").sample.name
        'normal-3'
        >>> len(twin.sample_mesh()) > 84  # the header and a triangle of an STL file
        True
    """
    return (yield from sample_shape()).data


def upload_mesh(
    source: str | Path | bytes,
    name: str | None = None,
    *,
    format: str | None = None,
    unit: scanner.LengthUnit | None = None,
    place: scanner.SamplePlace = "keep",
    material: str | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Flow[scanner.UploadResult]:
    """Upload a mesh in chunks; afterwards `set_sample(file=name)` puts it on the stage.

    Args:
        source: a file, or its bytes (then `name` and `format` are needed).
        name: it gets; the file's own if left out.
        format: stl, obj, ply, glb or off; the file's ending if left out.
        unit: of the mesh's coordinates; m for glb and mm for the others if left out.
        place: "keep" takes its coordinates for those of the object's frame; "centred"
            puts the middle of its box on the axis.
        material: it is made of.
        progress: called with bytes sent and bytes in all.

    Raises:
        ValueError: no name or format.
        OSError: the file cannot be read.

    Example:
        >>> import trimesh
        >>> cube = trimesh.creation.box((5.0, 5.0, 5.0)).export(file_type="stl")
        >>> twin.upload_mesh(cube, "cube", format="stl").complete
        True
    """
    if isinstance(source, bytes):
        data = source
    else:
        path = Path(source)
        data = path.read_bytes()
        name = path.stem if name is None else name
        if format is None:
            format = path.suffix.lower().lstrip(".")
    if name is None or format not in MESH_FORMATS:
        raise ValueError(
            f"a mesh needs a name and a format of {', '.join(MESH_FORMATS)}; "
            f"got name {name!r}, format {format!r}"
        )
    head = {
        "name": name,
        "kind": "mesh",
        "format": format,
        "unit": unit,
        "place": place,
        "material": material,
    }
    return _upload(head, data, progress)


def upload_scene(
    source: str | Path | Phantom,
    name: str | None = None,
    *,
    progress: Callable[[int, int], object] | None = None,
) -> Flow[scanner.UploadResult]:
    """Upload a phantom in chunks; afterwards `set_sample(file=name)` puts it on the stage.

    Args:
        source: a phantom, or the file (TOML or JSON) of a phantom or a scene.
        name: it gets; the phantom's or the file's own if left out.
        progress: called with bytes sent and bytes in all.

    Raises:
        PhantomError: the file does not hold; names the key path and the allowed values.

    Example:
        >>> from flexdt.phantoms import load_phantom
        >>> twin.upload_scene(load_phantom("normal-3"), "three").complete
        True
    """
    from flexdt.phantoms import Phantom
    from flexdt.phantoms.files.phantom_files import read_phantom_file

    # A scene file is read here, as its mesh files are on this machine; the upload is complete.
    if isinstance(source, Phantom):
        phantom = source
    else:
        phantom = read_phantom_file(Path(source))
    if name is None:
        if isinstance(source, Phantom):
            name = source.name
        else:
            name = Path(source).stem
    head = {"name": name, "kind": "scene", "format": "json"}
    return _upload(head, json.dumps(phantom.to_dict()).encode(), progress)


def upload_voxels(
    data: npt.NDArray[np.floating[Any]],
    voxel_mm: float | tuple[float, float, float],
    name: str,
    *,
    material: str | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Flow[scanner.UploadResult]:
    """Upload voxels in chunks.

    The data are sent as float32.

    Args:
        data: attenuation [1/mm], indexed [z, y, x].
        voxel_mm: their pitch, one number or (x, y, z).
        name: of the sample.
        material: they are made of.
        progress: called with bytes sent and bytes in all.

    Raises:
        ValueError: `data` is empty.

    Example:
        >>> twin.upload_voxels(np.full((4, 4, 4), 0.02), 0.5, "block").complete
        True
    """
    if isinstance(voxel_mm, (int, float)):
        size = (voxel_mm,) * 3
    else:
        size = voxel_mm
    raw = np.ascontiguousarray(data, dtype="<f4")
    head = {
        "name": name,
        "kind": "voxels",
        "format": "raw",
        "material": material,
        "shape": list(raw.shape),
        "voxel_mm": [float(v) for v in size],
    }
    return _upload(head, raw.tobytes(), progress)


def _upload(
    head: Mapping[str, object], data: bytes, progress: Callable[[int, int], object] | None
) -> Flow[scanner.UploadResult]:
    """Upload a sample in parts, and report the progress.

    `progress` is called after each part.

    Args:
        head: parameters of each part: name, format and so on.
        data: content of the file.
        progress: called with the bytes received and all.

    Returns the answer to the last part.
    Raises ValueError: there are no data.
    """
    total = len(data)
    done = None
    for start in range(0, total, CHUNK):
        part = data[start : start + CHUNK]
        done = yield from ask(
            scanner.SAMPLE_UPLOAD, **head, total=total, start=start, data=part
        )
        if progress is not None:
            yield Tell(progress, (done.received, total))
    if done is None:
        raise ValueError(f"nothing to upload as {head['name']!r}: the data are empty")
    return done


# -- images ------------------------------------------------------------------------------


def projection(
    kind: Kind = "line_integral",
    binning: int = 1,
    *,
    marks: bool = False,
    positions: Mapping[str, float] | None = None,
    tube: Mapping[str, object] | None = None,
    camera: Mapping[str, object] | None = None,
) -> Flow[Projection]:
    """Take an X-ray image at the current pose, or predict the one at another.

    Where `positions`, `tube` or `camera` is given nothing moves: the image is predicted, from
    the geometry of `geometry`, without noise.

    Args:
        kind: line_integral (float32) or counts (uint16).
        binning: average so many pixels along each side, for a quick look.
        marks: also mark pixels that are saturated, starved or where the sample is cut off.
        positions: motor -> [mm, deg] there, beyond its travel too; others keep their places.
        tube: as though set so: kV, power_W, on.
        camera: as though set so: exposure_ms, mode, roi, averages.

    Example:
        >>> projection = twin.projection("line_integral", binning=8)
        >>> projection.image.shape, projection.kind
        ((95, 119), 'line_integral')
    """
    answer = yield from ask(
        images.PROJECTION_GET,
        kind=kind,
        binning=binning,
        marks=marks or None,
        positions=positions,
        tube=tube,
        camera=camera,
    )
    return Projection.from_wire(answer)


def ray(column: float, row: float) -> Flow[dict[str, float]]:
    """Compute the path lengths through materials on the way to a pixel, by `geometry`.

    Args:
        column, row: of the image of this moment.

    Returns:
        Material -> [mm].

    Raises:
        RpcError: -32001, the image has no such pixel.

    Example:
        >>> all(mm >= 0.0 for mm in twin.ray(477.5, 379.5).values())
        True
    """
    told = yield from ask(images.PROJECTION_RAY, pixel=[column, row])
    return dict(told.paths_mm)


def geometry() -> Flow[s.GeometryResult]:
    """Return cone_vec, detector shape and pixel pitch: nominal plus the correction in
    force.

    Example:
        >>> len(twin.geometry().cone_vec)
        12"""
    return ask(images.GEOMETRY_GET)


# -- scripts and jobs --------------------------------------------------------------------


def predict_exposure(
    sample: str | None = None,
    *,
    kV: float | None = None,
    power_W: float | None = None,
    filter: str = "",
    exposure_ms: float | None = None,
    averages: int | None = None,
    mode: str | None = None,
    roi: tuple[int, int, int, int] | None = None,
    frames: int = 361,
    kind: str | None = None,
    sod_mm: float | None = None,
    sdd_mm: float | None = None,
    detail: str = "void:0.5",
) -> Flow[images.ExposurePrediction]:
    """Estimate transmission, contrast to noise and dose of a circular scan.

    Args:
        sample: a shipped phantom or an upload; default: the one on the stage.
        kV, power_W, exposure_ms, averages, mode, roi: default: as they are set.
        filter: MATERIAL:MM in addition to the machine's own.
        frames: of the scan.
        kind: of a scan to compose, for its time and bytes; default: those of the images.
        sod_mm, sdd_mm: distances; default: the present ones.
        detail: MATERIAL:MM or void:MM on the darkest ray, for its contrast.

    Raises:
        RpcError: -32001, nothing is on the stage, or a setting is beyond the machine's.

    Example:
        >>> told = twin.predict_exposure("lego", kV=60.0)
        >>> 0.0 < told.transmission.least < told.transmission.median <= 1.1, told.asked.kV
        (True, 60.0)
    """
    return ask(
        images.EXPOSURE_PREDICT,
        sample=sample,
        kV=kV,
        power_W=power_W,
        filter=filter,
        exposure_ms=exposure_ms,
        averages=averages,
        frames=frames,
        kind=kind,
        detail=detail,
        mode=mode,
        roi=None if roi is None else list(roi),
        sod_mm=sod_mm,
        sdd_mm=sdd_mm,
    )


def check_script(script: str | bytes, name: str | None = None) -> Flow[scans.CheckResult]:
    """Parse, plan and check a script; nothing moves.

    Example:
        >>> script = "camera\\tset exposure\\t100\\t\\tACK\\t\\t\\r\\n"
        >>> twin.check_script(script).ok
        True"""
    return ask(scans.SCRIPT_CHECK, **_script(script), name=name)


def submit_script(
    script: str | bytes,
    name: str | None = None,
    speed_up: SpeedUp | None = None,
    *,
    seed: int | None = None,
    motion_samples: int = 1,
) -> Flow[scans.SubmitResult]:
    """Run a script as a job.

    Args:
        script: its text, or its bytes, which reach the server unchanged.
        name: of the data set; an interrupted one of that name and script is continued.
        speed_up: for this job.
        seed: of the noise; the same scan with the same seed has the same bytes.
        motion_samples: moments averaged within the exposure of an image taken in motion.

    Raises:
        RpcError: -32005, all problems with line and column; -32003, a job runs.

    Example:
        >>> script = "camera\\tset exposure\\t100\\t\\tACK\\t\\t\\r\\n"
        >>> job = twin.submit_script(script, "exposure", "max").job
        >>> twin.wait_job(job).state
        'done'
    """
    return ask(
        scans.SCRIPT_SUBMIT,
        **_script(script),
        name=name,
        speed_up=speed_up,
        seed=seed,
        motion_samples=motion_samples,
    )


def check_trajectory(
    poses: Sequence[Positions],
    exposure_ms: float | None = None,
    *,
    flat: bool | Positions = True,
) -> Flow[scans.CheckResult]:
    """Plan and check poses, one image each; nothing moves. `flat` as in `submit_trajectory`.

    Example:
        >>> poses = [{"rot_obj": 0.0}, {"rot_obj": 90.0}]
        >>> twin.check_trajectory(poses, 100.0).frames
        2"""
    return ask(
        scans.TRAJECTORY_CHECK,
        poses=[dict(p) for p in poses],
        exposure_ms=exposure_ms,
        flat=flat if isinstance(flat, bool) else dict(flat),
    )


def submit_trajectory(
    poses: Sequence[Positions],
    exposure_ms: float | None = None,
    name: str | None = None,
    speed_up: SpeedUp | None = None,
    *,
    seed: int | None = None,
    flat: bool | Positions = True,
) -> Flow[scans.SubmitResult]:
    """Run poses as a job: a dark and a flat, then one image each.

    Args:
        poses: axis -> position [mm, deg]; axes left out stay where they are.
        exposure_ms: of each image; None keeps the camera's.
        name, speed_up, seed: as in `submit_script`.
        flat: where the sample is out of the beam; True lets the server find a place and a free
            path, False takes no flat.

    Raises:
        RpcError: as `submit_script`.

    Example:
        >>> poses = [{"rot_obj": 0.0}, {"rot_obj": 90.0}]
        >>> job = twin.submit_trajectory(poses, 100.0, "two", "max").job
        >>> twin.wait_job(job).frames_done
        2
    """
    return ask(
        scans.TRAJECTORY_SUBMIT,
        poses=[dict(p) for p in poses],
        exposure_ms=exposure_ms,
        name=name,
        speed_up=speed_up,
        seed=seed,
        flat=flat if isinstance(flat, bool) else dict(flat),
    )


def jobs() -> Flow[scans.JobListResult]:
    """List all jobs, oldest first.

    Example:
        >>> all(job.frames_done <= job.frames_total for job in twin.jobs().jobs)
        True
    """
    found = yield from ask(scans.JOB_LIST, count=PAGE)
    while len(found.jobs) < (found.total or 0):
        more = yield from ask(scans.JOB_LIST, start=len(found.jobs), count=PAGE)
        if not more.jobs or more.total != found.total:  # it changed meanwhile
            return (yield from ask(scans.JOB_LIST))
        found = found.model_copy(update={"jobs": [*found.jobs, *more.jobs]})
    return found


def _name_of(job: Job | None) -> str | None:
    """Return the job's name; None is the current or last one."""
    if isinstance(job, scans.SubmitResult | s.JobStatus):
        return job.job
    return job


def job_status(job: Job | None = None) -> Flow[s.JobStatus]:
    """Return the progress of a job; `job` defaults to the current or last one.

    Example:
        >>> job = twin.submit_trajectory([{"rot_obj": 0.0}] * 20, 9000.0, speed_up=1.0).job
        >>> twin.job_status(job).frames_total
        20
        >>> twin.wait_job(twin.abort_job(job).job).state in FINAL_STATES
        True"""
    return ask(scans.JOB_STATUS, job=_name_of(job))


def pause_job(job: Job | None = None) -> Flow[s.JobStatus]:
    """Pause; a frame under exposure is discarded and taken again.

    Example:
        >>> job = twin.submit_trajectory([{"rot_obj": 0.0}] * 20, 9000.0, speed_up=1.0).job
        >>> while twin.job_status(job).state == "queued":
        ...     pass
        >>> twin.pause_job(job).state in ("running", "paused")
        True
        >>> twin.wait_job(twin.abort_job(job).job).state in FINAL_STATES
        True"""
    return ask(scans.JOB_PAUSE, job=_name_of(job))


def resume_job(job: Job | None = None) -> Flow[s.JobStatus]:
    """Return to the pose of the pause and go on.

    Example:
        >>> job = twin.submit_trajectory([{"rot_obj": 0.0}] * 20, 9000.0, speed_up=1.0).job
        >>> while twin.job_status(job).state == "queued":
        ...     pass
        >>> twin.pause_job(job).job == twin.resume_job(job).job == job
        True
        >>> twin.wait_job(twin.abort_job(job).job).state in FINAL_STATES
        True"""
    return ask(scans.JOB_RESUME, job=_name_of(job))


def step_job(job: Job | None = None) -> Flow[s.JobStatus]:
    """Run a paused job for one step.

    Example:
        >>> job = twin.submit_trajectory([{"rot_obj": 0.0}] * 20, 9000.0, speed_up=1.0).job
        >>> while twin.job_status(job).state == "queued":
        ...     pass
        >>> twin.pause_job(job).job == job
        True
        >>> while twin.job_status(job).state != "paused":
        ...     pass
        >>> twin.step_job(job).job == job
        True
        >>> twin.wait_job(twin.abort_job(job).job).state in FINAL_STATES
        True"""
    return ask(scans.JOB_STEP, job=_name_of(job))


def abort_job(job: Job | None = None, reason: str | None = None) -> Flow[s.JobStatus]:
    """End a job; its data set stays, marked incomplete, with the reason.

    Example:
        >>> job = twin.submit_trajectory([{"rot_obj": 0.0}] * 20, 9000.0, speed_up=1.0).job
        >>> twin.wait_job(twin.abort_job(job).job).state
        'aborted'"""
    return ask(scans.JOB_ABORT, job=_name_of(job), reason=reason)


def forget_job(
    job: Job | None = None, *, days: float | None = None
) -> Flow[scans.JobForgetResult]:
    """Forget an ended job, or all that ended at least `days` ago; data sets stay.

    Example:
        >>> job = twin.submit_trajectory([{"rot_obj": 0.0}], 90.0, speed_up="max").job
        >>> twin.wait_job(job).state
        'done'
        >>> twin.forget_job(job).jobs == [job]
        True"""
    return ask(scans.JOB_FORGET, job=_name_of(job), days=days)


def wait_job(
    job: Job | None = None,
    progress: ScanProgress = None,
    *,
    poll_s: float = 0.2,
    timeout_s: float | None = None,
) -> Flow[s.JobStatus]:
    """Wait until a job has ended, also across a lost connection.

    Args:
        job: which one, by name or as `submit_script` and its kin returned it; the current one
            if left out.
        progress: a bar of frames after two seconds; False for none, or what is called with each
            status.
        poll_s: time between two requests for the status [s].
        timeout_s: give up waiting after this time [s]; the job goes on.

    Returns:
        The last status; its `state` says how the job ended.

    Raises:
        TimeoutError: the job has not ended in time.

    Example:
        >>> twin.wait_job(twin.submit_trajectory([{"rot_obj": 0.0}], 100.0, speed_up="max")).state
        'done'
    """
    if timeout_s is None:
        deadline = None
    else:
        deadline = time.monotonic() + timeout_s
    own = progress if callable(progress) else None
    shown = False if callable(progress) else progress
    with long_work.during("scanning", shown) as advance:
        while True:
            status = yield from job_status(job)
            job = status.job
            advance(status.frames_done / max(status.frames_total, 1))
            if own is not None:
                yield Tell(own, (status,))
            if status.state in FINAL_STATES:
                return status
            if deadline is not None and time.monotonic() > deadline:
                raise TimeoutError(
                    f"job {status.job} is {status.state} after {timeout_s:g} s"
                )
            yield Sleep(poll_s)


# -- data sets ---------------------------------------------------------------------------


def datasets(
    search: str = "", *, start: int = 0, count: int = 50
) -> Flow[corrections.DatasetListResult]:
    """List data sets of the data directory, the newest first.

    Args:
        search: words; each occurs in the name, the sample, a setting or the state.
        start, count: which of those found.

    Example:
        >>> poses = [{"rot_obj": 0.0}, {"rot_obj": 90.0}]
        >>> job = twin.submit_trajectory(poses, 100.0, "listed", "max").job
        >>> twin.wait_job(job).state
        'done'
        >>> [found.name for found in twin.datasets("listed").datasets]
        ['listed']
    """
    return ask(corrections.DATASET_LIST, search=search, start=start, count=count)


def dataset(
    name: str, points: int = 400, *, measure: bool = False, script: bool = False
) -> Flow[corrections.DatasetResult]:
    """Return a data set: its settings, and poses and times of at most `points` of its
    images.

    Args:
        name: of its folder.
        points: 2 to 2000.
        measure: with mean counts and clearances.
        script: with its script.

    Raises:
        RpcError: -32602, there is none of that name.

    Example:
        >>> poses = [{"rot_obj": 0.0}, {"rot_obj": 90.0}]
        >>> job = twin.submit_trajectory(poses, 100.0, "looked-at", "max").job
        >>> twin.wait_job(job).state
        'done'
        >>> twin.dataset("looked-at").positions["rot_obj"]
        [0.0, 0.0, 0.0, 90.0]
    """
    return ask(
        corrections.DATASET_GET, name=name, points=points, measure=measure, script=script
    )


def dataset_frame(
    name: str, index: int, kind: Kind = "counts", binning: int = 1
) -> Flow[tuple[npt.NDArray[np.generic], corrections.DatasetFrameResult]]:
    """Read an image of a data set.

    Args:
        name: of the data set's folder.
        index: of the image in the order taken; dark and flat images count.
        kind: counts (uint16, as saved) or line_integral (float32, of projections).
        binning: average so many pixels along each side.

    Returns:
        Its pixels (rows, cols), and what it is: file, time, positions, nominal cone_vec.

    Raises:
        RpcError: -32602, there is no such image, or its file is damaged.

    Example:
        >>> poses = [{"rot_obj": 0.0}, {"rot_obj": 90.0}]
        >>> job = twin.submit_trajectory(poses, 100.0, "shown", "max").job
        >>> twin.wait_job(job).state
        'done'
        >>> counts, what = twin.dataset_frame("shown", 0)
        >>> counts.dtype == np.uint16, what.image
        (True, 'dark')
    """
    told = yield from ask(
        corrections.DATASET_FRAME, name=name, index=index, kind=kind, binning=binning
    )
    return wire_image.from_bytes(told.data, told.dtype, told.shape), told


# -- calibration and scenes --------------------------------------------------------------


def apply_calibration(
    parameters: Mapping[str, float],
    name: str | None = None,
    *,
    comment: str | None = None,
    source: str | None = None,
    sides_known: bool = False,
) -> Flow[corrections.CorrectionResult]:
    """Put a correction (mm, deg; true minus nominal) in force; it replaces the last.

    `sides_known` means that it was found from beads of known places, which determine the
    direction of rotation and mirrored images.

    Example:
        >>> twin.apply_calibration({"det_roll": 0.1}, "rolled").correction.name
        'rolled'
        >>> twin.revert_calibration().correction is None
        True"""
    return ask(
        corrections.CALIBRATION_APPLY,
        parameters=dict(parameters),
        name=name,
        comment=comment,
        source=source,
        # A server before this field refuses it.
        sides_known=sides_known or None,
    )


def calibration(name: str | None = None) -> Flow[s.Correction | None]:
    """Return the correction in force, or the one called `name`.

    Example:
        >>> twin.calibration() is None  # none is in force
        True"""
    return (yield from ask(corrections.CALIBRATION_GET, name=name)).correction


def calibrations() -> Flow[corrections.CorrectionListResult]:
    """List all corrections, oldest first.

    Example:
        >>> twin.calibrations().current is None
        True"""
    return ask(corrections.CALIBRATION_LIST)


def revert_calibration() -> Flow[corrections.CorrectionResult]:
    """Replace the correction in force by the one before it.

    Example:
        >>> twin.apply_calibration({"det_roll": 0.2}, "second").correction.name
        'second'
        >>> twin.revert_calibration().correction is None
        True"""
    return ask(corrections.CALIBRATION_REVERT)


def delete_calibration(name: str) -> Flow[corrections.CorrectionDeleted]:
    """Delete a correction that is not in force; data sets keep theirs.

    Example:
        >>> twin.apply_calibration({"det_roll": 0.3}, "slip").correction.name
        'slip'
        >>> twin.revert_calibration().correction is None
        True
        >>> twin.delete_calibration("slip").name
        'slip'"""
    return ask(corrections.CALIBRATION_DELETE, name=name)


def fit_calibration(
    datasets: Sequence[str],
    phantom: str,
    free: Sequence[str] | None = None,
    *,
    priors: Mapping[str, float] | None = None,
    exclude: Sequence[str] = (),
    bead_tolerance: float | None = None,
    per_frame: Sequence[str] = (),
    steps: int = 0,
    residuals: bool = False,
    tracks: bool = False,
    markers: Sequence[tuple[int, str, float, float, float | None]] | None = None,
    scale: str | None = None,
) -> Flow[corrections.CalibrationFitResult]:
    """Calibrate from data sets of the twin's data directory; nothing is applied.

    Other calls of this connection wait for the answer.

    Args:
        datasets: their names.
        phantom: one that ships, a TOML or JSON file among the data sets, or "unknown": markers
            in unknown places.
        free: parameters to estimate; default: the six of a phantom on a stage, dO_x of unknown
            markers.
        priors: name -> standard deviation [mm, deg, 1]; 0 is exactly known.
        exclude: causes that cannot be, such as "gap".
        bead_tolerance: of the beads' places, which are estimated, too [mm].
        per_frame: parameters that may also move.
        steps: include the covariance after so many parts of the frames.
        residuals: include those of every bead in every frame.
        tracks: include the beads' places, seen, before and after the fit.
        markers: where beads were seen, (frame, bead, column, row, sigma) [px], sigma None where
            it is not known; default: they are detected in the images.
        scale: distance of two unknown markers [mm], "A-B=MM" or "A-B=MM+-SIGMA".

    Raises:
        ValueError: a row of `markers` has another length.
        RpcError: -32602, there is no such data set or phantom; -32008, it takes too long.

    Example:
        >>> twin.fit_calibration(["gone"], "lego")
        Traceback (most recent call last):
        ...
        flexdt.protocol.rpc_errors.RpcError: no data set 'gone' in the data directory
    """
    fields = corrections.Mark.model_fields
    for i, row in enumerate(markers or ()):
        if len(row) != len(fields):
            raise ValueError(f"mark {i} is {row!r}; allowed: ({', '.join(fields)})")
    if markers is None:
        marks = None
    else:
        marks = [dict(zip(fields, row, strict=True)) for row in markers]
    return ask(
        corrections.CALIBRATION_FIT,
        datasets=list(datasets),
        phantom=phantom,
        free=free and list(free),
        priors=dict(priors or {}),
        exclude=list(exclude),
        bead_tolerance=bead_tolerance,
        per_frame=list(per_frame),
        steps=steps,
        residuals=residuals,
        tracks=tracks,
        markers=marks,
        scale=scale,
    )


def align_dataset(
    name: str, *, per_frame: bool = False
) -> Flow[corrections.CalibrationAlignResult]:
    """Find the axis of a full-turn scan of anything by symmetry; nothing is applied.

    Args:
        name: of the data set.
        per_frame: look for shifts of single frames too; they are `motion` in the result.

    Raises:
        RpcError: as `fit_calibration`.

    Example:
        >>> twin.align_dataset("gone")
        Traceback (most recent call last):
        ...
        flexdt.protocol.rpc_errors.RpcError: no data set 'gone' in the data directory
    """
    return ask(corrections.CALIBRATION_ALIGN, name=name, per_frame=per_frame)


def save_scene(name: str | None = None) -> Flow[dict[str, Any]]:
    """Save the complete state as one versioned document.

    Example:
        >>> sorted(twin.save_scene("mine"))[:3]
        ['accelerations', 'camera', 'correction']"""
    return dict((yield from ask(documents.SCENE_SAVE, name=name)).document)


def load_scene(document: Mapping[str, Any]) -> Flow[s.State]:
    """Load a state that `save_scene` returned.

    Example:
        >>> twin.load_scene(twin.save_scene()).safety.state
        'ok'"""
    return ask(documents.SCENE_LOAD, document=dict(document))


def _script(script: str | bytes) -> dict[str, object]:
    """Make the parameters of a script from its text or bytes.

    One word without spaces is taken for a file's name. A text is sent as `text`, bytes as
    `data_base64`.

    Raises:
        RpcError: -32602, the name of a file in place of its text.
    """
    if isinstance(script, str) and script.split() == [script]:
        what = f"{script!r} is one word and no script"
        cure = f"the text; of a file Path({script!r}).read_bytes()"
        raise invalid_params(
            f"{what}; allowed: {cure}", [{"path": "text", "message": what}]
        )
    if isinstance(script, str):
        return {"text": script}
    return {"data_base64": base64.b64encode(script).decode("ascii")}
