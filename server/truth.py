"""The hidden misalignment: read once, used only where projections are made, shown nowhere.

It is what calibration is to find, so no reply, log line, state, data set or printed form may carry
it. This module hands out only true geometries for the projector, never the parameters.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

from flexdt.twin.errors import MachineFileError, TwinError
from flexdt.twin.geometry import ConeVec
from flexdt.twin.parameters import NOMINAL, Parameters
from flexdt.twin.pose import Poses
from flexdt.twin.state import Offset


class TrueGeometry:
    """Turns nominal poses into the geometry that X-rays really see.

    Args:
        parameters: the misalignment; none by default.
    """

    __slots__ = ("__parameters",)

    def __init__(self, parameters: Parameters = NOMINAL) -> None:
        self.__parameters = parameters

    def __repr__(self) -> str:
        return "TrueGeometry(hidden)"

    def cone_vec(self, poses: Poses, placement: Offset) -> ConeVec:
        """True geometry of each pose, in the frame of a sample placed at `placement`."""
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
        if not isinstance(value, (int, float)) or isinstance(value, bool):
            raise MachineFileError(
                f"{path}: {name}: the value must be a number", {"file": str(path), "path": name}
            )
    try:
        return TrueGeometry(Parameters.from_edge({k: float(v) for k, v in values.items()}))
    except TwinError as error:
        raise MachineFileError(f"{path}: {error.message}", {"file": str(path)}) from None
