"""The scanner that an agent moves: kinematic time, collisions, dose, geometry of each
frame.

`ScannerTwin` with its collision guard and a clock of its own: time is that of motors and
exposures, never wall-clock time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.collision import SceneGuard, box, build_scene
from flexdt.twin.errors import CollisionError, LimitError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.description import builtin_machine, profile_of
from flexdt.twin.motion.profiles import move
from flexdt.twin.scanner.scanner import ScannerTwin

REFERENCE_SOD_MM: Final = 600.0
BINNING: Final = 32
"""Number of detector pixels per coarse pixel of small images."""


COUNTS: Final = ("frames", "attempts")


def require_positive(*, or_zero: bool = False, **values: float) -> None:
    """Check that settings are finite and above 0 (0 or more with `or_zero`), and whole
    numbers if their name is in `COUNTS`.

    Args:
        or_zero: whether 0 is allowed.
        values: settings by name.

    Raises:
        LimitError: the first that does not hold; names it and what is allowed.
    """
    for name, value in values.items():
        counted = name in COUNTS
        above = value >= 0.0 if or_zero else value > 0.0
        if not (above and value < math.inf) or (counted and value != int(value)):
            if or_zero:
                least = "0 or more"
            else:
                least = "more than 0"
            if counted:
                allowed = f"{least}, a whole number"
            else:
                allowed = least
            raise LimitError(
                f"{name} {value:g}; allowed: {allowed}",
                {"asked": value, "allowed": allowed},
            )


def choices(action: npt.ArrayLike, sizes: Sequence[int]) -> list[int]:
    """Check an action of whole numbers, each from 0 to below its size, and return it as a
    list of ints.

    Args:
        action: (n,), or one number for a single size.
        sizes: of each number.

    Raises:
        LimitError: another count or value; lists the allowed ones.
    """
    values = np.atleast_1d(action).tolist()
    if len(values) != len(sizes) or any(
        v not in range(n) for v, n in zip(values, sizes, strict=True)
    ):
        allowed = ", ".join(f"0 to {n - 1}" for n in sizes)
        raise LimitError(
            f"action {values}; allowed: {len(sizes)} whole numbers, {allowed}",
            {"asked": values, "allowed": list(sizes)},
        )
    return [int(value) for value in values]


@dataclass(frozen=True)
class Taken:
    """Cost of one frame.

    Attributes:
        seconds: of motion and exposure [s].
        dose: exposure seconds at full tube power and SOD 600 mm of the same dose.
        collided: the motion ended before a contact; no frame was taken.
    """

    seconds: float
    dose: float
    collided: bool


class Lab:
    """A scanner with a sample on its stage, standing at SOD 600 mm, rot_obj 0.

    Args:
        size_mm: of the box around the sample, for collisions.
        exposure_s: of each frame.
    """

    def __init__(
        self, size_mm: tuple[float, float, float], exposure_s: float = 0.5
    ) -> None:
        """Make a scanner with a box on the stage, at the height of the beam, and the clock at
        0.

        Args:
            size_mm: sides of the box.
            exposure_s: of one image.
        """
        self.machine = builtin_machine()
        profile = profile_of(self.machine)
        guard = SceneGuard(build_scene(self.machine, profile, (box(size_mm),)))
        self.scanner = ScannerTwin(self.machine, profile, guard=guard)
        height = self.machine.sample_height_mm
        self.scanner.place({"ver_tube": height - profile.src_ort, "ver_det": height}, 0.0)
        self.exposure_s = exposure_s
        self.now = 0.0
        self.dose = 0.0

    @property
    def shape(self) -> tuple[int, int]:
        """Detector (rows, cols)."""
        return self.scanner.camera.shape

    @property
    def small_shape(self) -> tuple[int, int]:
        """(rows, cols) of the coarse detector."""
        rows, cols = self.shape
        return rows // BINNING, cols // BINNING

    def range_of(self, axis: str) -> tuple[float, float]:
        """Return the travel of a motor [mm, deg]."""
        a = self.machine.axes[axis]
        return a.lower, a.upper

    def position(self, axis: str) -> float:
        """Return the position of a motor [mm, deg]."""
        return self.scanner.positions(self.now)[axis]

    def take(self, targets: dict[str, float]) -> Taken:
        """Move the motors (rotations the shorter way), wait for rest, and expose; clock
        and dose go on.

        The dose is the exposure time [s] times the square of REFERENCE_SOD_MM over the
        distance to the axis. Before a contact the motors halt, and no frame is taken.

        Args:
            targets: axis -> [mm, deg].

        Returns:
            Time of motion and exposure [s], and dose; after a collision the time until
            the halt, and no dose.
        """
        start = self.now
        try:
            self.scanner.move(targets, self.now, shortest=True)
        except CollisionError:
            self.now = self.scanner.rest_time(self.now)
            return Taken(self.now - start, 0.0, collided=True)
        self.now = self.scanner.rest_time(self.now) + self.exposure_s
        dose = self.exposure_s * (REFERENCE_SOD_MM / float(self.poses().sod[0])) ** 2
        self.dose += dose
        return Taken(self.now - start, dose, collided=False)

    def seconds_to(self, targets: dict[str, float]) -> float:
        """Compute the time of `take` [s], the slowest axis's move and the exposure;
        collisions are not checked and nothing moves.

        Rotations take the shorter way.
        """
        ends = [self.now]
        for axis, target in targets.items():
            here = self.position(axis)
            way = target - here
            if self.machine.axes[axis].kind == "rotation":
                way = (way + 180.0) % 360.0 - 180.0
            ends.append(
                move(here, 0.0, here + way, *self.scanner.settings(axis), self.now).end
            )
        return max(ends) - self.now + self.exposure_s

    def poses(self, targets: dict[str, float] | None = None) -> Poses:
        """Compute the nominal pose of the present positions, or with some motors
        elsewhere."""
        positions = self.scanner.positions(self.now)
        return self.scanner.poses_at(
            {**positions, **(targets or {})}, self.scanner.camera
        )

    def small(self, poses: Poses, at: Offsets) -> ConeVec:
        """Compute the coarse detector's geometry."""
        return poses.cone_vec(at).binned(BINNING, self.shape)
