"""A bound of the bias in a volume of FDK, from the geometry and some of the images.

A coarse volume of the object is projected and reconstructed on a ladder of scans: from one
without a flaw (a panel that sees all, each layer from its own height) to the one at
hand, one flaw a rung, with the same pixels. The difference of two rungs is the effect of that
flaw on such an object, as far as its nodes show it: what a copy of half as many nodes shows less,
or more, is expected once more of the finest nodes, and may be wrong by as much (Richardson's
extrapolation to the first order, that of edges between nodes). Two flaws show in the images
alone, and get a reconstruction each: what lies beyond the panel's edges, continued in another
way, and the drift of the flat, which is seen beside the object. A voxel's bound is what all of
them come to about it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import Grid, Volume
from flexdt.twin.projection.volume import (
    MIN_DOUBLED_VOXELS,
    MIN_TWO_EDGES_PX,
    WARNING_BOUND,
    Accuracy,
    Residuals,
    Width,
    doubt_words,
)
from flexdt.twin.reconstruction.acquisition.truncation import Truncation
from flexdt.twin.reconstruction.coarse_scan import (
    FINE_NODES,
    NODES,
    Clipped,
    CoarseScan,
    ScanCopies,
)
from flexdt.twin.reconstruction.consistency.agreement import (
    Agreement,
    Contradiction,
    agreement_of,
    looked_at,
)
from flexdt.twin.reconstruction.consistency.cause_table import Finding
from flexdt.twin.reconstruction.consistency.causes import pixel_at_axis
from flexdt.twin.reconstruction.consistency.doubled_edges import doubled_mm
from flexdt.twin.reconstruction.consistency.suspects import SIDES, suspects
from flexdt.twin.reconstruction.consistency.view_pairs import sampling_error
from flexdt.twin.reconstruction.feldkamp.fdk_plan import plan_fdk
from flexdt.twin.reconstruction.known_beam import (
    UNKNOWN_BEAM,
    KnownBeam,
    StraightCopies,
)
from flexdt.twin.reconstruction.uniform_nodes import (
    MIN_EVENNESS,
    UniformNodes,
    smoothed,
)
from flexdt.twin.reconstruction.volume_errors import interpolated
from flexdt.twin.reconstruction.volume_residuals import residuals_of

OTHERWISE_FACTOR: Final = 3.0
"""Error of the continuation beyond the panel, over its difference from another one (assumed:
the figures of cut-off objects are no bounds)."""
SIGMAS: Final = 2.0
"""Standard deviations of the errors that a bound holds."""
PRISM_ERROR_SHARE: Final = 0.15
"""Share of a prism's part beyond the edges that may be wrong if it explains the
images."""
SHIFTS: Final = frozenset({"beyond", "drift", "hardening"})
"""Causes whose size is known: they shift values. Others scatter about zero."""
STATED: Final = {
    "axis": "axis",
    "distance": "distances",
    "turn": "angles",
    "lost": "angles",
    "slip": "axis",
    "haze": "haze",
    "gain": "beam",
}
"""Error -> what is taken as stated where images do not decide on it; others by their names."""
PARTS_OF_ERRORS: Final = (1.0, -1.0, 0.5, -0.5, 0.25, -0.25)
"""Parts of an error whose effect on the volume is taken in proportion, in this order."""
STREAK_ROWS: Final = 6
"""Rows of a scan in which what few views do is looked at: streaks are in each alike."""
FLOOR: Final = 0.001
"""Standard deviation of FDK's error without flaws, relative to the attenuation."""
REGION_SIGMA: Final = 0.447
"""Standard deviation along an axis of a ball of radius 1, 1 / sqrt(5): a region is a ball of a
node's radius."""
MAX_VOXEL_NODES: Final = 4.0
"""Largest edge of a voxel for which a grid can hold uniform regions [nodes]."""


