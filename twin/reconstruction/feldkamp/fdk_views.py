"""Views on their way to a volume of FDK: images, weights, filter, and where voxels see them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.reconstruction.acquisition.truncation import Continuation


@dataclass(frozen=True, eq=False)
class Views:
    """A group of views with their geometry, images and weights.

    They are widened, multiplied by factors / length of the ray to the pixel, and filtered
    along rows.

    Attributes:
        images: (n, rows of the panel, its cols).
        top: the first row that is needed.
        before: columns that go into the filter before the panel's first.
        beyond: how rows go on there and behind the panel's last column.
        factors: float64 (n, cols that go into the filter).
        across, up: squares of the ray's horizontal and vertical parts, (n, cols) and (n,
            rows that are needed) [mm^2].
        response: of the filter.
        kept: columns whose filtered values are needed.
        shares, table: of `fdk_kernels.backproject`.
        few: whether the panel has few rows.
    """

    images: Float32Array
    top: int
    before: int
    beyond: Continuation
    factors: FloatArray
    across: FloatArray
    up: FloatArray
    response: Float32Array
    kept: slice
    shares: Float32Array
    table: FloatArray
    few: bool

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Number of views, of columns before and after the filter, and of rows."""
        n, wide = self.factors.shape
        return n, wide, self.kept.stop - self.kept.start, self.up.shape[1]

    @property
    def wider(self) -> bool:
        """True if columns off the panel go into the filter."""
        return bool(self.factors.shape[1] > self.images.shape[2])

    @property
    def shown(self) -> slice:
        """Rows of the panel that are needed, or that rows off the panel repeat; at least
        one.
        """
        count = self.images.shape[1]
        first = min(max(self.top, 0), count - 1)
        return slice(first, min(max(self.top + self.up.shape[1], first + 1), count))

    def of(self, which: slice | npt.NDArray[np.intp]) -> Views:
        """Select some of these views."""
        return replace(self.without_images(which), images=self.images[which])

    def without_images(self, which: slice | npt.NDArray[np.intp]) -> Views:
        """Select the tables of some of these views; `images` is unchanged and still holds
        all views.
        """
        return replace(
            self,
            beyond=self.beyond.of(which),
            factors=self.factors[which],
            across=self.across[which],
            up=self.up[which],
            shares=self.shares[which],
            table=self.table[which],
        )

    def within(self, columns: slice, response: Float32Array) -> Views:
        """Cut rows to some of the columns that go into the filter; images, rows and the
        volume's table stay.

        Args:
            columns: the panel's and those that are kept are among them.
            response: of a filter for rows of so many columns; replaces the present one.
        """
        return replace(
            self,
            before=self.before - columns.start,
            beyond=self.beyond.within(columns),
            factors=np.ascontiguousarray(self.factors[:, columns]),
            across=np.ascontiguousarray(self.across[:, columns]),
            response=response,
            kept=slice(self.kept.start - columns.start, self.kept.stop - columns.start),
        )

    @property
    def reach(self) -> int:
        """Least distance in columns between two that do not act on each other."""
        return int(max(self.factors.shape[1] - self.kept.start, self.kept.stop))

    def prism_lengths(self) -> Float32Array:
        """Compute the prisms' path lengths times attenuation in the columns beyond the
        panel's edges and at them; 0 elsewhere.

        Returns:
            (n, bands, columns), over the ray's horizontal length [1/mm]; see
            `truncation_kernels.prism_lengths`.
        """
        from flexdt.twin.reconstruction.kernels import truncation_kernels

        on = self.beyond
        cols = self.images.shape[2]
        n, wide = self.factors.shape
        out = np.empty((n, len(on.prisms), wide), np.float32)
        truncation_kernels.prism_lengths(
            self.before, cols, on.edge, on.plane, on.prisms, out
        )
        return out

    def widen(self, out: Float32Array, *, weighed: bool = False) -> None:
        """Write the rows that are needed, continued beyond the panel's edges.

        Args:
            out: (n, rows, columns or more), filled; 0 in columns after these.
            weighed: multiply by factors / length of the ray to the pixel; else values as
                they are.
        """
        from flexdt.twin.reconstruction.kernels import truncation_kernels

        on = self.beyond
        factors = self.factors if weighed else self.factors[:, :0]
        truncation_kernels.continue_rows(
            np.ascontiguousarray(self.images),
            self.top,
            self.before,
            on.edge,
            self.prism_lengths(),
            on.band,
            on.share,
            on.cut,
            on.fade.astype(np.float32),
            self.across.astype(np.float32),
            self.up,
            factors.astype(np.float32),
            out,
        )


def view_table(cone_vec: ConeVec, shape: tuple[int, int]) -> FloatArray:
    """Compute the kernel's table of upright views.

    Args:
        cone_vec: n upright views; only the horizontal part of u is used.
        shape: detector (rows, cols).

    Returns:
        (n, 11): source x, y, z; horizontal unit normal, away from the source; unit row
        direction; distance over the pitch, and foot, of columns; the same of rows. See
        `fdk_kernels.backproject`.
    """
    rows, cols = shape
    pitch_u = np.linalg.norm(cone_vec.u, axis=1)
    pitch_v = np.linalg.norm(cone_vec.v, axis=1)
    u = cone_vec.u[:, :2] / pitch_u[:, None]
    offset = cone_vec.detector - cone_vec.source
    normal = np.column_stack([-u[:, 1], u[:, 0]])
    depth = (offset[:, :2] * normal).sum(axis=1)
    normal *= np.sign(depth)[:, None]
    depth = np.abs(depth)
    foot_c = (cols - 1) / 2 - (offset[:, :2] * u).sum(axis=1) / pitch_u
    foot_r = (rows - 1) / 2 + offset[:, 2] / pitch_v
    return np.ascontiguousarray(
        np.column_stack(
            [cone_vec.source, normal, u, depth / pitch_u, foot_c, depth / pitch_v, foot_r]
        )
    )
