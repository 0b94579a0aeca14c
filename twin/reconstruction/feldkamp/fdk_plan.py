"""Preparation of FDK before the first image: panels, widths, weights and filter.

`plan_fdk` works out the steps that all views share; `FdkPlan.views_of` takes the images of some
views through those that images pass before the filter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from flexdt.twin.algorithms import PLAIN
from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import Volume
from flexdt.twin.reconstruction.acquisition.coverage import Sharing, normalise_coverage
from flexdt.twin.reconstruction.acquisition.rectify import (
    FINER,
    columns_fall,
    leans,
    on_its_side,
    rectified,
    rows_needed,
    swapped,
    upright,
)
from flexdt.twin.reconstruction.acquisition.rectify import window as window_of
from flexdt.twin.reconstruction.acquisition.trajectory import (
    Circle,
    axis_between,
    circle_of,
    columns_beyond,
    narrow_overlap,
    no_fdk,
    redundancy,
)
from flexdt.twin.reconstruction.acquisition.truncation import Continuation, Truncation
from flexdt.twin.reconstruction.feldkamp.fdk_views import Views, view_table
from flexdt.twin.reconstruction.feldkamp.filtering import ramp

FEW_ROWS: Final = 8
"""Rows of a panel for which voxels side by side are computed at a time. The panel
decides, not the rows that a grid needs: slabs equal the complete volume to the bit."""
MAX_SIDEWAYS_SHARE: Final = 0.1
"""Largest sideways movement of the panel between views, over its width: jitter, not
tiles."""


@dataclass(frozen=True, eq=False)
class Panels:
    """The upright panels of a scan.

    Attributes:
        turned: whether the images' rows and columns are swapped first.
        seen: (rows, cols) of the images, so swapped.
        recorded: the geometry of the images, so swapped.
        upright: the geometry of the panels that FDK works on; `recorded` where they are the
            same.
        shape: (rows, cols) of these.
    """

    turned: bool
    seen: tuple[int, int]
    recorded: ConeVec
    upright: ConeVec
    shape: tuple[int, int]


@dataclass(frozen=True)
class Widths:
    """Rows and columns of the upright panel that are computed, counted from its first.

    Attributes:
        first, last: rows in the grid's shadow, first <= r < last; they may be off the
            panel.
        before, after: columns off the panel that go into the filter.
        near: columns off the panel on either side whose filtered values are needed.
        cols: of the panel.
    """

    first: int
    last: int
    before: int
    after: int
    near: tuple[int, int]
    cols: int

    @property
    def rows(self) -> int:
        """Number of rows needed."""
        return self.last - self.first

    @property
    def wide(self) -> int:
        """Number of columns that go into the filter."""
        return self.before + self.cols + self.after

    @property
    def panel(self) -> slice:
        """The panel's columns among these."""
        return slice(self.before, self.before + self.cols)

    @property
    def kept(self) -> slice:
        """Columns among these whose filtered values are needed."""
        return slice(self.before - self.near[0], self.before + self.cols + self.near[1])

    @property
    def reach(self) -> int:
        """Largest distance between a needed column and one that acts on it, plus 1."""
        return self.wide - min(self.before - self.near[0], self.after - self.near[1])


