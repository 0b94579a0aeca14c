"""Geometry of an ordinary circular scan from its own projections, and its limits.

Mirror symmetry (`mirror_symmetry.py`) determines the image of the axis and, less well,
the panel's yaw; planes through two sources (`plane_pairs.py`) determine the row in which
the source turns and shifts of single frames. They are given as offsets: dO_x for the
column, det_roll for the panel against the axis, det_yaw, dD_y for the row. A panel
shifted sideways looks like an axis shifted the other way, but for a yaw of shift / SDD,
and one shifted upwards like an axis that leans, but for a pitch: the complete geometry is
right whichever of the two it was.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Final, ParamSpec

import numpy as np

from flexdt.twin.calibration.without_phantom.alignment import (
    UNTOLD,
    AlignEstimate,
    Alignment,
)
from flexdt.twin.calibration.without_phantom.circular_scan import (
    FREE,
    OF_TURN,
    CircularScan,
)
from flexdt.twin.calibration.without_phantom.symmetry_plane import (
    SymmetryPlane,
    find_plane,
)
from flexdt.twin.calibration.without_phantom.turn import Image, Turn
from flexdt.twin.calibration.without_phantom.turn_planes import TurnPlanes
from flexdt.twin.errors import NotIdentifiableError
from flexdt.twin.geometry.motion import Motion
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.panel import Panel
from flexdt.twin.geometry.poses import Poses

P = ParamSpec("P")
STEP_TOLD: Final = 0.2
"""From here on a step of the images is a warning [px]."""
NEEDS_TURN: Final = (
    "a full turn of more rows tells it; the correction keeps what was in force"
)


def _or_refused(find: Callable[P, Alignment]) -> Callable[P, Alignment]:
    """Wrap a search so that it does not raise NotIdentifiableError: it then returns an
    alignment without offsets that refuses all parameters, with the error's message as
    reason. Other errors are raised.
    """

    @wraps(find)
    def found(*args: P.args, **options: P.kwargs) -> Alignment:
        """Call `find`; where it raises NotIdentifiableError, refuse every parameter.

        All but those of UNTOLD have its reason; offsets are None and frames 0.
        """
        try:
            return find(*args, **options)
        except NotIdentifiableError as error:
            names = ("axis_column_px", "det_roll", "det_yaw", "source_row_px")
            return Alignment(
                None, {}, {**dict.fromkeys(names, error.message), **UNTOLD}, (), 0
            )

    return found


@_or_refused
def align_turn(
    image: Image,
    poses: Poses,
    present: tuple[int, ...],
    shape: tuple[int, int],
    base: Offsets,
    priors: Mapping[str, float],
    random: np.random.Generator,
    per_frame: bool = False,
    panel: Panel | None = None,
) -> Alignment:
    """Estimate axis column, roll, yaw and the source's row from the frames of a turn.

    Without a full turn only the axis column is estimated, from opposite rays; the
    correction is never refused for the other parameters.

    Args:
        image: line integrals of a frame, (rows, cols).
        poses: nominal poses of all frames.
        present: indices of the frames that are there.
        shape: (rows, cols) of every image.
        base: offsets in force; dO_x, det_roll, det_yaw and dD_y are replaced.
        priors: standard deviation of each offset [mm, deg]; those of the panel and of
            axis_tilt_x count.
        random: for images of noise, which show the effect of noise.
        per_frame: whether shifts of single frames are looked for.
        panel: the distortion that is undone in the images.

    Returns:
        The alignment; parameters that the scan does not determine are in `refused`. If it
        determines no axis column, offsets are None and all are refused; no
        NotIdentifiableError is raised.
    """
    scan = CircularScan.of(image, poses, present, shape, base, priors)
    plane = find_plane(scan, panel, random)
    parameters, refused = _plane_parameters(plane)
    refused = {**UNTOLD, **refused}
    corrected = plane.scan.offsets(plane.values[:OF_TURN])
    if plane.turn is None:
        refused |= dict.fromkeys(("det_roll", "source_row_px", "motion"), NEEDS_TURN)
        return Alignment(
            corrected, parameters, refused, (), len(present), None, plane.panel
        )
    planes = TurnPlanes(
        plane.scan.image,
        poses,
        plane.turn,
        plane.scan.offsets,
        plane.values,
        plane.covariance,
        priors,
    )
    try:
        corrected, parameters["source_row_px"] = planes.row(random)
    except NotIdentifiableError as error:
        refused["source_row_px"] = error.message
    motion: Motion | None = None
    if per_frame:
        try:
            motion = _motion(planes, plane.turn, corrected, random)
        except NotIdentifiableError as error:
            refused["motion"] = error.message
    warnings = _warnings(plane, plane.turn, len(poses) - len(present))
    used = len(plane.turn.used)
    return Alignment(corrected, parameters, refused, warnings, used, motion, plane.panel)


def _plane_parameters(
    plane: SymmetryPlane,
) -> tuple[dict[str, AlignEstimate], dict[str, str]]:
    """Split the parameters into those that the plane of symmetry determines and the
    others.

    Args:
        plane: of symmetry, found in the images.

    Returns:
        Estimates by name: `axis_column_px` always, roll and yaw [deg] where they are
        told, the yaw's sigma with that of a panel shifted sideways, which looks alike;
        and name -> reason for the others, with both sigmas.
    """
    column = plane.scan.column(plane.values)
    parameters = {"axis_column_px": AlignEstimate(column, plane.column_sigma_px, "px")}
    refused = {}
    roll, yaw = plane.sigmas_deg
    # A panel shifted sideways looks as a yaw does.
    widths = roll, math.hypot(yaw, math.degrees(plane.scan.sideways_rad))
    for i, name in enumerate(FREE[1:3]):
        if plane.told[i]:
            value = math.degrees(plane.values[1 + i])
            parameters[name] = AlignEstimate(value, widths[i], "deg")
        else:
            images = math.degrees(plane.images_rad[i])
            prior = math.degrees(plane.priors_rad[i])
            refused[name] = (
                f"the images tell it to +- {images:.2g} deg, its prior to +- {prior:.2g} "
                "deg: that is what the correction contains"
            )
    return parameters, refused


def _motion(
    planes: TurnPlanes, turn: Turn, corrected: Offsets, random: np.random.Generator
) -> Motion:
    """Find the shifts of single frames as a motion of the sample.

    `corrected`: known offsets; `random`: for noise. Raises NotIdentifiableError: frames
    repeat, or shifts are not determined.
    """
    if turn.repeated:
        raise NotIdentifiableError(
            f"frames {list(turn.repeated)} repeat the one before: from there on "
            "the others may be a step behind their angles"
        )
    return planes.motion(corrected, random)


def _warnings(plane: SymmetryPlane, turn: Turn, missing: int) -> tuple[str, ...]:
    """List doubts about the scan, in this order: opposite rays disagree with the mean; a
    gap between tiles of the panel was found; one is not excluded; repeated frames;
    missing frames; a step of more than `STEP_TOLD` along the rows.

    Args:
        plane: of symmetry.
        turn: its frames.
        missing: number of missing frames.

    Returns:
        Sentences; empty without doubts.
    """
    out = []
    if plane.opposite is not None and plane.opposite.warning is not None:
        out.append(plane.opposite.warning)
    if plane.gap is not None:
        out.append(
            f"{plane.gap.text}: it is closed in what is told here, its uncertainty is in "
            "the axis column's sigma, and reconstruct closes it with the correction"
        )
    hidden = plane.hidden
    if hidden is not None and hidden.open:
        out.append(
            "the images do not exclude that a tile of the panel begins at columns "
            f"{hidden.first} to {hidden.last} behind a gap, which would move the axis by "
            f"half of its width: the column's sigma contains +- {hidden.column_px:.2g} "
            "px for it; calibrate with a phantom, and give that correction"
        )
    if turn.repeated:
        out.append(f"frames {list(turn.repeated)} repeat the one before and are left out")
    if missing:
        out.append(f"{missing} frames are missing; the sigmas contain what that may do")
    right, down = turn.step_px
    if abs(right) > STEP_TOLD:
        out.append(
            f"after frame {turn.step_after} the images step by {right:.2f} px to the "
            f"right and {down:.2f} px down: a jump there, or a drift over the scan; "
            "the sigmas contain half of it"
        )
    return tuple(out)
