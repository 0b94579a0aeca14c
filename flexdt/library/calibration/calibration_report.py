"""The report of a calibration: an HTML page, or its document as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.library.calibration.calibrate import Outcome, digits, unseen
from flexdt.library.datasets.image_set import ImageSet
from flexdt.library.figures import Series, arrows, ellipse_plot, image_under, plot
from flexdt.library.report_page import (
    bullets,
    code,
    figure,
    heading,
    page,
    paragraph,
    table,
)
from flexdt.runtime.files.whole_files import write_whole
from flexdt.twin.calibration.fit.certificate import Certificate
from flexdt.twin.calibration.fit.fit import FitResult

PARAMETER_COLUMNS = (
    "parameter",
    "value",
    "sigma",
    "of it from the images",
    "prior",
    "95 % from",
    "to",
    "unit",
)
MAX_ELLIPSES = 6
"""Number of parameter pairs drawn, most correlated first."""
MAX_MAP_FRAMES = 180
"""Largest number of frames whose residuals are drawn over the detector; of more frames, every
second, third... is drawn."""


def write_report(outcome: Outcome[ImageSet], path: Path) -> None:
    """Write the outcome's report as HTML, or its document as JSON if the name ends in
    .json (in either case); the file appears only when complete.
    """
    if path.suffix.lower() == ".json":
        text = json.dumps(outcome.document, indent=1) + "\n"
    else:
        text = report(outcome)
    write_whole(path, text)


def report(outcome: Outcome[ImageSet]) -> str:
    """Make the HTML report of a calibration.

    Without a fit only verdict, next commands and findings; ellipses only where the
    geometry is determined in full. The first present image of each data set is read.

    Args:
        outcome: of the calibration.

    Returns:
        A page with verdict, findings, parameters, residuals, trajectories and ellipses.
    """
    document: Any = outcome.document
    result = outcome.calibration
    names = ", ".join(d.name for d in outcome.datasets)
    body: list[str] = [
        heading(f"Calibration of {names}"),
        paragraph(
            f"Phantom {outcome.phantom.name}, {document['frames']} frames, "
            f"{document['detections']} shadows, {document['seconds']} s."
        ),
        paragraph(document["verdict"], kind="good" if result.identifiable else "bad"),
        *map(code, document["next"]),
    ]
    problems: Any = document["problems"]
    if problems:
        kinds = ["bad" if p["severity"] == "error" else "" for p in problems]
        body += [
            heading("Findings", level=2),
            bullets([p["text"] for p in problems], kinds),
        ]
    if result.fit is not None:
        body += _fit_parts(result.fit, document)
        body += _pictures(outcome, result.fit)
        if result.fit.certificate.spectrum.full:
            body += _ellipses(result.fit.certificate)
    return page(f"Calibration of {names}", body)


def _fit_parts(fit: FitResult, document: Mapping[str, Any]) -> list[str]:
    """Make the tables of parameters, spectrum and correlations of a fit.

    Quantities in the images, weak directions, held parameters and correlations are there
    only where known.

    Args:
        fit: of the geometry.
        document: of the calibration.

    Returns:
        HTML parts.
    """
    c = fit.certificate
    rows = [
        [
            n,
            *(digits(p[k], p["sigma"]) for k in ("value", "sigma")),
            "-" if p["images"] is None else f"{p['images']:.2g}",
            "-" if p["prior"] is None else f"{p['prior']:g}",
            *(digits(p[k], p["sigma"]) for k in ("low", "high")),
            p["unit"],
        ]
        for n, p in document["parameters"].items()
    ]
    seen = [
        [n, *(digits(q[k], q["sigma"]) for k in ("value", "sigma")), q["unit"]]
        for some in document.get("image_space", ())
        for n, q in some.items()
    ]
    body: list[str] = [
        heading("Parameters", level=2),
        table(PARAMETER_COLUMNS, rows),
        *(paragraph(f"{n} {t}.") for n, t in document.get("limited", {}).items()),
        heading("In the images", level=3) if seen else "",
        table(["quantity", "value", "sigma", "unit"], seen) if seen else "",
        paragraph(f"{text}.")
        if (text := unseen(document.get("reliability", ())))
        else "",
        paragraph(
            f"Reading of eq. 5.4: {fit.reading.value}. Values are true minus nominal."
        ),
        heading("Certificate", level=2),
        table(
            ["", ""],
            [
                ["rank", f"{c.spectrum.rank} of {len(c.spectrum.names)}"],
                ["column-scaled condition number", c.spectrum.condition],
                ["rms residual (px)", c.rms_px],
                ["residuals in units of the stated noise", c.noise],
                ["cost reduction (%)", fit.cost_reduction_pct],
                ["iterations", fit.iterations],
                ["positions left out", len(c.outliers)],
                ["covariance enlarged for correlated residuals by", c.enlargement],
            ],
        ),
    ]
    if c.weak:
        body += [heading("Null and weak directions", level=3), bullets(c.weak)]
    for name, why in c.held:
        body.append(paragraph(f"{name} is {why}."))
    if c.spectrum.full:
        names = list(c.estimates)
        rows = [
            [n, *map(float, row)] for n, row in zip(names, c.correlation, strict=True)
        ]
        body += [heading("Correlations", level=3), table(["", *names], rows)]
    return body


def _ellipses(c: Certificate) -> list[str]:
    """Make HTML parts: a heading, and an SVG of the joint 95 % ellipse for each of the
    `MAX_ELLIPSES` most correlated pairs of parameters (fewer if there are no more).
    """
    from scipy.special import fdtri

    names = list(c.estimates)
    pairs = [
        (abs(c.correlation[i, j]), i, j) for i in range(len(names)) for j in range(i)
    ]
    scale = math.sqrt(2.0 * float(fdtri(2, c.dof, 0.95)))
    out: list[str] = [heading("Joint 95 % ellipses about the estimate", level=2)]
    for _, i, j in sorted(pairs, reverse=True)[:MAX_ELLIPSES]:
        part = c.covariance[np.ix_([j, i], [j, i])]
        out.append(figure(ellipse_plot(part, (names[j], names[i]), scale)))
    return out


def _pictures(outcome: Outcome[ImageSet], fit: FitResult) -> list[str]:
    """Draw trajectories, residuals by frame and detector maps, and tabulate beads.

    Args:
        outcome: its data sets; the first image of each is read.
        fit: of the geometry.

    Returns:
        HTML parts. A parameter that moves during the scan is plotted, too; a data set
        without images has no picture.
    """
    c = fit.certificate
    beads = range(c.used.shape[1])
    frames = np.arange(len(c.used))
    measured = fit.problem.pixels
    body: list[str] = [heading("Trajectories", level=2)]
    for dataset, part in outcome.parts:
        tracks = measured[part]
        present = dataset.present
        if not present:
            continue
        series = [Series(f"bead {k}", tracks[:, k, 0], tracks[:, k, 1]) for k in beads]
        title = f"{dataset.name}: frame {present[0]} and the beads of all frames"
        body.append(image_under(dataset.line_integrals(present[0]), series, title=title))
    r = np.where(c.used[..., None], c.residuals_px, np.nan)
    body.append(heading("Residuals (measured minus predicted)", level=2))
    for axis, name in ((0, "column"), (1, "row")):
        body.append(
            plot(
                [Series(f"bead {k}", frames, r[:, k, axis], line=False) for k in beads],
                title=f"{name} residual by frame",
                x_label="frame",
                y_label="px",
            )
        )
    body.append(
        plot(
            [Series(f"bead {k}", r[:, k, 0], r[:, k, 1], line=False) for k in beads],
            title="residuals",
            x_label="column (px)",
            y_label="row (px)",
            width=340,
            height=340,
            flip_y=True,
            equal=True,
        )
    )
    body += _maps(outcome, fit, r)
    body.append(
        plot(
            [Series("beads used", frames, c.beads_per_frame)],
            title="usable beads by frame",
            x_label="frame",
            y_label="beads",
            height=180,
        )
    )
    for dataset, motion in zip(
        outcome.datasets, outcome.calibration.motions, strict=False
    ):
        for name, move in motion.to_dict().items():
            if move["moves"]:
                values = np.array(move["values"])
                body.append(
                    plot(
                        [Series(name, np.arange(len(values)), values)],
                        title=f"{dataset.name}: {name} during the scan",
                        x_label="frame",
                        y_label=str(move["unit"]),
                        height=180,
                    )
                )
    rows = [
        [
            k,
            int(c.used[:, k].sum()),
            sum(o.bead == k for o in c.outliers),
            float(c.rms_per_bead[k]),
        ]
        for k in beads
    ]
    table_of_beads = table(["bead", "frames used", "left out", "rms (px)"], rows)
    return [*body, heading("By bead", level=3), table_of_beads]


def _maps(
    outcome: Outcome[ImageSet], fit: FitResult, residuals: npt.NDArray[np.float64]
) -> list[str]:
    """Draw residuals over the detector, one map a scan, enlarged to be visible.

    At most `MAX_MAP_FRAMES` frames each; returns SVG maps, enlarged by a power of ten.

    Args:
        outcome: gives the data sets.
        fit: gives the measured positions [px].
        residuals: (n, k, 2) [px].
    """
    places = fit.problem.pixels
    rms = fit.certificate.rms_px
    if rms > 0:
        factor = 10.0 ** math.floor(math.log10(30.0 / rms))
    else:
        factor = 1.0
    out = []
    for dataset, part in outcome.parts:
        every = slice(
            None, None, max(1, math.ceil(places[part].shape[0] / MAX_MAP_FRAMES))
        )
        groups = [
            (f"bead {k}", places[part, k][every], residuals[part, k][every])
            for k in range(residuals.shape[1])
        ]
        title = f"{dataset.name}: residuals over the detector, {factor:g} times enlarged"
        out.append(arrows(groups, dataset.shape, title=title, factor=factor))
    return out
