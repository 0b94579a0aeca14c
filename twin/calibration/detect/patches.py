"""Windows in the form that the compiled kernels take, and the kernels applied to all of
them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.detect import spot_kernels as kernels
from flexdt.twin.calibration.detect.detection import CAP, MISFIT
from flexdt.twin.calibration.detect.windows import (
    Windows,
    free_of_others,
)
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

# Windows in the form that the compiled kernels take, and the kernels applied to all of them.


@dataclass(frozen=True, eq=False)
class Patches:
    """Windows and expected spots for the kernels, (m = n k, ...).

    Attributes:
        flat: (m, side, side) line integrals minus the body.
        offsets: (m, 2) expected place in the window.
        radii, stretch, peaks: (m,), (m, 3), (m,) expected spots.
        windows: their places in the images.
        entire: indices of complete, lone spots.
    """

    flat: Float32Array
    offsets: FloatArray
    radii: FloatArray
    stretch: FloatArray
    peaks: FloatArray
    windows: Windows
    entire: npt.NDArray[np.intp]


def centroids(
    patches: Patches, index: npt.NDArray[np.intp], least: FloatArray | None = None
) -> FloatArray:
    """Measure centroids in the windows `index` by the kernel `measure`.

    `least`: (m,) least noise, which weights pixels; None: 0. Returns (m, RESULTS); 0
    elsewhere and where it fails.
    """
    results = np.zeros((len(patches.flat), kernels.RESULTS))
    if least is None:
        least = np.zeros(len(results))
    for i in index:
        x, y = patches.offsets[i]
        kernels.measure(
            patches.flat[i], x, y, patches.radii[i], CAP, least[i], results[i]
        )
    return results


def fits(
    patches: Patches,
    index: npt.NDArray[np.intp],
    blur: tuple[float, float],
    free_radius: bool,
    masks: npt.NDArray[np.uint8],
) -> FloatArray:
    """Fit balls in the windows `index` by the kernel `fit_ball`, from the expected
    places.

    The background's slope is fitted for complete spots alone. `blur`: of the image [px],
    and the veil; `masks`: usable pixels of these windows. Returns (m, RESULTS), 0
    elsewhere and where it fails.
    """
    results = np.zeros((len(patches.flat), kernels.RESULTS))
    whole = patches.windows.whole.ravel()
    for i, mask in zip(index, masks, strict=True):
        kernels.fit_ball(
            patches.flat[i],
            mask,
            *patches.offsets[i],
            patches.radii[i],
            patches.stretch[i],
            patches.peaks[i],
            *blur,
            whole[i],
            free_radius,
            results[i],
        )
    return results


def ring_noise(results: FloatArray, entire: npt.NDArray[np.intp]) -> float:
    """Return the median noise of line integrals around the complete spots `entire` that
    were measured; 0 without any.
    """
    good = results[entire, kernels.OK] > 0
    if good.any():
        return float(np.median(results[entire[good], kernels.NOISE]))
    return 0.0


def take(
    results: FloatArray,
    fits: FloatArray,
    fitted: npt.NDArray[np.intp],
    whole: npt.NDArray[np.bool_],
) -> npt.NDArray[np.intp]:
    """Replace centroids by fits in `results`: entirely for all partial spots, also failed
    ones, and place, covariance and bias for complete ones with a misfit below `MISFIT`.

    Args:
        results: (m, `spot_kernels.RESULTS`) centroids, changed in place.
        fits: (m, `spot_kernels.RESULTS`) fits of the same windows.
        fitted: indices of the windows that were fitted.
        whole: (m,) complete spots.

    Returns:
        Indices of the used fits, in the order of `fitted`.
    """
    good = (fits[fitted, kernels.OK] > 0) & (fits[fitted, kernels.MISFIT] < MISFIT)
    part = fitted[~whole[fitted]]
    results[part] = fits[part]
    # Radius, peak and likeness stay those of the centroid: they judge the spot.
    lone = fitted[whole[fitted] & good]
    for place in (
        kernels.X,
        kernels.Y,
        kernels.VAR_X,
        kernels.COV_XY,
        kernels.VAR_Y,
        kernels.BIAS,
    ):
        results[lone, place] = fits[lone, place]
    return np.asarray(fitted[~whole[fitted] | good])


def contrasts(results: FloatArray, patches: Patches) -> FloatArray:
    """Estimate the contrast of each bead over all frames: the median of at least 3
    measured spots, else the expected one times the median ratio of found to expected
    contrast (1 without any).

    Args:
        results: (m, RESULTS) centroids.
        patches: m windows with expected contrasts; those of the first frame count.

    Returns:
        (m,) contrast of each window's bead, equal in all frames.
    """
    shape = patches.windows.whole.shape
    seen = np.where(results[:, kernels.OK] > 0, results[:, kernels.PEAK], np.nan).reshape(
        shape
    )
    given = patches.peaks.reshape(shape)[0]
    out = np.full(len(given), np.nan)
    for bead in range(len(out)):
        values = seen[:, bead][np.isfinite(seen[:, bead])]
        if len(values) >= 3:
            out[bead] = np.median(values)
    known = np.isfinite(out)
    if known.any():
        ratio = float(np.median(out[known] / given[known]))
    else:
        ratio = 1.0
    out[~known] = given[~known] * ratio
    return np.broadcast_to(out, shape).ravel().copy()


def usable(patches: Patches, index: npt.NDArray[np.intp]) -> npt.NDArray[np.uint8]:
    """Mark usable pixels of some windows: finite ones, and in crowded windows those free of
    other beads' spots.

    `patches`: the windows; `index`: (j,) of those to mark.
    Returns (j, side, side) uint8, 1 where usable.
    """
    masks = np.isfinite(patches.flat[index]).astype(np.uint8)
    windows = patches.windows
    k = windows.corner.shape[1]
    for i, position in enumerate(index.tolist()):
        frame, bead = divmod(position, k)
        if windows.crowded[frame, bead]:
            masks[i] &= free_of_others(windows, frame, bead)
    return masks
