"""What calibration knows of a phantom: where its beads are, how large they are, and how precisely
their positions are known.

`BeadPhantom` is the protocol that any phantom satisfies; `BeadModel` is the frozen value that
calibration computes with. Materials and meshes play no part here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray


@runtime_checkable
class BeadPhantom(Protocol):
    """Anything with bead centres (k, 3) [mm, object frame] and bead radii [mm]."""

    @property
    def beads(self) -> FloatArray:
        """Bead centres, (k, 3) [mm]."""

    @property
    def bead_radius_mm(self) -> FloatArray | float:
        """Bead radii, (k,) or one for all [mm]."""


@dataclass(frozen=True, eq=False)
class BeadModel:
    """Beads as calibration sees them, read-only float64.

    Attributes:
        beads: centres in the object's frame, (k, 3) [mm].
        bead_radius_mm: (k,) [mm].
        tolerance_mm: standard deviation of each coordinate of each bead about `beads` [mm]; 0 if
            the phantom is exact.
        name: for reports.
    """

    beads: FloatArray
    bead_radius_mm: FloatArray
    tolerance_mm: float = 0.0
    name: str = "phantom"

    def __post_init__(self) -> None:
        beads = np.array(self.beads, dtype=np.float64, ndmin=2, order="C")
        if beads.shape[1:] != (3,) or len(beads) == 0 or not np.isfinite(beads).all():
            shape = np.shape(self.beads)
            raise TwinError.of_shape("beads", shape, ("k", 3), ", finite, with k >= 1")
        radius = np.broadcast_to(
            np.asarray(self.bead_radius_mm, dtype=np.float64), (len(beads),)
        ).copy()
        if not (radius > 0).all():
            raise TwinError("bead radii must be positive", {"asked": radius.tolist()})
        beads.setflags(write=False)
        radius.setflags(write=False)
        object.__setattr__(self, "beads", beads)
        object.__setattr__(self, "bead_radius_mm", radius)

    def __len__(self) -> int:
        return len(self.beads)

    def mirrored(self) -> BeadModel:
        """The mirror image (x to -x): what a wrongly handed model would look like."""
        beads = self.beads * np.array([-1.0, 1.0, 1.0])
        return replace(self, beads=beads, name=f"{self.name}, mirrored")

    def turned_over(self) -> BeadModel:
        """Turned by 180 deg about x: what stands on its head."""
        beads = self.beads * np.array([1.0, -1.0, -1.0])
        return replace(self, beads=beads, name=f"{self.name}, upside down")


def bead_model(phantom: BeadPhantom | BeadModel | npt.ArrayLike) -> BeadModel:
    """The bead model of a phantom, or of bare bead centres (k, 3) (radius then 1 mm).

    Raises:
        TwinError: there are no beads in it.
    """
    match phantom:
        case BeadModel():
            return phantom
        case BeadPhantom():
            return BeadModel(
                np.asarray(phantom.beads),
                np.asarray(phantom.bead_radius_mm, dtype=np.float64),
                float(getattr(phantom, "bead_tolerance_mm", 0.0)),
                str(getattr(phantom, "name", "phantom")),
            )
        case _:
            return BeadModel(np.asarray(phantom, dtype=np.float64), np.array(1.0))


def spot_radii(model: BeadModel, cone: ConeVec) -> FloatArray:
    """Radius of each bead's spot, (n, k) [px], to first order (minor semi-axis).

    It is below 0 for a bead behind the source.
    """
    depth = np.einsum("nkj,nj->nk", model.beads[None] - cone.source[:, None], cone.normal)
    scale = cone.source_detector_distance / np.linalg.norm(cone.u, axis=1)
    return np.asarray(model.bead_radius_mm[None] * scale[:, None] / depth)