@dataclass(frozen=True, eq=False)
class Bias:
    """Possible errors of a volume, on a coarse grid.

    Attributes:
        found: attenuation, smooth [1/mm].
        even: weights of its nodes, little where values change fast and where some views
            do not see them, (nz, ny, nx).
        inside: nodes of the object, (nz, ny, nx).
        causes: of `flexdt.twin.projection.volume.CAUSES` -> by how much it shifts values, if
            it is of `shifts`, or scatters them (standard deviation) [1/mm], (nz, ny, nx).
        contradiction: between images and geometry, or clipped images, with which nothing is
            bounded.
        figures: cause -> its size, in words.
        taken: what is taken as stated, because the images do not decide it.
        doubled: cause -> distance at which it doubles edges, at the axis [mm], of errors that
            images tell.
        edges: likewise of the others, `SIGMAS` standard errors; None where it was not found.
    """

    found: Volume
    even: FloatArray
    inside: npt.NDArray[np.bool_]
    causes: dict[str, FloatArray]
    contradiction: Contradiction | Clipped | None = None
    figures: Mapping[str, str] = field(default_factory=dict)
    taken: tuple[str, ...] = ()
    shifts: frozenset[str] = SHIFTS
    doubled: Mapping[str, float] = field(default_factory=dict)
    edges: float | None = None

    @cached_property
    def shift(self) -> FloatArray:
        """What known errors change together at the nodes [1/mm]."""
        known = [one for cause, one in self.causes.items() if cause in self.shifts]
        return np.asarray(sum(known, np.zeros(self.found.shape)))

    @cached_property
    def spread(self) -> FloatArray:
        """Standard deviation of the other errors together, at the nodes [1/mm]."""
        rest = [one for cause, one in self.causes.items() if cause not in self.shifts]
        squares = sum(map(np.square, rest), np.square(FLOOR * self.found.data))
        return np.asarray(np.sqrt(squares), np.float64)

    @cached_property
    def total(self) -> Float32Array:
        """Bound at the nodes [1/mm]."""
        return np.asarray(self.shift + SIGMAS * self.spread, np.float32)

    def doubling(self, least_mm: float) -> str:
        """Return the cause that doubles edges most, by at least so much; "" without."""
        most = max(self.doubled, key=lambda cause: self.doubled[cause], default="")
        return most if self.doubled.get(most, 0.0) >= least_mm else ""

    def bound(self, grid: Volume) -> Float32Array | None:
        """Compute the bound of the error at each voxel of a grid, interpolated from the nodes.

        Returns (nz, ny, nx) [1/mm], NaN where the grid has no value; None if images and geometry
        contradict each other.
        """
        if self.contradiction is not None:
            return None
        out = interpolated(self.found.like(self.total), grid)
        for layer, values in zip(out, grid.data, strict=True):
            layer[np.isnan(values)] = np.nan
        return out

    def accuracy(
        self, grid: Grid | Volume, width: Width | None = None
    ) -> Accuracy | None:
        """Compute the relative accuracy of the object's uniform regions in a grid.

        Nodes within half a node of the grid count; those of evenness up to `MIN_EVENNESS`
        are left out, if there are others.

        Args:
            grid: place and size.
            width: of edges across the axis, as measured.

        Returns:
            Within what half and nine of ten regions are, of normal errors with the shift and
            spread of each node, with the cause that is largest in nine of ten; None if the
            grid holds no node of the object
            or has too large voxels, or if images and geometry contradict each other.
        """
        if self.contradiction is not None or too_coarse(grid, self.found):
            return None
        size = np.array(grid.shape[::-1]) * grid.voxel_mm + self.found.voxel_xyz
        near = [
            np.abs(places - middle) <= 0.5 * side
            for places, middle, side in zip(
                self.found.centers(), grid.center_mm, size, strict=True
            )
        ]
        inside = near[2][:, None, None] & near[1][:, None] & near[0] & self.inside
        value = np.abs(self.found.data)
        if (inside & (self.even > MIN_EVENNESS)).any():
            inside &= self.even > MIN_EVENNESS
        if not inside.any():
            return None
        off = {cause: flaw[inside] / value[inside] for cause, flaw in self.causes.items()}
        errors = self.shift[inside] / value[inside], self.spread[inside] / value[inside]
        half, most = (_within(share, *errors) for share in (0.5, 0.9))
        worst = max(off, key=lambda cause: float(np.percentile(off[cause], 90.0)))
        told = {
            cause: float(np.percentile(off[cause], 90.0))
            for cause in self.figures
            if cause in off and cause != worst
        }
        following = max(told, key=lambda cause: told[cause], default="")
        doubling = self.doubling(MIN_DOUBLED_VOXELS * float(np.max(grid.voxel_mm)))
        if doubling in told:
            following = doubling  # it may hardly change values
        elif following and told[following] <= FLOOR:
            following = ""
        edges, of_edges = self._edges(width, doubling)
        return Accuracy(
            half,
            most,
            worst,
            cut_off="beyond" in off,
            figure=self.figures.get(worst, ""),
            taken=self.taken,
            next=following,
            next_figure=self.figures.get(following, ""),
            doubled_mm=self.doubled.get(doubling, 0.0),
            edges_mm=edges,
            edges_cause=of_edges,
        )

    def _edges(self, width: Width | None, doubling: str) -> tuple[float | None, str]:
        """Compute how wide edges across the axis are at most [mm]: as measured, or as errors
        double them, whichever is more; and the cause, "" of a measured width. None where no
        width was measured.

        `width`: measured; `doubling`: the cause that doubles edges most."""
        if width is None:
            return None, ""
        found = [(width.mm + SIGMAS * width.error_mm, "")]
        if self.edges is not None:
            told = max(self.doubled.values(), default=0.0)
            found.append((told + self.edges, doubling or "geometry"))
        return max(found)


