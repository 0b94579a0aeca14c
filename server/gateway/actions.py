"""What each command of the socket interface does to the twin: one short function a type.

A function returns the reply of ACK or raises `Refusal`; while it takes it keeps `Progress.text`
up to date. It refuses to know events and sockets.
"""

from __future__ import annotations

import asyncio
import base64
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from flexdt.protocol import image
from flexdt.protocol.errors import RpcError
from flexdt.protocol.state import State
from flexdt.server.gateway.lab import POLL_S, Armed, Lab, Progress
from flexdt.server.gateway.recording import Image
from flexdt.server.gateway.vocabulary import (
    AbortScript,
    MoveRelative,
    Question,
    Refusal,
    RunScript,
    StopAll,
    shown,
)
from flexdt.twin.dataset.errors import DatasetError
from flexdt.twin.script import commands as c
from flexdt.twin.script.files import bare_name, image_name

ARMED_S: Final = 10.0
"""Real seconds that a move with a trigger waits for its image sequence before it just moves."""
JOB_POLL_S: Final = 0.1
READY_S: Final = 900.0
"""Twin seconds that X-rays may take to be ready."""
ENDED: Final = ("done", "failed", "aborted", "incomplete")

Action = Callable[[Lab, Any, Progress], Awaitable[str]]


async def pause(lab: Lab, command: c.Pause, progress: Progress) -> str:
    """On the twin's clock."""
    await lab.until(command.duration_ms / 1000.0, progress, "pause")
    return ""


async def output_path(lab: Lab, command: c.SetOutputPath, progress: Progress) -> str:
    """Images to come go to a folder of that name inside the data directory."""
    lab.begin_recording(command.path)
    return command.path


async def remember(lab: Lab, command: c.Command, progress: Progress) -> str:
    """Kept in the transcript; the twin does nothing with it."""
    return ""


async def write_settings(lab: Lab, command: c.WriteSettingsFile, progress: Progress) -> str:
    """Motor readings of this moment go to the settings texts."""
    try:
        lab.record().write_settings(await lab.state())
    except DatasetError as error:
        raise Refusal(str(error)) from None
    return ""


async def xray_on(lab: Lab, command: c.XrayOn, progress: Progress) -> str:
    """ACK when X-rays are on; ready is another question."""
    await lab.ask("tube.set", {"on": True})
    return ""


async def xray_off(lab: Lab, command: c.XrayOff, progress: Progress) -> str:
    """X-rays off."""
    await lab.ask("tube.set", {"on": False})
    return ""


async def voltage(lab: Lab, command: c.SetVoltage, progress: Progress) -> str:
    """Tube voltage."""
    await lab.ask("tube.set", {"kV": command.kV})
    return f"{command.kV:g}"


async def power(lab: Lab, command: c.SetPower, progress: Progress) -> str:
    """Tube power."""
    await lab.ask("tube.set", {"power_W": command.power_W})
    return f"{command.power_W:g}"


async def wait_ready(lab: Lab, command: c.WaitXrayReady, progress: Progress) -> str:
    """The script's loop as one command."""
    state = await lab.state()
    if not state.tube.on:
        raise Refusal("X-rays are off, so they will not be ready; tube xrayon first")
    clock = asyncio.get_running_loop().time
    end, patience = state.time + READY_S, clock() + READY_S
    while not state.tube.ready:
        if state.time > end or (clock() > patience and state.clock.speed_up == "max"):
            raise Refusal(f"X-rays are not ready after {READY_S:g} s")
        progress.text = "FALSE"
        await asyncio.sleep(POLL_S)
        state = await lab.state()
    return "TRUE"


async def mode(lab: Lab, command: c.SetMode, progress: Progress) -> str:
    """Camera mode."""
    await lab.ask("camera.set", {"mode": command.mode})
    return command.mode


async def exposure(lab: Lab, command: c.SetExposure, progress: Progress) -> str:
    """Exposure of one image."""
    await lab.ask("camera.set", {"exposure_ms": command.exposure_ms})
    return f"{command.exposure_ms:g}"


async def frames(lab: Lab, command: c.SetFrames, progress: Progress) -> str:
    """Images of a sequence."""
    await lab.ask("camera.set", {"frames": command.frames})
    return str(command.frames)


async def averages(lab: Lab, command: c.SetAverages, progress: Progress) -> str:
    """Exposures averaged to an image."""
    await lab.ask("camera.set", {"averages": command.averages})
    return str(command.averages)


async def roi(lab: Lab, command: c.SetRoi, progress: Progress) -> str:
    """Region of interest."""
    r = command.roi
    await lab.ask("camera.set", {"roi": [r.left, r.top, r.right, r.bottom]})
    return str(r)


