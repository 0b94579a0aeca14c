"""FDK with estimates for its volume: object beyond the panel, noise, bias and warnings."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import numpy.typing as npt

from flexdt.twin import long_work
from flexdt.twin.algorithms import PLAIN
from flexdt.twin.caller_warnings import warn_caller
from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.long_work import Advance, Progress
from flexdt.twin.plausibility import Operation, PlausibilityWarning, examine, settled
from flexdt.twin.projection import Grid, Volume, as_volume
from flexdt.twin.projection.operators import (
    as_cone_vec,
    check_projections,
    require_finite,
    require_line_integrals,
)
from flexdt.twin.reconstruction.acquisition.coverage import LostVoxels
from flexdt.twin.reconstruction.acquisition.truncation import truncation_of
from flexdt.twin.reconstruction.bias import BiasOnDemand, copies_of, too_coarse
from flexdt.twin.reconstruction.feldkamp.backprojection import CHUNK, PIXELS
from flexdt.twin.reconstruction.feldkamp.fdk import fdk_parts
from flexdt.twin.reconstruction.volume_errors import with_errors
from flexdt.twin.signatures import public

CHECKING_SHARE = 0.1
"""Share of the progress that is left for looking at the volume, about."""


@public
def fdk(
    projections: npt.ArrayLike,
    cone_vec: ConeVec | npt.ArrayLike,
    like: Volume | Grid,
    *,
    window: str = PLAIN,
    progress: Progress = None,
    errors: bool = True,
) -> Volume:
    """Reconstruct attenuation from line integrals of a circular or helical scan.

    Line integrals are taken as they are: dead, hot and flickering pixels are interpolated by
    `DataSet.reconstruct` alone, which knows counts and flat images.

    Args:
        projections: (n, rows, cols) line integrals.
        cone_vec: ConeVec or (n, 12) [mm].
        like: the grid, or a volume on it, whose values are not used.
        window: of the ramp filter: ram-lak, shepp-logan, cosine, hamming, hann.
        progress: a bar after two seconds; False for none, or what takes the fraction done.
        errors: find `sigma`, `bias_bound` and `accuracy` of the volume, and warn.

    Returns:
        Volume [1/mm]; its data is a (nz, ny, nx) view with z contiguous. Voxels that too few
        views see, above or below the panel, are NaN.

    Raises:
        GeometryError: no circle and no helix, too short a scan, too steep a helix, shapes
            that do not fit, values that are not finite, or a doubt that is a refusal, such
            as counts in place of line integrals.
        UnknownNameError: no such window.

    Warns:
        UserWarning: a cause by which values may be off by some per cent; layers of the
            grid lie above or below what the panel sees, or most voxels are not seen from all
            sides.

    Examples:
        A cube of 0.02 / mm with two denser bars, projected and reconstructed:

        >>> from flexdt.twin.projection import forward
        >>> cube = np.zeros((24, 24, 24), np.float32)
        >>> cube[6:18, 6:18, 6:18] = 0.02
        >>> cube[8:14, 3:6, 14:17] = 0.03
        >>> cube[4:8, 10:14, 18:22] = 0.03
        >>> volume = Volume(cube, 0.5)
        >>> turn = np.linspace(0, 2 * np.pi, 90, endpoint=False)
        >>> c, s, o = np.cos(turn), np.sin(turn), np.zeros(90)
        >>> source, detector = np.stack([s, -c, o], 1) * 600, np.stack([-s, c, o], 1) * 400
        >>> scan = ConeVec.from_vectors(source, detector, np.stack([c, s, o], 1), (0, 0, -1))
        >>> found = fdk(forward(volume, scan, (36, 36)), scan, like=volume)
        >>> bool(abs(found.data[12, 12, 12] - 0.02) < 0.002)
        True
    """
    geometry = as_cone_vec(cone_vec)
    values = np.asarray(projections)
    require_line_integrals(values)
    if values.ndim != 3 or len(values) != len(geometry):
        values = check_projections(values, len(geometry))
    if len(values):
        chunk = max(CHUNK, 4 * PIXELS // max(values[0].size, 1))
    else:
        chunk = CHUNK

    def parts() -> Iterable[Float32Array]:
        """Yield the images as float32 in chunks; raises on values that are not finite."""
        for start in range(0, len(values), chunk):
            part = np.asarray(values[start : start + chunk], dtype=np.float32)
            require_finite(part)
            yield part

    shape = values.shape[1], values.shape[2]
    box = as_volume(like).boxes[0]
    found = examine(Operation.FDK, geometry, shape, images=values, grid=box)
    sentences = settled(found, GeometryError)
    try:
        with long_work.during("reconstructing by FDK", progress) as advance:
            volume, doubts = checked_fdk(
                values.__getitem__,
                parts,
                geometry,
                shape,
                like,
                window,
                advance,
                errors=errors,
            )
    except GeometryError as error:
        message = "; ".join([error.message, *sentences])
        raise GeometryError(message, error.data) from None
    for sentence in sentences:
        warn_caller(sentence, PlausibilityWarning)
    for doubt in doubts:
        warn_caller(doubt)
    return volume


def checked_fdk(
    image: Callable[[int], npt.NDArray[np.generic]],
    parts: Callable[[], Iterable[Float32Array]],
    cone_vec: ConeVec,
    shape: tuple[int, int],
    like: Volume | Grid,
    window: str = PLAIN,
    progress: Advance | None = None,
    *,
    errors: bool = True,
) -> tuple[Volume, list[str]]:
    """Reconstruct a volume by FDK, with its accuracy and noise if `errors`, and list
    warnings for the user; warns of nothing itself.

    Args and raises as `fdk`, except for these:

    Args:
        image: gives an image by its number, (rows, cols).
        parts: see `fdk_parts`.
        cone_vec: of all views.
        shape: (rows, cols).

    Returns:
        The volume and the texts of warnings: with `errors` first what limits the
        accuracy, then lost voxels.
    """
    truncation = truncation_of(image, cone_vec, shape)
    if not errors:
        volume = fdk_parts(parts, cone_vec, shape, like, window, progress, truncation)
        return volume, LostVoxels.of(volume.data).warnings()
    copies = copies_of(cone_vec, shape, truncation)

    def seen() -> Iterable[Float32Array]:
        """Yield the parts, and copy them on the way."""
        return parts() if copies is None else copies.passing(parts())

    def told(part: float) -> None:
        """Report the part of FDK that is done."""
        if progress is not None:
            progress((1.0 - CHECKING_SHARE) * part)

    volume = fdk_parts(seen, cone_vec, shape, like, window, told, truncation, errors=True)
    lost = LostVoxels.of(volume.data).warnings()
    bias = BiasOnDemand.of(copies)
    doubts = bias_warnings(bias, volume)
    if progress is not None:
        progress(1.0)
    return with_errors(volume, bias=bias), [*doubts, *lost]


def bias_warnings(bias: BiasOnDemand | None, grid: Grid | Volume) -> list[str]:
    """List warnings about uniform regions that may deviate, or of which nothing is known.

    The first of: accuracy unknown as there is no bias, voxels too large, a contradiction;
    else causes of large errors. Empty if there is nothing to warn of.

    Args:
        bias: of the scan; None if it could not be found.
        grid: of the volume.
    """
    if bias is None:
        return [
            "accuracy is not known: a coarse copy of the scan, by which it is found, "
            "cannot be reconstructed"
        ]
    if too_coarse(grid, bias.found):
        edge = float(np.max(grid.voxel_mm))
        return [
            f"accuracy is not known: voxels of {edge:g} mm are too large to hold a "
            "uniform region; "
            f"choose at most {max(bias.found.voxel_xyz):.2g} mm"
        ]
    return bias.warnings(grid)