def _within(share: float, shift: FloatArray, spread: FloatArray) -> float:
    """Compute within what a share of normal errors are, by size.

    Args:
        share: of them, 0 to 1.
        shift, spread: mean, at least 0, and standard deviation, above 0, of each (m,).
    """
    from scipy.optimize import brentq
    from scipy.special import ndtr

    def more(size: float) -> float:
        inside = ndtr((size - shift) / spread) - ndtr((-size - shift) / spread)
        return float(inside.mean()) - share

    return float(brentq(more, 0.0, float((shift + 9.0 * spread).max()), rtol=1e-3))


def too_coarse(grid: Grid | Volume, nodes: Volume) -> bool:
    """Return whether a grid's voxels are too large to hold a uniform region."""
    return bool(np.max(grid.voxel_mm) > MAX_VOXEL_NODES * max(nodes.voxel_xyz))


class BiasOnDemand:
    """Possible errors of FDK's volume of a scan, from coarse copies of it.

    Whether images and geometry agree is looked at when this is made, in the stated geometry
    alone; errors and other geometries are looked for at once only where that leaves a
    doubt. All else is found when it is asked for, and then kept.

    Args:
        copied: makes a coarse copy of the whole scan, of so many nodes.
        sides_known: beads have told the direction of rotation and mirrored images.
        known: of the scan's energies.

    Raises:
        GeometryError: a coarse copy cannot be reconstructed.
    """

    def __init__(
        self,
        copied: Callable[[int], CoarseScan],
        *,
        sides_known: bool = False,
        known: KnownBeam = UNKNOWN_BEAM,
    ) -> None:
        """Look at the scan once; see the class."""
        scan = copied(NODES)
        rows, cols = scan.images.shape[1:]
        plan_fdk(scan.cone_vec, (rows, cols), scan.grid, truncation=scan.truncation)
        self._known = known
        self._bent = None
        if known.beam is not None and not scan.cut_off:
            copied = self._bent = StraightCopies(copied, known.beam)
        self._measured = self._bent.measured if self._bent else copied
        self._copied = copied
        self._sides_known = sides_known
        look = looked_at(copied(FINE_NODES))
        self._clipped = scan.clipped
        self._doubtful = self._clipped is not None or (look is not None and look.doubtful)

    @classmethod
    def of(
        cls,
        copied: ScanCopies | None,
        *,
        sides_known: bool = False,
        known: KnownBeam = UNKNOWN_BEAM,
    ) -> BiasOnDemand | None:
        """Look at copies that have their images; None where a coarse one cannot be
        reconstructed.
        """
        if copied is None:
            return None
        try:
            return cls(copied, sides_known=sides_known, known=known)
        except GeometryError:
            return None

    @property
    def found(self) -> Volume:
        """The grid of nodes."""
        return self._copied(NODES).grid

    @cached_property
    def bias(self) -> Bias:
        """The errors, cause by cause; unbounded if another geometry fits the images
        better.

        Standard deviations are the coarse volume's changes by each flaw, extrapolated:
        missing angles, the rungs of `ladder`, "sampling" between pixels. Truncated rows'
        other continuation ("beyond"), complete rows' level ("drift"), told errors and a
        known spectrum ("hardening") shift values; what the images leave open scatters
        them ("geometry"), but what may exceed all that is taken as stated, and named.
        """
        bounded = self._told
        if bounded.contradiction is not None:
            return bounded
        sampling = self._sampling(bounded)
        bounded = replace(bounded, causes={**bounded.causes, "sampling": sampling})
        straight = {k: one for k, one in bounded.causes.items() if k != "hardening"}
        accuracy = replace(bounded, causes=straight).accuracy(bounded.found)
        if accuracy is None or accuracy.cut_off:
            return bounded
        if not self._agreement.compared:
            return replace(bounded, taken=(*self._known.taken, "geometry"))
        return self._with_undecided(bounded, accuracy.most)

    def bound(self, grid: Volume) -> Float32Array | None:
        """Compute the bound of the error at each voxel of a grid; see `Bias.bound`."""
        return self.bias.bound(grid)

    def accuracy(
        self, grid: Grid | Volume, width: Width | None = None
    ) -> Accuracy | None:
        """Compute the relative accuracy of uniform regions in a grid; see `Bias.accuracy`."""
        return self.bias.accuracy(grid, width)

    def warnings(self, grid: Grid | Volume) -> list[str]:
        """List what is wrong at first sight: another geometry that fits better, or causes of
        large errors, by their names. How large they are is found by `accuracy` alone.

        Args:
            grid: of the volume.
        """
        if self._doubtful and self._contradiction is not None:
            return [str(self._contradiction)]
        scan = self._copied(NODES)
        if scan.cut_off:
            # A drifted flat looks like an object beyond the panel: what it does tells them apart.
            cut = self._bounded.accuracy(grid)
            causes = ["beyond"] if cut is not None and cut.most > WARNING_BOUND else []
        else:
            causes = scan.at_sight
        if self._bent is not None and self._bent.strong:
            causes.append("hardening")
        if scan.few and not scan.cut_off and self._streaked(grid):
            causes.append("angles")
        doubling = ""
        if self._doubtful:
            told = self._with_told(self._blank)
            accuracy = told.accuracy(grid) if told.causes else None
            if accuracy is not None and accuracy.most > WARNING_BOUND:
                causes.append(accuracy.cause)
            doubling = told.doubling(MIN_TWO_EDGES_PX * self._pixel_mm)
        return doubt_words(list(dict.fromkeys(causes)), doubling)

    def _streaked(self, grid: Grid | Volume) -> bool:
        """Return whether few views alone make values off, by some rows of the scan."""
        thin = self._copied(NODES).thinned(all_views=True, least_rows=STREAK_ROWS)
        nodes = UniformNodes.of(thin.volume, thin.rim)
        causes = extrapolated(thin, nodes, _angles)
        found = Bias(thin.grid.like(nodes.found), nodes.even, nodes.inside, causes)
        accuracy = found.accuracy(grid)
        return accuracy is not None and accuracy.most > WARNING_BOUND

    def residuals(self, volume: Volume) -> Residuals | None:
        """Compare the finer copy's images with a volume's projections; None if
        impossible.
        """
        try:
            return residuals_of(volume, self._measured(FINE_NODES))
        except GeometryError:
            return None

    @cached_property
    def _nodes(self) -> UniformNodes:
        """Uniform regions of the coarse volume."""
        scan = self._copied(NODES)
        return UniformNodes.of(scan.volume, scan.rim)

    @cached_property
    def _blank(self) -> Bias:
        """The coarse volume without any error."""
        nodes = self._nodes
        found = self._copied(NODES).grid.like(nodes.found)
        return Bias(found, nodes.even, nodes.inside, {})

    @cached_property
    def _bounded(self) -> Bias:
        """The errors, but for what the comparison adds."""
        scan, nodes = self._copied(NODES), self._nodes
        causes = extrapolated(scan, nodes, _flaws) | beside(scan, nodes)
        return self._of_beam(replace(self._blank, causes=causes))

    def _of_beam(self, found: Bias) -> Bias:
        """Add what is known of the scan's energies."""
        found = replace(found, taken=self._known.taken)
        if self._bent is None:
            return found
        nodes = self._nodes
        bent = self._bent.bent_share(nodes) * np.abs(nodes.found)
        return replace(
            found,
            causes={**found.causes, "hardening": bent},
            figures={"hardening": self._bent.figure},
        )

    @cached_property
    def _agreement(self) -> Agreement:
        """The images, compared with the stated geometry and others."""
        return agreement_of(self._copied(FINE_NODES), sides_known=self._sides_known)

    @property
    def _contradiction(self) -> Clipped | Contradiction | None:
        """What forbids a claim."""
        return self._clipped or self._agreement.contradiction

    @cached_property
    def _told(self) -> Bias:
        """The errors, with those that the images tell."""
        doubt = self._contradiction
        if doubt is not None:
            scan = self._copied(NODES)
            nodes = UniformNodes.of(scan.fdk(scan.images, scan.cone_vec), scan.rim)
            blank = scan.grid.like(nodes.found)
            return Bias(blank, nodes.even, nodes.inside, {}, doubt)
        return self._with_told(self._bounded)

    @cached_property
    def _changes(self) -> list[tuple[Finding, FloatArray]]:
        """Errors that the images tell, and by how much each shifts values."""
        even = self._blank.even
        return [
            (one, _about(self._changed(one, one.size), even))
            for one in self._agreement.findings
            if one.told
        ]

    def _with_told(self, bounded: Bias) -> Bias:
        """Add the errors that the images tell, and their standard errors ("geometry")."""
        causes = dict(bounded.causes)
        figures = dict(bounded.figures)
        shifts = set(bounded.shifts)
        squares = np.zeros(bounded.found.shape)
        doubled: dict[str, float] = {}
        for one, change in self._changes:
            name = one.cause.name
            doubled[name] = max(doubled.get(name, 0.0), self._doubled(one))
            squares += np.square(one.sigma / one.size * change)
            level = one.level * np.abs(bounded.found.data)
            causes[name] = causes.get(name, 0.0) + change + level
            shifts.add(name)
            figures[name] = one.figure
        unexplained = self._agreement.unexplained
        if unexplained:
            causes["images"] = unexplained * np.abs(bounded.found.data)
        if squares.any():
            causes["geometry"] = np.sqrt(squares)
        return replace(
            bounded,
            causes=causes,
            figures=figures,
            shifts=frozenset(shifts),
            doubled=doubled,
        )

    def doubling(self) -> tuple[str, float]:
        """Return the error of those that images tell that doubles edges most, and by how much
        at the axis [mm]; "" and 0 without one."""
        told = self._told
        cause = told.doubling(0.0)
        return cause, told.doubled.get(cause, 0.0)

    @cached_property
    def _pixel_mm(self) -> float:
        """Width of a pixel of the panel at the axis."""
        scan = self._copied(NODES)
        across, _ = pixel_at_axis(scan.cone_vec, scan.circle.centre)
        return float(across.mean()) / scan.binned[1]

    def _doubled(self, one: Finding) -> float:
        """Compute by how much an error doubles edges, at the axis [mm]."""
        scan = self._copied(NODES)
        if one.cause.views is None:
            return 0.0
        sizes = one.size * one.course(scan.share)
        centre = np.append(scan.circle.centre, scan.grid.center_mm[2])
        return doubled_mm(
            scan.cone_vec,
            one.cause.views(scan.cone_vec, sizes),
            (scan.images.shape[1], scan.images.shape[2]),
            centre,
            0.5 * max(scan.ends),
            0.25 * scan.grid.size_mm[2],
        )

    def _sampling(self, bounded: Bias) -> FloatArray:
        """Compute what the pixels' sampling does to the coarse volume: a line integral that
        bends between pixels is off by a rounded share of the bend (`ROUNDING`), in each pixel
        by another; one draw of that, averaged over regions.
        """
        from scipy.ndimage import gaussian_filter

        scan, fine = self._copied(NODES), self._copied(FINE_NODES)
        radius = scan.grid.voxel_xyz[0] / fine.grid.voxel_xyz[0]
        # An edge crosses B of the B x B pixels of the panel in one of the copy, each of which is
        # off by itself, and in each of the scan's views.
        pixels = float(np.prod(fine.binned)) ** -0.75
        views = np.sqrt(len(fine.numbers) / len(fine.circle.angle))
        off = pixels * views * sampling_error(fine.images, fine.noise)
        drawn = off * np.random.default_rng(0).standard_normal(off.shape)
        along = min(1.0, 0.25 * (off.shape[1] - 1)) * REGION_SIGMA * radius
        smooth = gaussian_filter(drawn, (0.0, along, REGION_SIGMA * radius))
        change = np.nan_to_num(scan.fdk(smooth.astype(np.float32), fine.cone_vec))
        return scatter_about(change, bounded.even)

    def _changed(self, one: Finding, size: float) -> Float32Array:
        """Compute the change of the coarse volume by an error of a size, (nz, ny, nx).

        Where FDK refuses, it is in proportion to a part or the opposite; else the whole
        volume.
        """
        for part in PARTS_OF_ERRORS:
            try:
                return self._changed_exactly(one, part * size) / np.float32(part)
            except GeometryError:
                continue
        return self._volume

    def _changed_exactly(self, one: Finding, size: float) -> Float32Array:
        """Compute the change by an error of a size; see `_changed`.

        Raises:
            GeometryError: FDK cannot use the views.
        """
        scan = self._copied(NODES)
        images, views = one.cause.corrected(
            scan.images, scan.cone_vec, size * one.course(scan.share)
        )
        return self._moved(images, views)

    def _moved(self, images: Float32Array, views: ConeVec) -> Float32Array:
        """Compute the change of the coarse volume with other images or another geometry."""
        scan = self._copied(NODES)
        other = np.nan_to_num(scan.fdk(images, views, scan.truncation))
        return np.asarray(other - self._volume, np.float32)

    @cached_property
    def _volume(self) -> Float32Array:
        """The coarse volume, 0 where no data cover it."""
        return np.nan_to_num(self._copied(NODES).volume)

    def _with_undecided(self, bounded: Bias, claimed: float) -> Bias:
        """Add the errors that the images do not decide.

        To the cause "geometry" and to `edges` where they change the volume by no more than
        `claimed`; else they are named in `taken`, as are another rotation or order. The
        distances are always named.

        Args:
            bounded: the errors without it.
            claimed: relative error of nine of ten uniform regions by these.
        """
        scan = self._copied(NODES)
        nodes = UniformNodes.of(self._volume, scan.rim)
        taken: dict[str, float] = {}

        def negligible(name: str, moved: Float32Array) -> bool:
            """Return whether a change is within what is claimed; if not, note it in `taken`."""
            size = nodes.change(nodes.found + moved)
            if size > claimed:
                taken[name] = max(taken.get(name, 0.0), size)
            return size <= claimed

        squares = np.square(bounded.causes.get("geometry", np.zeros(scan.grid.shape)))
        edges = 0.0
        for one in self._agreement.findings:
            if one.cause.nuisance or one.cause.name == "distance":
                continue
            doubled = self._doubled(replace(one, size=SIGMAS * one.sigma))
            if one.told:
                edges = float(np.hypot(edges, doubled))
                continue
            change = self._changed(one, one.sigma)
            moved = SIGMAS * _smooth_about(change, bounded.even)
            name = STATED.get(one.cause.name, one.cause.name)
            if negligible(name, moved.astype(np.float32)):
                squares += np.square(_about(change, bounded.even))
                if doubled < MIN_TWO_EDGES_PX * self._pixel_mm:
                    edges = float(np.hypot(edges, doubled))
                else:  # as the angles of a ball: it is its edges that are taken as stated
                    taken.setdefault(name, 0.0)
        kinds = [one for one in suspects(scan) if one.kind in self._agreement.open]
        for suspect in kinds:
            try:
                shifted = self._moved(suspect.images, suspect.cone_vec)
            except GeometryError:
                continue
            negligible(
                "rotation" if suspect.kind in SIDES else "order", smoothed(shifted)
            )
        largest = sorted(taken, key=lambda name: -taken[name])
        listed = dict.fromkeys([*largest, *self._known.taken, "distances"])
        causes = {**bounded.causes, "geometry": np.sqrt(squares)}
        return replace(bounded, causes=causes, taken=tuple(listed), edges=edges)