@dataclass(frozen=True, eq=False)
class FdkPlan:
    """FDK of a scan into a grid.

    Attributes:
        like: the grid.
        circle: of all views.
        panels: upright.
        widths: of the rows that are worked on.
        level: geometry of these rows and columns.
        weights: of rays, (n, columns that go into the filter).
        response: of the filter.
        table: of all views, for the columns that are kept; see `fdk_kernels.backproject`.
        sharing: of the views of a helix; None for a circle.
        truncation: object beyond the panel's edges; None for nothing.
    """

    like: Volume
    circle: Circle
    panels: Panels
    widths: Widths
    level: ConeVec
    weights: FloatArray
    response: Float32Array
    table: FloatArray
    sharing: Sharing | None
    truncation: Truncation | None

    @property
    def count(self) -> int:
        """Number of views."""
        return len(self.level)

    def views_of(self, part: Float32Array, done: int) -> Views:
        """Take the images of some views up to the filter.

        They are turned and rectified to an upright panel where needed, and get their
        weights and the data by which rows are continued beyond a truncated panel;
        filtering is the back-projector's.

        Args:
            part: (k, rows, cols) line integrals as recorded.
            done: number of views before these.

        Raises:
            GeometryError: images of another shape, or more than there are views.
        """
        panels = self.panels
        widths = self.widths
        views = slice(done, done + len(part))
        if panels.turned:
            images = part.transpose(0, 2, 1)
        else:
            images = part
        if images.shape[1:] != panels.seen or views.stop > self.count:
            given = f"projections of shape {images.shape} after {done} views"
            allowed = f"{self.count} views of {panels.seen}"
            raise GeometryError.instead(given, list(images.shape), allowed)
        if panels.upright is not panels.recorded:
            both = panels.recorded[views], panels.upright[views]
            images = rectified(images, *both, panels.shape[1])
        shape = (widths.rows, widths.wide)
        level = self.level[views]
        if self.truncation is None:
            beyond = Continuation.empty(len(part), *shape)
        else:
            beyond = self.truncation.continuation(
                level, widths.first, shape, widths.panel
            )
        shares = np.zeros((len(part), 0, 0), np.float32)
        if self.sharing is not None:
            shares = self.sharing.table(views, (widths.first, widths.last))
        factors, across, up = weighing(
            shape, level, self.circle, views, self.weights[views]
        )
        few = panels.shape[0] <= FEW_ROWS and self.sharing is None
        return Views(
            images,
            widths.first,
            widths.before,
            beyond,
            factors,
            across,
            up,
            self.response,
            widths.kept,
            shares,
            self.table[views],
            few,
        )

    def cover(self, data: Float32Array, grid: Volume, *, outside: bool) -> None:
        """Scale voxels that some views do not see, and make NaN those that too few see;
        in place.

        In a helix, layers outside those that are seen from every side become NaN, and
        nothing is scaled.

        Args:
            data: of a volume of all views, (ny, nx, nz), changed in place.
            grid: its grid.
            outside: keep voxels that the panel's continued rows alone show from all
                sides.
        """
        if self.sharing is not None:
            z = grid.centers()[2]
            low, high = self.sharing.whole
            data[:, :, (z < low) | (z > high)] = np.nan
            return
        widths = self.widths
        own = widths.near[0], widths.near[0] + widths.cols - 1
        normalise_coverage(
            data,
            grid,
            self.circle,
            self.table,
            self.weights[:, widths.kept],
            widths.rows,
            own,
            cut_off=self.truncation is not None and not outside,
        )


def plan_fdk(
    cone_vec: ConeVec,
    shape: tuple[int, int],
    like: Volume,
    window: str = PLAIN,
    truncation: Truncation | None = None,
) -> FdkPlan:
    """Plan FDK of a scan into a grid; reads no images.

    Args:
        cone_vec: of all views.
        shape: detector (rows, cols).
        like: the grid; its values are not read.
        window: of the ramp filter.
        truncation: object beyond the panel's edges (`truncation_of`); None for nothing.

    Raises:
        GeometryError: no circle and no helix, too short a scan, too steep a helix, a
            panel that moves sideways or lies flat, the axis off the panel, or rows of one
            pixel.
        UnknownNameError: no such window.
    """
    circle = circle_of(cone_vec)
    panels = _panels(circle, cone_vec, cone_vec.of_shape(shape))
    whole = panels.upright
    cols = panels.shape[1]
    widths = _widths(circle, panels, like, truncation)
    beyond = truncation is not None and truncation.beyond
    weights = redundancy(circle, whole, cols, beyond=beyond)
    if widths.wide > cols:
        weights = np.pad(weights, ((0, 0), (widths.before, widths.after)), "edge")
    rows = (widths.first, widths.last)
    near = widths.near
    backed = window_of(whole, panels.shape, rows, (-near[0], cols + near[1]))
    level = window_of(whole, panels.shape, rows, (-widths.before, cols + widths.after))
    table = view_table(backed, (widths.rows, cols + sum(near)))
    if circle.rise:
        sharing = Sharing.of(circle, whole, panels.shape, like)
    else:
        sharing = None
    if sharing is not None:
        table = np.hstack([table, sharing.columns()])
    # Pitches may change from view to view: one filter, and factors for what it scales with.
    pitch = np.linalg.norm(level.u, axis=1)
    response = ramp(widths.reach, float(pitch[0]), window)
    weights = weights * (pitch[0] / pitch)[:, None]
    return FdkPlan(
        like, circle, panels, widths, level, weights, response, table, sharing, truncation
    )


