"""Actions of the commands of the socket interface: one short function for each type.

A function returns the text of ACK or raises `Refusal`; while it runs, it keeps
`Progress.text` up to date for FDB. Events and sockets are the business of `event_server`.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from flexdt.clients.client import twin_methods as m
from flexdt.clients.gateway.connected_twin import (
    POLL_S,
    Armed,
    CommandProgress,
    ConnectedTwin,
)
from flexdt.clients.gateway.saved_images import Image
from flexdt.clients.gateway.vocabulary import (
    AbortScript,
    Question,
    Refusal,
    StopAll,
    shown,
)
from flexdt.protocol.state_model import JobStatus, State
from flexdt.runtime.log import log
from flexdt.twin.dataset.dataset_errors import DatasetError
from flexdt.twin.machine.kinematics import motor_targets, virtual_reading
from flexdt.twin.machine.travel import Rate, arrival, rate
from flexdt.twin.script import commands as c
from flexdt.twin.script.grammar import bare_name, image_name

ARMED_S: Final = 10.0
"""Time that a move with a trigger waits for its image sequence before it moves alone
[real s]."""
JOB_POLL_S: Final = 0.1
READY_S: Final = 900.0
"""Time limit for the X-rays to be ready [twin s]."""

Action = Callable[[ConnectedTwin, Any, CommandProgress], Awaitable[str]]


async def pause(twin: ConnectedTwin, command: c.Pause, progress: CommandProgress) -> str:
    """Wait, on the twin's clock."""
    await twin.until(command.duration_ms / 1000.0, progress, "pause")
    return ""


async def output_path(
    twin: ConnectedTwin, command: c.SetOutputPath, progress: CommandProgress
) -> str:
    """Save later images in a folder of that name inside the data directory."""
    twin.begin_recording(command.path)
    return command.path


async def remember(
    twin: ConnectedTwin, command: c.Command, progress: CommandProgress
) -> str:
    """Keep the command in the transcript; the twin does nothing with it."""
    return ""


async def write_settings(
    twin: ConnectedTwin, command: c.WriteSettingsFile, progress: CommandProgress
) -> str:
    """Write the present motor positions into the recording's settings texts; return "".

    Before the first saved image they are only stored, for later texts.
    Raises Refusal: they cannot be written, or the twin does not answer.
    """
    try:
        twin.record().write_settings(await twin.state())
    except DatasetError as error:
        raise Refusal(str(error)) from None
    return ""


def setting(
    method: str, params: Callable[[Any], dict[str, object]], reply: Callable[[Any], str]
) -> Action:
    """Make the action of a command that only sets a value.

    `params` gives the parameters of the twin's `method` from the command, `reply` the
    text of ACK. Errors become Refusal.
    """

    async def send(
        twin: ConnectedTwin, command: c.Command, progress: CommandProgress
    ) -> str:
        """Send the command's parameters to the twin and return the reply; raises Refusal
        if the twin rejects them."""
        await twin.ask(method, params(command))
        return reply(command)

    return send


async def wait_ready(
    twin: ConnectedTwin, command: c.WaitXrayReady, progress: CommandProgress
) -> str:
    """Wait until X-rays are ready: the script's polling loop as one command.

    READY_S counts in the twin's time, and also in real time where the twin runs as fast
    as it can. It looks every `POLL_S` seconds (real time); FDB is "FALSE" meanwhile.

    Returns:
        "TRUE".

    Raises:
        Refusal: they are off, or not ready after READY_S.
    """
    state = await twin.state()
    if not state.tube.on:
        raise Refusal("X-rays are off, so they will not be ready; tube xrayon first")
    clock = asyncio.get_running_loop().time
    end = state.time + READY_S
    patience = clock() + READY_S
    while not state.tube.ready:
        if state.time > end or (clock() > patience and state.clock.speed_up == "max"):
            raise Refusal(f"X-rays are not ready after {READY_S:g} s")
        progress.text = "FALSE"
        await asyncio.sleep(POLL_S)
        state = await twin.state()
    return "TRUE"


