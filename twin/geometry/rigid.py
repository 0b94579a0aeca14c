"""Rigid motions as values: turns and shifts of geometries and points, composed with `@`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, overload

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import (
    BEAM,
    COORDINATES,
    RIGHT,
    UP,
    FloatArray,
    rotation_about,
)
from flexdt.twin.signatures import public

AXES: Final = dict(zip(COORDINATES, (RIGHT, BEAM, UP), strict=True))
ORTHOGONAL_TOLERANCE: Final = 1e-9
"""Largest deviation of a rotation from orthogonal."""


@public
@dataclass(frozen=True, eq=False)
class Rigid:
    """A rigid motion: points p become `turn` p + `shift`.

    Attributes:
        turn: rotation, float64 (3, 3), read-only, determinant +1.
        shift: float64 (3,) [mm], read-only.

    Raises:
        GeometryError: no such numbers, or a matrix that is no rotation.

    Example:
        >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, pixel=0.15)
        >>> move = Rigid.translate(0, 0, 2) @ Rigid.rotate("z", 90)
        >>> (move @ scan).detector[0].round(9).tolist()
        [-459.0, 0.0, 2.0]
        >>> (move @ [[1.0, 0.0, 0.0]]).round(9).tolist()
        [[0.0, 1.0, 2.0]]
    """

    turn: FloatArray
    shift: FloatArray

    def __post_init__(self) -> None:
        """Copy `turn` and `shift` as read-only float64 after checking them.

        Raises:
            GeometryError: shapes other than (3, 3) and (3,), a shift that is not finite,
                or a `turn` that mirrors or is not orthogonal within
                `ORTHOGONAL_TOLERANCE`.
        """
        turn, shift = (
            np.array(part, dtype=np.float64) for part in (self.turn, self.shift)
        )
        if turn.shape != (3, 3):
            raise GeometryError.of_shape("turn", turn.shape, (3, 3))
        if shift.shape != (3,):
            raise GeometryError.of_shape("shift", shift.shape, (3,), " [mm]")
        if not np.isfinite(shift).all():
            problem = f"shift is {', '.join(f'{one:g}' for one in shift)}"
            raise GeometryError.instead(problem, shift.tolist(), "finite numbers [mm]")
        off = float(np.abs(turn @ turn.T - np.eye(3)).max())
        if not (off < ORTHOGONAL_TOLERANCE and np.linalg.det(turn) > 0):
            raise GeometryError(
                f"the matrix is no rotation: it is {off:.3g} from orthogonal, determinant "
                f"{np.linalg.det(turn):.6g}; allowed: a rotation without a mirror",
                {"asked": turn.tolist(), "allowed": "rotation"},
            )
        for name, value in (("turn", turn), ("shift", shift)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    @classmethod
    def translate(cls, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Rigid:
        """Make a shift [mm].

        Example:
            >>> Rigid.translate(1, 2, 3) @ [0.0, 0.0, 0.0]
            array([1., 2., 3.])"""
        return cls(np.eye(3), np.array([x, y, z], dtype=np.float64))

    @classmethod
    def rotate(
        cls,
        axis: str | npt.ArrayLike,
        angle_deg: float,
        about: npt.ArrayLike = (0.0, 0.0, 0.0),
    ) -> Rigid:
        """Make a right-handed turn about an axis through a point.

        A direction is normalized.

        Args:
            axis: "x", "y", "z", or a direction (3,).
            angle_deg: [deg].
            about: a point on the axis, (3,) [mm]; it stays where it is.

        Raises:
            GeometryError: an unknown name of an axis, a direction that is none, or an angle
                that is not finite.

        Example:
            >>> (Rigid.rotate("z", 90, about=(1, 0, 0)) @ [0.0, 0.0, 0.0]).round(9).tolist()
            [1.0, -1.0, 0.0]
        """
        if isinstance(axis, str):
            if axis not in AXES:
                message = f"axis {axis!r}; allowed: x, y, z or a direction of 3 numbers"
                raise GeometryError(message, {"asked": axis, "allowed": list(AXES)})
            axis = AXES[axis]
        if not math.isfinite(angle_deg):
            problem = f"angle_deg is {angle_deg:g}"
            raise GeometryError.instead(problem, str(angle_deg), "a finite number [deg]")
        direction = np.asarray(axis, dtype=np.float64)
        if direction.shape != (3,):
            raise GeometryError.of_shape("axis", direction.shape, (3,), ", or x, y, z")
        if not 0.0 < np.linalg.norm(direction) < math.inf:
            problem = f"axis is {', '.join(f'{one:g}' for one in direction)}"
            allowed = "a direction of finite numbers that are not all 0"
            raise GeometryError.instead(problem, direction.tolist(), allowed)
        turn = rotation_about(direction, math.radians(angle_deg))
        point = np.asarray(about, dtype=np.float64)
        return cls(turn, point - turn @ point)

    @property
    def inverse(self) -> Rigid:
        """The motion back."""
        return Rigid(self.turn.T, -self.turn.T @ self.shift)

    @overload
    def __matmul__(self, other: Rigid) -> Rigid: ...
    @overload
    def __matmul__(self, other: ConeVec) -> ConeVec: ...
    @overload
    def __matmul__(self, other: npt.ArrayLike) -> FloatArray: ...
    def __matmul__(self, other: Any) -> Any:
        """Apply this motion after another one, to a geometry, or to points (..., 3) [mm].

        Returns a `Rigid` for a `Rigid`, a `ConeVec` for a `ConeVec`, else the points (..., 3)
        [mm], moved.
        Raises GeometryError: points whose last dimension is not 3.
        """
        if isinstance(other, Rigid):
            return Rigid(self.turn @ other.turn, self.turn @ other.shift + self.shift)
        if isinstance(other, ConeVec):
            return other.moved(self.turn, self.shift)
        points = np.asarray(other, dtype=np.float64)
        if points.ndim == 0 or points.shape[-1] != 3:
            raise GeometryError.of_shape("points", points.shape, ("...", 3), " [mm]")
        return points @ self.turn.T + self.shift

    def __eq__(self, other: object) -> bool:
        """Compare type, rotation and shift, exactly (no tolerance)."""
        return (
            isinstance(other, Rigid)
            and np.array_equal(self.turn, other.turn)
            and np.array_equal(self.shift, other.shift)
        )

    def __hash__(self) -> int:
        """Hash the bytes of rotation and shift."""
        return hash((self.turn.tobytes(), self.shift.tobytes()))

    def __repr__(self) -> str:
        """One line that evaluates back to an equal value."""
        return f"Rigid({self.turn.tolist()!r}, {self.shift.tolist()!r})"

    def to_dict(self) -> dict[str, Any]:
        """Convert to JSON types: turn and shift.

        Example:
            >>> Rigid.translate(0, 0, 2).to_dict()["shift"]
            [0.0, 0.0, 2.0]"""
        return {"turn": self.turn.tolist(), "shift": self.shift.tolist()}

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Rigid:
        """Make a motion from the document of `to_dict`.

        Example:
            >>> move = Rigid.rotate("x", 30)
            >>> Rigid.from_dict(move.to_dict()) == move
            True"""
        return cls(np.asarray(document["turn"]), np.asarray(document["shift"]))
