"""Errors of volumes that iterations made, by the same iterations once more.

Noise: the images' own noise is added to them again, with a random sign in each view (a wild
bootstrap: Liu, Ann. Stat. 16 (1988) 1696), and the volume made again. What it changes has the
variance of the noise, for any algorithm, detector and exposure. Bias: a coarse volume of the
scan is projected, and the algorithm applied to that; what it misses is its bias.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.dataset.normalise import binned_mean
from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.plausibility import PlausibilityWarning
from flexdt.twin.projection import Grid, Volume, as_volume
from flexdt.twin.reconstruction.acquisition.trajectory import circle_of
from flexdt.twin.reconstruction.acquisition.truncation import truncation_of
from flexdt.twin.reconstruction.bias import (
    Bias,
    BiasOnDemand,
    beside,
    copies_of,
    scatter_about,
)
from flexdt.twin.reconstruction.coarse_scan import (
    FINE_NODES,
    NODES,
    CoarseScan,
    ScanCopies,
    two_rays,
)
from flexdt.twin.reconstruction.feldkamp.noise import MIN_ROW_DISTANCE, excess_of_mean
from flexdt.twin.reconstruction.feldkamp.noise_by_value import NoiseByValue
from flexdt.twin.reconstruction.known_beam import UNKNOWN_BEAM, KnownBeam
from flexdt.twin.reconstruction.uniform_nodes import UniformNodes
from flexdt.twin.reconstruction.volume_errors import interpolated, with_errors

PROBES: Final = 2
"""Volumes that are made again for the noise: with the neighbors of a voxel they leave it
known to about a tenth."""
NEAR_VOXELS: Final = 2.0
"""Standard deviation of the Gaussian over which squares of the changes are averaged [voxels]."""
LEVEL_VIEWS: Final = 60
"""Largest number of views, about, in which the noise by value is measured."""
WINDOW: Final = 5
"""Side of the square in which noise and object are told apart [pixels]."""
MOST_RMS: Final = 1.45
"""Largest root mean square of the noise of `WINDOW`^2 pixels, over its standard deviation
(chi-squared, 1 of 1000)."""
FINER_POWER: Final = 1.5
"""Power of the voxels' size with which a region's error by sampling falls: an edge crosses B of
the B x B pixels of one, and each is off by itself."""
SIGNS: Final = np.array([-1.0, 1.0], np.float32)
OF_COPIES: Final = frozenset(
    {"iterations", "subsets", "relaxation", "nonnegative", "weight", "tolerance"}
)
"""Options of an algorithm that hold for a coarse copy, too; others have its arrays."""

Again = Callable[[Float32Array], Volume]
"""Makes the volume from images (n, rows, cols) as it was made."""
OnCopy = Callable[[Float32Array, ConeVec, Volume], Volume]
"""Makes a volume from images (n, rows, cols) of n views on a grid, likewise."""


def checked(
    made: Volume,
    images: npt.ArrayLike,
    cone_vec: ConeVec | npt.ArrayLike,
    algorithm: Callable[..., Volume],
    options: Mapping[str, Any],
) -> Volume:
    """Give a volume the errors that its images tell; warns as `with_iteration_errors`.

    Args:
        made: the volume.
        images: (n, rows, cols) line integrals, kept for its `sigma`.
        cone_vec: n views.
        algorithm: that made it, called with images, views and grid.
        options: of that call.

    Raises:
        GeometryError: images on a device.
    """
    if hasattr(images, "__cuda_array_interface__"):
        message = "errors of images on a device"
        raise GeometryError.instead(message, "device", "images of the host")
    measured = np.asarray(images, np.float32)
    views = cone_vec if isinstance(cone_vec, ConeVec) else ConeVec(np.asarray(cone_vec))
    shape = (measured.shape[1], measured.shape[2])
    copies = copies_of(views, shape)
    if copies is not None:
        for number in copies.wanted:
            copies.take(number, measured[number])
    given = {name: one for name, one in options.items() if one is not None}
    return with_iteration_errors(
        made, measured, lambda: measured, views, algorithm, given, copies
    )


def with_iteration_errors(
    made: Volume,
    images: Float32Array,
    again: Callable[[], Float32Array],
    cone_vec: ConeVec,
    algorithm: Callable[..., Volume],
    options: Mapping[str, Any],
    copies: ScanCopies | None,
    *,
    sides_known: bool = False,
    known: KnownBeam = UNKNOWN_BEAM,
) -> Volume:
    """Give a volume of iterations its noise, and its bias unless it is of several materials;
    warns of what `BiasOfIterations.warnings` lists.

    Args:
        made: the volume.
        images: (n, rows, cols) line integrals; not kept.
        again: gives them once more, when the noise is asked for.
        cone_vec: n views.
        algorithm, options: that made it, called with images, views and grid.
        copies: of the scan, with all images that they want; None without.
        sides_known, known: as of `BiasOnDemand`.
    """
    from flexdt.twin.caller_warnings import warn_caller

    noise = noise_of_probes(
        again, cone_vec, lambda b: quietly(algorithm, b, cone_vec, made, **options)
    )
    bias = None
    if copies is not None and options.get("hardening") is None:
        shape = (images.shape[1], images.shape[2])
        cause = "penalty" if "weight" in options else "stopping"
        with suppress(GeometryError):  # a trajectory that is not looked at
            copies.truncation = truncation_of(images.__getitem__, cone_vec, shape)
            bias = BiasOfIterations(
                copies,
                on_copies(algorithm, options, made),
                cause,
                made,
                sides_known=sides_known,
                known=known,
            )
    for doubt in () if bias is None else bias.warnings(made):
        warn_caller(doubt)
    return with_errors(made, noise, bias)


def on_copies(
    algorithm: Callable[..., Volume], options: Mapping[str, Any], made: Volume
) -> OnCopy:
    """Make an algorithm that does to coarse copies of a scan what made its volume.

    A penalty counts voxels' faces: its weight becomes that of the same object. Of
    `options`, arrays are left out.
    """
    smaller = {name: one for name, one in options.items() if name in OF_COPIES}

    def run(images: Float32Array, cone_vec: ConeVec, grid: Volume) -> Volume:
        given = dict(smaller)
        if "weight" in given:
            given["weight"] *= min(made.voxel_xyz) / min(grid.voxel_xyz)
        return quietly(algorithm, images, cone_vec, grid, **given)

    return run


def quietly(algorithm: Callable[..., Volume], *arrays: Any, **options: Any) -> Volume:
    """Run an algorithm once more: what is implausible has been said, and no bar is shown."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PlausibilityWarning)
        return algorithm(*arrays, progress=False, **options)


