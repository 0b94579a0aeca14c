"""Movement of the object or the scanner between views, as shifts of the images.

Images of a scan with movement are reconstructed into a blurred volume. Each image is registered
with that volume's projection, the images are shifted back, and the next volume is sharper. The
shifts explain any movement of which a panel sees most: of the object, the stage, the source or
the panel itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.reconstruction.coarse_scan import CoarseScan
from flexdt.twin.reconstruction.consistency.reprojection import Reprojection
from flexdt.twin.reconstruction.consistency.suspects import Suspect

CENTROID_FLOOR_PX: Final = 0.05
"""Error of a projection's centroid by coarse voxels, whatever the second reconstruction
(assumed) [coarse pixels]."""
MOVEMENT_ROUNDS: Final = 3
"""Number of registrations: of four simulated scans with movement, nine more changed the
misfit by at most 4 % (`tests/studies/misfits.py --seed 6061`, draws 9, 12, 27 and 98)."""
SHIFT_SIGMA_PX: Final = 1.0
"""Prior standard deviation of a shift's change in one registration (assumed) [coarse
pixels]."""


def moving(
    scan: CoarseScan,
    starts: Sequence[tuple[FloatArray, Reprojection]],
    shown: Callable[[Suspect], Reprojection | None],
) -> tuple[Suspect, Reprojection | None]:
    """Estimate how far each image is shifted along its rows and columns.

    Registration begins with the images' centroids or one of the given shifts, whichever
    fit better. A panel at another place is such a start: movement includes it, and shall
    not seem to fit worse because its registration is less advanced.

    Args:
        scan: coarse, n views.
        starts: shifts (n, 2) and the reprojection with them, one at least.
        shown: reprojects a suspect; None where FDK cannot use its geometry.

    Returns:
        The scan with the shifts that fit best of those from which registration begins,
        unless all are 0, and of `MOVEMENT_ROUNDS` registrations, and its reprojection;
        None without one (`shown`).
    """
    shifts, latest = min(starts, key=lambda start: start[1].arcs.sum())
    from_centroids = without_placement(centroids(scan.images), scan.angles)
    by_centroids = shown(_suspect(scan, from_centroids))
    if by_centroids is not None and by_centroids.arcs.sum() < latest.arcs.sum():
        shifts = from_centroids
        latest = by_centroids
    best = latest if shifts.any() else None
    found = _suspect(scan, shifts)
    for _ in range(MOVEMENT_ROUNDS):
        shifts = shifts + registered(latest)
        shifts = without_placement(shifts, scan.angles, only_same_volume=True)
        suspect = _suspect(scan, shifts)
        again = shown(suspect)
        if again is None:
            break
        latest = again
        if best is None or again.arcs.sum() < best.arcs.sum():
            best = again
            found = suspect
    return found, best


def centroids(images: Float32Array) -> FloatArray:
    """Compute the centres of mass of images, (n, 2) as (column, row) [pixels]; the middle
    for images without mass.

    Those of a whole object without movement are a constant and a first harmonic of the
    angle, for rays that are almost parallel.

    Args:
        images: (n, rows, cols) line integrals.
    """
    mass = np.maximum(images.astype(np.float64), 0.0)
    least = np.finfo(np.float64).tiny
    total = np.maximum(mass.sum(axis=(1, 2)), least)
    places = []
    for axis in (2, 1):
        along = np.arange(images.shape[axis]) - 0.5 * (images.shape[axis] - 1)
        profile = mass.sum(axis=3 - axis)
        places.append(profile @ along / total)
    return np.column_stack(places)


def wandering(angles: FloatArray, own: Reprojection, second: Reprojection) -> float:
    """Compute how far centroids of images along rows are from those of the volume's
    projections, relative to what a volume's second reconstruction, noise and
    `CENTROID_FLOOR_PX` explain.

    A constant and a first harmonic of the angle, which a displaced object has, are
    subtracted. Meaningful only for an object that the panel sees complete.

    Args:
        angles: (n,) of the views [rad].
        own: of the stated geometry or an explanation, without shifts.
        second: of the projections of `own`.

    Returns:
        Ratio of root mean squares: 48 simulated right scans have at most 1.8, four with
        movement 6.7 to 18, and an interlaced one 6.1 (the first 60 draws of
        `tests/studies/misfits.py --seed 6061`).
    """
    images, first, again = (
        centroids(one)[:, :1] for one in (own.images, own.again, second.again)
    )
    found = without_placement(images - first, angles)
    expected = without_placement(first - again, angles)
    variance = float(np.square(expected).mean()) + own.centroid_variance
    variance += CENTROID_FLOOR_PX**2
    return float(np.sqrt(np.square(found).mean() / variance))


def registered(shown: Reprojection) -> FloatArray:
    """Estimate the shift of each image against the volume's projection, by one step of
    Gauss and Newton with a prior of `SHIFT_SIGMA_PX`.

    Args:
        shown: n views; its images may be shifted already.

    Returns:
        (n, 2) along rows and columns [coarse pixels], positive where the image is to the
        right or below; 0 along columns for images of one row.
    """
    rest = (shown.images - shown.again).astype(np.float64)
    variance = np.square(rest).mean()
    projections = shown.again.astype(np.float64)
    shifts = np.zeros((len(rest), 2))
    for direction, axis in enumerate((2, 1)):
        if rest.shape[axis] == 1:
            continue
        slope = np.gradient(projections, axis=axis)
        power = np.square(slope).sum(axis=(1, 2)) + variance / SHIFT_SIGMA_PX**2
        least = np.finfo(np.float64).tiny
        shifts[:, direction] = -(rest * slope).sum(axis=(1, 2)) / np.maximum(power, least)
    return shifts


def without_placement(
    shifts: FloatArray, angles: FloatArray, *, only_same_volume: bool = False
) -> FloatArray:
    """Subtract from shifts those of an object that is placed elsewhere on the stage: a
    constant and a first harmonic of the angle.

    Args:
        shifts: (n, directions), along rows and, if there are two, along columns.
        angles: (n,) of the views [rad].
        only_same_volume: subtract only what leaves the volume as it is, at another place:
            along rows the harmonic (a constant is an offset of the axis), along columns
            the constant.

    Returns:
        (n, directions).
    """
    placement = np.column_stack([np.ones_like(angles), np.cos(angles), np.sin(angles)])
    fitted = np.linalg.lstsq(placement, shifts, rcond=None)[0]
    if only_same_volume:
        fitted[0, 0] = 0.0
        fitted[1:, 1] = 0.0
    return np.asarray(shifts - placement @ fitted)


def _suspect(scan: CoarseScan, shifts: FloatArray) -> Suspect:
    """Make the suspect of a scan whose images are shifted by (n, 2) coarse pixels along
    rows and columns; its figure is the largest shift along each, in pixels of the panel.
    """
    down, across = scan.binned
    along, below = np.abs(shifts).max(axis=0, initial=0.0) * (across, down)
    figure = f"by up to {along:.1f} px along rows and {below:.1f} px along columns"
    return Suspect("movement", scan.images, scan.cone_vec, figure, shifts)
