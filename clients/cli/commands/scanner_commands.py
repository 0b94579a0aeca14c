"""`flexdt state`, `move`, `jog`, `stop`, `tube`, `camera`, `sample`, `snap` and their
like.

They show or set the state of a running twin. The twin checks ranges and limits; its error
is printed as it comes.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import typer

from flexdt.clients.cli import option_values, options, value_completion
from flexdt.clients.cli.boundary import REFUSED
from flexdt.clients.cli.command_settings import SampleSettings
from flexdt.clients.cli.console import duration, note, table, warn
from flexdt.clients.cli.options import Answer, Twin, argument, option
from flexdt.clients.cli.settings_file import chosen
from flexdt.library.failure import CommandError
from flexdt.runtime import process_settings
from flexdt.twin.length_units import UNITS_MM

if TYPE_CHECKING:
    import numpy.typing as npt

    from flexdt.clients.client.client import TwinClient
    from flexdt.protocol.methods.scanner_messages import LengthUnit, SampleResult
    from flexdt.protocol.state_model import (
        AxisState,
        ImageFlags,
        State,
        Stopped,
        TubeState,
    )


def state(twin: Twin) -> Answer:
    """Show axes, geometry, tube, camera, sample, safety, job.

    Yields:
        The state as document of --json, a table of the axes, and a line for each other fact.
    """
    with twin() as client:
        current = client.state()
    yield current
    yield table(
        [_axis(n, a) for n, a in current.axes.items()],
        ("axis", "position", "target", "velocity", "limits", "unit", ""),
    )
    yield ""
    for name, text in _facts(current):
        yield f"{name:12} {text}"


def _axis(name: str, axis: AxisState) -> tuple[str, ...]:
    """Return the cells of an axis: name, position, target, velocity, limits, unit, and
    "moving", "virtual" or "".

    Positions have 4 decimals, the velocity 3; limits are "[lower, upper]".
    """
    lower, upper = axis.limits
    if axis.moving:
        doing = "moving"
    elif axis.virtual:
        doing = "virtual"
    else:
        doing = ""
    return (
        name,
        f"{axis.position:.4f}",
        f"{axis.target:.4f}",
        f"{axis.velocity:.3f}",
        f"[{lower:g}, {upper:g}]",
        axis.unit,
        doing,
    )


def _facts(state: State) -> list[tuple[str, str]]:
    """List the facts of a state for its table: geometry, view, tube, camera, sample,
    safety, clock, correction and controller; then image (saturated, starved, cut off) and
    job, if there are any.

    Lengths are in [mm], voxels in [um].

    Returns:
        Label and text of each.
    """
    g = state.geometry
    c = state.camera
    t = state.tube
    s = state.sample
    rows, cols = c.shape
    facts = [("missing", f"{name}: {why}") for name, why in state.missing.items()]
    if g is not None:
        facts += [
            (
                "geometry",
                f"SOD {g.SOD_mm:.4f} mm, SDD {g.SDD_mm:.4f} mm, magnification "
                f"{g.magnification:.4f}, voxel {g.voxel_size_mm * 1000:.3f} um",
            ),
            (
                "view",
                f"{g.field_of_view_mm[0]:.2f} x {g.field_of_view_mm[1]:.2f} mm, piercing point "
                f"column {g.piercing_point_px[0]:.2f}, row {g.piercing_point_px[1]:.2f}",
            ),
        ]
    facts += [
        ("tube", f"{xrays(t)}, {t.kV:g} kV, {t.power_W:g} W"),
        (
            "camera",
            f"{c.mode}, {cols} x {rows} pixels of {c.pixel_mm:g} mm, {c.exposure_ms:g} ms",
        ),
        ("sample", s.name or "none"),
        ("safety", " ".join(w for w in (state.safety.state, state.safety.message) if w)),
        ("clock", f"{state.clock.time_s:.2f} s, speed-up {state.clock.speed_up}"),
        ("correction", state.correction.name if state.correction else "none"),
        ("controller", state.controller or "nobody"),
    ]
    if state.image is not None:
        i = state.image
        if i.truncated:
            cut = f", sample cut off at: {', '.join(i.truncated)}"
        else:
            cut = ""
        facts.append(
            ("image", f"{i.saturated:.1%} saturated, {i.starved:.1%} starved{cut}")
        )
    if state.job is not None:
        j = state.job
        facts.append(
            ("job", f"{j.job} {j.state}, {j.frames_done} of {j.frames_total} frames")
        )
    return facts


def tube(
    twin: Twin,
    kV: float | None = option(None, "--kv"),
    power_W: float | None = option(None, "--power", metavar="W"),
    on: bool | None = option(None, "--on/--off"),
) -> Answer:
    """Set the X-ray tube, or show it; missing settings stay.

    Args:
        kV: Set the tube's voltage.
        power_W: Set the tube's power.
        on: Switch X-rays on or off.

    Yields:
        The tube as document of --json, then one line. Without options nothing is set.
    """
    with twin() as client:
        if kV is None and power_W is None and on is None:
            t = client.state().tube
        else:
            t = client.set_tube(kV=kV, power_W=power_W, on=on)
    yield t
    yield f"X-rays {xrays(t)}, {t.kV:g} kV, {t.power_W:g} W"


def xrays(tube: TubeState) -> str:
    """Format the tube's X-rays: off, on, or the time until they are ready."""
    if tube.on and not tube.ready:
        return f"on, ready in {tube.ready_in_s or 0.0:.1f} s"
    return "on" if tube.on else "off"


