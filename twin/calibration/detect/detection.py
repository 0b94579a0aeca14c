"""Detection of bead spots in a radiograph: positions to a small fraction of a pixel, with
covariances.

The input is a line-integral image, -ln((counts - dark) / (flat - dark)). Candidates are
found on a coarse image without structures wider than a bead (gradients, bricks, large
foreign objects). Each candidate is measured at full resolution, and spots unlike a ball
are dropped. A bead that is cut by the image's edge is fitted as a ball with the other
beads' radius. `identify` then finds the bead of each spot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.detect import spot_kernels as kernels
from flexdt.twin.calibration.repeated_frames import ROBUST
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

CAP = 6.0
"""Largest line integral above the background; larger ones are cut. Noise may lower it."""
FAINTEST = 0.12
"""Least height of a bead, as a share of the strongest small structure's in the image."""
MIN_LIKENESS = 0.90
"""Smallest correlation with a ball's profile."""
MISFIT = 0.3
"""Largest misfit of a fitted ball beyond noise, as a share of its spot's contrast."""
BLUR_PX = 0.7
"""Assumed blur (focal spot, scintillator) where a ball is fitted to part of a spot."""
BRIGHT_PERCENT = 99.0
"""Percentile of the pixels of an image of intensities that is taken for the open beam."""
LEAST_LIGHT = 1e-4
"""Least intensity that is taken a logarithm of, as a share of the open beam."""
_Candidate = tuple[float, float, float]
"""Column, row, radius [px], as in the kernels' results."""
_Found = TypeVar("_Found", _Candidate, FloatArray)


@dataclass(frozen=True, eq=False)
class Detections:
    """Bead spots of one image, strongest first; read-only arrays.

    Attributes:
        centers: (k, 2) pixels (column, row).
        covariances: (k, 2, 2) [px^2].
        radii_px: (k,) radius of each spot.
        contrast: (k,) line integral through its middle, above the background.
        bias: (k,) sphere-centre bias factor of the position (see `fit.problem.Centre`).
        whole: (k,) whether the spot is entirely in the image.
        likeness: (k,) correlation with a ball's profile (complete spots), or the share of
            it in view.
        shape: (rows, cols) of the image.
    """

    centers: FloatArray
    covariances: FloatArray
    radii_px: FloatArray
    contrast: FloatArray
    bias: FloatArray
    whole: npt.NDArray[np.bool_]
    likeness: FloatArray
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.centers)

    @classmethod
    def of_points(
        cls,
        centers: FloatArray,
        noise_px: float | FloatArray,
        radii_px: float | FloatArray,
        shape: tuple[int, int],
    ) -> Detections:
        """Make complete, unbiased spots of contrast and likeness 1 at points (k, 2) [px].

        `noise_px` is the sigma of each coordinate; it and the radii are one or (k,).
        """
        k = len(centers)
        one = np.ones(k)
        covariances = np.multiply.outer((noise_px * one) ** 2, np.eye(2))
        return cls(
            centers,
            covariances,
            radii_px * one,
            one,
            0 * one,
            one.astype(bool),
            one,
            shape,
        )


@dataclass(frozen=True)
class SpotFinder:
    """Settings of the detection.

    Attributes:
        radius_px: smallest and largest radius of a bead's spot.
        same: a spot whose contrast and radius differ from the typical ones by more than this
            factor is dropped; inf keeps beads of several sizes and materials.
        faintest: least height of a bead, as a share of the strongest small structure's.
        intensities: the images hold intensities that were taken for line integrals.
    """

    radius_px: tuple[float, float] = (1.5, 60.0)
    same: float = 1.6
    faintest: float = FAINTEST
    intensities: bool = False


