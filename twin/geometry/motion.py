"""Motion of scanner or sample during a scan: how frames differ from one another.

It is put into `Poses`, so whatever takes one geometry a view takes it: formats,
reconstruction. `calibration.diagnose.table.followed` finds it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from flexdt.twin.errors import TwinError, UnknownNameError
from flexdt.twin.geometry.conventions import FloatArray, from_unity
from flexdt.twin.geometry.offsets import NAMES, UNITS, to_edge, to_internal
from flexdt.twin.geometry.poses import Poses

MOVABLE: Final = ("dO_x", "dO_y", "dO_z", "alpha", "dS_x", "dS_y", "dD_x", "dD_y", "dD_z")
"""Parameters that may move: stage, turntable, focal spot and panel."""


def require_movable(names: Sequence[str]) -> Sequence[str]:
    """Return the names unchanged if all are parameters that may differ from frame to
    frame (`MOVABLE`).

    An empty sequence passes. Raises UnknownNameError: lists those allowed.
    """
    for name in names:
        if name not in MOVABLE:
            message = f"{name!r} cannot differ from frame to frame; allowed"
            raise UnknownNameError.among(message, name, MOVABLE)
    return names


@dataclass(frozen=True, eq=False)
class Motion:
    """Deviations of parameters from their values in a fit, one row for each frame of one scan.

    Attributes:
        names: p parameters.
        values: (n, p) deviations, internal units (mm, rad).
        sigma: (n, p) their standard deviations; nan where a parameter was found not to
            move.
        evidence: (p,) gain in log likelihood by letting the parameter move.
    """

    names: tuple[str, ...]
    values: FloatArray
    sigma: FloatArray
    evidence: tuple[float, ...]

    def __repr__(self) -> str:
        """Format as one line: number of frames, and the range (maximum less minimum) of
        each parameter in its edge unit (mm, deg).
        """
        sizes = ", ".join(
            f"{n} {to_edge(n, float(np.ptp(self.values[:, i]))):.3g} {UNITS[n]}"
            for i, n in enumerate(self.names)
        )
        return f"<Motion: {len(self.values)} frames, {sizes}>"

    def near(self, other: Motion) -> bool:
        """Return whether two estimates of one motion differ by at most a hundredth of this one's
        sigma, in every value. Where sigma is NaN the values must be equal."""
        difference = np.abs(self.values - other.values)
        return bool((difference <= 0.01 * np.nan_to_num(self.sigma)).all())

    def applied(self, poses: Poses, sign: float = 1.0) -> Poses:
        """Return poses with the deviations added to axis, angle, source and detector,
        `sign` times.

        Deviations are added in the world frame [mm], to the angle in rad; u, v and mount
        stay. Parameters without deviations do not move.

        Args:
            poses: of as many frames; not changed.
            sign: -1 removes the deviations to first order.

        Returns:
            New poses, n.

        Raises:
            TwinError: another number of frames.
        """
        if len(poses) != len(self.values):
            message = f"motion of {len(self.values)} frames for a scan of {len(poses)}"
            raise TwinError(message, {"asked": len(self.values), "allowed": len(poses)})
        d = dict.fromkeys(NAMES, np.zeros(len(poses))) | dict(
            zip(self.names, sign * self.values.T, strict=True)
        )

        def shift(part: str) -> FloatArray:
            """Return a part's deviation in the world, (n, 3) [mm]; 0 without a parameter.
            `part`: "dS", "dO" or "dD".
            """
            z = d.get(f"{part}_z", np.zeros(len(poses)))
            return from_unity(np.stack([d[f"{part}_x"], d[f"{part}_y"], z], axis=1))

        return replace(
            poses,
            source=poses.source + shift("dS"),
            axis=poses.axis + shift("dO"),
            detector=poses.detector + shift("dD"),
            angle=poses.angle + d["alpha"],
        )

    def to_dict(self) -> dict[str, dict[str, object]]:
        """Convert to parameter -> {unit, values, sigmas, evidence, moves}, values and
        sigmas as lists in edge units (mm, deg).

        A sigma that is not finite becomes None; `moves` is whether any value is not 0.
        """
        return {
            name: {
                "unit": UNITS[name],
                "values": [to_edge(name, v) for v in self.values[:, i].tolist()],
                "sigmas": [
                    to_edge(name, v) if math.isfinite(v) else None
                    for v in self.sigma[:, i].tolist()
                ],
                "evidence": self.evidence[i],
                "moves": bool(self.values[:, i].any()),
            }
            for i, name in enumerate(self.names)
        }

    @classmethod
    def from_dict(cls, document: Mapping[str, Mapping[str, object]]) -> Motion:
        """Make a motion from the document of `to_dict`.

        Unit and `moves` are not read; a null sigma becomes NaN.

        Args:
            document: parameter -> values, sigmas [mm, deg] and evidence.

        Raises:
            TwinError: a missing key, values that are not finite numbers, one a frame; the
                message names the parameter. Or numbers of frames that differ, or no
                parameter.
            UnknownNameError: a parameter that is not in `MOVABLE`.
        """
        columns = {}
        for name in require_movable(tuple(document)):
            try:
                values, sigmas = (
                    np.array(document[name][key], dtype=np.float64)
                    for key in ("values", "sigmas")
                )
                evidence = float(str(document[name]["evidence"]))
            except (KeyError, TypeError, ValueError) as error:
                raise TwinError(f"motion of {name}: {error}") from None
            if (
                values.ndim != 1
                or values.shape != sigmas.shape
                or not np.isfinite(values).all()
            ):
                raise TwinError(
                    f"motion of {name}: values and sigmas are not a number a frame"
                )
            columns[name] = (values, sigmas, evidence)
        if len({len(c[0]) for c in columns.values()}) != 1:
            raise TwinError(
                "motion: parameters have different numbers of frames, or there is none"
            )
        unit = np.array([to_internal(name, 1.0) for name in columns])
        return cls(
            tuple(columns),
            np.stack([c[0] for c in columns.values()], axis=1) * unit,
            np.stack([c[1] for c in columns.values()], axis=1) * unit,
            tuple(c[2] for c in columns.values()),
        )
