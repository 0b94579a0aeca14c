"""The parameters and settings of a calibration, and the resulting priors of the scans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.fit.priors import (
    known,
    known_scale,
    known_strain,
    require_widths,
    with_tolerance,
)
from flexdt.twin.calibration.fit.problem import (
    SIX,
    Reading,
    Strain,
    require_names,
    require_tolerance,
)
from flexdt.twin.calibration.fit.weak_directions import BOUND
from flexdt.twin.calibration.frame_source import (
    Scan,
)
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.motion import require_movable
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.told_lengths import PHANTOM

ANYWHERE = 1e3
"""Prior [mm, deg] so wide that the images alone determine its parameter."""


@dataclass(frozen=True)
class CalibrationRequest:
    """The parameters and settings of a calibration.

    Attributes:
        free: parameters to estimate.
        per_scan: those with a value of their own in every scan.
        reading: of eq. 5.4.
        start: offsets to begin with, and the center of every prior; parameters that are
            neither free nor have a prior stay there.
        bead_tolerance_mm: > 0: bead positions are unknowns with this prior. 0: they are
            at their stated places. None: the phantom may be strained by STRAIN, and
            single beads are unknowns only if the residuals require it.
        second_look: measure again where the first fit predicts the beads.
        priors: standard deviations [mm, deg, 1] in place of the scans' own; 0 is exactly
            known. The scans' apply to parameters that are not free, these to any.
        bound: sigma [mm, deg] beyond which the result is not identifiable.
        known_sizes: the beads' radii are known; else they were taken from the spots.
        misfit_px: residual up to which a fit is used, whatever its positions scatter.
        per_frame: those that may also differ from frame to frame, see `diagnose.table.followed`.

    Raises:
        UnknownNameError: a name that is no parameter, or cannot differ from frame to frame.
        TwinError: nothing is free, the tolerance or a prior is invalid, one of `per_scan`
            is not free, or a parameter is both free and exactly known.
    """

    free: tuple[str, ...] = SIX
    per_scan: tuple[str, ...] = ()
    reading: Reading = Reading.AXIS_AT_O_PLUS_TAU
    start: Offsets = NOMINAL
    bead_tolerance_mm: float | None = None
    second_look: bool = True
    priors: Mapping[str, float] = field(default_factory=dict)
    bound: float = BOUND
    known_sizes: bool = True
    misfit_px: float = 0.0
    per_frame: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check names, priors, tolerance and bound; drop repeated names of `per_frame`.

        Raises:
            TwinError: no parameter is free, one is both free and exactly known, a `per_scan`
                parameter is not free, or a value is out of its range.
            UnknownNameError: a name that is no parameter.
        """
        object.__setattr__(
            self, "per_frame", tuple(dict.fromkeys(require_movable(self.per_frame)))
        )
        require_names((*self.free, *self.per_scan))
        if not self.free:
            raise TwinError(
                "no parameter is free: there is nothing to estimate", {"asked": []}
            )
        for name in self.per_scan:
            if name not in self.free:
                raise TwinError(
                    f"{name} is to have a value in each scan but is not free; free are "
                    + ", ".join(self.free),
                    {"asked": name, "allowed": list(self.free)},
                )
        if self.bead_tolerance_mm is not None:
            require_tolerance(self.bead_tolerance_mm)
        for name, width in require_widths(self.priors).items():
            if width == 0 and name in self.free:
                raise TwinError(
                    f"{name} is free, and its prior is 0: exactly known; choose one"
                )
        if not self.bound > 0:
            raise TwinError(f"bound {self.bound:g}; allowed: a sigma above 0 [mm, deg]")


def priors_of(
    scans: Sequence[Scan], request: CalibrationRequest, model: BeadModel
) -> dict[str, float]:
    """Return every prior of the fit [mm, deg, 1]."""
    return {n: w for n, w in stated_priors(scans, request, model).items() if w > 0}


def stated_priors(
    scans: Sequence[Scan], request: CalibrationRequest, model: BeadModel
) -> dict[str, float]:
    """Return the request's priors, and the widest of the scans' for parameters that are
    not free; 0: exact. The phantom's scale has one, too, unless it is free.
    """
    out = known(request.free, request.priors, [scan.priors for scan in scans])
    if PHANTOM in request.free:
        return out
    scale = known_scale(model, request.free, request.priors, request.bead_tolerance_mm)
    return out | {PHANTOM: scale}


def with_stated(request: CalibrationRequest, model: BeadModel) -> CalibrationRequest:
    """Return the request with the tolerances that the phantom's file states, where the request
    states none.
    """
    given, tolerance = with_tolerance(model, request.priors, request.bead_tolerance_mm)
    assert isinstance(given, Mapping)
    given = {n: w for n, w in given.items() if w > 0 or n not in request.free}
    return replace(request, priors=given, bead_tolerance_mm=tolerance)


def strain_prior(model: BeadModel, request: CalibrationRequest) -> Strain:
    """Return the standard deviations of the phantom's stretches and shears [1]."""
    return known_strain(model, request.free, request.priors, request.bead_tolerance_mm)


def with_free(request: CalibrationRequest, names: Sequence[str]) -> CalibrationRequest:
    """Return the request with further free parameters, each once; those that were fixed lose the
    request's priors.

    `request`: not changed; `names`: of parameters.
    """
    priors = {
        n: w for n, w in request.priors.items() if n in request.free or n not in names
    }
    return replace(
        request, free=tuple(dict.fromkeys((*request.free, *names))), priors=priors
    )