def bias_of(
    image: Callable[[int], npt.NDArray[np.generic]],
    cone_vec: ConeVec,
    shape: tuple[int, int],
    truncation: Truncation | None = None,
    *,
    sides_known: bool = False,
) -> Bias | None:
    """Find the possible errors of FDK's volume of a scan at once; each view is read once.

    `image`: gives line integrals (rows, cols) by number. `sides_known`: beads have told
    rotation and mirroring. Returns None where a coarse scan cannot be reconstructed.
    """
    copies = copies_of(cone_vec, shape, truncation)
    if copies is None:
        return None
    for number in copies.wanted:
        copies.take(number, image(number))
    found = BiasOnDemand.of(copies, sides_known=sides_known)
    try:
        return None if found is None else found.bias
    except GeometryError:
        return None


def copies_of(
    cone_vec: ConeVec, shape: tuple[int, int], truncation: Truncation | None = None
) -> ScanCopies | None:
    """Make copies of a scan, which take its images; None where it cannot be copied."""
    try:
        copies = ScanCopies(cone_vec, shape)
    except GeometryError:
        return None
    copies.truncation = truncation
    return copies


@dataclass(frozen=True, eq=False)
class Flaw:
    """What a flaw of the scan does to a coarse volume.

    Attributes:
        cause: of `flexdt.twin.projection.volume.CAUSES`.
        change: of the volume, (nz, ny, nx) [1/mm].
        weights: of its nodes, (nz, ny, nx), above 0.
        finite: it is one of finite pixels alone: the scan's own, finer ones, have less of it.
    """

    cause: str
    change: Float32Array
    weights: FloatArray
    finite: bool = False


