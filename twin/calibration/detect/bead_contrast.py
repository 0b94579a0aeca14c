"""Contrast of the beads' spots: limits for the detection, and the values of the first
measurement.

Beads of a phantom may be of several sizes and materials. Their contrasts at the energy of
the phantom's attenuations give no more than a rough ratio in a tube's beam, so they bound
how faint a spot may be, and replace the contrast of a bead that was not seen.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.detection import FAINTEST, Detections, SpotFinder
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.poses import Poses

MAX_KIND_RATIO = 1.2
"""Factor between the sizes or contrasts of a phantom's beads from which they are of several
kinds."""


def detector_for(model: BeadModel, poses: Poses) -> SpotFinder:
    """Make a spot finder whose limits allow for the beads' sizes and contrasts.

    Radii may be 0.65 times the smallest to 1.5 times the largest that is expected in any
    view. Contrasts that are not above 0 are left out of the faintest.

    Args:
        model: the phantom's beads.
        poses: rough geometry, which converts radii to pixels.

    Returns:
        Limits of radius, of likeness (none if the beads are of several kinds,
        `MAX_KIND_RATIO`) and of the faintest contrast.
    """
    sizes = model.bead_radius_mm
    contrasts = model.contrasts
    dark = contrasts[contrasts > 0]
    if len(dark):
        faintest = float(dark.min() / dark.max())
    else:
        faintest = 1.0
    several = (
        sizes.max() > MAX_KIND_RATIO * sizes.min() or faintest * MAX_KIND_RATIO < 1.0
    )
    return SpotFinder(
        radius_px=(
            0.65 * float(sizes.min() * poses.pixels_per_mm.min()),
            1.5 * float(sizes.max() * poses.pixels_per_mm.max()),
        ),
        same=np.inf if several else SpotFinder.same,
        faintest=FAINTEST * faintest,
    )


def seen_contrasts(
    model: BeadModel, detections: Sequence[Detections], index: npt.NDArray[np.int64]
) -> FloatArray:
    """Estimate the typical contrast of each bead: the median over the frames; of an
    unseen one the model's, times the seen ones' median ratio to the model.

    Args:
        model: the beads, k.
        detections: of n frames.
        index: (n, k) which spot of a frame is which bead, -1 for none.

    Returns:
        (k,) line integrals; all nan if no bead was seen.
    """
    seen = np.full(index.shape, np.nan)
    for frame, (found, numbers) in enumerate(
        zip(detections, index.tolist(), strict=True)
    ):
        beads = [k for k, number in enumerate(numbers) if number >= 0]
        seen[frame, beads] = found.contrast[[numbers[k] for k in beads]]
    known = np.isfinite(seen).any(axis=0)
    if not known.any():
        return np.full(len(model), np.nan)
    typical = np.full(len(model), np.nan)
    typical[known] = np.nanmedian(seen[:, known], axis=0)
    ratio = float(np.median(typical[known] / model.contrasts[known]))
    return np.where(known, typical, ratio * model.contrasts)