def detect_beads(
    image: npt.ArrayLike,
    detector: SpotFinder | None = None,
    *,
    radius_px: tuple[float, float] | None = None,
) -> Detections:
    """Detect the beads in one image.

    Spots unlike a ball, too faint or unlike most others are dropped; those cut by the
    image's edge are fitted. NaN counts as 0, infinity as 16 or 0. With the setting
    `intensities` the image is converted to line integrals first.

    Args:
        image: (rows, cols) line integrals.
        detector: settings; None is the default.
        radius_px: (smallest, largest) of a spot, instead of the detector's.

    Returns:
        One row a spot, complete ones first; `centers` (k, 2) are (column, row) [px].

    Raises:
        TwinError: the image is not two-dimensional or has no pixel.

    Example: a ball of 10 pixels radius.

    >>> import numpy as np
    >>> row, column = np.mgrid[:120, :160]
    >>> chord = 2 * np.sqrt(np.maximum(10**2 - (row - 50) ** 2 - (column - 90) ** 2, 0))
    >>> detect_beads(0.1 * chord, radius_px=(5, 20)).centers.round(2) + 0.0
    array([[90., 50.]])
    """
    if detector is None:
        how = SpotFinder()
    else:
        how = detector
    if radius_px is not None:
        how = replace(how, radius_px=radius_px)
    data = np.ascontiguousarray(image, dtype=np.float32)
    if data.ndim != 2 or data.size == 0:
        raise TwinError.of_shape("an image", data.shape, ("rows", "cols"))
    if not np.isfinite(data).all():
        data = np.nan_to_num(data, nan=0.0, posinf=16.0, neginf=0.0)
    if how.intensities:
        data = of_intensity(data)
    low = how.radius_px[0]
    if low >= 4.5:
        factor = 4
    elif low >= 2.5:
        factor = 2
    else:
        factor = 1
    whole, cut = _candidates(coarser(data, factor), factor, how)
    found = [r for r in (_measure(data, c, how) for c in whole) if r is not None]
    found = _alike(_distinct(found, kernels.SCORE, 0.5), how)
    return _pack(found, _cut_beads(data, cut, found), (data.shape[0], data.shape[1]))


def of_intensity(image: Float32Array) -> Float32Array:
    """Convert an image of intensities to line integrals, relative to the percentile
    `BRIGHT_PERCENT` of its pixels; intensities count as `LEAST_LIGHT` of that at least."""
    bright = max(float(np.percentile(image, BRIGHT_PERCENT)), 1e-12)
    return np.asarray(-np.log(np.maximum(image / bright, LEAST_LIGHT)), dtype=np.float32)


def coarser(image: Float32Array, factor: int) -> Float32Array:
    """Average factor x factor pixels into a new image; incomplete blocks at the far edges
    are dropped.

    Factor 1 returns the image itself, one larger than the image an empty array.
    """
    if factor == 1:
        return image
    rows = image.shape[0] // factor
    cols = image.shape[1] // factor
    if rows == 0 or cols == 0:
        return np.zeros((rows, cols), dtype=np.float32)
    part = image[: rows * factor, : cols * factor]
    return np.asarray(cv2.resize(part, (cols, rows), interpolation=cv2.INTER_AREA))


def _candidates(
    coarse: Float32Array, factor: int, how: SpotFinder
) -> tuple[list[_Candidate], list[_Candidate]]:
    """Find compact bright blobs: those entirely inside, and those at the image's edge.

    Blobs are sought at several thresholds, halved from half the highest value to the
    larger of 8 sigmas of noise and the faintest height, above a background opened by a
    window wider than a bead. Blobs of unsuitable size, and elongated ones inside, are
    dropped; of several at a place the largest is taken.

    Args:
        coarse: (rows, cols) line integrals, averaged.
        factor: of the averaging.
        how: sizes and heights of spots.

    Returns:
        Candidates inside, and at the edge: (column, row, radius) in pixels of the
        original image; none for images under 3 x 3.
    """
    low, high = how.radius_px
    rows, cols = coarse.shape
    if rows < 3 or cols < 3:
        return [], []
    side = 2 * math.ceil(high / factor) + 3
    # What survives an opening by a window wider than a bead is background. The border repeats,
    # so that a bead cut by the edge still counts as small.
    wide = cv2.morphologyEx(
        coarse,
        cv2.MORPH_OPEN,
        np.ones((side, side), np.uint8),
        borderType=cv2.BORDER_REFLECT,
    )
    small = coarse - wide
    sample = small[::3, ::3].ravel()
    noise = ROBUST * _middle(np.abs(sample - _middle(sample))) + 1e-4
    top = float(small.max())
    floor = max(8.0 * noise, how.faintest * top)
    inside: list[_Candidate] = []
    edge: list[_Candidate] = []
    level = 0.5 * top
    levels = []
    while level > floor:
        levels.append(level)
        level *= 0.5
    for threshold in (*levels, floor):
        if threshold >= top:
            continue
        mask = (small > threshold).astype(np.uint8)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        for contour in contours:
            left, up, width, height = cv2.boundingRect(contour)
            if (
                max(width, height) * factor > 2.6 * high
                or max(width, height) * factor < low
            ):
                continue
            at_edge = left <= 0 or up <= 0 or left + width >= cols or up + height >= rows
            if not at_edge and not 0.6 <= width / height <= 1.67:
                continue
            # Pick's theorem: pixels of a filled contour from its polygon's area and boundary.
            count = cv2.contourArea(contour) + 0.5 * len(contour) + 1.0
            radius = factor * math.sqrt(count / math.pi) * 1.05
            x = (left + (width - 1) / 2 + 0.5) * factor - 0.5
            y = (up + (height - 1) / 2 + 0.5) * factor - 0.5
            spot = (x, y, min(max(radius, low), high))
            (edge if at_edge else inside).append(spot)
    # The largest outline of a place wins over those at other thresholds.
    return _distinct(inside, 2, 0.7), _distinct(edge, 2, 0.7)