async def take_image(
    twin: ConnectedTwin, command: c.TakeImage, progress: CommandProgress
) -> str:
    """Take an image at the present pose and settings, and wait for its exposure on the twin's
    clock.

    The camera keeps it in place of the one before; nothing is saved. The exposure is exposure
    time times averages.
    Returns "columns x rows, mean" of its counts.
    Raises Refusal: the twin refuses, or does not answer."""
    state = await twin.state()
    counts = np.asarray((await twin.run(m.projection("counts"))).image, dtype=np.uint16)
    twin.image = Image(counts, state)
    seconds = state.camera.exposure_ms * state.camera.averages / 1000.0
    await twin.until(seconds, progress, "exposure")
    rows, cols = counts.shape
    return f"{cols} x {rows}, mean {counts.mean():.1f}"


async def save_image(
    twin: ConnectedTwin, command: c.SaveImage, progress: CommandProgress
) -> str:
    """Save the last image under the bare name of the command's path, in the recording's folder.

    Without an output path the folder takes the name of the path's folder. Writing is in a
    thread; the image stays in the camera.

    Returns:
        The file's path.

    Raises:
        Refusal: no image was taken, the path has no name, or it cannot be written.
    """
    if twin.image is None:
        raise Refusal("no image has been taken; camera take image first")
    name = image_name(command.path)
    if name is None:
        raise Refusal(f"{shown(command.path)} does not end with a file name")
    taken = twin.image
    twin.record().suggest(command.path)
    try:
        return str(await asyncio.to_thread(twin.record().save, name, taken))
    except DatasetError as error:
        raise Refusal(str(error)) from None


async def move(
    twin: ConnectedTwin, command: c.MoveAbsolute, progress: CommandProgress
) -> str:
    """Move to a position and wait for arrival.

    With a trigger position, the move waits for an image sequence and is then a part of its job.
    Where none takes the armed move within ARMED_S, it is made without.

    Args:
        twin: state and requests.
        command: axis, target [mm, deg] and, if any, trigger position.
        progress: its text is the position under way.

    Returns the motor's reply, see `ConnectedTwin.motor_text`.
    Raises Refusal: the move was refused or ended elsewhere, or its sequence failed.
    """
    if command.trigger is None:
        return await _go(twin, command.component, command.target, progress)
    armed = Armed(command.component, command.target, command.trigger)
    twin.armed = armed
    progress.text = "POS"
    try:
        async with asyncio.timeout(ARMED_S):
            await armed.taken.wait()
    except TimeoutError:
        if not armed.taken.is_set():
            if twin.armed is armed:
                twin.armed = None
            return await _go(twin, command.component, command.target, progress)
    assert armed.ended is not None
    return await asyncio.shield(armed.ended)


async def _go(
    twin: ConnectedTwin, axis: str, target: float, progress: CommandProgress
) -> str:
    """Move an axis, report its position while it moves, and check that it arrived.

    It looks every `POLL_S` seconds. The request's errors are Refusals, too. Arrived is within
    1e-9 of the target and not sent elsewhere.

    Args:
        twin: state and requests.
        axis: name of the motor or virtual axis.
        target: [mm, deg]; beyond a limit it is clamped where the machine does so.
        progress: its text is the position under way.

    Returns the motor's reply, see `ConnectedTwin.motor_text`.
    Raises Refusal: the axis was stopped or sent elsewhere.
    """
    await twin.ask(
        "axes.move", {"targets": {axis: await _at_limit_switch(twin, axis, target)}}
    )
    state = await twin.state()
    bound = state.axes[axis].target
    while state.axes[axis].moving and state.axes[axis].target == bound:
        progress.text = f"{state.axes[axis].position:.10f}"
        await asyncio.sleep(POLL_S)
        state = await twin.state()
    at = state.axes[axis]
    if at.target != bound or abs(at.position - bound) > 1e-9:
        raise Refusal(
            f"{axis} was bound for {bound:g} {at.unit} and is at {at.position:g}: "
            f"it was stopped or sent elsewhere{_why(state)}"
        )
    return twin.motor_text(axis, at)


