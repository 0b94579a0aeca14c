"""Figures of geometries, data sets and plans with matplotlib, which is imported when one is
made.

Every function draws into axes that are given, or into a new figure, and returns the axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from flexdt.library.datasets.image_set import ImageSet
from flexdt.library.figures import require_plots
from flexdt.library.notebook.notebook_slices import window_of
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.panel_corners import panel_corners
from flexdt.twin.projection.volume import Residuals, Volume
from flexdt.twin.script import CheckReport, ScanPlan

PATH_SAMPLES = 2000
"""Number of moments at which motors are drawn."""
KIND_COLOURS = {"dark": "k", "flat": "C1", "projection": "C0", "preview": "C7"}
LAYER_LABELS = {
    "data": "attenuation",
    "sigma": "noise of attenuation",
    "bias_bound": "bound of its bias",
}
DOT_PT = 6.0
"""Size of the dots of sources and panels."""
GEOMETRY_INCH = (7.0, 5.5)
BAR_WIDTH = 0.05
"""Of a color bar, as a share of its picture's width."""
RESIDUALS_INCH = (12.0, 3.6)
MOVIE_MS = 400
"""Time of a view in a movie of residuals."""
MAX_TICKS = 6
"""Of the longest axis of a geometry."""
GEOMETRY_ZOOM = 0.8
"""Of the box in its figure; at 1, matplotlib's default, a flat box reaches beyond it."""
LABEL_PAD_PT = 9.0
"""From the ticks' numbers to the name of an axis in three dimensions [pt]."""
MAX_PANELS = 12
"""Largest number of panels drawn, evenly chosen."""


def plot_geometry(cone_vec: ConeVec, axes: Any = None) -> Any:
    """Plot sources, panels and central rays in the object's frame [mm], in three
    dimensions.

    At most `MAX_PANELS` panels and rays are drawn; a panel only if its shape is known.

    Args:
        cone_vec: the geometry.
        axes: three-dimensional axes of matplotlib; None makes a figure.

    Returns:
        The axes.
    """
    if axes is None:
        figure = _pyplot().figure(figsize=GEOMETRY_INCH)
        axes = figure.add_subplot(projection="3d")
    axes.plot(*cone_vec.source.T, "C0.", markersize=DOT_PT, label="source")
    shown = np.unique(
        np.linspace(0, len(cone_vec) - 1, min(len(cone_vec), MAX_PANELS)).astype(int)
    )
    for view in cone_vec[shown]:
        centre = view.detector[0]
        axes.plot(*np.stack([view.source[0], centre]).T, "k-", linewidth=0.4)
        if view.detector_shape is not None:
            (corners,) = panel_corners(view)
            axes.plot(*np.vstack([corners, corners[:1]]).T, "C1-", linewidth=0.8)
    axes.plot(*cone_vec.detector.T, "C1.", markersize=DOT_PT, label="detector")
    axes.plot([0.0], [0.0], [0.0], "k+", label="origin of the object")
    axes.set(
        xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]", title=f"{len(cone_vec)} views"
    )
    spans = [
        np.ptp(one.get_view_interval()) for one in (axes.xaxis, axes.yaxis, axes.zaxis)
    ]
    axes.set_box_aspect(spans, zoom=GEOMETRY_ZOOM)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        _spread_ticks(axis)
        axis.labelpad = LABEL_PAD_PT
    axes.legend(loc="upper left", fontsize="small")
    return axes


def plot_projection(data: ImageSet, index: int, axes: Any = None) -> Any:
    """Plot line integrals of one projection, as the source sees it, with a color bar.

    `axes`: matplotlib's, or None. Raises DatasetError: as `DataSet.line_integrals`.
    """
    axes = _room(axes)
    shown = axes.imshow(data.line_integrals(index), cmap="gray")
    _colour_bar(axes, shown, "line integral")
    axes.set(
        xlabel="column", ylabel="row", title=f"{data.name}: {data.frames[index].file}"
    )
    return axes