async def take_image(lab: Lab, command: c.TakeImage, progress: Progress) -> str:
    """An image of the pose and settings of this moment, kept in the camera."""
    state = await lab.state()
    answer = await lab.ask("projection.get", {"kind": "counts"})
    if not isinstance(answer, Mapping):
        raise Refusal("the twin sent no image")
    counts = np.asarray(image.decode(answer), dtype=np.uint16)
    lab.image = Image(counts, state)
    seconds = state.camera.exposure_ms * state.camera.averages / 1000.0
    await lab.until(seconds, progress, "exposure")
    rows, cols = counts.shape
    return f"{cols} x {rows}, mean {counts.mean():.1f}"


async def save_image(lab: Lab, command: c.SaveImage, progress: Progress) -> str:
    """The image taken last, under the bare name of the path."""
    if lab.image is None:
        raise Refusal("no image has been taken; camera take image first")
    name = image_name(command.path)
    if name is None:
        raise Refusal(f"{shown(command.path)} does not end with a file name")
    taken = lab.image
    lab.record().suggest(command.path)
    try:
        return str(await asyncio.to_thread(lab.record().save, name, taken))
    except DatasetError as error:
        raise Refusal(str(error)) from None


async def move(lab: Lab, command: c.MoveAbsolute, progress: Progress) -> str:
    """ACK when it stands there; with a trigger position it may become a scan in motion."""
    if command.trigger is None:
        return await _go(lab, command.component, command.target, progress)
    armed = Armed(command.component, command.target, command.trigger)
    lab.armed, progress.text = armed, "POS"
    try:
        async with asyncio.timeout(ARMED_S):
            await armed.taken.wait()
    except TimeoutError:
        if not armed.taken.is_set():
            if lab.armed is armed:
                lab.armed = None
            return await _go(lab, command.component, command.target, progress)
    assert armed.ended is not None
    return await asyncio.shield(armed.ended)


async def move_relative(lab: Lab, command: MoveRelative, progress: Progress) -> str:
    """From where the axis stands."""
    state = await lab.state()
    at = state.axes[command.component].position
    return await _go(lab, command.component, at + command.step, progress)


async def _go(lab: Lab, axis: str, target: float, progress: Progress) -> str:
    await lab.ask("axes.move", {"targets": {axis: target}})
    state = await lab.state()
    bound = state.axes[axis].target
    while state.axes[axis].moving and state.axes[axis].target == bound:
        progress.text = f"{state.axes[axis].position:.6f}"
        await asyncio.sleep(POLL_S)
        state = await lab.state()
    at = state.axes[axis]
    if at.target != bound or abs(at.position - bound) > 1e-9:
        raise Refusal(
            f"{axis} was bound for {bound:g} {at.unit} and is at {at.position:g}: it was stopped "
            f"or sent elsewhere{_why(state)}"
        )
    return f"{at.position:.6f}"


def _why(state: State) -> str:
    safety = state.safety
    return f" ({safety.message or safety.state})" if safety.state != "ok" else ""


async def speed(lab: Lab, command: c.SetSpeed, progress: Progress) -> str:
    """Of moves to come."""
    await lab.ask("axes.set", {"axis": command.component, "speed": command.speed})
    return f"{command.speed:g}"


async def acceleration(lab: Lab, command: c.SetAcceleration, progress: Progress) -> str:
    """Of moves to come."""
    asked = {"axis": command.component, "acceleration": command.acceleration}
    await lab.ask("axes.set", asked)
    return f"{command.acceleration:g}"


async def stop(lab: Lab, command: StopAll, progress: Progress) -> str:
    """All axes brake; works for anyone."""
    await lab.ask("axes.stop")
    return ""


async def question(lab: Lab, command: Question, progress: Progress) -> str:
    """A part of the twin's state as text."""
    value: object = (await lab.state()).model_dump(mode="json")
    for key in command.path:
        value = value.get(key) if isinstance(value, Mapping) else None
    match value:
        case bool():
            return "TRUE" if value else "FALSE"
        case float():
            return f"{value:.6f}"
        case list():
            return " ".join(str(v) for v in value)
        case Mapping():  # a job
            return f"{value.get('state')} {value.get('frames_done')}/{value.get('frames_total')}"
    return "" if value is None else str(value)


async def sequence(lab: Lab, command: c.TakeSequence, progress: Progress) -> str:
    """A job of the twin: standing still, or during the move that is armed.

    The twin decides each image's moment by its own clock, so the frames lie where the scanner's
    rule puts them, however slow the network.
    """
    armed, lab.armed = lab.armed, None
    if armed is not None:
        armed.ended = asyncio.get_running_loop().create_future()
        armed.taken.set()
    try:
        state = await lab.state()
        text = _sequence_script(state, command, armed)
        lab.record().suggest(command.prefix)
        name = f"{lab.record().name}-{bare_name(command.prefix).strip('_') or 'sequence'}"
        folder = await _run(lab, text.encode(), name, progress)
        state = await lab.state()
        reply = await _adopt(lab, folder, state)
    except BaseException as error:
        if armed is not None and armed.ended is not None:
            armed.ended.set_exception(
                error if isinstance(error, Refusal) else Refusal("the sequence was cut short")
            )
            armed.ended.exception()  # told by the sequence too: nobody need listen
        raise
    if armed is not None and armed.ended is not None:
        armed.ended.set_result(f"{state.axes[armed.axis].position:.6f}")
    return reply