class BiasOfIterations(BiasOnDemand):
    """Possible errors of an iterative volume: what the algorithm misses of a smooth coarse volume
    that it gets the projections of.

    That holds what iterations that end early, or a penalty, leave out, views and rays that are
    missing, and matter beyond the grid ("rows"), which is pressed into it.

    Args:
        copied, sides_known, known: as of `BiasOnDemand`.
        run: reconstructs images (n, rows, cols) of n views on a grid, by the algorithm
            and with the options of the volume.
        cause: stopping or penalty.
        made: the volume; its grid counts.
    """

    def __init__(
        self,
        copied: Callable[[int], CoarseScan],
        run: OnCopy,
        cause: str,
        made: Volume,
        *,
        sides_known: bool = False,
        known: KnownBeam = UNKNOWN_BEAM,
    ) -> None:
        """Look at the scan once; see the class."""
        self._run = run
        self._cause = cause
        self._box = made.boxes[0]
        self._voxel = made.voxel_xyz
        super().__init__(copied, sides_known=sides_known, known=known)

    def warnings(self, grid: Grid | Volume) -> list[str]:
        """List what is wrong at first sight: a contradiction, or an object in layers that some
        view does not see."""
        if self._doubtful and self._contradiction is not None:
            return [str(self._contradiction)]
        scan = self._copied(NODES)
        outside = int(self._beyond(as_volume(grid)).sum())
        if not scan.more or not outside:
            return []
        return [
            f"{outside} of {grid.shape[0]} layers of the grid lie outside what the panel sees; "
            "their values are not bounded"
        ]

    def _beyond(self, grid: Volume) -> npt.NDArray[np.bool_]:
        """Mark the layers of a grid that are above or below what views see, (nz,)."""
        low, high = self._copied(NODES).grid.boxes[0, :, 2]
        z = grid.centers()[2]
        return np.asarray((z < low) | (z > high))

    @cached_property
    def _bounded(self) -> Bias:
        """The errors, but for what the comparison adds."""
        scan = self._copied(NODES)
        causes = self._missed(scan.grid) | beside(scan, self._nodes)
        return self._of_beam(replace(self._blank, causes=causes))

    def bound(self, grid: Volume) -> Float32Array | None:
        """Compute the bound of the error at each voxel of a grid; see `Bias.bound`. It is NaN
        where some view does not see a voxel, too: iterations give it a value all the same."""
        out = super().bound(grid)
        if out is not None:
            scan = self._copied(NODES)
            unseen = np.isnan(scan.volume) | scan.rim
            out[interpolated(scan.grid.like(unseen.astype(np.float32)), grid) > 0.5] = (
                np.nan
            )
            out[self._beyond(grid)] = np.nan
        return out

    def _sampling(self, bounded: Bias) -> FloatArray:
        """Compute the errors by the sampling of voxels, and of pixels as for FDK, (nz, ny, nx).

        The algorithm reconstructs a volume's images, and those of the same with voxels twice
        as large, on the grid of the latter; the difference is scaled to the scan's voxels.
        """
        scan = self._copied(FINE_NODES)
        half = scan.halved
        rows, cols = half.images.shape[1:]
        down = max(1, scan.images.shape[1] // rows)
        sharp = UniformNodes.of(scan.volume, scan.rim).sharp
        block, own = _block_of(self._box, scan.grid, 0)
        each = (min(2, own.shape[0]), min(2, own.shape[1]), min(2, own.shape[2]))
        block = _whole(block, each)
        part = np.zeros_like(sharp)
        part[block] = sharp[block]
        images = scan.projected(part, scan.cone_vec, scan.images.shape[1:], beyond=False)
        images = binned_mean(images[:, : down * rows, : 2 * cols], (down, 2))
        larger = _larger(scan.grid, block, each, sharp[block])
        alike = two_rays(larger, half.cone_vec, (rows, cols))
        done = [
            np.nan_to_num(self._run(one, half.cone_vec, larger).data)
            for one in (np.ascontiguousarray(images, np.float32), alike)
        ]
        finer = min(self._voxel) / min(larger.voxel_xyz)
        change = np.asarray((done[0] - done[1]) * finer**FINER_POWER, np.float32)
        grid = bounded.found
        even = interpolated(grid.like(bounded.even.astype(np.float32)), larger)
        spread = scatter_about(
            change, even.astype(np.float64), grid.voxel_xyz[0] / larger.voxel_xyz[0]
        )
        found = interpolated(larger.like(spread.astype(np.float32)), grid)
        return np.hypot(found, super()._sampling(bounded))

    def _missed(self, grid: Volume) -> dict[str, FloatArray]:
        """Compute what the algorithm misses of the finer copy's volume, and what of the matter
        beyond the box it presses into that: cause -> standard deviation of regions at the nodes
        of a grid [1/mm]."""
        scan = self._copied(FINE_NODES)
        nodes = UniformNodes.of(scan.volume, scan.rim)
        shape = (scan.images.shape[1], scan.images.shape[2])
        spare = ((scan.more, scan.more), (0, 0), (0, 0))
        thing = np.pad(nodes.sharp, spare, "edge")
        block, own = _block_of(self._box, scan.grid, scan.more)
        part = np.zeros_like(thing)
        part[block] = thing[block]
        found = {}
        before = thing[block]
        for cause, matter in ((self._cause, part), ("rows", thing)):
            if cause == "rows" and (thing == part).all():
                continue
            images = scan.projected(matter, scan.cone_vec, shape, beyond=False)
            done = np.nan_to_num(self._run(images, scan.cone_vec, own).data)
            change = np.zeros_like(thing)
            change[block] = done - before
            before = done
            of_regions = scatter_about(
                change[scan.more : len(change) - scan.more],
                nodes.even,
                grid.voxel_xyz[0] / scan.grid.voxel_xyz[0],
            )
            found[cause] = interpolated(
                scan.grid.like(of_regions.astype(np.float32)), grid
            ).astype(np.float64)
        return found


Block = tuple[slice, slice, slice]
"""Of nodes (z, y, x)."""


def _whole(block: Block, each: tuple[int, int, int]) -> Block:
    """Shorten a block to whole numbers of so many nodes."""
    z, y, x = (
        slice(one.start, one.stop - (one.stop - one.start) % count)
        for one, count in zip(block, each, strict=True)
    )
    return z, y, x


def _larger(
    grid: Volume, block: Block, each: tuple[int, int, int], values: Float32Array
) -> Volume:
    """Average values of a whole block of a grid over voxels of `each` nodes."""
    nz, ny, nx = (n // k for n, k in zip(values.shape, each, strict=True))
    means = values.reshape(nz, each[0], ny, each[1], nx, each[2]).mean(axis=(1, 3, 5))
    sides = np.array(grid.voxel_xyz)
    first = np.array([one.start for one in block[::-1]])
    last = np.array([one.stop for one in block[::-1]])
    x, y, z = (float(c) for c in grid.boxes[0, 0] + 0.5 * (first + last) * sides)
    dx, dy, dz = (float(side) for side in sides * each[::-1])
    return Volume(means, (dx, dy, dz), (x, y, z))


def _block_of(box: FloatArray, grid: Volume, more: int) -> tuple[Block, Volume]:
    """Find the nodes of a grid, with so many layers more above and below, whose middles are in a
    box (low, high corner), one at least along each axis; and make the blank grid of these."""
    low = grid.boxes[0, 0] - [0.0, 0.0, more * grid.voxel_xyz[2]]
    counts = np.array(grid.shape[::-1]) + [0, 0, 2 * more]
    ends = (box - low) / grid.voxel_xyz - 0.5
    first = np.clip(np.ceil(ends[0] - 1e-6), 0, counts - 1).astype(int)
    last = np.clip(np.floor(ends[1] + 1e-6) + 1, first + 1, counts).astype(int)
    x, y, z = (slice(int(a), int(b)) for a, b in zip(first, last, strict=True))
    nx, ny, nz = (int(n) for n in last - first)
    cx, cy, cz = (float(c) for c in low + 0.5 * (first + last) * grid.voxel_xyz)
    blank = np.zeros((nz, ny, nx), np.float32)
    return (z, y, x), Volume(blank, grid.voxel_mm, (cx, cy, cz))


def noise_of_probes(
    images: Callable[[], Float32Array], cone_vec: ConeVec, again: Again
) -> NoiseOfProbes | None:
    """Make the noise of a volume; None of fewer than three views. Args: of `NoiseOfProbes`."""
    return NoiseOfProbes(images, cone_vec, again) if len(cone_vec) > 2 else None


@dataclass(frozen=True, eq=False)
class NoiseOfProbes:
    """Noise of a volume by making it again, `PROBES` times, when it is first asked for.

    Attributes:
        images: gives the (n, rows, cols) line integrals of which it was made.
        cone_vec: n views.
        again: makes it from others.
    """

    images: Callable[[], Float32Array]
    cone_vec: ConeVec
    again: Again
    _kept: dict[str, Float32Array] = field(default_factory=dict, repr=False)

    def sigma(self, grid: Volume) -> Float32Array:
        """Compute the standard deviation at each voxel, (nz, ny, nx) [1/mm].

        Args:
            grid: the volume that was made, with its values.
        """
        from scipy.ndimage import gaussian_filter

        if "sigma" not in self._kept:
            images = self.images()
            noise, shared = noise_in(images, in_order(self.cone_vec))
            rng = np.random.default_rng(0)
            squares = np.zeros(grid.shape)
            for _ in range(PROBES):
                signs = rng.choice(SIGNS, len(images))
                probe = images + signs[:, None, None] * noise
                probe += np.float32(np.sqrt(shared)) * _mean(noise, rng)
                change = self.again(np.asarray(probe, np.float32)).data - grid.data
                squares += np.square(change, dtype=np.float64) / PROBES
            variance = gaussian_filter(squares, NEAR_VOXELS, mode="nearest")
            self._kept["sigma"] = np.sqrt(variance).astype(np.float32)
        return self._kept["sigma"]


def in_order(cone_vec: ConeVec) -> npt.NDArray[np.intp]:
    """Order views so that neighbors see nearly the same: by angle on a circle, else as they
    are; (n,) numbers."""
    try:
        circle = circle_of(cone_vec)
    except GeometryError:
        return np.arange(len(cone_vec))
    if circle.rise:
        return np.arange(len(cone_vec))
    return np.argsort(circle.angle % (2.0 * np.pi), kind="stable")


def noise_in(
    images: Float32Array, order: npt.NDArray[np.intp]
) -> tuple[Float32Array, float]:
    """Find a realization of the noise in each view, and how much more all views share.

    It is the view less the mean of its neighbors, scaled to the variance of one view. Where that
    has more than noise in a square of `WINDOW` pixels, by the variance of such line integrals,
    the object moves there, and it is scaled down to the noise.

    Args:
        images: (n, rows, cols), three views at least.
        order: in which views are neighbors.

    Returns:
        (n, rows, cols); and the variance of the noise common to all views, over that of the mean
        of their own.
    """
    from scipy.ndimage import uniform_filter

    by_value = _by_value(images, order)
    out = np.empty_like(images)
    signed = np.zeros(images.shape[1:])
    for place in range(len(order)):
        number, bend, level = _bend(images, order, place)
        expected = np.sqrt(by_value(level))
        squares = uniform_filter(np.square(bend), WINDOW, mode="nearest")
        local = np.sqrt(np.maximum(squares, 0.0))
        most = MOST_RMS * expected
        out[number] = bend * np.minimum(1.0, most / np.maximum(local, 1e-30)) ** (
            local > most
        )
        signed += (-1.0) ** place * images[number]
    if images.shape[1] <= MIN_ROW_DISTANCE + 1:
        return out, 0.0
    mean = np.asarray(images.mean(axis=0, dtype=np.float64))
    return out, excess_of_mean(mean, signed / len(order))


def _bend(
    images: Float32Array, order: npt.NDArray[np.intp], place: int
) -> tuple[int, FloatArray, FloatArray]:
    """Return a view's number, what it has less the mean of its neighbors, of a view's variance,
    and the mean of the three; the ends take the three outermost."""
    middle = min(max(place, 1), len(order) - 2)
    before, here, after = (
        np.asarray(images[order[middle + k]], np.float64) for k in (-1, 0, 1)
    )
    bend = (2.0 * here - before - after) / np.sqrt(6.0)
    return int(order[place]), bend, (before + here + after) / 3.0


def _by_value(images: Float32Array, order: npt.NDArray[np.intp]) -> NoiseByValue:
    """Measure the noise by value between views.

    Rows `MIN_ROW_DISTANCE` apart are compared: what the object gives to both cancels, and blur
    does not make them alike.
    """
    squares, sizes = [], []
    step = max(1, len(order) // LEVEL_VIEWS)
    far = MIN_ROW_DISTANCE if images.shape[1] > MIN_ROW_DISTANCE else 0
    for place in range(1, len(order) - 1, step):
        _, bend, level = _bend(images, order, place)
        if far:
            bend = (bend[far:] - bend[:-far]) / np.sqrt(2.0)
            level = 0.5 * (level[far:] + level[:-far])
        squares.append(np.square(bend).ravel())
        sizes.append(level.ravel())
    return NoiseByValue.fitted(np.concatenate(squares), np.concatenate(sizes))


def _mean(noise: Float32Array, rng: np.random.Generator) -> Float32Array:
    """Draw a mean of the views' noise, (rows, cols)."""
    signs = rng.choice(SIGNS, len(noise))
    return np.asarray(np.einsum("i,ijk->jk", signs, noise) / len(noise), np.float32)