def _middle(values: Float32Array) -> float:
    """Compute the median approximately, faster than `np.median`."""
    half = len(values) // 2
    return float(np.partition(values, half)[half])


def _distinct(found: Sequence[_Found], by: int, reach: float) -> list[_Found]:
    """Keep one of those within `reach` radii: the largest by value number `by`.

    `found` begin with column, row, radius [px]. Returns those kept, by falling value.
    """
    out: list[_Found] = []
    for one in sorted(found, key=lambda r: -r[by]):
        if all(math.hypot(one[0] - o[0], one[1] - o[1]) > reach * o[2] for o in out):
            out.append(one)
    return out


def _window(
    image: Float32Array, x: float, y: float, reach: float
) -> tuple[Float32Array, float, float]:
    """Cut out the pixels within `reach` of a place, limited to the image.

    Returns a contiguous window, perhaps empty, and the column and row of its first pixel.
    """
    left = max(int(x - reach), 0)
    top = max(int(y - reach), 0)
    part = image[top : int(y + reach) + 2, left : int(x + reach) + 2]
    return np.ascontiguousarray(part), left, top


def _measure(image: Float32Array, spot: _Candidate, how: SpotFinder) -> FloatArray | None:
    """Measure a candidate at full resolution, in a larger window if the spot found may
    exceed the first one.

    Args:
        image: (rows, cols) line integrals.
        spot: rough place and radius [px].
        how: limits of radius.

    Returns:
        `spot_kernels.RESULTS` values, places in pixels of the image; None if the spot is
        cut, unlike a ball (`MIN_LIKENESS`), below 5 sigmas of noise (less for larger
        spots) or of another size.
    """
    x, y, radius = spot
    result = np.zeros(kernels.RESULTS)
    # What is measured may lie beside the spot or be larger; then a larger window is needed.
    for reach in (2.0 * radius + 8.0, 4.2 * radius + 8.0):
        window, left, top = _window(image, x, y, reach)
        kernels.measure(window, x - left, y - top, radius, CAP, 0.0, result)
        result[kernels.X] += left
        result[kernels.Y] += top
        moved = max(abs(result[kernels.X] - x), abs(result[kernels.Y] - y))
        if result[kernels.OK] > 0 and 1.6 * result[kernels.RADIUS] + 5.0 + moved < reach:
            break
    low, high = how.radius_px
    good = (
        result[kernels.OK] > 0
        and low <= result[kernels.RADIUS] <= high
        and result[kernels.SCORE] >= MIN_LIKENESS
        and result[kernels.PEAK] > 5.0 * result[kernels.NOISE] * min(1.0, 3.0 / radius)
    )
    return result if good else None


def _alike(found: list[FloatArray], how: SpotFinder) -> list[FloatArray]:
    """Keep the spots that resemble the strongest group: beads of a phantom are alike."""
    if math.isinf(how.same) or len(found) < 2:
        return found
    return _largest_group(found, how.same)[0]