Flaws = Callable[[CoarseScan, UniformNodes], dict[str, Flaw]]
"""Finds the flaws of a coarse copy and its nodes, by a name that copies of one scan share."""


def extrapolated(
    scan: CoarseScan, nodes: UniformNodes, flaws: Flaws
) -> dict[str, FloatArray]:
    """Compute how far flaws scatter values, from a coarse copy and one of half its nodes.

    What flaws do between nodes is not in a copy. If it falls with their distance, the finest
    nodes show as much more than these as these show more than half as many; that estimate may be
    wrong by as much. Without the coarser copy's the flaw's own size is that error.

    Args:
        scan: the copy.
        nodes: of its volume.
        flaws: finds what is to be extrapolated.

    Returns:
        Cause -> standard deviation at each node, (nz, ny, nx) [1/mm].
    """
    found = flaws(scan, nodes)
    if not found:
        return {}
    half = scan.halved
    coarser: dict[str, Flaw] = {}
    if not all(one.finite for one in found.values()):
        # Not where the axis is within half a column of the panel's edge.
        with suppress(GeometryError):
            coarser = flaws(half, UniformNodes.of(half.volume, half.rim))
    squares: dict[str, FloatArray] = {}
    for name, one in found.items():
        more, whole = one.change, one.change
        if one.finite:
            more = np.zeros_like(whole)
        elif name in coarser:
            known = half.grid.like(np.asarray(coarser[name].change, np.float32))
            more = one.change - interpolated(known, scan.grid)
            whole = one.change + more
        square = squares.get(one.cause, np.zeros(scan.grid.shape))
        for part in (whole, more):
            square = square + np.square(scatter_about(part, one.weights))
        squares[one.cause] = square
    return {cause: np.sqrt(square) for cause, square in squares.items()}


