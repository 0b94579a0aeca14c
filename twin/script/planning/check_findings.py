"""Findings of a script's dry run: collisions, clearance, the projections' view, dose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

Trace = tuple[tuple[float, float], ...]


CUT_AT_SIDE: Final = {
    "left": "columns",
    "right": "columns",
    "top": "rows",
    "bottom": "rows",
}
"""Side of an image -> whether columns or rows are cut off there."""
MIN_CUT_PX: Final = 0.5
"""Truncation above this is reported [px]."""


def cut_off(sides: Mapping[str, float]) -> str:
    """Describe how far the sample is cut off; "" if it is not.

    `sides`: left, right, top, bottom -> pixels."""
    found = []
    for side, px in sides.items():
        if px > MIN_CUT_PX:
            count, unit = f"{px:.0f}", CUT_AT_SIDE[side]
            found.append(
                f"{side} by {count} {unit.removesuffix('s' if count == '1' else '')}"
            )
    return ", ".join(found)


@dataclass(frozen=True)
class Collision:
    """A contact on the way: line that moves, time, parts that touch.

    `last_free` is the position of every axis at the last moment that is still free.
    """

    line: int
    time_s: float
    pair: tuple[str, str]
    last_free: Mapping[str, float]

    def to_dict(self) -> dict[str, object]:
        """Return the JSON form of `flexdt check`."""
        return {**vars(self), "pair": list(self.pair), "last_free": dict(self.last_free)}


@dataclass(frozen=True)
class Clearance:
    """Result of the collision check of a plan.

    `min_clearance_mm` of a plan with collisions is that at which the worst of them
    begins: how far parts overlap then is not measured. `trace` are (time [s], smallest
    clearance [mm]) points for a plot, in time order.
    """

    collisions: tuple[Collision, ...] = ()
    min_clearance_mm: float | None = None
    min_clearance_pair: tuple[str, str] | None = None
    trace: Trace = ()


@dataclass(frozen=True)
class Optics:
    """View of the projections of one camera setting [mm, um]; ranges are (least, greatest).

    Attributes:
        field_mm: width and height of the field of view at the rotation axis.
        turn_field_mm: diameter of the cylinder that is completely visible over a full
            rotation.
        truncation: None without a sample's size; else columns (and rows, if the height is
            known) of its projection that fall beyond left, right, top, bottom, at worst
            over the rotation.
    """

    lines: tuple[int, int]
    shape: tuple[int, int]
    pixel_mm: float
    sod_mm: tuple[float, float]
    sdd_mm: tuple[float, float]
    magnification: tuple[float, float]
    voxel_um: tuple[float, float]
    field_mm: tuple[float, float]
    turn_field_mm: float
    truncation: Mapping[str, float] | None

    @property
    def truncated(self) -> bool:
        """Whether the sample is cut off at any edge; False if that was not computed."""
        return self.truncation is not None and any(
            x > 0 for x in self.truncation.values()
        )

    def to_dict(self) -> dict[str, object]:
        """Return the JSON form: the fields by name, with rows and cols for the shape, and
        units in the names.
        """
        names = {
            "field_mm": "field_of_view_mm",
            "turn_field_mm": "full_turn_diameter_mm",
            "truncation": "truncation_px",
        }
        document = {
            n: list(v) if isinstance(v, tuple) else v for n, v in vars(self).items()
        }
        document["rows"], document["cols"] = document.pop("shape")
        return {names.get(name, name): value for name, value in document.items()}


@dataclass(frozen=True)
class Dose:
    """Figures related to dose: beam time, charge on the target, time that makes images.

    `charge_mAs` is power over voltage times beam time. It is not the dose in a sample:
    spectrum, filter and distance are not in it.
    """

    beam_on_s: float
    charge_mAs: float
    exposing_s: float
