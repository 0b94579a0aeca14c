"""Compare a data set with the twin's own projections: `flexdt compare` (thesis 4.10).

The twin is posed from the data set's texts and projects the phantom. The projections are
compared with the radiographs before and after the correction that calibration finds, as
residuals of the beads in pixels and as difference images. A correction that is not identifiable
is an error.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np

from flexdt.library.calibration.bead_tracks import coordinate_rms, predictions
from flexdt.library.calibration.calibrate import Outcome, calibrate_datasets
from flexdt.library.datasets.image_set import ImageSet
from flexdt.library.figures import Series, image_under, plot
from flexdt.library.reading.folders import load_dataset
from flexdt.library.report_page import figure, heading, marked, page, paragraph, table
from flexdt.phantoms import Phantom
from flexdt.phantoms.channels import line_integrals
from flexdt.runtime.files.whole_files import room_named
from flexdt.twin.calibration.fit.fit import require_identifiable
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.geometry.offsets import NOMINAL, Offsets

TOLERANCE_PX: Final = 0.5
"""Default of the largest allowed rms residual of the beads after correction."""


FIGURES: Final = ("rms_px", "max_px", "image_rms")
"""Figures of one correction: rms and largest residual of the beads [px], rms of the
difference images."""
SHOWN_FRAMES: Final = 4
"""Number of frames with difference images."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """A data set compared with the twin.

    Attributes:
        document: the JSON of `flexdt compare`.
        outcome: the calibration behind it.
        frames: indices of the frames shown.
        seen: (m, rows, cols) their line integrals.
        before, after: (m, rows, cols) seen minus virtual, nominal and corrected.
        residuals: (n, k, 2) measured minus virtual bead positions [px], nominal and corrected.
    """

    document: dict[str, Any]
    outcome: Outcome[ImageSet]
    frames: tuple[int, ...]
    seen: Float32Array
    before: Float32Array
    after: Float32Array
    residuals: tuple[FloatArray, FloatArray]

    @property
    def within(self) -> bool:
        """The residual after correction is within the tolerance."""
        return bool(self.document["within"])


def compare_folder(
    folder: str | PathLike[str],
    phantom: str | Phantom,
    tolerance_px: float = TOLERANCE_PX,
    *,
    shown: int = SHOWN_FRAMES,
) -> Comparison:
    """Compare a data set with the twin: calibrate it, and simulate some frames with and
    without the correction.

    Args:
        folder: the data set; TIFFs and the two settings texts are enough.
        phantom: that was scanned, by value, name or file.
        tolerance_px: largest allowed rms residual of the beads after correction, per
            coordinate.
        shown: number of frames, evenly spread, of which difference images are made.

    Returns:
        Residuals before (nominal geometry) and after correction, and difference images,
        radiograph less simulation; the document has figures of the residuals of the
        correction in force, too, if there is one.

    Raises:
        DatasetError: no data set.
        NotIdentifiableError: the data do not determine a correction.
        TwinError: they contradict the phantom or the angles; the message has the
            findings.
    """
    begun = time.perf_counter()
    dataset = load_dataset(folder)
    outcome = calibrate_datasets([dataset], phantom)
    result = outcome.calibration
    if result.errors or result.fit is None:
        texts = "; ".join(f.text for f in result.errors)
        raise TwinError(f"{folder}: {texts}", {"problems": outcome.document["problems"]})
    require_identifiable(result.fit)
    corrected = result.fit.parameters
    before, after = (bead_residuals(outcome, p) for p in (NOMINAL, corrected))
    present = dataset.present
    chosen = tuple(
        present[i] for i in np.linspace(0, len(present) - 1, shown).round().astype(int)
    )
    seen = dataset.stack(chosen)
    first = seen - virtual(outcome.phantom, dataset, chosen, NOMINAL)
    second = seen - virtual(outcome.phantom, dataset, chosen, corrected)
    rms = coordinate_rms(after)
    document: dict[str, Any] = {
        "within": bool(rms <= tolerance_px),
        "tolerance_px": tolerance_px,
        "before": _figures(before, first),
        "after": _figures(after, second),
        "frames": len(dataset),
        "shown": list(chosen),
        "correction": corrected.to_edge(),
        "calibration": outcome.document,
        "seconds": round(time.perf_counter() - begun, 3),
    }
    in_force = dataset.correction
    if in_force is not None:
        third = bead_residuals(outcome, in_force.parameters)
        document["in_force"] = {"name": in_force.name, **_figures(third, None)}
    return Comparison(document, outcome, chosen, seen, first, second, (before, after))


def bead_residuals(outcome: Outcome[ImageSet], parameters: Offsets) -> FloatArray:
    """Measured minus virtual bead positions of the first data set, (n, k, 2) [px], nan
    unseen."""
    fit = outcome.calibration.fit
    assert fit is not None
    return fit.problem.pixels - predictions(fit, [parameters] * len(fit.problem.base))


def virtual(
    phantom: Phantom, dataset: ImageSet, frames: tuple[int, ...], parameters: Offsets
) -> Float32Array:
    """Simulate line integrals of some frames by the twin, (m, rows, cols)."""
    cone = dataset.poses[np.array(frames)].cone_vec(parameters)
    return line_integrals(phantom, cone, dataset.shape)


def _figures(
    residual: FloatArray, images: Float32Array | None
) -> dict[str, float | None]:
    """Compute the `FIGURES` of residuals (n, k, 2) [px], nan unseen, and difference
    images.

    That is rms a coordinate, largest length, and the images' rms (None without).
    """
    length = np.linalg.norm(residual, axis=2)
    if images is None:
        of_images = None
    else:
        of_images = float(np.sqrt(np.mean(images.astype("f8") ** 2)))
    return dict(
        zip(
            FIGURES,
            (coordinate_rms(residual), float(np.nanmax(length)), of_images),
            strict=True,
        )
    )


def rows_of(document: Mapping[str, Any]) -> list[tuple[Any, ...]]:
    """List the table's rows that a comparison has: correction, rms, largest [px], image
    rms.
    """
    return [
        (name, *(document[name][figure] for figure in FIGURES))
        for name in ("before", "after", "in_force")
        if name in document
    ]


def write_comparison(comparison: Comparison, out: Path) -> None:
    """Write report.html, compare.json and the difference images into a folder.

    The report has a verdict on the tolerance, residuals by frame, and pictures of each
    frame shown. Images are `difference_FRAME_before.tif` and `_after.tif`.

    Args:
        comparison: of a data set with the twin.
        out: the folder, made if needed; images are float32 TIFF.

    Raises:
        OSError: it cannot be written.
    """
    import tifffile

    out.mkdir(parents=True, exist_ok=True)
    for k, frame in enumerate(comparison.frames):
        for name, stack in (("before", comparison.before), ("after", comparison.after)):
            file = out / f"difference_{frame:06d}_{name}.tif"
            with room_named(file):
                tifffile.imwrite(file, stack[k])
    document = comparison.document
    (out / "compare.json").write_text(
        json.dumps(document, indent=1) + "\n", encoding="utf-8"
    )
    rows = [[name, *figures] for name, *figures in rows_of(document)]
    before, after = (
        np.sqrt(np.nanmean(residual**2, axis=(1, 2))) for residual in comparison.residuals
    )
    frames = np.arange(len(before))
    if comparison.within:
        verdict = marked("within", "good")
    else:
        verdict = marked("exceeded", "bad")
    body: list[str] = [
        heading(f"{comparison.outcome.datasets[0].name} beside the twin"),
        paragraph(
            f"Tolerance {document['tolerance_px']} px: ", verdict, " after correction."
        ),
        table(["", "rms (px)", "worst bead (px)", "rms of the difference image"], rows),
        plot(
            [Series("before", frames, before), Series("after", frames, after)],
            title="Residual of the beads by frame",
            x_label="frame",
            y_label="rms (px)",
        ),
    ]
    shown = {
        "radiograph": comparison.seen,
        "difference before": comparison.before,
        "difference after": comparison.after,
    }
    for k, frame in enumerate(comparison.frames):
        for name, stack in shown.items():
            picture = image_under(stack[k], [], title=f"{name}, frame {frame}", width=300)
            body.append(figure(picture))
    (out / "report.html").write_text(page("flexdt compare", body), encoding="utf-8")