def camera(
    twin: Twin,
    exposure_ms: float | None = option(None, "--exposure", metavar="MS"),
    mode: str | None = option(None, proposes=value_completion.mode_names),
    roi: options.Roi = None,
    averages: int | None = option(None),
) -> Answer:
    """Set the camera, or show it; missing settings stay.

    Args:
        exposure_ms: Set the exposure time.
        mode: Set the mode: HWaSWbHigh or HWaSWbLow.
        averages: Average so many read-outs in an image.

    Yields:
        The camera as document of --json, then one line. Without options nothing is set.
    """
    with twin() as client:
        if exposure_ms is None and mode is None and roi is None and averages is None:
            c = client.state().camera
        else:
            c = client.set_camera(
                exposure_ms=exposure_ms, mode=mode, roi=roi, averages=averages
            )
    yield c
    rows, cols = c.shape
    yield (
        f"{c.mode}, {cols} x {rows} pixels of {c.pixel_mm:g} mm, {c.exposure_ms:g} ms, "
        f"averages {c.averages}, ROI {' '.join(map(str, c.roi))}"
    )


def clock(twin: Twin, speed_up: str = argument(..., "X or max")) -> Answer:
    """Set how fast the twin's time runs.

    Yields:
        The clock as document of --json, then one line.
    """
    wanted = process_settings.speed_up(speed_up)
    with twin() as client:
        now = client.set_clock(wanted)
    yield now
    yield f"speed-up {now.speed_up}, {now.time_s:.2f} s on the twin's clock"


JOG_LEASE_S = 1.0
"""Length of a lease: an axis moves on so long after this process has died [real s]."""
LONGEST_LEASE_S = 10.0
"""Longest lease that the wire allows [twin s]."""
JOG_RENEWED = 0.3
"""Part of a lease after which the next one is requested."""
JOG_POLL_S = 0.002


def move(
    twin: Twin,
    targets: list[str] = argument(
        ..., "AXIS=VALUE...", proposes=value_completion.axis_values
    ),
    relative: bool = option(False, "--relative"),
    plan: bool = option(False, "--plan"),
    shortest: bool = option(False, "--shortest"),
    no_wait: bool = option(False, "--no-wait"),
) -> Answer:
    """Move axes; several start together.

    Args:
        targets: mm or deg, script's sign.
        relative: Move by these values instead of to them.
        plan: Plan a path around obstacles.
        shortest: Turn rot_obj by the shortest way.
        no_wait: Return without waiting for the arrival.

    Yields:
        The result as document of --json, then one line with the time. Ctrl-C leaves the
        axes moving, with a note; raises CommandError (exit code REFUSED) if an axis did
        not arrive. Targets are read by `assignments`.
    """
    wanted = option_values.assignments(targets)
    with twin() as client:
        try:
            done = client.move(
                wanted, relative=relative, plan=plan, shortest=shortest, wait=not no_wait
            )
        except KeyboardInterrupt:
            note("flexdt: the axes keep moving; `flexdt stop` brakes them")
            raise
    warn(done.warnings)
    yield done
    if done.arrived is False:
        raise CommandError(
            "the move did not end at its target; see `flexdt state`", REFUSED
        )
    if no_wait:
        verb = "moving, arrives in"
    else:
        verb = "arrived after"
    yield f"{verb} {duration(done.duration_s)} of the twin's clock"