async def _at_limit_switch(twin: ConnectedTwin, axis: str, target: float) -> float:
    """Clamp a target beyond a limit to the limit, where the machine does so.

    Unchanged also where the machine does not have the axis, the target is within the limits, or
    the machine refuses instead of clamping. A virtual axis gets its reading when its motors are
    at the clamped targets.

    Args:
        twin: connection and machine.
        axis: that moves, also a virtual one.
        target: of the command.

    Returns the target that the twin gets; unchanged without a machine.
    """
    machine = twin.machine
    if machine is None or not machine.has(axis):
        return target
    axes = (await twin.state()).axes
    bound = {motor: axes[motor].target for motor in machine.axes}
    found = arrival(machine, axis, motor_targets(machine, axis, target, bound))
    if found.messages and found.is_clamped(machine):
        _tell_clamped(found.messages)
    if found.beyond is None or not found.is_clamped(machine):
        return target  # the twin judges it by the same rule
    if axis in machine.axes:
        return found.motors[axis]
    return virtual_reading(machine, axis, {**bound, **found.motors})


def _tell_clamped(messages: Sequence[str]) -> None:
    """Log that values were set to the limit; ACK, whose columns Acquila has fixed, holds
    the values in force."""
    for message in messages:
        log("limit_clamped", logging.WARNING, message=f"{message}; set to the limit")


def rate_setting(what: Rate, digits: int) -> Action:
    """Make the action that sets an axis's speed or acceleration for later moves.

    Args:
        what: which of both.
        digits: decimals of the reply.

    Returns:
        The action; it clamps values as the machine does, and replies with the value.
    """

    async def send(twin: ConnectedTwin, command: Any, progress: CommandProgress) -> str:
        """Set speed or acceleration of an axis; returns the value sent, as text.

        A value that the machine would clamp is lowered first to the slowest motor's share
        of it. Without a machine, or on an axis it lacks, the value is sent as it is.
        Raises Refusal if the twin rejects it; moves under way keep their own rate.
        """
        axis = command.component
        machine = twin.machine
        value: float = getattr(command, what)
        if machine is not None and machine.has(axis):
            found = rate(machine, axis, what, value)
            shares = machine.moves(axis)
            if found.messages and found.is_clamped(machine):
                _tell_clamped(found.messages)
                value = min(
                    found.motors[motor] / abs(share) for motor, share in shares.items()
                )
        await twin.ask("axes.set", {"axis": axis, what: value})
        return f"{value:.{digits}f}"

    return send


def _why(state: State) -> str:
    """Return the reason of the safety state in brackets, or nothing."""
    safety = state.safety
    if safety.state != "ok":
        return f" ({safety.message or safety.state})"
    return ""


async def question(
    twin: ConnectedTwin, command: Question, progress: CommandProgress
) -> str:
    """Answer with a part of the twin's state as text.

    The path must end at a bool or a number. A path without such a value raises an error
    of formatting, which the gateway logs. Booleans are asked before numbers.

    Returns:
        "TRUE" or "FALSE", or a number with 10 decimals for positions and 6 for all else.
    """
    value: object = (await twin.state()).model_dump(mode="json")
    for key in command.path:
        if isinstance(value, Mapping):
            value = value.get(key)
        else:
            value = None
    if isinstance(value, bool):
        return "TRUE" if value else "FALSE"
    return f"{value:.{10 if command.path[-1] == 'position' else 6}f}"


