"""The geometry that a circular scan determines by itself, and the parameters that it does
not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

from flexdt.twin.errors import NotIdentifiableError
from flexdt.twin.geometry.motion import Motion
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.panel import Panel

UNTOLD: Final[Mapping[str, str]] = {
    "SOD": "an object twice as large at twice the distance gives the same images; a phantom of "
    "known size tells it",
    "magnification": "it is SDD / SOD; a phantom of known size tells it",
    "SDD": "in a circular scan it trades against the object's size; a phantom tells it (dD_z)",
    "det_pitch": "its axis is perpendicular to the plane of symmetry, which stays as it is; a "
    "phantom tells it",
    "dO_y": "a shift along the axis moves the object alone; a phantom tells it",
}
"""Parameter that a circular scan, or this method, does not determine -> the reason."""


class AlignEstimate(NamedTuple):
    """A value with its standard deviation."""

    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class Alignment:
    """The geometry determined from a scan.

    Attributes:
        offsets: the complete correction: the one in force, with the estimated parameters;
            None: refused.
        parameters: axis_column_px and, if the images determine them, det_roll, det_yaw
            and source_row_px [px, deg].
        refused: name -> reason.
        warnings: doubts about the scan.
        frames: number of used frames.
        motion: shifts of single frames, as shifts of the sample; None: not requested, or
            refused.
        panel: the distortion that was undone, with the gap between two tiles that was
            found; None: no distortion.
    """

    offsets: Offsets | None
    parameters: Mapping[str, AlignEstimate]
    refused: Mapping[str, str]
    warnings: tuple[str, ...]
    frames: int
    motion: Motion | None = None
    panel: Panel | None = None

    @property
    def identifiable(self) -> bool:
        """Whether the axis column is given."""
        return self.offsets is not None


def refuse_if(wrong: bool, why: str) -> None:
    """Raise NotIdentifiableError with `why` if `wrong`."""
    if wrong:
        raise NotIdentifiableError(why)
