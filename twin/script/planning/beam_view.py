"""The beam's view of the sample in the images of a plan, and warnings about it.

Poses come from the nominal geometry. The sample is a body of revolution about the rotation
axis that holds it at every angle of a full rotation: that of its corners, else a cylinder, or
only the axis where its size is unknown. A report about truncation is about that body.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import assert_never

import numpy as np
import numpy.typing as npt

from flexdt.twin.findings import Finding, Findings, Place, warning
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.script.commands import ImageKind
from flexdt.twin.script.planning.plan import ScanPlan
from flexdt.twin.script.problems import ScriptCode

BoolArray = npt.NDArray[np.bool_]

_SAMPLED_IMAGES = 33
"""Images of one sequence that are examined; positions between them are smooth."""


@dataclass(frozen=True, eq=False)
class View:
    """Images of one camera setting and kind, and the sample's projection in them [pixels].

    Attributes:
        left, right: columns of the projection's edges, (n,); equal where the size is
            unknown.
        top, bottom: rows, (n,); NaN where the height is unknown.
        axis: column of the rotation axis, (n,).
    """

    kind: ImageKind
    camera: CameraSettings
    lines: tuple[int, ...]
    poses: Poses
    left: FloatArray
    right: FloatArray
    top: FloatArray
    bottom: FloatArray
    axis: FloatArray

    @property
    def outside(self) -> BoolArray:
        """Whether no part of the sample is projected onto the image, (n,) bool.

        An unknown top or bottom is taken as the rotation axis's row.
        """
        rows, cols = self.camera.shape
        middle = _project(self.poses, self.poses.axis, (rows, cols))[:, 1]
        top, bottom = (np.where(np.isnan(y), middle, y) for y in (self.top, self.bottom))
        return np.asarray(
            (self.right < -0.5)
            | (self.left > cols - 0.5)
            | (bottom < -0.5)
            | (top > rows - 0.5)
        )

    @property
    def cut_columns(self) -> FloatArray:
        """Columns beyond the left and the right edge, (n, 2)."""
        return _beyond(self.left, self.right, self.camera.shape[1])

    @property
    def cut_rows(self) -> FloatArray:
        """Rows of the projection beyond the top and the bottom edge, (n, 2); NaN if unknown."""
        return _beyond(self.top, self.bottom, self.camera.shape[0])


def _beyond(low: FloatArray, high: FloatArray, size: int) -> FloatArray:
    """Compute how far a projection is beyond the image's low and high edge [pixels], (n, 2)."""
    return np.maximum(np.stack([-0.5 - low, high - (size - 0.5)], axis=1), 0.0)


def views(plan: ScanPlan) -> Iterator[View]:
    """Group the saved images of `plan` by camera setting and kind; yield a view of each
    group.

    Exposure, frames and averages make no other group. Images without a file, or with an
    empty region, are left out.

    Args:
        plan: of a script; of a moving sequence at most `_SAMPLED_IMAGES` images are
            taken, evenly spread, of another one image.
    """
    batches: dict[tuple[CameraSettings, ImageKind], tuple[list[int], list[int]]] = {}
    first = 0
    for g in plan.groups:
        if g.files and min(g.camera.shape) > 0:
            camera = replace(g.camera, frames=1, averages=1, exposure_ms=1.0)
            index, lines = batches.setdefault((camera, g.kind), ([], []))
            count = 1
            if g.moving:
                count = min(len(g), _SAMPLED_IMAGES)
            probes = np.linspace(0, len(g) - 1, count).round().astype(int).tolist()
            index += [first + i for i in probes]
            lines += [g.line] * len(probes)
        first += len(g)
    for (camera, kind), (index, lines) in batches.items():
        positions = {n: x[index] for n, x in plan.image_positions.items()}
        yield _view(plan, camera, kind, tuple(lines), positions)


def beam_problems(plan: ScanPlan) -> Findings:
    """Warn of projections with the sample wholly outside the image, and of flats that
    show it.

    At most one warning of each kind for a view; the line is the first one's. Dark and
    preview images are not checked.

    Returns:
        Warnings `sample_out_of_beam` and `sample_in_flat`, in the order of the views.
    """
    warnings: list[Finding] = []
    for view in views(plan):
        outside = view.outside
        match view.kind:
            case "projection":
                bad = outside
                code = ScriptCode.SAMPLE_OUT_OF_BEAM
                text = _outside_text
            case "flat":
                bad = ~outside
                code = ScriptCode.SAMPLE_IN_FLAT
                text = _inside_text
            case "dark" | "preview":
                continue
            case _:
                assert_never(view.kind)
        if bad.any():
            warnings.append(_aggregate(view, bad, code, text(view)))
    return Findings(warnings)


