"""The dry run: parse, plan and check a script without a server, as one report.

The report has everything a user wants to know before touching the scanner: problems with
their lines, time (computed and assumed), frames, bytes, dose-relevant exposure, the
beam's view and, through a function passed as an argument, collisions and clearances.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from flexdt.twin.findings import Finding, Findings, Place, error, warning
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.physics.predicted_beam import Physics
from flexdt.twin.script import commands as c
from flexdt.twin.script.parse import Source, content, read_script
from flexdt.twin.script.planning.beam_view import View, views
from flexdt.twin.script.planning.check_findings import Clearance, Dose, Optics, cut_off
from flexdt.twin.script.planning.open_beam_findings import open_beam_problems
from flexdt.twin.script.planning.plan import CheckReport, ScanPlan
from flexdt.twin.script.planning.plan_values import SampleSize, StartState
from flexdt.twin.script.planning.planner import plan_script
from flexdt.twin.script.problems import ScriptCode

CollisionCheck = Callable[[ScanPlan, Machine, Profile, SampleSize | None], Clearance]
"""Reports the collisions of a plan; the function holds the scene and the sample's body."""


def check_script(
    text: c.Script | Source,
    machine: Machine | None = None,
    profile: Profile | None = None,
    *,
    start: StartState | None = None,
    sample: SampleSize | None = None,
    collision: CollisionCheck | None = None,
    physics: Physics = "poly",
) -> CheckReport:
    r"""Parse, plan and check a script; unreadable lines are reported and the rest is
    planned.

    Args:
        text: the script's text, bytes or path; or a script from `parse_script`.
        machine: on which it would run; the FleX-ray if None.
        profile: zero offsets in force; the machine's default if None.
        start: the scanner before it; None assumes the machine's homes, which the report
            states.
        sample: its size, for truncation; None takes the script's own, if any.
        collision: finds collisions and clearances over a plan; None leaves them
            unchecked.
        physics: predicts whether the open beam saturates the panel.

    Returns:
        The report; problems of the script are in it and never raise.

    Example:
        >>> script = "camera\tset exposure\t100\t\tACK\t\t\r\n"
        >>> check_script(script).ok
        True
    """
    problems: Findings
    if isinstance(text, c.Script):
        script = text
        problems = text.warnings
        shown = ""
    else:
        text = content(text)
        script, problems = read_script(text)
        if isinstance(text, str):
            shown = text
        else:
            shown = text.decode("utf-8", "replace")
    bare = c.Script(script.commands, Findings(), script.lines)
    plan = plan_script(bare, machine, profile, start=start, sample=sample)
    return check_plan(plan, problems, collision, shown, start is not None, physics)


def check_plan(
    plan: ScanPlan,
    problems: Sequence[Finding] = (),
    collision: CollisionCheck | None = None,
    text: str = "",
    start_known: bool = True,
    physics: Physics = "poly",
) -> CheckReport:
    """Check a plan: collisions, truncation, open beam and dose, with its problems, as a
    report.

    A collision is an error; the sample's truncation, a beam that saturates or starves the
    panel, and an unknown start are warnings.

    Args:
        plan: of a script or of poses.
        problems: of the text that it was made from, in addition to its own.
        collision: finds collisions and clearances; None leaves them unchecked.
        text: script that the plan was made from, for the page.
        start_known: whether the start was given; if not, motors that nothing moves before
            the first projection are a warning.
        physics: see `check_script`.

    Returns:
        The report, with problems in the order of lines; nothing is raised for them.
    """
    seen = [v for v in views(plan) if v.kind == "projection"]
    optics = tuple(_optics(v) for v in seen)
    clearance = None
    if collision is not None:
        clearance = collision(plan, plan.machine, plan.profile, plan.sample)
    findings = [*problems, *plan.problems, *_truncation_problems(seen)]
    findings += open_beam_problems(plan, physics)
    if not start_known:
        findings += _start_problems(plan)
    if clearance is not None:
        for x in clearance.collisions:
            message = (
                f"{x.pair[0]} and {x.pair[1]} come within the safety margin at "
                f"{x.time_s:.3f} s; last free at {_moved(plan, x.last_free)}"
            )
            findings.append(error(ScriptCode.COLLISION, message, place=Place(x.line)))
    return CheckReport(
        plan,
        Findings(findings).by_place(),
        clearance,
        optics,
        _dose(plan),
        text,
        start_known,
    )


def _moved(plan: ScanPlan, positions: Mapping[str, float]) -> str:
    """List positions of the motors that are not where they start, with units."""
    axes, start = plan.machine.axes, plan.start.positions
    moved = {k: x for k, x in positions.items() if abs(x - start.get(k, x)) > 5e-4}
    return ", ".join(
        f"{name} {x:.3f} {axes[name].unit}" for name, x in (moved or positions).items()
    )


