"""The hidden misalignment: read once, used only for projections, never shown.

Calibration is to find it, so no reply, log line, state, data set or printed form may carry it. This
module hands out true geometries for the projector, never the parameters.
"""

from __future__ import annotations

import tomllib
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import numpy.typing as npt
from annotated_types import Ge, Gt, Lt
from pydantic import ConfigDict, TypeAdapter

from flexdt.twin.errors import MachineFileError, TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.scanner.state import StagePlacement

LARGEST = 1e6
"""Above any value of a truth file [mm, deg, s]; NaN and infinities are not below it."""
Small = Annotated[float, Gt(-LARGEST), Lt(LARGEST)]


class TrueGeometry:
    """Turns nominal poses into the geometry that X-rays really see.

    Args:
        parameters: the misalignment; none by default.
        unrest: what moves during a scan and should not; nothing by default.
    """

    __slots__ = ("__parameters", "__unrest")

    def __init__(self, parameters: Offsets = NOMINAL, unrest: HiddenMotion | None = None) -> None:
        self.__parameters = parameters
        self.__unrest = HiddenMotion() if unrest is None else unrest

    def __repr__(self) -> str:
        return "TrueGeometry(hidden)"

    def cone_vec(
        self, poses: Poses, placement: StagePlacement, times: npt.ArrayLike | None = None
    ) -> ConeVec:
        """True geometry of each pose, in the frame of a sample placed at `placement`.

        Args:
            poses: nominal.
            placement: of the sample.
            times: since the scan's start, (n,) [s]; None is the start.
        """
        return placement.to_sample(self.__unrest.shaken(poses.cone_vec(self.__parameters), times))


@dataclass(frozen=True)
class HiddenMotion:
    """Uncommanded motion: part of the hidden truth and never of a data set's report.

    Attributes:
        vibration_mm: standard deviation of the sample's position across the beam, right and up,
            new for every pose; the same pose always shakes the same way.
        spot_drift_mm: how far the focal spot wanders to the right and up while the tube warms up.
        spot_drift_s: time after which it has gone 63 % of that.
        seed: of the vibration.
    """

    vibration_mm: Annotated[Small, Ge(0)] = 0.0
    spot_drift_mm: tuple[Small, Small] = (0.0, 0.0)
    spot_drift_s: Annotated[Small, Gt(0)] = 600.0
    seed: Annotated[int, Ge(0)] = 0
    __pydantic_config__ = ConfigDict(extra="forbid")

    def shaken(self, cone_vec: ConeVec, times: npt.ArrayLike | None = None) -> ConeVec:
        """The geometry with it."""
        if self.vibration_mm == 0.0 and self.spot_drift_mm == (0.0, 0.0):
            return cone_vec
        right = cone_vec.u / np.linalg.norm(cone_vec.u, axis=1, keepdims=True)
        up = -cone_vec.v / np.linalg.norm(cone_vec.v, axis=1, keepdims=True)
        shake = np.array([self._shake(row) for row in cone_vec.rows])
        moved = shake[:, :1] * right + shake[:, 1:] * up
        when = np.zeros(len(cone_vec)) if times is None else np.asarray(times, dtype=np.float64)
        gone = -np.expm1(-np.maximum(when, 0.0) / self.spot_drift_s)[:, None]
        wander = gone * (self.spot_drift_mm[0] * right + self.spot_drift_mm[1] * up)
        # The sample moving one way is source and detector moving the other.
        return ConeVec.from_vectors(
            cone_vec.source - moved + wander, cone_vec.detector - moved, cone_vec.u, cone_vec.v
        )

    def _shake(self, row: FloatArray) -> FloatArray:
        key = zlib.crc32(np.round(row, 6).tobytes())
        rng = np.random.default_rng([self.seed, key])
        return np.asarray(self.vibration_mm * rng.standard_normal(2))


_UNREST: Final = TypeAdapter(HiddenMotion)


def load_truth(path: Path, data: Path) -> TrueGeometry:
    """Read a truth file: TOML, parameter = value [mm, deg], and a table `unrest` of `HiddenMotion`.

    Args:
        path: the file.
        data: the data directory, in which it must not lie.

    Raises:
        MachineFileError: file, key, and what is allowed; no value of the file is repeated.
    """
    file = path.resolve()
    if file.is_relative_to(data.resolve()):
        raise MachineFileError(
            f"the truth file {path} lies inside the data directory {data}; it must not",
            {"file": str(path), "allowed": "outside the data directory"},
        )
    try:
        values = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise MachineFileError(
            f"cannot read {path}: {error.strerror}", {"file": str(path)}
        ) from None
    except ValueError:
        raise MachineFileError(f"{path}: not valid TOML", {"file": str(path)}) from None
    unrest = _unrest(values.pop("unrest", {}), path)
    for name, value in values.items():
        if type(value) not in (int, float) or not abs(value) < LARGEST:
            raise MachineFileError(
                f"{path}: {name}: the value must be a number below {LARGEST:g}",
                {"file": str(path), "path": name, "allowed": [-LARGEST, LARGEST]},
            )
    try:
        parameters = Offsets.from_edge({k: float(v) for k, v in values.items()})
    except TwinError as error:
        raise MachineFileError(f"{path}: {error.message}", {"file": str(path)}) from None
    return TrueGeometry(parameters, unrest)


def _unrest(table: object, path: Path) -> HiddenMotion:
    """The table `unrest` of a truth file."""
    try:
        return _UNREST.validate_python(table)
    except ValueError:
        raise MachineFileError(
            f"{path}: unrest: allowed are vibration_mm >= 0, spot_drift_mm = [right, up], "
            f"spot_drift_s > 0 (all below {LARGEST:g}) and seed >= 0",
            {"file": str(path), "path": "unrest", "allowed": list(HiddenMotion.__annotations__)},
        ) from None