def _sequence_script(state: State, command: c.TakeSequence, armed: Armed | None) -> str:
    """The twin's state as a script that says everything, then move and sequence."""
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
        to, at = repr(armed.target), repr(armed.trigger)
        lines.append((armed.axis, "move absolute", to, at, "POS"))
    prefix = bare_name(command.prefix)
    first = str(command.first)
    lines.append(("camera", "take and save image sequence", prefix, first, "ACK"))
    if armed is not None:  # the same move once more: wait for its end
        lines.append((armed.axis, "move absolute", repr(armed.target), "", "ACK"))
    return "".join("\t".join((*line, "", "")) + "\r\n" for line in lines)


async def run_script(lab: Lab, command: RunScript, progress: Progress) -> str:
    """A whole script as a job; FDB tells frames, ACK the data set's folder."""
    return await _run(lab, command.text.encode(), command.name or "script", progress)


async def abort_script(lab: Lab, command: AbortScript, progress: Progress) -> str:
    """The job that this gateway started."""
    if lab.job is None:
        raise Refusal("no script or sequence of this gateway is running")
    await lab.ask("job.abort", {"job": lab.job})
    return lab.job


async def _run(lab: Lab, script: bytes, name: str, progress: Progress) -> str:
    """Submit a script and wait for the end of its job; returns the data set's folder."""
    if lab.job is not None:
        raise Refusal(f"{lab.job} is running; wait for it or scanner abort script")
    data = base64.b64encode(script).decode("ascii")
    wish: dict[str, object] = {"data_base64": data}
    taken = name
    for number in range(2, 1000):
        try:
            answer = await lab.ask("script.submit", {**wish, "name": taken})
            break
        except Refusal as error:
            if not _name_taken(error):
                raise
            taken = f"{name}-{number}"
    else:
        raise Refusal(f"every name from {name} to {taken} is taken")
    lab.job = str(answer["job"]) if isinstance(answer, Mapping) else ""
    try:
        while True:
            status = await lab.ask("job.status", {"job": lab.job})
            assert isinstance(status, Mapping)
            done, total = status.get("frames_done"), status.get("frames_total")
            progress.text = f"{status.get('state')} {done}/{total}"
            if status.get("state") in ENDED:
                break
            await asyncio.sleep(JOB_POLL_S)
    finally:
        lab.job = None
    if status.get("state") != "done":
        error_of = status.get("error")
        why = error_of.get("message") if isinstance(error_of, Mapping) else None
        raise Refusal(f"the scan ended {status.get('state')}: {why or 'aborted'}")
    return str(status.get("dataset") or "")


def _name_taken(refusal: Refusal) -> bool:
    error = refusal.__cause__
    if not isinstance(error, RpcError) or not isinstance(error.data, Mapping):
        return False
    problems = error.data.get("problems")
    found = problems if isinstance(problems, list) else []
    return any(isinstance(p, Mapping) and p.get("path") == "name" for p in found)


async def _adopt(lab: Lab, folder: str, state: State) -> str:
    """The frames into this session's folder, where the twin's disk is this machine's."""
    if not folder or not Path(folder).is_dir():
        return folder
    try:
        count = await asyncio.to_thread(lab.record().adopt, Path(folder), state)
    except (DatasetError, OSError) as error:
        raise Refusal(f"the images are in {folder}, but: {error}") from None
    return f"{count} images in {lab.record().folder}"


ACTIONS: Final[Mapping[type[c.Command], Action]] = {
    c.Pause: pause,
    c.SetOutputPath: output_path,
    c.SetSampleInfo: remember,
    c.KeepXrayOn: remember,
    c.WriteSettingsFile: write_settings,
    c.XrayOn: xray_on,
    c.XrayOff: xray_off,
    c.SetVoltage: voltage,
    c.SetPower: power,
    c.WaitXrayReady: wait_ready,
    c.SetMode: mode,
    c.SetExposure: exposure,
    c.SetFrames: frames,
    c.SetAverages: averages,
    c.SetRoi: roi,
    c.TakeImage: take_image,
    c.SaveImage: save_image,
    c.TakeSequence: sequence,
    c.MoveAbsolute: move,
    c.SetSpeed: speed,
    c.SetAcceleration: acceleration,
    MoveRelative: move_relative,
    StopAll: stop,
    Question: question,
    RunScript: run_script,
    AbortScript: abort_script,
}
"""One for each command of the grammar and of `vocabulary`; a test holds that none is missing."""

AT_ONCE: Final = (StopAll, Question, AbortScript, c.MotorCommand)
"""Commands that do not wait for their component's earlier ones."""