def _angles(scan: CoarseScan, nodes: UniformNodes) -> dict[str, Flaw]:
    """Compute what few views do, if they are few; streaks come from edges.

    Args:
        scan: a coarse copy.
        nodes: of its volume.
    """
    if not scan.sparse:
        return {}
    wide = (max(scan.ends),) * 2
    best, ours = (
        scan.seen(nodes.sharp, scan.parallel("", wide, t)) for t in (None, scan.angles)
    )
    return {
        "angles": Flaw(
            "angles", ours - best, nodes.even, finite=scan.whole and not scan.few
        )
    }


def _flaws(scan: CoarseScan, nodes: UniformNodes) -> dict[str, Flaw]:
    """Compute what the flaws of a scan do: few views, and the rungs of its ladder.

    Args:
        scan: a coarse copy.
        nodes: of its volume.
    """
    found = _angles(scan, nodes)
    # Ends that few rays see blur no edge: they count as the middle does.
    weights = np.where(nodes.inside, 1.0, 1e-3)
    compared = nodes.inside.any(axis=(1, 2), keepdims=True)
    layers = np.flatnonzero(compared)
    rungs = [(rung.flaw, scan.seen(nodes.found, rung)) for rung in scan.ladder(layers)]
    for (_, before), (flaw, after) in pairwise(rungs):
        change = np.where(compared, after - before, np.float32(0.0))
        # A panel aside sees every ray of a whole scan: only steps of weights are a flaw.
        found[flaw] = Flaw(flaw, change, weights, finite=flaw == "aside" and scan.whole)
    return found