async def sequence(
    twin: ConnectedTwin, command: c.TakeSequence, progress: CommandProgress
) -> str:
    """Take an image sequence as a job of the twin, at rest or during the armed move.

    The twin decides by its own clock when each image is taken, so the frames are where
    the scanner's rule puts them, however slow the network is. The armed move is taken
    over and forgotten. The images are added to the recording; the data set is named after
    it and the prefix. The reply is that of `_adopt`.

    Returns:
        Text of ACK. The armed move ends with the job: with its reply, or with its error.

    Raises:
        Refusal: the twin refuses the job, or it fails.
    """
    armed = twin.armed
    twin.armed = None
    if armed is not None:
        armed.ended = asyncio.get_running_loop().create_future()
        armed.taken.set()
    try:
        state = await twin.state()
        text = _sequence_script(state, command, armed)
        twin.record().suggest(command.prefix)
        name = (
            f"{twin.record().name}-{bare_name(command.prefix).strip('_') or 'sequence'}"
        )
        twin.sequence = text.encode()
        folder = await _run(twin, twin.sequence, name, progress)
        state = await twin.state()
        reply = await _adopt(twin, folder, state)
    except BaseException as error:
        if armed is not None and armed.ended is not None:
            if isinstance(error, Refusal):
                armed.ended.set_exception(error)
            else:
                armed.ended.set_exception(Refusal("the sequence was cut short"))
            # The sequence reports the same error: mark the move's as retrieved, so asyncio
            # logs nothing.
            armed.ended.exception()
        raise
    if armed is not None and armed.ended is not None:
        armed.ended.set_result(twin.motor_text(armed.axis, state.axes[armed.axis]))
    return reply


def _sequence_script(state: State, command: c.TakeSequence, armed: Armed | None) -> str:
    """Write the script of a sequence: every setting of the twin's state, the move, the
    sequence.

    With a move armed it ends with the same move again, which waits for its end. Lines are
    tab-separated, ended by CR LF, seven columns; the prefix is reduced to its bare name.
    A rate that is None is left out.

    Args:
        state: of the twin; its camera, tube and rates are written as settings.
        command: prefix and first number of the images.
        armed: move with a trigger position; None takes the images at rest.
    """
    camera = state.camera
    lines = [
        ("camera", "set mode", camera.mode, "", "ACK"),
        ("camera", "set ROI", " ".join(str(e) for e in camera.roi), "", "ACK"),
        ("camera", "set exposure", repr(camera.exposure_ms), "", "ACK"),
        ("camera", "set number of frames", str(camera.frames), "", "ACK"),
        ("camera", "set number of averages", str(camera.averages), "", "ACK"),
        ("tube", "set kV", repr(state.tube.kV), "", "ACK"),
        ("tube", "set power", repr(state.tube.power_W), "", "ACK"),
        ("scanner", "write settings file", "", "", "ACK"),
    ]
    if armed is not None:
        axis = state.axes[armed.axis]
        for what, value in (("speed", axis.speed), ("acceleration", axis.acceleration)):
            if value is not None:
                lines.append((armed.axis, f"set {what}", repr(value), "", "ACK"))
        to = repr(armed.target)
        at = repr(armed.trigger)
        lines.append((armed.axis, "move absolute", to, at, "POS"))
    prefix = bare_name(command.prefix)
    first = str(command.first)
    lines.append(("camera", "take and save image sequence", prefix, first, "ACK"))
    if armed is not None:  # the same move again, to wait for its end
        lines.append((armed.axis, "move absolute", repr(armed.target), "", "ACK"))
    return "".join("\t".join((*line, "", "")) + "\r\n" for line in lines)


async def abort_script(
    twin: ConnectedTwin, command: AbortScript, progress: CommandProgress
) -> str:
    """Abort the job that this gateway started, without waiting for its end.

    Returns its name.
    Raises Refusal: none is running, or the twin refuses."""
    if twin.job is None:
        raise Refusal("no script or sequence of this gateway is running")
    await twin.ask("job.abort", {"job": twin.job})
    return twin.job


