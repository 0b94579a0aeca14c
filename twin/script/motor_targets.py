"""Where a machine's motors bring source, sample and detector, and out of the beam.

Targets follow from the machine's linear map and the profile's offsets. A motor that moves
two of these things can set one of them only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Final

from flexdt.twin.errors import LimitError
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.machine.kinematics import motor_poses

BESIDE_BEAM_MM: Final = 60.0
"""Distance of the sample from the field of view in the flat image [mm]
(assumed: any sample)."""


QUANTITIES: Final = {
    "object_y": "the source-object distance",
    "detector_y": "the source-detector distance",
    "source_z": "the height of the beam",
    "object_x": "the sample sideways",
    "detector_x": "the detector sideways",
    "detector_z": "the height of the detector",
    "source_x": "the source sideways",
    "object_z": "the height of the sample",
}
"""Quantities that motors set, the most important first."""


@dataclass(frozen=True)
class MotorTargets:
    """Where the motors of a machine bring its stages."""

    machine: Machine
    profile: Profile

    def has(self, *quantities: str) -> bool:
        """Return whether motors move all of these quantities."""
        return all(self.machine.geometry.get(quantity) for quantity in quantities)

    def constant(self, quantity: str) -> float:
        """Sum up the parts of a quantity that no motor changes: the profile's zero
        offset, the sample's height, and the machine's fixed part [mm].
        """
        p = self.profile
        offsets = {
            "source_z": p.src_ort,
            "detector_x": p.det_tan,
            "detector_y": p.c_det,
            "object_x": p.axs_tan,
            "object_y": p.c_obj,
            "object_z": self.machine.sample_height_mm,
        }
        return offsets.get(quantity, 0.0) + self.machine.fixed.get(quantity, 0.0)

    def at_home(self, quantity: str) -> float:
        """Compute a quantity with every motor at home [mm], to six decimals."""
        return round(self.value(quantity, {}), 6)

    def value(self, quantity: str, positions: Mapping[str, float]) -> float:
        """Compute a quantity with motors at `positions`, the others at home [mm].

        It is the constant part plus the sum of factor times position.
        """
        factors = self.machine.geometry.get(quantity, {})
        moved = (
            f * positions.get(n, self.machine.axis(n).home) for n, f in factors.items()
        )
        return self.constant(quantity) + sum(moved)

    @cached_property
    def drivers(self) -> dict[str, str]:
        """Quantity -> the motor that sets it: the free one that moves it most.

        Quantities choose in the order of `QUANTITIES`; no motor sets two of them.
        object_z has none where motors move the source's height. The other motors of a
        quantity stay at home.
        """
        out: dict[str, str] = {}
        for quantity in QUANTITIES:
            factors = self.machine.geometry.get(quantity, {})
            free = [motor for motor in factors if motor not in out.values()]
            if quantity == "object_z" and self.has("source_z"):
                continue  # the beam goes to the sample
            if free:
                out[quantity] = max(free, key=lambda motor: abs(factors[motor]))
        return out

    def solved(self, wanted: Mapping[str, float]) -> dict[str, float]:
        """Solve for the motors' positions that bring quantities to the `wanted` values
        [mm].

        One after the other, each by its driver, with all other motors at home; quantities
        without one stay. Limits are not checked. Returns all motors that move these
        quantities, to six decimals.
        """
        geometry = self.machine.geometry
        moved = (motor for quantity in wanted for motor in geometry.get(quantity, {}))
        out = {motor: self.machine.axis(motor).home for motor in moved}
        for quantity, value in wanted.items():
            if motor := self.drivers.get(quantity):
                rest = self.value(quantity, {motor: 0.0})
                out[motor] = round((value - rest) / geometry[quantity][motor], 6)
        return out

    def driver(self, quantity: str) -> str:
        """Return the motor that sets a quantity.

        Raises LimitError: no motor is left for it.
        """
        if quantity not in self.drivers:
            message = f"has no motor of its own for {QUANTITIES[quantity]}"
            raise self.lacking(message, missing=quantity)
        return self.drivers[quantity]

    def need(self, what: str, quantity: str) -> None:
        """Check that motors move a quantity. `what`: purpose; `quantity`: of
        `QUANTITIES`. Raises LimitError: names the quantity that no motor moves.
        """
        if not self.has(quantity):
            none = f"has no motor for {QUANTITIES[quantity]}, which {what} needs"
            raise self.lacking(none, asked=what, missing=quantity)

    def lacking(self, what: str, **data: object) -> LimitError:
        """Make the error for a motor that this machine lacks."""
        return LimitError(f"{self.machine.name} {what}", data)

    @property
    def aside(self) -> tuple[str, ...]:
        """The quantity by which the sample leaves the beam."""
        return tuple(q for q in ("object_x", "object_z") if q in self.drivers)[:1]


def beside_beam(
    machine: Machine,
    profile: Profile,
    camera: CameraSettings,
    positions: Mapping[str, float],
    radius_mm: float = 0.0,
) -> tuple[dict[str, float], dict[str, float]]:
    """Find the targets that take the sample out of the beam, as far as its stage can.

    The sample's stage moves it sideways, or up and down, until it is `BESIDE_BEAM_MM` and
    its radius beside the field of view, at most to the ends of its travel.

    Args:
        machine: whose motors these are.
        profile: zero offsets.
        camera: decides how wide the beam is that reaches the image.
        positions: motors [mm, deg]; those left out are at home.
        radius_mm: of the sample, if known.

    Returns:
        Two dicts of one motor -> target (to six decimals), to either side of the beam,
        the freer side first.

    Raises:
        LimitError: no motor takes the sample out of the beam.
    """
    places = MotorTargets(machine, profile)
    if not places.aside:
        message = (
            "has no motor that takes the sample out of the beam, "
            "so no flat image can be taken"
        )
        raise places.lacking(
            message, asked="a flat field", missing=["object_x", "object_z"]
        )
    [quantity] = places.aside
    name = places.drivers[quantity]
    axis = machine.axis(name)
    factor = machine.geometry[quantity][name]
    p = motor_poses(machine, profile, camera, positions)
    k = 0 if quantity == "object_x" else 1
    beam = (p.detector - p.source)[0]
    sample = (p.axis - p.source)[0]
    share = float(sample[1] / beam[1])
    off = float((share * beam - sample)[2 * k])
    middle = positions.get(name, axis.home) + off / factor
    size = camera.shape[1 - k] * camera.pixels_mm(machine.detector.pixels)[k]
    away = (abs(share) * size / 2 + BESIDE_BEAM_MM + radius_mm) / abs(factor)
    least = math.ceil(axis.lower * 1e6) / 1e6
    most = math.floor(axis.upper * 1e6) / 1e6
    upper, lower = (
        {name: round(min(max(middle + way, least), most), 6)} for way in (away, -away)
    )
    freer = middle - axis.lower > axis.upper - middle
    if freer:
        return (lower, upper)
    return (upper, lower)
