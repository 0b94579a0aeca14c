"""Files of a study: summary.json, heat maps in SVG, and one HTML page with all."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.extending import write_whole
from flexdt.library.figures import Series, axes_of, blank, plot, svg
from flexdt.library.report_page import cell_text, figure, heading, page, paragraph, table
from flexdt.twin.geometry.offsets import UNITS
from flexdt_extensions.studies.experiment_4 import ENOUGH
from flexdt_extensions.studies.runs import Run, grid


def write_study(out: Path, document: Mapping[str, Any], runs: Sequence[Run]) -> None:
    """Write everything about a study into a folder (made if need be).

    These are summary.json and report.html; of experiments other than basin and real also
    the report's two charts, mae.svg and parameters.svg.

    Args:
        out: the folder.
        document: the JSON of `flexdt study`.
        runs: of the document.
    """
    out.mkdir(parents=True, exist_ok=True)
    write_whole(out / "summary.json", json.dumps(document, indent=1) + "\n")
    if "success_share" in document:
        parts = _basin_charts(document)
    elif "curves" in document:
        parts = _real_charts(document)
    else:
        charts = _error_charts(document, runs)
        for name, chart in charts.items():
            write_whole(out / f"{name}.svg", chart)
        parts = list(charts.values())
    write_whole(out / "report.html", report(document, *parts))


def _error_charts(document: Mapping[str, Any], runs: Sequence[Run]) -> dict[str, str]:
    """Plot mean errors as heat maps, "mae" by setting and number of projections,
    "parameters" by setting and parameter [mm, deg]; below 0.2 is good.

    Args:
        document: of the study.
        runs: its runs.

    Returns:
        Name -> SVG.
    """
    settings, counts, values = grid(runs)
    title = f"{document['experiment']}, {document['fidelity']}: MAE"
    parameters = next((list(run.errors) for run in runs if run.errors), [])
    by_parameter = [
        [
            _mean([r.errors[p] for r in runs if r.setting == s and r.errors])
            for p in parameters
        ]
        for s in settings
    ]
    return {
        "mae": heat_map(
            values,
            settings,
            [str(n) for n in counts],
            title=title,
            x_label="projections N",
            good_below=0.2,
        ),
        "parameters": heat_map(
            np.reshape(by_parameter, (len(settings), len(parameters))),
            settings,
            parameters,
            title="mean absolute error by parameter (mm, deg)",
            x_label="parameter",
            good_below=0.2,
        ),
    }


def _basin_charts(document: Mapping[str, Any]) -> list[str]:
    """Plot the share of successes [%] over the start's errors (rows: mm, columns: deg),
    one heat map (SVG) for each method.
    """
    rows = [f"{v:g} mm" for v in document["start_mm"]]
    columns = [f"{v:g} deg" for v in document["start_deg"]]
    return [
        heat_map(
            100.0 * np.asarray(share),
            rows,
            columns,
            title=f"{name}: successes (%)",
            x_label="error of the start angle",
            good_from=95.0,
        )
        for name, share in document["success_share"].items()
    ]


def _real_charts(document: Mapping[str, Any]) -> list[str]:
    """Plot the logged fits with their simulation: for each scan alpha [deg] against log10
    of N, and a table.

    Three curves: logged, simulated as the author fits, and simulated with right angles
    (our fit). Missing values are gaps in the curve (nan).

    Args:
        document: of the study.

    Returns:
        HTML of the lines of `real_lines`, then of a chart and a table for each scan.
    """
    charts = ["".join(paragraph(f"{line}.") for line in real_lines(document))]
    for curve in document["curves"]:
        rows = curve["by_projections"]
        x = np.log10([float(n) for n in rows])
        series = {
            "logged": [r["logged"]["alpha"] for r in rows.values()],
            "simulated as the author fits": [
                r["simulated"]["alpha"] for r in rows.values()
            ],
            "simulated, right angles": [
                math.nan if r["ours_alpha"] is None else r["ours_alpha"]
                for r in rows.values()
            ],
        }
        charts.append(
            plot(
                [Series(name, x, y) for name, y in series.items()],
                title=f"{curve['setting']}: alpha against N",
                x_label="log10 N",
                y_label="alpha (deg)",
            )
        )
        charts.append(curve_table(curve))
    return charts


def open_directions(rows: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]] | None:
    """Sum up weak directions of each row.

    Args:
        rows: of the study.

    Returns:
        For each row "K of N" runs with a weak direction, and the largest mean sigma with
        its parameter ("-" without sigmas); None if no row has a weak run that was solved.
    """
    if not any(row["weak"] > row["unidentifiable"] for row in rows):
        return None
    out = []
    for row in rows:
        sigmas = {n: s for n, s in row["mean_sigma"].items() if s is not None}
        worst = max(sigmas, key=lambda n: sigmas[n], default=None)
        if worst is None:
            text = "-"
        else:
            text = f"{worst} {sigmas[worst]:.3g} {UNITS[worst]}"
        out.append((f"{row['weak']} of {row['runs']}", text))
    return out


def real_lines(document: Mapping[str, Any]) -> list[str]:
    """Describe in sentences how the logged fits of real scans are explained; none where
    not studied.

    The first sentence is of all scans, then one for each scan.

    Args:
        document: of the study.
    """
    found = document.get("explained")
    if not found:
        return []
    whole = sum(row["within"] == row["fits"] for row in found)
    most = sum(
        r["alpha_rms_deg"] < 1.0 and abs(r["rms_largest_pct"]) < 15.0 for r in found
    )
    lines = [
        f"logged fits of real scans from N = {ENOUGH} up, against their simulation: "
        f"{sum(r['within'] for r in found)} of {sum(r['fits'] for r in found)} agree within 1 deg "
        f"of alpha and 15 % of the residual, all of a scan's in {whole} of {len(found)} scans; "
        f"with the rms of alpha's differences instead of each, {most} of {len(found)}"
    ]
    return lines + [
        f"{r['setting']}: alpha differs by {r['alpha_rms_deg']:.2f} deg (rms; largest "
        f"{r['alpha_largest_deg']:.2f}), the residual by at most "
        f"{r['rms_largest_pct']:+.0f} %; "
        f"{r['iterations'][0]:.0f} iterations logged, {r['iterations'][1]:.0f} simulated; "
        f"{r['within']} of {r['fits']} within"
        for r in found
    ]


def curve_table(curve: Mapping[str, Any]) -> str:
    """Make an HTML table of one scan against N: logged, simulated as the author fits,
    with right angles; residuals and iterations.
    """
    names = ("alpha", "dO_z", "tau_x", "tau_z")
    return table(
        [
            "N",
            *(f"{n}: logged, simulated ({UNITS[n]})" for n in names),
            "right angles: alpha (deg)",
            "rms: logged, simulated, right angles (px)",
            "iterations: logged, simulated",
        ],
        [
            [
                n,
                *(f"{r['logged'][k]:.2f}, {r['simulated'][k]:.2f}" for k in names),
                r["ours_alpha"],
                ", ".join(
                    cell_text(r[f"{k}_rms_px"]) for k in ("logged", "simulated", "ours")
                ),
                f"{r['logged_iterations']}, {r['simulated_iterations']}",
            ]
            for n, r in curve["by_projections"].items()
        ],
    )


def _mean(values: Sequence[float]) -> float:
    if values:
        return float(np.mean(values))
    return float("nan")


def report(document: Mapping[str, Any], *charts: str) -> str:
    """Make the HTML page of a study: table of settings, charts, source, assumptions.

    Columns that are empty in all rows are left out, except the first three.

    Args:
        document: of the study.
        charts: SVG or HTML.
    """
    rows = [
        [
            r["setting"],
            r["runs"],
            r["success"],
            r["unidentifiable"],
            r["mae"],
            r["mae_max"],
            r["iterations"],
            r["cost_reduction_pct"],
            r["beside"].get("mae"),
            r["beside"].get("iterations"),
            r["thesis_mae"],
            r["thesis_iterations"],
            r["thesis_cost_reduction_pct"],
        ]
        for r in document["rows"]
    ]
    weak = open_directions(document["rows"])
    others = [r["beside"].get("method") for r in document["rows"] if r["beside"]]
    other = others[0] if others else "other method"
    head = [
        "setting",
        "runs",
        "success",
        "not identifiable",
        "MAE",
        "worst MAE",
        "iterations",
        "cost red. %",
        f"{other} MAE",
        f"{other} iterations",
        "thesis MAE",
        "thesis iterations",
        "thesis cost red. %",
    ]
    if weak is not None:
        head += ["weak", "largest mean sigma"]
        rows = [[*row, *more] for row, more in zip(rows, weak, strict=True)]
    shown = [
        i for i in range(len(head)) if i < 3 or any(row[i] is not None for row in rows)
    ]
    head = [head[i] for i in shown]
    rows = [[row[i] for i in shown] for row in rows]
    body = [
        heading(f"Study: {document['experiment']}, {document['fidelity']}"),
        table(head, rows),
        *map(figure, charts),
        paragraph(f"{document['thesis_source']}."),
    ]
    assumed = [f"{k}: {v}" for k, v in document["assumed"].items() if v is not None]
    body.append(paragraph(f"Assumed: {'; '.join(assumed)}."))
    return page(f"flexdt study {document['experiment']}", body)


def heat_map(
    values: npt.ArrayLike,
    rows: Sequence[str],
    columns: Sequence[str],
    *,
    title: str,
    x_label: str,
    good_below: float | None = None,
    good_from: float = 1.0,
) -> str:
    """Draw a table of numbers as SVG, green where they are good and red where not; each
    cell shows its number.

    With `good_below` colors follow the logarithm of value over limit, up to a factor of
    100 either way; otherwise there are two colors.

    Args:
        values: (rows, columns); nan is white.
        rows, columns: names.
        title, x_label: texts.
        good_below: smaller values are good, the more the smaller.
        good_from: where no `good_below` is given: values from here on are good.
    """
    data = np.asarray(values, dtype=np.float64)
    figure = blank(110 + 52 * len(columns), 80 + 24 * len(rows))
    axes = axes_of(figure, title, x_label, "")
    worse = np.where(data >= good_from, -0.5, 0.5)
    if good_below is not None:
        worse = np.log10(np.maximum(data, 1e-9) / good_below)
    axes.imshow(
        np.where(np.isfinite(data), worse, np.nan),
        "RdYlGn_r",
        aspect="auto",
        vmin=-2,
        vmax=2,
    )
    axes.set_xticks(range(len(columns)), columns)
    axes.set_yticks(range(len(rows)), rows)
    for (i, j), value in np.ndenumerate(data):
        axes.text(j, i, cell_text(float(value)), ha="center", va="center", size=9)
    return svg(figure)