def beside(scan: CoarseScan, nodes: UniformNodes) -> dict[str, FloatArray]:
    """Compute by how much the drift of the flat shifts values, or what is beyond the panel's
    edges.

    Args:
        scan: the coarse copy.
        nodes: of its volume.

    Returns:
        Cause -> error at each node, (nz, ny, nx) [1/mm].
    """
    truncation = scan.truncation
    if truncation is None or not truncation.cut_off.any():
        level = np.nan_to_num(scan.fdk(_drift(scan.images), scan.cone_vec))
        return {"drift": _about(level, nodes.even)}
    ways = [(truncation.otherwise, OTHERWISE_FACTOR)]
    if truncation.explained:
        # Prisms explain the rows, but their residual at the edges is as unknown as ever.
        ways = [
            (truncation.otherwise, PRISM_ERROR_SHARE),
            (truncation.later, OTHERWISE_FACTOR),
        ]
    beyond = np.zeros(scan.grid.shape)
    data = np.nan_to_num(scan.volume)
    for way, share in ways:
        other = np.nan_to_num(scan.fdk(scan.images, scan.cone_vec, way))
        beyond += share * _about(other - data, nodes.even)
    return {"beyond": beyond}


def _drift(images: Float32Array) -> Float32Array:
    """Make images of each view's level beside the object: the smaller value, by size, of its
    rows' two ends, in every pixel. `images`: (n, rows, cols); each view's ends are averaged over
    rows. Returns new images of that shape."""
    ends = images[:, :, [0, -1]].mean(axis=1)
    beside = np.take_along_axis(ends, np.abs(ends).argmin(axis=1)[:, None], axis=1)
    return np.ascontiguousarray(np.broadcast_to(beside[:, :, None], images.shape))


def _about(values: Float32Array, weights: FloatArray) -> FloatArray:
    """Compute the weighted rms about each node of smoothed values (nz, ny, nx)."""
    squares = np.square(_smooth_about(values, weights))
    return np.sqrt(np.maximum(_smooth_about(squares, weights), 0.0))


def scatter_about(
    values: Float32Array, weights: FloatArray, nodes: float = 1.0
) -> FloatArray:
    """Compute the weighted rms about each node of regions' means, `nodes` in radius."""
    squares = np.square(_smooth_about(values, weights, REGION_SIGMA * nodes))
    return np.sqrt(np.maximum(_smooth_about(squares, weights), 0.0))


def _smooth_about(
    values: npt.NDArray[np.floating], weights: FloatArray, nodes: float = 1.0
) -> FloatArray:
    """Compute weighted means about each node, by a Gaussian of some nodes, (nz, ny, nx)."""
    from scipy.ndimage import gaussian_filter

    total = gaussian_filter(weights * values.astype(np.float64), nodes, mode="nearest")
    return np.asarray(total / gaussian_filter(weights, nodes, mode="nearest"))
