"""The dry run: parse, plan and check a script without a server, as one report.

The report has everything a user wants to know before touching the scanner: problems with their
lines, time (computed and assumed), frames, bytes, dose-relevant exposure, what the beam sees and,
through a function passed as an argument, collisions and clearances.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.script import commands as c
from flexdt.twin.script.parse import Source, content, read_script
from flexdt.twin.script.plan import Range, SampleSize, ScanPlan, StartState, step_range, total_range
from flexdt.twin.script.planner import View, plan_script, views
from flexdt.twin.script.problems import ScriptProblem, WithProblems, in_order

Trace = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Collision:
    """A contact on the way: which line moves, when, what touches what.

    `last_free` is where every axis stands at the last moment that is still free.
    """

    line: int
    time_s: float
    pair: tuple[str, str]
    last_free: Mapping[str, float]

    def to_dict(self) -> dict[str, object]:
        """The JSON form of `flexdt check`."""
        return {**vars(self), "pair": list(self.pair), "last_free": dict(self.last_free)}


@dataclass(frozen=True)
class Clearance:
    """What a collision check found over a whole plan.

    `min_clearance_mm` of a plan with collisions is that at which the worst of them begins: how far
    parts overlap then is not measured. `trace` are (time [s], smallest clearance [mm]) points for a
    plot, in time order.
    """

    collisions: tuple[Collision, ...] = ()
    min_clearance_mm: float | None = None
    min_clearance_pair: tuple[str, str] | None = None
    trace: Trace = ()


_OF_STEP = ("line", "start_s", "duration_s", "holds_s", "assumed_s", "assumed_from", "what")
HOME_ASSUMED = "the machine's home, assumed"
EMPTY, EMPTY_ASSUMED = "none", "empty stage assumed"

CollisionCheck = Callable[[ScanPlan, Machine, Profile, SampleSize | None], Clearance]
"""Reports the collisions of a plan; the function holds the scene and the sample's body."""


@dataclass(frozen=True)
class Optics:
    """What the projections of one camera setting see [mm, um]; ranges are (least, greatest).

    Attributes:
        field_mm: width and height of the field of view at the rotation axis.
        turn_field_mm: diameter of the cylinder seen whole over a full rotation.
        truncation: None without a sample's size; else columns (and rows, if the height is known)
            of its projection that fall beyond left, right, top, bottom, at worst over the rotation.
    """

    lines: tuple[int, int]
    shape: tuple[int, int]
    pixel_mm: float
    sod_mm: tuple[float, float]
    sdd_mm: tuple[float, float]
    magnification: tuple[float, float]
    voxel_um: tuple[float, float]
    field_mm: tuple[float, float]
    turn_field_mm: float
    truncation: Mapping[str, float] | None

    @property
    def truncated(self) -> bool:
        """Whether the sample is cut off anywhere."""
        return self.truncation is not None and any(x > 0 for x in self.truncation.values())

    def to_dict(self) -> dict[str, object]:
        """JSON form."""
        names = {"field_mm": "field_of_view_mm", "turn_field_mm": "full_turn_diameter_mm",
                 "truncation": "truncation_px"}  # fmt: skip
        told = {n: list(v) if isinstance(v, tuple) else v for n, v in vars(self).items()}
        told["rows"], told["cols"] = told.pop("shape")
        return {names.get(name, name): value for name, value in told.items()}


@dataclass(frozen=True)
class Dose:
    """What matters for dose: beam time, charge on the target, time that makes images.

    `charge_mAs` is power over voltage times beam time. It says nothing about dose in a sample:
    spectrum, filter and distance are not in it.
    """

    beam_on_s: float
    charge_mAs: float
    exposing_s: float


