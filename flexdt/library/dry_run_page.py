"""HTML pages of a dry run, and of an executed script compared with its prediction.

The page shows the verdict, each problem with its line, the figures, every step with its start,
duration and effect, and the clearance over time as a plot.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexdt.library.figures import Series, plot, require_plots
from flexdt.library.report_page import (
    facts,
    figure,
    folded,
    heading,
    marked,
    page,
    paragraph,
    table,
)
from flexdt.twin.errors import TwinError
from flexdt.twin.findings import Finding
from flexdt.twin.script.dry_run_report import against_summary, between, summary
from flexdt.twin.script.log_fit import LogComparison
from flexdt.twin.script.planning.check_findings import Clearance
from flexdt.twin.script.planning.plan import CheckReport
from flexdt.twin.script.planning.time_ranges import step_range


def html_report(report: CheckReport, name: str = "script") -> str:
    """Make one self-contained HTML page of a report.

    It has the verdict, summary, problems, clearance, steps and, if known, the script.

    Args:
        report: from `check_script`.
        name: of the script.
    """
    title = f"Dry run of {name}"
    doubts = len(report.problems)
    if report.ok and doubts:
        verdict = marked(
            f"can run, {doubts} warning{'s' if doubts > 1 else ''}", "warning"
        )
    elif report.ok:
        verdict = marked("ok", "good")
    else:
        verdict = marked("not ok", "bad")
    body = [
        heading(title, " ", verdict),
        facts(summary(report)),
        *_problems(report.problems),
        *_clearance(report.clearance),
        *_steps(report),
        folded("The script", printable(report.text)) if report.text else "",
    ]
    return page(title, body)


def against_html(comparison: LogComparison, name: str = "script") -> str:
    """Make one self-contained HTML page that compares the prediction with the execution.

    Args:
        comparison: of a plan and its log.
        name: of the script.
    """
    title = f"{name}: predicted and executed"
    rows = table(comparison.HEADER, comparison.table(), text=("what",))
    return page(
        title,
        [
            heading(title),
            facts(against_summary(comparison)),
            *_problems(comparison.problems),
            rows,
        ],
    )


def clearance_plot(clearance: Clearance) -> str:
    """Plot the smallest clearance over time, contacts marked, as an SVG element.

    Args:
        clearance: with a trace; parts that overlap are drawn as 0 mm apart.

    Raises:
        TwinError: matplotlib is not installed.
    """
    times, distances = np.array(clearance.trace, dtype=np.float64).T
    return plot(
        [Series("", times, np.maximum(distances, 0.0))],
        title="Smallest clearance",
        x_label="time (s)",
        y_label="clearance (mm)",
        width=900,
        marks=[
            (c.time_s, f"line {c.line}: {' and '.join(c.pair)}")
            for c in clearance.collisions
        ],
    )


def printable(text: str) -> str:
    """Replace unprintable characters by dots, and keep only plain line ends."""
    lines = text.replace("\r\n", "\n")
    return "".join(c if c.isprintable() or c in "\n\t" else "·" for c in lines)


def _problems(problems: Sequence[Finding]) -> list[str]:
    """Make HTML parts on a script's problems: heading and table of line, severity, code
    and message; [] without any."""
    if not problems:
        return []
    head = ("line", "severity", "code", "what")
    rows = [(str(p.line), p.severity, p.code, p.message) for p in problems]
    kinds = [p.severity for p in problems]
    return [heading("Problems", level=2), table(head, rows, kinds=kinds, text=head[1:])]


def _clearance(clearance: Clearance | None) -> list[str]:
    """Make HTML parts with the plot of the clearance; [] without a trace; without
    matplotlib a sentence takes the place of the plot."""
    if clearance is None or not clearance.trace:
        return []
    try:
        require_plots()
    except TwinError as error:
        shown = paragraph(f"Not drawn: {error.message}")
    else:
        shown = figure(clearance_plot(clearance))
    return [heading("Clearance", level=2), shown]


def _steps(report: CheckReport) -> list[str]:
    """Make heading and HTML table of a plan's steps: line, start and duration [s], its 90
    % range, the assumed part of it with its source, and effect."""
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
    head = ("line", "start [s]", "takes [s]", "90 % within [s]", "assumed [s]", "effect")
    texts = ("assumed [s]", "effect")
    return [heading("Steps", level=2), table(head, rows, text=texts)]