async def _run(
    twin: ConnectedTwin, script: bytes, name: str, progress: CommandProgress
) -> str:
    """Submit a script and wait for the end of its job.

    A status without data set returns "". At most 999 names are tried; the status is
    requested every `JOB_POLL_S` seconds. `twin.job` is None again afterwards, whatever
    happens.

    Args:
        twin: connection; its `job` is the running one meanwhile.
        script: bytes of the script.
        name: of the data set; a number is added where it is taken.
        progress: its text is state and frames.

    Returns:
        The data set's folder.

    Raises:
        Refusal: another job runs, no name is free, or the job did not end as done.
    """
    if twin.job is not None:
        raise Refusal(f"{twin.job} is running; wait for it or scanner abort script")
    for taken in (name, *(f"{name}-{number}" for number in range(2, 1000))):
        try:
            made = await twin.run(m.submit_script(script, taken))
            break
        except Refusal as error:
            if not _name_taken(error):
                raise
    else:
        raise Refusal(f"every name from {name} to {taken} is taken")
    twin.job = made.job

    def tell(status: JobStatus) -> None:
        progress.text = f"{status.state} {status.frames_done}/{status.frames_total}"

    try:
        status = await twin.run(m.wait_job(made.job, tell, poll_s=JOB_POLL_S))
    finally:
        twin.job = None
    if status.state != "done":
        why = (status.error or {}).get("message") or "aborted"
        raise Refusal(f"the scan ended {status.state}: {why}")
    return status.dataset or ""


def _name_taken(refusal: Refusal) -> bool:
    """Check whether the twin refused a job because its name is in use: a problem of the
    refusal is at "name".
    """
    data = getattr(refusal.__cause__, "data", None)
    if isinstance(data, Mapping):
        problems = data.get("problems")
    else:
        problems = None
    return any(problem.get("path") == "name" for problem in problems or ())


async def _adopt(twin: ConnectedTwin, folder: str, state: State) -> str:
    """Add the frames in a data set's folder to this session's recording.

    Returns how many, and the recording's folder; `folder` itself, with nothing added, if this
    machine's disk lacks it.
    Raises Refusal: they cannot be added.
    """
    if not folder or not Path(folder).is_dir():
        return folder
    try:
        count = await asyncio.to_thread(twin.record().adopt, Path(folder), state)
    except (DatasetError, OSError) as error:
        raise Refusal(f"the images are in {folder}, but: {error}") from None
    return f"{count} images in {twin.record().folder}"


ACTIONS: Final[Mapping[type[c.Command], Action]] = {
    c.Pause: pause,
    c.SetOutputPath: output_path,
    c.SetSampleInfo: remember,
    c.KeepXrayOn: remember,
    c.WriteSettingsFile: write_settings,
    # X-rays are on with this ACK, not ready: that takes the warm-up.
    c.XrayOn: setting("tube.set", lambda k: {"on": True}, lambda k: ""),
    c.XrayOff: setting("tube.set", lambda k: {"on": False}, lambda k: ""),
    c.SetVoltage: setting("tube.set", lambda k: {"kV": k.kV}, lambda k: f"{k.kV:.6f}"),
    c.SetPower: setting(
        "tube.set", lambda k: {"power_W": k.power_W}, lambda k: f"{k.power_W:.6f}"
    ),
    c.WaitXrayReady: wait_ready,
    c.SetMode: setting("camera.set", lambda k: {"mode": k.mode}, lambda k: k.mode),
    c.SetExposure: setting(
        "camera.set",
        lambda k: {"exposure_ms": k.exposure_ms},
        lambda k: f"{k.exposure_ms:.6f}",
    ),
    c.SetFrames: setting(
        "camera.set", lambda k: {"frames": k.frames}, lambda k: str(k.frames)
    ),
    c.SetAverages: setting(
        "camera.set", lambda k: {"averages": k.averages}, lambda k: str(k.averages)
    ),
    c.SetRoi: setting(
        "camera.set", lambda k: {"roi": list(k.roi.edges)}, lambda k: str(k.roi)
    ),
    c.TakeImage: take_image,
    c.SaveImage: save_image,
    c.TakeSequence: sequence,
    c.MoveAbsolute: move,
    # Of moves to come; the one under way keeps its own.
    c.SetSpeed: rate_setting("speed", 10),
    c.SetAcceleration: rate_setting("acceleration", 6),
    # Works for anyone, with or without control.
    StopAll: setting("axes.stop", lambda k: {}, lambda k: ""),
    Question: question,
    AbortScript: abort_script,
}
"""The action of each command of the grammar and of `vocabulary`; tested to be complete."""

AT_ONCE: Final = (StopAll, Question, AbortScript, c.MotorCommand)
"""Commands that do not wait for the component's earlier commands."""
