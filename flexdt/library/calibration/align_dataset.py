"""`flexdt align` without its command line: a data set in, a correction and a JSON document
out."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Final, Generic

import numpy as np

from flexdt.library.datasets.image_doubts import image_doubts
from flexdt.library.datasets.image_set import Images, Images_co, ImageSet
from flexdt.twin import long_work
from flexdt.twin.calibration.fit.priors import prior_widths
from flexdt.twin.calibration.without_phantom.align import align_turn
from flexdt.twin.calibration.without_phantom.alignment import Alignment
from flexdt.twin.calibration.without_phantom.circular_scan import STANDS
from flexdt.twin.errors import NotIdentifiableError
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.geometry.offsets import NOMINAL
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.scanner.state import NamedCorrection

MAX_STEP_SHARE: Final = 0.1
"""Largest step of a panel that is no tiling, as a share of the panel's shorter side."""


@dataclass(frozen=True, eq=False, repr=False)
class Aligned(Generic[Images_co]):
    """Geometry estimated from a scan without a phantom.

    Attributes:
        alignment: the estimate with all its details.
        document: the JSON of `flexdt align`.
        dataset: the aligned data set, with the estimated motion.
    """

    alignment: Alignment
    document: dict[str, object]
    dataset: Images_co

    def __repr__(self) -> str:
        return f"<Alignment of {self.dataset.name!r}: {self.verdict}>"

    @property
    def verdict(self) -> str:
        """Parameters that were estimated, each with value, standard deviation and unit,
        as one line; without any, why the axis column is not identifiable.
        """
        estimates = [
            f"{name} {e.value:.6g} +- {e.sigma:.2g} {e.unit}"
            for name, e in self.alignment.parameters.items()
        ]
        if estimates:
            return ", ".join(estimates)
        return f"not identifiable: {self.alignment.refused['axis_column_px']}"

    @property
    def identifiable(self) -> bool:
        """Whether there is a correction."""
        return self.alignment.identifiable

    @property
    def warnings(self) -> tuple[str, ...]:
        """Doubts about the scan and its alignment."""
        return (*self.dataset.warnings, *self.alignment.warnings)

    @property
    def parameters(self) -> Mapping[str, Mapping[str, object]]:
        """Name -> {value, sigma, unit}: axis_column_px [px] and, if determined, det_roll,
        det_yaw [deg], source_row_px [px].
        """
        estimates: Mapping[str, Mapping[str, object]] = self.document["parameters"]  # type: ignore[assignment]
        return estimates

    @property
    def correction(self) -> NamedCorrection:
        """The correction, for `DataSet.with_correction` and `calibration.apply`: the one
        that was in force, with dO_x, det_roll, det_yaw and dD_y replaced. It is named by
        the present time (UTC), and has the panel's distortion and lag that were found. It
        knows the sides if that one did.

        Raises:
            NotIdentifiableError: there is no correction; the message gives the reason.
        """
        offsets = self.alignment.offsets
        if offsets is None:
            raise NotIdentifiableError(self.alignment.refused["axis_column_px"])
        now = datetime.now(UTC)
        name = f"alignment {now:%Y-%m-%d %H:%M:%S}"
        note = f"without a phantom, {self.alignment.frames} frames of {self.dataset.name}"
        before = self.dataset.correction
        return NamedCorrection(
            name,
            now.isoformat(timespec="seconds"),
            offsets,
            note,
            self.alignment.panel,
            sides_known=before is not None and before.sides_known,
        )


def align_dataset(data: Images, per_frame: bool = False) -> Aligned[Images]:
    """Estimate the geometry of a scan without a phantom, with warnings about the images.

    An earlier correction is the start. Small steps of the panel are undone first. Doubts
    about the images are added to the data set's warnings; a motion that was found, to its
    document and geometry; the panel, to the document.

    Args:
        data: a data set with a flat image; frames may be missing.
        per_frame: whether shifts of single frames are looked for too.

    Returns:
        The data set with the correction, the alignment and the report's document; without
        a correction where the images do not determine the axis.

    Raises:
        DatasetError: a frame cannot be read, or there is no flat image.
    """
    begun = time.perf_counter()
    # Once, also where a result is aligned again.
    doubts = dict.fromkeys((*data.warnings, *image_doubts(data)))
    data = replace(data, warnings=tuple(doubts))
    if data.correction is None:
        base = NOMINAL
    else:
        base = data.correction.parameters
    frames, poses = _at_rest(data)
    passes = long_work.Passes(len(data))
    with long_work.during("aligning") as passes.report:
        alignment = align_turn(
            passes.counting(frames),
            poses,
            data.present,
            data.shape,
            base,
            prior_widths(data.machine, data.profile),
            np.random.default_rng(0),
            per_frame,
            data.panel,
        )
    document: dict[str, object] = {
        "identifiable": alignment.identifiable,
        "parameters": {
            name: estimate._asdict() for name, estimate in alignment.parameters.items()
        },
        "refused": dict(alignment.refused),
        "warnings": [*data.warnings, *alignment.warnings],
        "frames": alignment.frames,
        "seconds": round(time.perf_counter() - begun, 4),
        "dataset": data.where,
    }
    if alignment.offsets is not None:
        document["correction"] = alignment.offsets.to_edge()
    if alignment.panel is not None:
        document["panel"] = alignment.panel.to_json()
    if alignment.motion is not None:
        document["motion"] = [alignment.motion.to_dict()]
        document["datasets"] = [data.where]
        data = data.with_motion(alignment.motion)
    return Aligned(alignment, document, data)


def _at_rest(data: ImageSet) -> tuple[Callable[[int], Float32Array], Poses]:
    """Return line integrals and poses, with small steps of the panel undone.

    Both are the data set's own if the largest step is at most `STANDS` [px], or at least
    `MAX_STEP_SHARE` of the shorter side.

    Args:
        data: the scan.

    Returns:
        Line integrals (rows, cols) of a frame by its index, and the poses. Where the
        panel steps by a few pixels, images are shifted and the panel of the poses is at
        rest.
    """
    from scipy.ndimage import shift

    poses = data.poses
    aside = poses.detector - poses.detector.mean(axis=0)
    steps = np.stack(
        [(aside * side).sum(1) / (side**2).sum(1) for side in (poses.v, poses.u)], 1
    )
    if not STANDS < np.abs(steps).max() < MAX_STEP_SHARE * min(data.shape):
        return data.line_integrals, poses
    still = poses.detector - steps[:, :1] * poses.v - steps[:, 1:] * poses.u
    moved = replace(poses, detector=still)
    return lambda i: shift(
        data.line_integrals(i), steps[i], order=1, mode="nearest"
    ), moved
