"""The hidden misalignment: read once, used only for projections, never shown.

Calibration is to find it, so no reply, log line, state, data set or printed form may carry it. This
module hands out true geometries for the projector, never the parameters.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

from flexdt.twin.errors import MachineFileError, TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.scanner.state import StagePlacement

LARGEST = 1e6
"""Above any value of a truth file [mm, deg]; NaN and infinities are not below it."""


class TrueGeometry:
    """Turns nominal poses into the geometry that X-rays really see.

    Args:
        parameters: the misalignment; none by default.
    """

    __slots__ = ("__parameters",)

    def __init__(self, parameters: Offsets = NOMINAL) -> None:
        self.__parameters = parameters

    def __repr__(self) -> str:
        return "TrueGeometry(hidden)"

    def cone_vec(self, poses: Poses, placement: StagePlacement) -> ConeVec:
        """True geometry of each pose, in the frame of a sample placed at `placement`.

        Args:
            poses: nominal.
            placement: of the sample.
        """
        return placement.to_sample(poses.cone_vec(self.__parameters))


def load_truth(path: Path, data: Path) -> TrueGeometry:
    """Read a truth file: TOML, parameter = value [mm, deg].

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
    return TrueGeometry(parameters)