def _start_problems(plan: ScanPlan) -> list[Finding]:
    """Warn if motors that nothing has moved stand at an assumed place when the first
    projection is taken.

    Args:
        plan: of the script; positions of its start are those assumed.

    Returns:
        At most one warning, `default_assumed`; none without projections.
    """
    seen = [group for group in plan.groups if group.kind == "projection"]
    if not seen:
        return []
    first = min(seen, key=lambda group: float(group.starts[0]))
    moved = {
        motor
        for step in plan.steps[: first.step]
        if isinstance(step.command, c.MoveAbsolute)
        and plan.machine.has(step.command.component)
        for motor in plan.machine.moves(step.command.component)
    }
    left = {m: x for m, x in plan.start.positions.items() if m not in moved}
    if not left:
        return []
    where = ", ".join(f"{name}={x:g}" for name, x in left.items())
    message = (
        f"nothing moves {', '.join(left)} before this image; home is assumed: {where}"
    )
    return [warning(ScriptCode.DEFAULT_ASSUMED, message, place=Place(first.line))]


def _optics(view: View) -> Optics:
    """Compute the figures of a view's images: lines, distances [mm], magnification, voxel
    [um], fields [mm] and truncation.

    `turn_field_mm` is the width that stays within the image over a full turn.

    Args:
        view: images of one camera setting and kind.

    Returns:
        Ranges (least, greatest) over the images; `truncation` is side -> the largest
        number of pixels cut off, without top and bottom if the height is unknown, None if
        the width is.
    """
    p = view.poses
    camera = view.camera
    rows, cols = shape = camera.shape
    pixel = float(np.linalg.norm(p.u[0]))
    m = p.sdd / p.sod
    half = np.minimum(view.axis + 0.5, cols - 0.5 - view.axis) * pixel
    reach = float(np.min(p.sod * np.sin(np.arctan2(np.maximum(half, 0.0), p.sdd))))
    cut = dict(zip(("left", "right"), view.cut_columns.max(axis=0).tolist(), strict=True))
    if not np.isnan(view.top).any():
        cut |= zip(("top", "bottom"), view.cut_rows.max(axis=0).tolist(), strict=True)
    known = bool((view.right > view.left).any())
    return Optics(
        lines=(min(view.lines), max(view.lines)),
        shape=shape,
        pixel_mm=pixel,
        sod_mm=_extent(p.sod),
        sdd_mm=_extent(p.sdd),
        magnification=_extent(m),
        voxel_um=_extent(pixel / m * 1000.0),
        field_mm=(float(np.min(cols * pixel / m)), float(np.min(rows * pixel / m))),
        turn_field_mm=2 * reach,
        truncation=cut if known else None,
    )


def _extent(values: FloatArray) -> tuple[float, float]:
    """Return the least and the greatest of some values."""
    return float(np.min(values)), float(np.max(values))


def _truncation_problems(seen: Sequence[View]) -> list[Finding]:
    """Warn if no image of the scan shows some side of the sample's width or height.

    Each side counts by the image that cuts off least of it, so positions of several scans
    of one script (tiles, helical turns) make up for each other. Views with the sample
    wholly outside, or of unknown size, are skipped.

    Args:
        seen: views of the projections.

    Returns:
        At most one warning, `truncated`, for each view.
    """
    warnings = []
    for view in seen:
        if view.outside.all() or not (view.right > view.left).any():
            continue
        names = ("left", "right", "top", "bottom")
        cuts = (view.cut_columns, view.cut_rows)
        least = [
            px for cut in cuts for px in np.min(cut, axis=0).tolist()
        ]  # NaN: height unknown
        if parts := cut_off(dict(zip(names, least, strict=True))):
            message = f"the sample is cut off over the rotation: {parts}"
            warnings.append(
                warning(ScriptCode.TRUNCATED, message, place=Place(min(view.lines)))
            )
    return warnings


def _dose(plan: ScanPlan) -> Dose:
    """Sum up a plan's time with X-rays on [s], charge [mAs] and exposing time [s].

    Exposing counts images with X-rays on, with all averages, saved or not; beam of 1e-3
    kV or less has no charge.
    """
    exposing = sum(
        len(g) * g.camera.exposure_ms * g.camera.averages / 1000.0
        for g in plan.groups
        if g.xrays_on
    )
    on = sum(b.end_s - b.start_s for b in plan.beam)
    # Below a volt there is no current to speak of, and the quotient may overflow.
    charge = sum(
        (b.end_s - b.start_s) * b.power_W / b.kV for b in plan.beam if b.kV > 1e-3
    )
    return Dose(on, charge, exposing)