@dataclass(frozen=True)
class CheckReport(WithProblems):
    """The whole report; `to_dict` is the document of `flexdt check --json`."""

    plan: ScanPlan
    problems: tuple[ScriptProblem, ...]
    clearance: Clearance | None
    optics: tuple[Optics, ...]
    dose: Dose
    text: str = field(default="", repr=False)
    start_known: bool = True
    """Whether the start was given; otherwise the machine's home positions are assumed."""

    def __repr__(self) -> str:
        """One line."""
        hits = len(self.clearance.collisions) if self.clearance else 0
        return (
            f"<CheckReport: {'ok' if self.ok else 'not ok'}, {hits} collisions, of {self.plan!r}>"
        )

    @property
    def ok(self) -> bool:
        """No error and no collision; warnings do not count."""
        return not self.errors  # a collision is one

    @property
    def start(self) -> str:
        """Where the motors stand before, in words."""
        at = ", ".join(f"{name}={x:g}" for name, x in self.plan.start.positions.items())
        return at if self.start_known else f"{HOME_ASSUMED}: {at}"

    @property
    def sample(self) -> str:
        """What stands on the stage, in words."""
        size = self.plan.sample
        if size is None:
            return EMPTY if self.start_known else f"{EMPTY} ({EMPTY_ASSUMED})"
        high = f", {size.height_mm:g} mm high" if size.height_mm else ""
        return f"{size.diameter_mm:g} mm across{high} ({size.source})"

    def to_dict(self) -> dict[str, object]:
        """The JSON document."""
        plan, clearance = self.plan, self.clearance
        size, found = plan.sample, clearance or Clearance()
        return {
            "ok": self.ok,
            "machine": plan.machine.name,
            "profile": plan.profile.name,
            "problems": [p.to_dict() for p in self.problems],
            "steps": [
                {n: getattr(s, n) for n in _OF_STEP} | _range(step_range(s, plan.machine.timing))
                for s in plan.steps
            ],
            "duration_s": plan.duration_s,
            **_range(total_range(plan.steps, plan.duration_s, plan.machine.timing)),
            "computed_s": plan.computed_s,
            "assumed_s": plan.assumed_s,
            "timing_source": plan.machine.timing.source,
            "frames": plan.frames,
            "images": sum(len(g.files) for g in plan.groups),
            "bytes": plan.bytes,
            "collisions": [x.to_dict() for x in found.collisions],
            "collisions_checked": clearance is not None,
            "min_clearance_mm": found.min_clearance_mm,
            "min_clearance_pair": found.min_clearance_pair and list(found.min_clearance_pair),
            "clearance": [list(p) for p in found.trace],
            "optics": [o.to_dict() for o in self.optics],
            "dose": dict(vars(self.dose)),
            "start": {"known": self.start_known, "positions": dict(plan.start.positions)},
            "summary": {"sample": self.sample, "start": self.start},
            "sample": size and {**vars(size), "height_mm": size.height_mm or None},
        }


def _range(found: Range | None) -> dict[str, float | None]:
    low, high = found or (None, None)
    return {"p5_s": low, "p95_s": high}


def check_script(
    text: c.Script | Source,
    machine: Machine | None = None,
    profile: Profile | None = None,
    *,
    start: StartState | None = None,
    sample: SampleSize | None = None,
    collision: CollisionCheck | None = None,
) -> CheckReport:
    """Parse, plan and check a script; what cannot be read is reported and the rest is planned.

    Args:
        text: the script's text, bytes or path; or a script from `parse_script`.
        machine: on which it would run; the FleX-ray if None.
        profile: zero offsets in force; the machine's default if None.
        start: the scanner before it; None assumes the machine's homes, and the report says so.
        sample: its size, for truncation; None takes what the script says, if anything.
        collision: finds collisions and clearances over a plan; None leaves them unchecked.

    Example:
        >>> script = "camera\\tset exposure\\t100\\t\\tACK\\t\\t\\r\\n"
        >>> check_script(script).ok
        True
    """
    problems: tuple[ScriptProblem, ...]
    if isinstance(text, c.Script):
        script, problems, shown = text, text.warnings, ""
    else:
        text = content(text)
        script, problems = read_script(text)
        shown = text if isinstance(text, str) else text.decode("utf-8", "replace")
    bare = c.Script(script.commands, (), script.lines)
    plan = plan_script(bare, machine, profile, start=start, sample=sample)
    return check_plan(plan, problems, collision, shown, start is not None)