def _panels(circle: Circle, cone_vec: ConeVec, shape: tuple[int, int]) -> Panels:
    """Make the panels upright, with the axis on a column or between two if few columns
    are beyond it.

    A tilted panel gets `FINER` times as many columns; one on its side is swapped.

    Args:
        circle: of the sources.
        cone_vec: n views as stated.
        shape: (rows, cols).

    Returns:
        The views as stated and upright with their shapes, and whether rows and columns
        were exchanged.

    Raises:
        GeometryError: rows of one pixel, a horizontal panel, or one that moves sideways.
    """
    turned = on_its_side(cone_vec)
    if turned:
        cone_vec = swapped(cone_vec)
        shape = (shape[1], shape[0])
    if shape[1] < 2:
        raise GeometryError.instead(
            "rows of 1 pixel, which cannot be filtered", 1, "2 or more"
        )
    seen = shape
    level = cone_vec
    leaning = leans(cone_vec)
    if leaning:
        shape = (shape[0], round(FINER * shape[1]))
    if leaning or not columns_fall(cone_vec):
        level = upright(cone_vec, shape[1] / seen[1])
    _check_steady(circle, level, shape)
    if narrow_overlap(circle, level, shape[1]):
        level = axis_between(circle, level, shape)
    return Panels(turned, seen, cone_vec, level, shape)


def _check_steady(circle: Circle, level: ConeVec, shape: tuple[int, int]) -> None:
    """Check that all views see the axis at about one column (within `MAX_SIDEWAYS_SHARE` of the
    columns): redundancy is weighed by columns.

    `circle`: of the sources; `level`: upright views; `shape`: (rows, cols).
    Raises GeometryError: the panel moves sideways during the scan, as in a tiled one.
    """
    axis = np.array([[*circle.centre, 0.0]])
    columns = level.project_points(axis, shape)[:, 0, 0]
    moved = float(np.ptp(columns))
    if not moved <= MAX_SIDEWAYS_SHARE * shape[1]:
        most = MAX_SIDEWAYS_SHARE * shape[1]
        reason = f"the panel moves {moved:.1f} columns sideways between the views (a tiled scan?)"
        raise no_fdk(f"{reason}; FDK takes {most:.1f} at most", moved, most)


def _widths(
    circle: Circle, panels: Panels, like: Volume, truncation: Truncation | None
) -> Widths:
    """Find the rows in the grid's shadow, and the columns off the panel that a shifted
    panel and the object beyond its edges need.

    Args:
        circle: of the sources.
        panels: upright ones.
        like: the grid.
        truncation: of the object, None without.
    """
    level = panels.upright
    cols = panels.shape[1]
    near = columns_beyond(circle, level, cols)
    if truncation is None:
        far = (0, 0)
    else:
        far = truncation.columns(level, cols)
    before, after = (max(pair) for pair in zip(near, far, strict=True))
    # Only rows in the grid's shadow matter: the filter runs along rows.
    first, last = rows_needed(level, panels.shape, like)
    return Widths(first, last, before, after, near, cols)


def weighing(
    shape: tuple[int, int],
    cone_vec: ConeVec,
    circle: Circle,
    views: slice,
    weights: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute the weights that FDK applies before the filter: cosine, distances, redundancy and
    the view's arc.

    The cosine is that of the ray with the line from source to axis. Exact fan-beam inversion for
    a panel at any angle to that line then needs the distance along the panel's normal only.

    Args:
        shape: (rows, cols).
        cone_vec: the chosen views, n of them.
        circle: of all sources.
        views: which of all views these are.
        weights: (n, cols) of `redundancy`.

    Returns factors (n, cols), across (n, cols) and up (n, rows) of `Views`; across and up are
    squares [mm^2].
    """
    rows, cols = shape
    source = cone_vec.source
    u = cone_vec.u
    v = cone_vec.v
    panel = cone_vec.detector - source
    inward = circle.centre - source[:, :2]
    radius = np.linalg.norm(inward, axis=1)
    depth = np.abs((panel * cone_vec.normal).sum(axis=1))
    c = np.arange(cols) - (cols - 1) / 2
    r = np.arange(rows) - (rows - 1) / 2
    x = panel[:, :1] + c * u[:, :1]
    y = panel[:, 1:2] + c * u[:, 1:2]
    z = panel[:, 2:] + r * v[:, 2:]
    ahead = inward / radius[:, None]
    along = x * ahead[:, :1] + y * ahead[:, 1:]
    factors = weights * along * (circle.step[views] * depth * radius)[:, None]
    return factors, x * x + y * y, z * z