def _largest_group(
    found: list[FloatArray], same: float
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Split spots into the largest group of spots alike to one of them, and the others;
    among equal groups the one about the stronger spot counts.

    Args:
        found: results of `_measure`, one at least.
        same: largest factor between contrasts, and between radii, of alike spots.

    Returns:
        The group and the others, each in the order of `found`.
    """
    peaks = np.array([r[kernels.PEAK] for r in found])
    radii = np.array([r[kernels.RADIUS] for r in found])
    limit = math.log(same)
    alike = np.abs(np.log(peaks / peaks[:, None])) < limit
    alike &= np.abs(np.log(radii / radii[:, None])) < limit
    best = alike[np.argmax(alike.sum(axis=1) + 0.5 * peaks / peaks.max())]
    return (
        [r for r, inside in zip(found, best, strict=True) if inside],
        [r for r, inside in zip(found, best, strict=True) if not inside],
    )


def _kinds(found: list[FloatArray]) -> list[tuple[float, float]]:
    """Compute typical (median) radius [px] and contrast of each group of alike spots
    (`SpotFinder.same`), largest group first; empty without spots.
    """
    out = []
    while found:
        group, found = _largest_group(found, SpotFinder.same)
        typical = np.median(group, axis=0)
        out.append((float(typical[kernels.RADIUS]), float(typical[kernels.PEAK])))
    return out


def _cut_beads(
    image: Float32Array, spots: list[_Candidate], found: list[FloatArray]
) -> list[FloatArray]:
    """Fit balls to spots at the edge, with radius and contrast of the kind that fits
    best.

    Kinds are those of the complete spots `found`; of `spots` only the places are used.
    Returns the good fits, one a place.
    """
    kinds = _kinds(found) if spots else []
    out: list[FloatArray] = []
    for x, y, _ in spots:
        fits = [_fitted_cut(image, x, y, radius, peak) for radius, peak in kinds]
        good = [fit for fit in fits if fit is not None]
        out += sorted(good, key=lambda fit: float(fit[kernels.NOISE]))[:1]
    return _distinct(out, kernels.SCORE, 0.5)


def _fitted_cut(
    image: Float32Array, x: float, y: float, radius: float, peak: float
) -> FloatArray | None:
    """Fit a ball of a given radius and contrast to a spot at the edge.

    Its variances are raised by the part of the spot that is cut off, as blur is not known
    yet (`BLUR_PX` is assumed).

    Args:
        image: (rows, cols) line integrals.
        x, y: of the spot [px].
        radius: of the ball [px].
        peak: its contrast.

    Returns:
        Results of the kernel; None if the fit fails, the misfit reaches `MISFIT`, or at
        most 0.3 of the spot is inside.
    """
    result = np.zeros(kernels.RESULTS)
    window, left, top = _window(image, x, y, 2.8 * radius + 8.0)
    kernels.fit_ball(
        window,
        np.zeros((0, 0), np.uint8),
        x - left,
        y - top,
        radius,
        np.array([1.0, 0.0, 1.0]),
        peak,
        BLUR_PX,
        0.0,
        False,
        False,
        result,
    )
    result[kernels.X] += left
    result[kernels.Y] += top
    if not (result[kernels.OK] > 0 and result[kernels.MISFIT] < MISFIT):
        return None
    if not result[kernels.SCORE] > 0.3:
        return None
    # Blur is not known yet: it changes where a radius puts the centre.
    slack = (0.4 * max(1.0 - result[kernels.SCORE], 0.0)) ** 2
    result[kernels.VAR_X] += slack
    result[kernels.VAR_Y] += slack
    return result


def _pack(
    whole: list[FloatArray], cut: list[FloatArray], shape: tuple[int, int]
) -> Detections:
    """Sort measured spots into `Detections`: complete ones first, those at the edge last,
    each kind by falling contrast.

    Args:
        whole: results of complete spots; may be empty.
        cut: results of spots at the image's edge; may be empty.
        shape: the image's (rows, cols).
    """
    rows = np.array([*whole, *cut]).reshape(-1, kernels.RESULTS)
    flags = np.array([True] * len(whole) + [False] * len(cut), dtype=bool)
    order = np.lexsort((-rows[:, kernels.PEAK], ~flags))
    rows = rows[order]
    flags = flags[order]
    return Detections(
        rows[:, [kernels.X, kernels.Y]],
        covariances_of(rows),
        rows[:, kernels.RADIUS],
        rows[:, kernels.PEAK],
        rows[:, kernels.BIAS],
        flags,
        rows[:, kernels.SCORE],
        shape,
    )


def covariances_of(results: FloatArray) -> FloatArray:
    """Return the covariances (..., 2, 2) [px^2] in results (..., RESULTS) of the kernels."""
    places = [kernels.VAR_X, kernels.COV_XY, kernels.COV_XY, kernels.VAR_Y]
    return results[..., places].reshape(*results.shape[:-1], 2, 2)