def jog(
    twin: Twin,
    axis: str = argument(..., "AXIS", proposes=value_completion.axis_names),
    velocity: str = argument(..., "VELOCITY"),
    seconds: str | None = option(None, "--for", metavar="SECONDS"),
) -> Answer:
    """Move an axis at a velocity until Ctrl-C, or for a time.

    Args:
        velocity: mm/s or deg/s, signed.
        seconds: Stop after so many seconds of the twin's clock.

    Yields:
        The axis at the end as document of --json, then one line. The axis is braked after
        the time and after Ctrl-C; numbers that are not finite, and a time of 0 or less,
        are usage errors.
    """
    speed = option_values.number(velocity, "the velocity")
    if seconds is None:
        lasting = math.inf
    else:
        lasting = option_values.number(seconds, "--for")
    if lasting <= 0:
        raise typer.BadParameter(f"--for {seconds}: the seconds must be more than 0")
    with twin() as client:
        note(f"jogging {axis} at {speed:g}; Ctrl-C stops it")
        try:
            _lease(client, axis, speed, lasting)
        except KeyboardInterrupt:
            note("")
        client.jog(axis, 0.0)
        position = client.state().axes[axis]
    yield position
    yield f"{axis} braking at {position.position:.4f} {position.unit}"


def _lease(client: TwinClient, axis: str, speed: float, seconds: float) -> None:
    """Jog for so many seconds of the twin's clock, lease after lease, at any speed of the
    clock.

    Returns at the end of the travel; warnings are printed once. A lease lasts
    `JOG_LEASE_S` of real time, at most `LONGEST_LEASE_S` of the twin's, and is renewed
    before its end. At the fastest clock, and the last one, it runs out by itself.

    Args:
        client: connected to the twin.
        axis: name of the motor.
        speed: [mm/s, deg/s], signed.
        seconds: on the twin's clock [s]; the end of the travel ends it earlier.
    """
    now = client.state()
    left = seconds
    shown = ""
    while left > 0:
        if now.clock.speed_up == "max":
            pace = math.inf
        else:
            pace = now.clock.speed_up
        lease = min(JOG_LEASE_S * pace, LONGEST_LEASE_S, left)
        jogged = client.jog(axis, speed, lease_s=lease)
        if jogged.duration_s == 0.0:
            return  # at the end of its travel
        for warning in jogged.warnings:  # a contact cuts it short
            if warning != shown:
                note(shown := warning)
        if lease == left or pace == math.inf:
            now = _outwait(client, axis, jogged.duration_s)
            left -= lease
            continue
        begun = now.time
        time.sleep(max(JOG_POLL_S, JOG_RENEWED * lease / pace))
        now = client.state()
        left -= min(lease, now.time - begun)


def _outwait(client: TwinClient, axis: str, duration_s: float) -> State:
    """Wait until a jog's lease has ended or the axis rests; return the state then.

    The lease runs out by itself: a renewal could come after its end. `duration_s` is by
    the twin's clock.
    """
    now = client.state()
    end = now.time + duration_s  # counted from after its start, not from before
    while now.time < end and now.axes[axis].moving:
        time.sleep(JOG_POLL_S)
        now = client.state()
    return now


def stop(twin: Twin) -> Answer:
    """Bring all motors to rest (pauses a running job).

    Yields:
        The state as document of --json, then one line.
    """
    with twin() as client:
        current = client.stop()
    yield current
    yield f"{_rest(current)}; a running job is paused"


def estop(twin: Twin) -> Answer:
    """Emergency stop: everything halts, X-rays off.

    Yields:
        The state as document of --json, then one line that names `flexdt reset`.
    """
    with twin() as client:
        current = client.estop()
    yield current
    yield f"emergency stop, {_rest(current)}; `flexdt reset` leaves it"


def _rest(state: Stopped) -> str:
    """Describe in words after which time and distance each axis rests, and which bodies
    would collide on the way; "nothing moves" without any.

    Also "nothing moves" where the stop has no record.
    """
    stopping = state.stopping
    if stopping is None or not stopping.distances:
        return "nothing moves"
    ways = [
        f"{n} after {d:.3g} {state.axes[n].unit}" for n, d in stopping.distances.items()
    ]
    if stopping.would_hit:
        hit = f"; {' and '.join(stopping.would_hit)} would collide"
    else:
        hit = ""
    return f"at rest in {stopping.duration_s:.3g} s: {', '.join(ways)}{hit}"


def reset(twin: Twin) -> Answer:
    """Leave the emergency stop.

    Yields:
        The state as document of --json, then a line on its safety. Only the stop that was
        seen is released.
    """
    with twin() as client:
        seen = (
            client.state().safety
        )  # the stop to release; an older twin has no number for it
        current = client.reset(seen.stop or None)
    if current.safety.message:
        why = f": {current.safety.message}"
    else:
        why = ""
    yield current
    yield f"safety: {current.safety.state}{why}"