def check_plan(
    plan: ScanPlan,
    problems: Sequence[ScriptProblem] = (),
    collision: CollisionCheck | None = None,
    text: str = "",
    start_known: bool = True,
) -> CheckReport:
    """The report about a plan.

    Args:
        plan: of a script or of poses.
        problems: of the text that it was made from, beside its own.
        collision: see `check_script`.
        text: that it was made from, for the page.
        start_known: whether the start was given.
    """
    seen = [v for v in views(plan) if v.kind == "projection"]
    optics = tuple(_optics(v) for v in seen)
    clearance = (
        None if collision is None else collision(plan, plan.machine, plan.profile, plan.sample)
    )
    found = [*problems, *plan.problems, *_truncation_problems(seen)]
    if not start_known:
        found += _start_problems(plan)
    if clearance is not None:
        for x in clearance.collisions:
            what = f"{x.pair[0]} and {x.pair[1]} come within the safety margin at {x.time_s:.3f} s"
            found.append(ScriptProblem("error", "collision", x.line, 1, what))
    return CheckReport(plan, in_order(found), clearance, optics, _dose(plan), text, start_known)


def _start_problems(plan: ScanPlan) -> list[ScriptProblem]:
    """A warning where the first projection is taken with motors that nothing has moved before."""
    seen = [group for group in plan.groups if group.kind == "projection"]
    if not seen:
        return []
    first = min(seen, key=lambda group: float(group.starts[0]))
    moved = {
        motor
        for step in plan.steps[: first.step]
        if isinstance(step.command, c.MoveAbsolute) and plan.machine.has(step.command.component)
        for motor in plan.machine.moves(step.command.component)
    }
    left = {m: x for m, x in plan.start.positions.items() if m not in moved}
    if not left:
        return []
    where = ", ".join(f"{name}={x:g}" for name, x in left.items())
    what = f"nothing moves {', '.join(left)} before this image; home is assumed: {where}"
    return [ScriptProblem("warning", "default_assumed", first.line, 1, what)]


def _optics(view: View) -> Optics:
    p, camera = view.poses, view.camera
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
    return float(np.min(values)), float(np.max(values))


def _truncation_problems(seen: Sequence[View]) -> list[ScriptProblem]:
    """A warning where no image of the scan shows some part of the sample's width or height.

    Positions of several scans of one script (tiles, helical turns) make up for each other.
    """
    found = []
    for view in seen:
        if view.outside.all() or not (view.right > view.left).any():
            continue
        parts = [
            f"{name} by {px:.0f} {pixels}"
            for pixels, names, cut in (
                ("columns", ("left", "right"), view.cut_columns),
                ("rows", ("top", "bottom"), view.cut_rows),  # NaN where the height is unknown
            )
            for name, px in zip(names, np.min(cut, axis=0).tolist(), strict=True)
            if px > 0.5
        ]
        if parts:
            what = f"the sample is cut off over the rotation: {', '.join(parts)}"
            found.append(ScriptProblem("warning", "truncated", min(view.lines), 1, what))
    return found


def _dose(plan: ScanPlan) -> Dose:
    exposing = sum(
        len(g) * g.camera.exposure_ms * g.camera.averages / 1000.0
        for g in plan.groups
        if g.xrays_on
    )
    on = sum(b.end_s - b.start_s for b in plan.beam)
    # Below a volt there is no current to speak of, and the quotient may overflow.
    charge = sum((b.end_s - b.start_s) * b.power_W / b.kV for b in plan.beam if b.kV > 1e-3)
    return Dose(on, charge, exposing)
