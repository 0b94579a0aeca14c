"""A dry run's report for people: its figures, and one self-contained HTML page.

The page shows the verdict, each problem with its line, the figures, every step with its start,
duration and effect, and the clearance over time as a plot. The command line prints the same figures
and steps.
"""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence
from itertools import zip_longest

from flexdt.twin.script.log_fit import LogComparison
from flexdt.twin.script.planning.check_findings import Optics, Trace
from flexdt.twin.script.planning.plan import HOME_ASSUMED, CheckReport
from flexdt.twin.script.planning.time_ranges import Range, step_range, total_range
from flexdt.twin.script.problems import ScriptProblem

Facts = Sequence[tuple[str, str]]

_STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 68rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.4rem; margin-bottom: .2rem; } h2 { font-size: 1.1rem; margin-top: 2rem; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .15rem .7rem .15rem 0; border-bottom: 1px solid #8883; }
th { font-weight: 600; } td.n, th.n { text-align: right; } td.a { color: #888; }
.verdict { display: inline-block; padding: .1rem .6rem; border-radius: .3rem; color: #fff; }
.ok { background: #1a7f37; } .bad { background: #b3261e; }
.error { color: #c62828; } .warning { color: #a86500; }
svg { width: 100%; height: auto; } svg text { font-size: 11px; fill: currentColor; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .1rem 1.2rem; } dd { margin: 0; }
"""


def html_report(report: CheckReport, name: str = "script") -> str:
    """The report as one self-contained HTML page.

    Args:
        report: from `check_script`.
        name: what to call the script.
    """
    verdict = ("ok", "ok") if report.ok else ("bad", "not ok")
    mark = f' <span class="verdict {verdict[0]}">{verdict[1]}</span>'
    facts, problems = _facts_html(summary(report)), _problems_html(report.problems)
    found = [facts, problems, _clearance_html(report), _steps_html(report)]
    page = _page(f"Dry run of {name}", mark)
    parts = [*page, *found, _source_html(report.text), "</body></html>"]
    return "\n".join(p for p in parts if p) + "\n"


def _page(title: str, mark: str = "") -> list[str]:
    name = html.escape(title)
    return [
        "<!doctype html>",
        f'<html lang="en"><head><meta charset="utf-8"><title>{name}</title>',
        f"<style>{_STYLE}</style></head><body>",
        f"<h1>{name}{mark}</h1>",
    ]


def against_html(found: LogComparison, name: str = "script") -> str:
    """Predicted beside executed as one self-contained HTML page.

    Args:
        found: the comparison.
        name: what to call the script.
    """
    table = _table(found.HEADER, found.table())
    facts = _facts_html(against_summary(found))
    parts = [facts, _problems_html(found.problems), table]
    return "\n".join([*_page(f"{name}: predicted and executed"), *parts, "</body></html>"])


def against_summary(found: LogComparison) -> Facts:
    """The figures of a comparison as (label, value)."""
    ranges = [row.inside for row in found.rows if row.inside is not None]
    return [
        ("machine", f"{found.machine.name}; timing: {found.machine.timing.source}"),
        ("executed", f"{found.total_real_s:.2f} s"),
        ("predicted", f"{found.total_predicted_s:.2f} s"),
        ("  90 % range", between(found.total_range) or "no time is measured"),
        ("absolute errors", f"{found.sum_abs_error_s:.2f} s, summed over {len(found.rows)} lines"),
        (
            "in their 90 % range",
            f"{sum(ranges)} of {len(ranges)} lines" if ranges else "no time is measured",
        ),
        ("start", f"{HOME_ASSUMED}: where an axis stood before its first move, a log does not say"),
    ]


def summary(report: CheckReport) -> Facts:
    """The figures of a report as (label, value)."""
    plan, dose = report.plan, report.dose
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
    where = f"line {o.lines[0]}" if o.lines[0] == o.lines[1] else f"lines {o.lines[0]}-{o.lines[1]}"
    facts = [
        (
            f"projections, {where}",
            f"{o.shape[1]} x {o.shape[0]} pixels of {o.pixel_mm:g} mm, SOD {_span(o.sod_mm)} mm, "
            f"SDD {_span(o.sdd_mm)} mm",
        ),
        ("  magnification", f"{_span(o.magnification)}, voxel {_span(o.voxel_um)} um"),
        (
            "  field of view",
            f"{o.field_mm[0]:.2f} x {o.field_mm[1]:.2f} mm at the axis; whole over a full turn: "
            f"{o.turn_field_mm:.2f} mm across",
        ),
    ]
    if o.truncation is not None:
        cut = [f"{side} {px:.0f} px" for side, px in o.truncation.items() if px > 0.5]
        facts.append(("  truncation", ", ".join(cut) if cut else "none"))
    return facts


def _collisions(report: CheckReport) -> str:
    c = report.clearance
    if c is None:
        return "not checked"
    nearest = ""
    if c.min_clearance_mm is not None and not c.collisions:
        pair = f" ({' and '.join(c.min_clearance_pair)})" if c.min_clearance_pair else ""
        nearest = f"; parts in relative motion stay {c.min_clearance_mm:.2f} mm apart{pair}"
    return f"{len(c.collisions) or 'none'}{nearest}"


def _sources(report: CheckReport) -> str:
    timing = report.plan.machine.timing
    parts = {"measured": 0.0, "assumed": 0.0}
    for s in report.plan.steps:
        parts["measured" if s.kind in timing.spread else "assumed"] += s.assumed_s
    told = ", ".join(f"{t:.2f} s {what}" for what, t in parts.items() if t) or "none"
    return f"{told}; {report.plan.machine.name} timing: {timing.source}"


def between(found: Range | None) -> str:
    """A 90 % range in words; nothing where there is none."""
    return "" if found is None else f"{found[0]:.2f} to {found[1]:.2f}"


def _total(report: CheckReport) -> str:
    plan = report.plan
    text = between(total_range(plan.steps, plan.duration_s, plan.machine.timing))
    start = "" if report.start_known else ", if axes and X-rays start as assumed below"
    return f"{text} s{start}" if text else "unknown: no time of this machine is measured"


def _time(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min {rest} s" if hours else f"{minutes} min {rest} s"


def _span(pair: tuple[float, float]) -> str:
    low, high = (f"{x:.6g}" for x in pair)
    return low if low == high else f"{low} to {high}"


def _facts_html(facts: Facts) -> str:
    rows = "".join(
        f"<dt>{html.escape(label)}</dt><dd>{html.escape(value)}</dd>" for label, value in facts
    )
    return f"<dl>{rows}</dl>"


def _problems_html(problems: Sequence[ScriptProblem]) -> str:
    if not problems:
        return ""
    rows = [(str(p.line), p.severity, p.code, p.message) for p in problems]
    table = _table(("line", "severity", "code", "what"), rows, [p.severity for p in problems])
    return f"<h2>Problems</h2>{table}"


def _steps_html(report: CheckReport) -> str:
    timing = report.plan.machine.timing
    rows = [
        (
            *(str(s.line), f"{s.start_s:.3f}", f"{s.duration_s:.3f}"),
            between(step_range(s, timing)),
            f"{s.assumed_s:.3f} s {s.assumed_from}" if s.assumed_s else "",
            s.what,
        )
        for s in report.plan.steps
    ]
    head = ("line", "start [s]", "takes [s]", "90 %", "of it commands", "effect")
    return f"<h2>Steps</h2>{_table(head, rows)}"


def _table(names: Sequence[str], rows: Sequence[Sequence[str]], kinds: Sequence[str] = ()) -> str:
    """A table with a head; `kinds` are the classes of its rows."""
    classes = {"line": "n", "start [s]": "n", "takes [s]": "n", "of it commands": "a"}
    marks = [f' class="{classes[n]}"' if n in classes else "" for n in names]
    parts = [f"<th{mark}>{name}</th>" for mark, name in zip(marks, names, strict=True)]
    for row, kind in zip_longest(rows, kinds):
        parts.append("</tr>" + (f'<tr class="{kind}">' if kind else "<tr>"))
        cells = zip(marks, row, strict=True)
        parts += [f"<td{mark}>{html.escape(cell)}</td>" for mark, cell in cells]
    return f"<table><tr>{''.join(parts)}</tr></table>"


def _source_html(text: str) -> str:
    if not text:
        return ""
    shown = "".join(
        c if c.isprintable() or c in "\n\t" else "·" for c in text.replace("\r\n", "\n")
    )
    return f"<details><summary>The script</summary><pre>{html.escape(shown)}</pre></details>"


def _clearance_html(report: CheckReport) -> str:
    c = report.clearance
    if c is None or not c.trace:
        return ""
    marks = [(x.time_s, f"line {x.line}: {' and '.join(x.pair)}") for x in c.collisions]
    return f"<h2>Clearance</h2>{clearance_plot(c.trace, marks)}"


def clearance_plot(trace: Trace, marks: Iterable[tuple[float, str]] = ()) -> str:
    """The smallest clearance over time as an inline SVG.

    Args:
        trace: (time [s], clearance [mm]), in time order.
        marks: (time [s], text) of collisions.
    """
    width, height, left, bottom, top = 900.0, 236.0, 60.0, 30.0, 28.0
    end = max(trace[-1][0], 1e-9)
    peak = max(max(value for _, value in trace), 1e-9)

    def x(time: float) -> float:
        return left + (width - left - 30.0) * time / end

    def y(value: float) -> float:
        return height - bottom - (height - bottom - top) * max(value, 0.0) / peak

    points = " ".join(f"{x(t):.1f},{y(v):.1f}" for t, v in trace)
    parts = [
        f'<svg viewBox="0 0 {width:g} {height:g}" role="img" '
        'aria-label="smallest clearance over time">',
        f'<path d="M{left},{top} V{height - bottom} H{width - 30}" fill="none" '
        'stroke="currentColor"/>',
    ]
    for value in _ticks(peak):
        parts.append(
            f'<text x="{left - 6}" y="{y(value) + 4:.1f}" text-anchor="end">{value:g}</text>'
        )
    for time in _ticks(end):
        parts.append(
            f'<text x="{x(time):.1f}" y="{height - bottom + 16}" text-anchor="middle">{time:g}'
            "</text>"
        )
    parts.append(f'<polyline points="{points}" fill="none" stroke="#1565c0" stroke-width="1.5"/>')
    for time, text in marks:
        at = f"{x(time):.1f}"
        parts.append(
            f'<line x1="{at}" x2="{at}" y1="{top}" y2="{height - bottom}" stroke="#c62828">'
            f"<title>{html.escape(text)}</title></line>"
        )
    parts.append(f'<text x="{left}" y="14">smallest clearance [mm] over time [s]</text></svg>')
    return "".join(parts)


def _ticks(end: float) -> list[float]:
    """Round numbers from 0 to `end`, about five of them."""
    raw = end / 4
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1, 2, 2.5, 5, 10) if m * power >= raw)
    return [round(k * step, 12) for k in range(int(end / step + 1e-9) + 1)]