def sample(
    twin: Twin,
    name: str | None = argument(
        None, "NAME or FILE", proposes=value_completion.sample_names
    ),
    unit: str | None = option(None, among=lambda: UNITS_MM),
    material: str | None = option(None, proposes=value_completion.material_names),
) -> Answer:
    """Put a sample on the stage, or list the samples.

    Args:
        name: A mesh, phantom or scene file is sent first. Lists the samples if left out.
        unit: Read a mesh in this unit; default: mm, for GLB m.
        material: Fill a mesh with this material; default: abs.

    Yields:
        The samples, or the result, as document of --json, then lines. A file is uploaded
        if its ending is that of a mesh, phantom or scene and it exists; any other word is
        a name. --unit and --material without a mesh file are a usage error; warnings go
        to standard error.
    """
    from flexdt.clients.client.twin_methods import MESH_FORMATS

    file = _sample_file(name)
    if (file is None or _ending(file) not in MESH_FORMATS) and (
        unit is not None or material is not None
    ):
        raise typer.BadParameter("--unit and --material are for a mesh file")
    with twin() as client:
        if name is None:
            found = client.samples()
            yield found
            yield from (f"{one.name:20} {one.description}" for one in found.samples)
            return
        now = put_on_stage(
            client, name, unit=cast("LengthUnit | None", unit), material=material
        )
        what = ""
        if file is not None:
            every = client.samples().samples
            mine = (one for one in every if one.name == now.sample.name)
            what = f" ({next(mine).description})"
    warn(now.warnings)
    yield now
    yield f"on the stage: {now.sample.name or 'nothing'}{what}"


def _ending(file: Path) -> str:
    return file.suffix.lower().lstrip(".")


def _sample_file(word: str | None) -> Path | None:
    """Return the mesh, phantom or scene file that a sample's word means; None of a name."""
    from flexdt.clients.client.twin_methods import MESH_FORMATS, SCENE_FORMATS

    file = Path(word or "")
    known = _ending(file) in (*MESH_FORMATS, *SCENE_FORMATS) and file.is_file()
    return file if known else None


def put_on_stage(
    client: TwinClient,
    word: str,
    *,
    unit: LengthUnit | None = None,
    material: str | None = None,
) -> SampleResult:
    """Put a sample on the stage, by its name or by its file, which is sent first.

    Args:
        client: connected to the twin.
        word: name or file.
        unit: of a mesh; None for mm, of GLB m.
        material: of a mesh; None for ABS.

    Raises:
        CommandError: a file that is not there or holds no sample.
        RpcError: the twin refuses it.
    """
    from flexdt.clients.client.twin_methods import SCENE_FORMATS

    file = _sample_file(word)
    if file is None:
        return _named_sample(client, word)
    if _ending(file) in SCENE_FORMATS:
        sent = client.upload_scene(file)
    else:
        place = chosen(SampleSettings).place
        sent = client.upload_mesh(file, unit=unit, place=place, material=material)
    return client.set_sample(file=sent.name)


def _named_sample(client: TwinClient, name: str) -> SampleResult:
    """Put a sample on the stage by its name.

    A refused name is looked up as a file only to explain the error.

    Args:
        client: connected to the twin.
        name: of a sample of the twin.

    Returns:
        The sample on the stage, with warnings.

    Raises:
        CommandError: the twin has no such sample, and the name is that of a file, which is
            not there or holds no sample.
        RpcError: the twin refuses it.
    """
    from flexdt.clients.client.twin_methods import MESH_FORMATS, SCENE_FORMATS
    from flexdt.protocol.rpc_errors import RpcError

    try:
        return client.set_sample(name)
    except RpcError:
        file = Path(name)
        known = (*MESH_FORMATS, *SCENE_FORMATS)
        ends = _ending(file) in known
        if file.is_file() and not ends:
            endings = ", ".join(f".{ending}" for ending in known)
            raise CommandError(
                f"{name}: not a sample's file; allowed: {endings}"
            ) from None
        if not file.is_file() and (ends or len(file.parts) > 1):
            raise CommandError(f"{name}: no such file") from None
        raise