def plot_volume(
    volume: Volume,
    axes: Any = None,
    what: str = "data",
    window: Sequence[float] | Volume | None = None,
) -> Any:
    """Plot the middle layer of a volume.

    Places are in [mm], +y up.

    Args:
        volume: to plot.
        axes: matplotlib's, to draw into; None makes a figure.
        what: `data`, `sigma` or `bias_bound`.
        window: values of black and of white, or a volume whose window is taken, so that
            both can be compared; None: percentiles of the layer.

    Returns:
        The axes.

    Raises:
        TwinError: the volume has no such values, or the window is none.
    """
    if what in LAYER_LABELS:
        values = getattr(volume, what, None)
    else:
        values = None
    if values is None:
        allowed = [name for name in LAYER_LABELS if getattr(volume, name) is not None]
        raise TwinError(f"what: {what!r} is not there; there is {', '.join(allowed)}")
    axes = _room(axes)
    x, y, z = volume.centers()
    middle = len(z) // 2
    half = volume.voxel_xyz[0] / 2
    ends = (x[0] - half, x[-1] + half, y[0] - half, y[-1] + half)
    if isinstance(window, Volume):
        other = getattr(window, what)
        seen, window = other[len(other) // 2], None
    else:
        seen = values[middle]
    black, white = window_of(seen, window)
    shown = axes.imshow(
        values[middle], cmap="gray", origin="lower", extent=ends, vmin=black, vmax=white
    )
    _colour_bar(axes, shown, f"{LAYER_LABELS[what]} [1/mm]")
    axes.set(xlabel="x [mm]", ylabel="y [mm]", title=f"z = {z[middle]:g} mm")
    return axes


def plot_residuals(residuals: Residuals) -> Any:
    """Plot residuals by view and by pixel, and those of the worst view.

    Args:
        residuals: of a volume.

    Returns:
        The three axes.
    """
    require_plots()
    import matplotlib.pyplot as plt

    _, axes = plt.subplots(1, 3, figsize=RESIDUALS_INCH, layout="constrained")
    axes[0].plot(residuals.views, residuals.by_view, ".")
    axes[0].set(xlabel="view", ylabel="residual [line integral]", ylim=(0.0, None))
    shown = axes[1].imshow(residuals.by_pixel, cmap="viridis", vmin=0.0)
    axes[1].set(xlabel="column", ylabel="row", title="by pixel")
    _colour_bar(axes[1], shown, "")
    view = int(residuals.worst(1)[0])
    rest = residuals.images[residuals.views.tolist().index(view)]
    most = float(np.abs(rest).max()) or 1.0
    shown = axes[2].imshow(rest, cmap="RdBu_r", vmin=-most, vmax=most)
    axes[2].set(xlabel="column", title=f"view {view}")
    _colour_bar(axes[2], shown, "")
    return axes


def movie_of_residuals(residuals: Residuals, count: int) -> Any:
    """Make an animation of the views with the largest residuals, in the order of the scan.

    Args:
        residuals: of a volume.
        count: of views.
    """
    require_plots()
    import matplotlib.pyplot as plt
    from matplotlib.animation import FuncAnimation

    views = np.sort(residuals.worst(count))
    rest = residuals.images[np.isin(residuals.views, views)]
    most = float(np.abs(rest).max()) or 1.0
    figure, axes = plt.subplots(layout="constrained")
    shown = axes.imshow(rest[0], cmap="RdBu_r", vmin=-most, vmax=most)
    _colour_bar(axes, shown, "residual [line integral]")

    def show(number: int) -> list[Any]:
        """Draw one view."""
        shown.set_data(rest[number])
        return [shown, axes.set_title(f"view {views[number]}")]

    return FuncAnimation(figure, show, frames=len(views), interval=MOVIE_MS)


def plot_plan(plan: ScanPlan, report: CheckReport) -> Any:
    """Plot motors, X-rays and exposures, and the smallest clearance over time [s].

    Only motors that move are drawn, rotations on an axis of their own; collisions are red
    lines.

    Args:
        plan: gives the motors' paths.
        report: of its dry run, for clearance and collisions.

    Returns:
        matplotlib's figure.
    """
    figure, (motors, beam, space) = _pyplot().subplots(
        3, 1, sharex=True, figsize=(9, 7), height_ratios=(5, 1, 2), layout="constrained"
    )
    times = np.linspace(0.0, plan.duration_s, PATH_SAMPLES)
    turning = motors.twinx()
    places = plan.positions(times)
    for i, (name, path) in enumerate(plan.paths.items()):
        if len(path.times) > 1:
            axis = plan.machine.axes[name]
            if axis.unit == "deg":
                axes = turning
            else:
                axes = motors
            axes.plot(times, places[name], f"C{i}", label=f"{name} [{axis.unit}]")
    motors.set(ylabel="position [mm]", title=repr(plan).strip("<>"))
    turning.set(ylabel="angle [deg]")
    handles = [
        h for axes in (motors, turning) for h in axes.get_legend_handles_labels()[0]
    ]
    if handles:
        motors.legend(handles=handles, fontsize="small")
    for on in plan.beam:
        beam.axvspan(on.start_s, on.end_s, color="gold", alpha=0.5)
    for kind, colour in KIND_COLOURS.items():
        starts = [g.starts for g in plan.groups if g.kind == kind]
        beam.eventplot(
            np.concatenate(starts or [np.empty(0)]), colors=colour, linewidths=0.8
        )
    beam.set(ylabel="images", yticks=[])
    trace = () if report.clearance is None else report.clearance.trace
    space.plot(*np.array(trace).reshape(-1, 2).T, "k-")
    space.set(xlabel="time [s]", ylabel="clearance [mm]", ylim=(0, None))
    for collision in () if report.clearance is None else report.clearance.collisions:
        space.axvline(collision.time_s, color="red")
    return figure


def _room(axes: Any) -> Any:
    """Return axes in whose figure color bars and titles get room of their own: those given,
    or of a new figure. A figure's own layout stays if it has one.
    """
    if axes is None:
        return _pyplot().figure(layout="constrained").add_subplot()
    figure = axes.figure
    if figure.get_layout_engine() is None:
        figure.set_layout_engine("constrained")
    return axes


def _colour_bar(axes: Any, shown: Any, label: str) -> None:
    """Draw a color bar as high as the picture beside it."""
    beside = axes.inset_axes((1.03, 0.0, BAR_WIDTH, 1.0))
    axes.figure.colorbar(shown, cax=beside, label=label)


def _spread_ticks(axis: Any) -> None:
    """Give an axis in three dimensions as many ticks as its length on the figure has room
    for: short axes, seen from the side, get few.
    """
    from matplotlib.ticker import MaxNLocator

    spans = {
        one: abs(np.subtract(*one.get_view_interval()))
        for one in (axis.axes.xaxis, axis.axes.yaxis, axis.axes.zaxis)
    }
    share = spans[axis] / max(spans.values())
    count = max(1, round(MAX_TICKS * share))
    axis.set_major_locator(MaxNLocator(count, min_n_ticks=min(2, count)))
    axis.set_tick_params(labelsize="small")


def _pyplot() -> Any:
    """Import matplotlib.pyplot; TwinError if not installed."""
    require_plots()
    from matplotlib import pyplot

    return pyplot
