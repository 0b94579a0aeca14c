"""How far the values of a reconstructed volume may be off, in short."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

WARNED: Final = 0.03
"""Relative bound from which on a warning tells of it, where a tenth of the even places have more.
The bound is two to four times what is off: about 1 %."""
CAUSES: Final = {
    "angles": "directions that no view saw",
    "aside": "the few columns of the panel that see beyond the axis",
    "cone": "the angle of the cone, more so with few views",
    "rows": "what lies above or below the panel's rows",
    "beyond": "what lies beyond the panel's sides",
    "drift": "images that are not empty beside the object",
}
UNSEEN: Final = (
    "; this holds if the object goes on beyond the panel's sides as it is within them: a denser "
    "shell out there makes every value too low, and no image shows it"
)


@dataclass(frozen=True)
class Accuracy:
    """What the even places of an object may be off by, beside the noise.

    Attributes:
        half: of the attenuation there, in half of them at most.
        most: in nine of ten at most.
        cause: what contributes most to the others: angles, aside, cone, rows, beyond or drift.
        cut_off: the object goes on beyond the panel's sides, where its outline is a guess.
    """

    half: float
    most: float
    cause: str
    cut_off: bool = False

    def __str__(self) -> str:
        half, most = (f"{min(100.0 * part, 99.0):.2g} %" for part in (self.half, self.most))
        return (
            f"half of the object's even places are right within {half} and nine of ten within "
            f"{most}, beside the noise; what contributes most: {CAUSES[self.cause]}"
        ) + UNSEEN * self.cut_off

    @property
    def warnings(self) -> list[str]:
        """A warning where a tenth of the places may be off by more than some per cent."""
        return [f"values may be off: {self}"] * (self.most > WARNED)