def delete_sample(twin: Twin, name: str = argument(..., "NAME")) -> Answer:
    """Delete an uploaded sample from the twin.

    Args:
        name: As `flexdt sample` lists it.

    Yields:
        Name and bytes, as document of --json and as a line.
    """
    with twin() as client:
        gone = client.delete_sample(name)
    yield gone
    yield f"deleted: {gone.name}, {gone.bytes} bytes"


def delete_correction(twin: Twin, name: str = argument(..., "NAME")) -> Answer:
    """Delete a correction that is not in force from the twin.

    Args:
        name: Of the correction.

    Yields:
        Its name, as document of --json and as a line.
    """
    with twin() as client:
        gone = client.delete_calibration(name)
    yield gone
    yield f"deleted: {gone.name}"


def snap(
    twin: Twin,
    file: Path = argument(..., "FILE.{tif,png}"),
    kind: Literal["counts", "line_integral"] | None = option(None),
    binning: int = option(1, min=1, max=32),
    marks: bool = option(True),
) -> Answer:
    """Take a projection at the current pose.

    A TIFF holds the values as they come: uint16 counts by default. A PNG is windowed to 8 bit,
    dense parts dark, and shows line integrals by default, so X-rays may be off. It marks in
    color pixels of a wrong exposure: saturated red, starved blue, cut-off edges
    yellow.

    Args:
        kind: Write this kind; default: counts in a TIFF, integrals in a PNG.
        binning: Average so many pixels a side.
        marks: Color saturated, starved and cut-off pixels of a PNG.

    Yields:
        The document of --json (file, dtype, shape, cone_vec, kind, flags), then a line,
        and the legend of marks. A dark image, and bad exposure, are warned of on standard
        error; another ending, or a missing folder, is an error before anything is taken.
    """
    option_values.require_ending(file, ".tiff", ".tif", ".png")
    option_values.require_folder(file)
    with twin() as client:
        wanted = kind or ("line_integral" if file.suffix.lower() == ".png" else "counts")
        tube = client.state().tube
        dark = wanted == "counts" and not (tube.on and tube.ready)
        colours = marks and file.suffix.lower() == ".png" and not dark
        taken = client.projection(kind=wanted, binning=binning, marks=colours)
    image = taken.image
    save(file, image, dark_is_dense=wanted == "line_integral", marks=taken.marks)
    if dark and not tube.on:
        note(
            "warning: X-rays are off, so this is a dark image; `flexdt tube --on` "
            "switches them on"
        )
    elif dark:
        note(
            f"warning: X-rays warm up (ready in {tube.ready_in_s:.1f} s): this is a dark image"
        )
    elif taken.flags is not None:
        warn_of_exposure(taken.flags)
    if dark or taken.flags is None:
        flags = None
    else:
        flags = taken.flags.model_dump()
    yield {
        "file": str(file),
        "dtype": str(image.dtype),
        "shape": image.shape,
        "cone_vec": taken.cone_vec,
        "kind": wanted,
        "flags": flags,
    }
    rows, cols = image.shape
    yield f"{file}: {cols} x {rows} {image.dtype}"
    if taken.marks is not None:
        from flexdt.library.datasets.pictures import legend

        yield from legend(taken.marks)


def warn_of_exposure(flags: ImageFlags) -> None:
    """Warn on standard error of the share [%] of saturated and of starved pixels, each
    from `WARNING_SHARE` on.

    Nothing is written below that share."""
    from flexdt.twin.physics.exposure import WARNING_SHARE

    for name, share in (("saturated", flags.saturated), ("starved", flags.starved)):
        if share >= WARNING_SHARE:
            note(f"warning: {100 * share:.3g} % of the pixels are {name}")


def save(
    file: Path,
    image: npt.NDArray[Any],
    *,
    dark_is_dense: bool = False,
    marks: npt.NDArray[Any] | None = None,
) -> None:
    """Write an image (rows, cols) as TIFF, or windowed to 8 bit as PNG.

    An existing file is replaced. Any ending but .png makes a TIFF, unchanged.

    Args:
        dark_is_dense: draw dense parts dark, in a PNG.
        marks: (rows, cols) of pixels to color, in a PNG.

    Raises:
        CommandError: it cannot be drawn as PNG.
        OSError: the file cannot be written.
    """
    if file.suffix.lower() == ".png":
        from flexdt.library.datasets.pictures import png

        try:
            encoded = png(image, dark_is_dense=dark_is_dense, marks=marks)
        except ValueError as error:
            raise CommandError(f"{file}: {error}") from None
        file.write_bytes(encoded)
    else:
        import tifffile

        from flexdt.runtime.files.whole_files import room_named

        with room_named(file):
            tifffile.imwrite(file, image)
