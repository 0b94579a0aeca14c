"""The figures of a dry run in words, for people: the command line and the page
show the same."""

from __future__ import annotations

from collections.abc import Sequence

from flexdt.twin.backends import backend
from flexdt.twin.script.log_fit import LogComparison
from flexdt.twin.script.planning.check_findings import Optics, cut_off
from flexdt.twin.script.planning.plan import HOME_ASSUMED, CheckReport
from flexdt.twin.script.planning.time_ranges import Range, total_range

Facts = Sequence[tuple[str, str]]


def html_report(report: CheckReport, name: str = "script") -> str:
    """Make one self-contained HTML page of a report.

    Args:
        report: from `check_script`.
        name: title of the script.

    Returns:
        Text of the page.
    """
    return str(backend("dry-run pages").html_report(report, name))


def against_summary(found: LogComparison) -> Facts:
    """List the figures of a log comparison as (label, value), for people.

    Machine and timing source, executed and predicted time with its 90 % range, sum of
    absolute errors, lines in their range, and the assumed start.

    Args:
        found: a log and what was predicted for it.
    """
    ranges = [row.inside for row in found.rows if row.inside is not None]
    return [
        ("machine", f"{found.machine.name}; timing: {found.machine.timing.source}"),
        ("executed", f"{found.total_real_s:.2f} s"),
        ("predicted", f"{found.total_predicted_s:.2f} s"),
        ("  90 % range", between(found.total_range) or "no time is measured"),
        (
            "absolute errors",
            f"{found.sum_abs_error_s:.2f} s, summed over {len(found.rows)} lines",
        ),
        (
            "in their 90 % range",
            f"{sum(ranges)} of {len(ranges)} lines" if ranges else "no time is measured",
        ),
        (
            "start",
            f"{HOME_ASSUMED}: where an axis stood before its first move, a log does not say",
        ),
    ]


def summary(report: CheckReport) -> Facts:
    """List the figures of a report as (label, value), for people.

    Machine and profile, duration and its parts, images, X-rays, sample, start, a group
    for each camera setting, and collisions.

    Args:
        report: of `check_script`.
    """
    plan = report.plan
    dose = report.dose
    images = sum(len(g.files) for g in plan.groups)
    facts = [
        ("machine, profile", f"{plan.machine.name}, {plan.profile.name}"),
        ("duration", f"{_time(plan.duration_s)} ({plan.duration_s:.2f} s)"),
        ("  90 % range", _total(report)),
        ("  computed", f"{plan.computed_s:.2f} s (moves, pauses, exposures)"),
        ("  commands", f"{plan.assumed_s:.2f} s ({_sources(report)})"),
        ("images", f"{images}, {plan.frames} of them projections; {plan.bytes:,} bytes"),
        (
            "X-rays",
            f"on for {dose.beam_on_s:.1f} s, {dose.exposing_s:.1f} s of it exposing; "
            f"{dose.charge_mAs:.2f} mAs",
        ),
    ]
    facts += [("sample", report.sample), ("start", report.start)]
    for o in report.optics:
        facts += _optics_facts(o)
    facts.append(("collisions", _collisions(report)))
    return facts


def _optics_facts(o: Optics) -> Facts:
    """List the figures of one camera setting as (label, value).

    Pixels and distances, magnification with voxel, field of view, and truncation if the
    sample's size is known.

    Args:
        o: of the images of one camera setting.
    """
    if o.lines[0] == o.lines[1]:
        where = f"line {o.lines[0]}"
    else:
        where = f"lines {o.lines[0]}-{o.lines[1]}"
    facts = [
        (
            f"projections, {where}",
            f"{o.shape[1]} x {o.shape[0]} pixels of {o.pixel_mm:g} mm, SOD "
            f"{_span(o.sod_mm)} mm, "
            f"SDD {_span(o.sdd_mm)} mm",
        ),
        ("  magnification", f"{_span(o.magnification)}, voxel {_span(o.voxel_um)} um"),
        (
            "  field of view",
            f"{o.field_mm[0]:.2f} x {o.field_mm[1]:.2f} mm at the axis; whole over "
            f"a full turn: {o.turn_field_mm:.2f} mm across",
        ),
    ]
    if o.truncation is not None:
        cut = cut_off(o.truncation)
        facts.append(("  truncation", f"in the worst image {cut}" if cut else "none"))
    return facts


def _collisions(report: CheckReport) -> str:
    """Format the number of collisions, or "none" with the least clearance and its pair,
    or "not checked".

    The clearance is given only where there are no collisions and it is known.
    """
    c = report.clearance
    if c is None:
        return "not checked"
    nearest = ""
    if c.min_clearance_mm is not None and not c.collisions:
        pair = ""
        if c.min_clearance_pair:
            pair = f" ({' and '.join(c.min_clearance_pair)})"
        nearest = (
            f"; parts in relative motion stay {c.min_clearance_mm:.2f} mm apart{pair}"
        )
    return f"{len(c.collisions) or 'none'}{nearest}"


def _sources(report: CheckReport) -> str:
    """Describe how much of the steps' assumed time is measured and how much not [s], and
    the timing's source.

    A kind with a spread counts as measured; parts of 0 s are left out.
    """
    timing = report.plan.machine.timing
    parts = {"measured": 0.0, "assumed": 0.0}
    for s in report.plan.steps:
        parts["measured" if s.kind in timing.spread else "assumed"] += s.assumed_s
    times = ", ".join(f"{t:.2f} s {origin}" for origin, t in parts.items() if t) or "none"
    return f"{times}; {report.plan.machine.name} timing: {timing.source}"


def between(found: Range | None) -> str:
    """Format a 90 % range [s]; "" if there is none."""
    if found is None:
        return ""
    return f"{found[0]:.2f} to {found[1]:.2f}"


def _total(report: CheckReport) -> str:
    """Describe the 90 % range of the duration [s], with a condition if the start is not
    known.

    "unknown" if no time of the machine is measured.
    """
    plan = report.plan
    text = between(total_range(plan.steps, plan.duration_s, plan.machine.timing))
    start = ", if axes and X-rays start as assumed below"
    if report.start_known:
        start = ""
    if text:
        return f"{text} s{start}"
    return "unknown: no time of this machine is measured"


def _time(seconds: float) -> str:
    """Format a duration [s], rounded to seconds, as hours (left out if 0), min and s."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min {rest} s"
    return f"{minutes} min {rest} s"


def _span(pair: tuple[float, float]) -> str:
    """Format a range, or a single number if both ends read alike."""
    low, high = (f"{x:.6g}" for x in pair)
    return low if low == high else f"{low} to {high}"
