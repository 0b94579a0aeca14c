"""Positions of source, rotation axis and detector, and the cone_vec that follows from them.

`Poses` is the nominal geometry of n frames in the world frame. `Poses.cone_vec(offsets)`
applies offsets to it: the true geometry (hidden misalignment), the corrected one and the
model that calibration fits all come from it, so they cannot disagree about a sign.
`machine.kinematics` makes poses from motor positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import MAX_PRINTED_VIEWS, ConeVec
from flexdt.twin.geometry.conventions import (
    COLUMN_DIRECTION,
    ROW_DIRECTION,
    FloatArray,
    from_unity,
    rotation_x,
    rotation_y,
    stage_rotation,
    turn_detector,
)
from flexdt.twin.geometry.offsets import NOMINAL, Offsets


@dataclass(frozen=True, eq=False)
class Poses:
    """Nominal geometry of n frames, world frame, read-only float64 arrays.

    Attributes:
        source: focal spot, (n, 3) [mm].
        axis: point of the rotation axis at the sample's reference height, (n, 3) [mm].
        detector: center of the region of interest, (n, 3) [mm].
        u: step to the next column, (n, 3) [mm].
        v: step to the next row, (n, 3) [mm].
        angle: accumulated stage angle, (n,) [rad]; growing turns the object clockwise
            from above.
        mount: where a stage on the turntable holds the sample, (n, 3) [mm]; it turns with
            it.
    """

    source: FloatArray
    axis: FloatArray
    detector: FloatArray
    u: FloatArray
    v: FloatArray
    angle: FloatArray
    mount: FloatArray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        """Broadcast each field to the number of angles, (n,) or (n, 3), as read-only
        float64 copies.

        One value or row stands for all frames. Shapes that do not broadcast raise numpy's
        ValueError; values are not checked.
        """
        n = np.size(self.angle)
        for f in fields(self):
            given = np.asarray(getattr(self, f.name), dtype=np.float64)
            value = np.broadcast_to(given, (n,) if f.name == "angle" else (n, 3)).copy()
            value.setflags(write=False)
            object.__setattr__(self, f.name, value)

    def __len__(self) -> int:
        return len(self.angle)

    def __getitem__(self, index: slice | npt.NDArray[np.intp]) -> Poses:
        """Select poses by a slice or an array of indices, in all fields."""
        return Poses(*(getattr(self, f.name)[index] for f in fields(self)))

    def __eq__(self, other: object) -> bool:
        """Compare all fields with those of other poses, exactly (no tolerance)."""
        return isinstance(other, Poses) and all(
            np.array_equal(getattr(self, f.name), getattr(other, f.name))
            for f in fields(self)
        )

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        """Format as one line; up to `MAX_PRINTED_VIEWS` views it evaluates to an equal value.

        Above that it has the number of views, and the first and last angle [deg].
        """
        if len(self) > MAX_PRINTED_VIEWS:
            turn = np.degrees(self.angle)
            return f"<Poses: {len(self)} views, {turn[0]:.6g} to {turn[-1]:.6g} deg>"
        values = ", ".join(
            f"{f.name}={getattr(self, f.name).tolist()!r}" for f in fields(self)
        )
        return f"Poses({values})"

    @classmethod
    def concatenate(cls, parts: Sequence[Poses]) -> Poses:
        """Stack several sets of poses, in order; at least one (numpy's ValueError
        otherwise).
        """
        return cls(
            *(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls))
        )

    @classmethod
    def upright(
        cls,
        source: npt.ArrayLike,
        axis: npt.ArrayLike,
        detector: npt.ArrayLike,
        pixel: float,
        angle: npt.ArrayLike,
    ) -> Poses:
        """Make poses with an upright detector of square pixels, and no shift of a stage
        on the turntable.

        Args:
            source, axis, detector: as the attributes, (3,) or (n, 3) [mm].
            pixel: pitch of columns and rows [mm].
            angle: accumulated stage angles, (n,) [rad].

        Example:
            >>> poses = Poses.upright([0, 0, 0], [0, 600, 0], [0, 1059, 0], 0.1496, [0.0, 0.1])
            >>> len(poses), poses.sdd.tolist()
            (2, [1059.0, 1059.0])
        """
        u = np.multiply(COLUMN_DIRECTION, pixel)
        v = np.multiply(ROW_DIRECTION, pixel)
        return cls(source, axis, detector, u, v, angle)  # type: ignore[arg-type]

    @classmethod
    def from_cone_vec(cls, cone_vec: ConeVec) -> Poses:
        """Make world poses whose nominal cone_vec is this one, to 1e-12 of its size.

        The stage angle is the direction of u seen from above, unwrapped, so that an
        object at rest in the world stays at rest. A det_yaw is taken for a turn of the
        sample, which only shifts alpha. The axis is the object frame's z through the
        world's origin. The detector's shape is lost.

        Raises:
            GeometryError: u is vertical in some view; names the first.
        """
        u = cone_vec.u
        standing = np.hypot(u[:, 0], u[:, 1]) < 1e-6 * np.linalg.norm(u, axis=1)
        if standing.any():
            i = int(np.argmax(standing))
            message = f"cone_vec row {i}: u is vertical, so the stage angle cannot be read from it"
            raise GeometryError(message, {"row": i})
        # stage_rotation(phi)^-1 turns +x to (cos phi, sin phi).
        angle = np.unwrap(np.arctan2(u[:, 1], u[:, 0]))
        world = cone_vec.moved(stage_rotation(angle), np.zeros(3))
        return cls(world.source, np.zeros(3), world.detector, world.u, world.v, angle)

    @property
    def sod(self) -> FloatArray:
        """Source-object distance along the beam, (n,) [mm]."""
        return np.asarray(self.axis[:, 1] - self.source[:, 1])

    @property
    def sdd(self) -> FloatArray:
        """Source-detector distance along the beam, (n,) [mm]."""
        return np.asarray(self.detector[:, 1] - self.source[:, 1])

    @property
    def pixels_per_mm(self) -> FloatArray:
        """Columns per mm at the rotation axis, (n,)."""
        return np.asarray(self.sdd / self.sod / np.linalg.norm(self.u, axis=1))

    def cone_vec(self, parameters: Offsets = NOMINAL) -> ConeVec:
        """Compute the geometry in the object's frame, with `parameters` [mm, rad] added.

        A point b of the phantom is in the world at q = c + T R(alpha + angle_scale *
        angle) (b + mount - tau), c = O + dO + tau, with R clockwise from above and T the
        axis tilt (axis_tilt_x about world +x, then axis_tilt_z about world +y, pivot c,
        assumed): thesis eq. 5.4 for T = 1. The detector is shifted by dD, then turned by
        det_yaw about v, det_pitch about the turned u, det_roll about the turned normal.
        """
        p = parameters
        tau = from_unity([p.tau_x, 0.0, p.tau_z])
        pivot = self.axis + from_unity([p.dO_x, p.dO_y, p.dO_z]) + tau
        source = self.source + from_unity([p.dS_x, p.dS_y, 0.0])
        detector = self.detector + from_unity([p.dD_x, p.dD_y, p.dD_z])
        u, v = self._turned_detector(p)
        tilt = rotation_y(p.axis_tilt_z) @ rotation_x(p.axis_tilt_x)
        turn = stage_rotation(p.alpha + p.angle_scale * self.angle)
        t_object_world = np.swapaxes(tilt @ turn, 1, 2)
        world = ConeVec.from_vectors(source - pivot, detector - pivot, u, v)
        return world.moved(t_object_world, tau - self.mount)

    def _turned_detector(self, p: Offsets) -> tuple[FloatArray, FloatArray]:
        """Turn the pixel steps u and v by the detector's yaw, pitch and roll offsets
        [rad]: `turn_detector`; unchanged if all are 0.
        """
        if p.det_yaw == 0.0 and p.det_pitch == 0.0 and p.det_roll == 0.0:
            return self.u, self.v
        return turn_detector(self.u, self.v, p.det_yaw, p.det_pitch, p.det_roll)