def _aggregate(view: View, bad: BoolArray, code: ScriptCode, text: str) -> Finding:
    """Make one warning for all `bad` images (n,) of a view, at the first of their lines.

    The text ends with the number of further lines, if any.
    """
    lines = sorted({line for line, b in zip(view.lines, bad.tolist(), strict=True) if b})
    more = ""
    if len(lines) > 1:
        more = f" (and at {len(lines) - 1} more lines)"
    return warning(code, text + more, place=Place(lines[0]))


def _outside_text(view: View) -> str:
    """Describe, for a warning, on which side the first image without the sample has lost
    it.

    Left or right, of the image's columns; else above or below its rows. The column of the
    rotation axis is in the text too.
    """
    i = int(np.argmax(view.outside))
    rows, cols = view.camera.shape
    side = "above or below"
    sides = f"rows 0 to {rows - 1}"
    if view.right[i] < -0.5 or view.left[i] > cols - 0.5:
        side = "right"
        if view.right[i] < -0.5:
            side = "left"
        sides = f"columns 0 to {cols - 1}"
        side += " of"
    return (
        "the sample is out of the beam: the shadow of its axis lies at column "
        f"{view.axis[i]:.0f}, "
        f"{side} the image's {sides}; projections show no sample"
    )


def _inside_text(view: View) -> str:
    """Describe, for a warning, which columns the sample's shadow has in the first flat
    image that shows it; for a sample without width the axis's column.
    """
    i = int(np.argmin(view.outside))
    if view.left[i] == view.right[i]:
        where = f"the shadow of its axis lies at column {view.axis[i]:.0f}"
    else:
        where = f"its shadow spans columns {view.left[i]:.0f} to {view.right[i]:.0f}"
    return f"the sample is in the beam in a flat image: {where} of 0 to {view.camera.shape[1] - 1}"


def _view(
    plan: ScanPlan,
    camera: CameraSettings,
    kind: ImageKind,
    lines: tuple[int, ...],
    positions: dict[str, FloatArray],
) -> View:
    """Project the sample's outline into the images of one camera setting.

    A sample of unknown size is as wide as the axis; without a height its top and bottom
    are NaN.

    Args:
        plan: with machine, profile and the sample's size.
        camera: the setting.
        kind: of the images.
        lines: of the script, that take them.
        positions: axis -> positions (n,) [mm, deg].

    Returns:
        The view: edges of the shadow, and the axis's column, (n,) each [pixels].
    """
    p = motor_poses(plan.machine, plan.profile, camera, positions)
    shape = camera.shape
    axis = _project(p, p.axis, shape)[:, 0]
    left = right = axis
    top = bottom = np.full(len(p), np.nan)
    size = plan.sample
    if size is not None:
        radius = size.diameter_mm / 2
        edges = [_project(p, q, shape)[:, 0] for q in _tangents(p, radius)]
        left = np.minimum(*edges)
        right = np.maximum(*edges)
        if size.height_mm > 0.0:
            rows = [_project(p, q, shape)[:, 1] for q in _rims(p, size.outline_mm)]
            top = np.min(rows, axis=0)
            bottom = np.max(rows, axis=0)
    return View(kind, camera, lines, p, left, right, top, bottom, axis)


def _tangents(p: Poses, radius: float) -> list[FloatArray]:
    """Compute the points where rays touch the sample's cylinder, at the source's height.

    A cylinder that contains the source is touched beside it: the sine is at most 1.

    `p`: n poses; `radius`: of the cylinder about the rotation axis [mm].
    Returns two arrays of (n, 3) [mm], one for each side.
    """
    to_source = p.source - p.axis
    flat = to_source[:, :2]
    distance = np.linalg.norm(flat, axis=1, keepdims=True)
    toward = flat / distance
    sine = np.minimum(radius / distance, 1.0)
    cosine = np.sqrt(1.0 - sine**2)
    across = np.stack([-toward[:, 1], toward[:, 0]], axis=1)
    aside = [radius * (sine * toward + sign * cosine * across) for sign in (1.0, -1.0)]
    return [np.column_stack([p.axis[:, :2] + xy, p.source[:, 2]]) for xy in aside]


def _rims(p: Poses, rims_mm: Sequence[tuple[float, float]]) -> list[FloatArray]:
    """Compute the points of circles about the axis nearest to and farthest from the
    source.

    `rims_mm`: (radius, height above the axis's origin). Returns (n, 3) [mm] each.
    """
    along = (p.source - p.axis)[:, :2]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    return [
        p.axis + np.column_stack([depth * along, np.full(len(along), height)])
        for radius, height in rims_mm
        for depth in (radius, -radius)
    ]


def _project(p: Poses, points: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Project one world point (n, 3) for each pose to (n, 2) pixels."""
    moved = ConeVec.from_vectors(p.source - points, p.detector - points, p.u, p.v)
    return moved.project_points(np.zeros((1, 3)), shape)[:, 0, :]
