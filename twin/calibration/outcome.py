"""The outcome of a calibration, complete or under way."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.camera_lag import Lag
from flexdt.twin.calibration.detect.missing_light import MissingLight
from flexdt.twin.calibration.detect.refine import Refined
from flexdt.twin.calibration.fit.certificate import Hidden
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.frame_source import (
    FrameSpots,
    Scan,
)
from flexdt.twin.calibration.identify import Identification
from flexdt.twin.findings import Finding, Findings
from flexdt.twin.geometry.motion import Motion
from flexdt.twin.geometry.panel import Panel


@dataclass(frozen=True, eq=False)
class Calibration:
    """The outcome of a calibration, as far as it got.

    Attributes:
        fit: the last fit made, with its certificate; None before the first.
        identifications: of each scan, as far as it got.
        findings: faults of the data, worst first.
        looks: detections and state of every frame of each scan.
        measured: positions of the second measurement of each scan; empty without one.
        scans: that were calibrated, with the motion found in their poses.
        model: the phantom's beads.
        motions: of each scan, in their poses; empty if none was requested.
        lags: of the camera in each scan, removed from the measurements.
        missing_light: in the images of each scan, given back in the measurements.
    """

    fit: FitResult | None
    identifications: tuple[Identification, ...]
    findings: Findings
    looks: tuple[tuple[FrameSpots, ...], ...]
    measured: tuple[Refined, ...]
    scans: tuple[Scan, ...]
    model: BeadModel
    motions: tuple[Motion, ...] = ()
    lags: tuple[Lag, ...] = ()
    missing_light: tuple[MissingLight, ...] = ()

    @property
    def panel(self) -> Panel | None:
        """Distortion and lag of the panel; lag is the mean over the scans that show it,
        on a flat panel of the first scan's shape without distortion. None if neither was
        found.
        """
        if self.fit is None:
            panel = None
        else:
            panel = self.fit.panel
        if not (seen := [lag.part for lag in self.lags if lag.seen]):
            return panel
        return replace(
            panel or Panel.flat(self.scans[0].frames.shape), lag=float(np.mean(seen))
        )

    @property
    def reliability(self) -> tuple[Hidden, ...]:
        """What each cause could do to the geometry without being told, of the axis the most
        first; empty where the numbers must not be used.
        """
        if self.fit is None or not self.identifiable:
            return ()
        return self.fit.certificate.hidden

    @property
    def errors(self) -> Findings:
        """Findings that forbid using the numbers."""
        return self.findings.errors

    @property
    def identifiable(self) -> bool:
        """There is a fit, it determines every parameter, and nothing forbids using it."""
        return self.fit is not None and self.fit.identifiable and not self.errors

    def moved(self, motions: tuple[Motion, ...]) -> Calibration:
        """Return the calibration with motions in its scans' poses, in place of those in them."""
        scans = self.scans
        for some, sign in ((self.motions, -1.0), (motions, 1.0)):
            if some:
                scans = tuple(
                    replace(scan, poses=motion.applied(scan.poses, sign))
                    for scan, motion in zip(scans, some, strict=True)
                )
        return replace(self, scans=scans, motions=motions)

    def with_findings(self, *more: Finding) -> Calibration:
        """Add findings."""
        return replace(self, findings=self.findings.and_also(more).worst_first())

    @property
    def detections(self) -> int:
        """Spots found in all frames."""
        return sum(len(look.detections) for looks in self.looks for look in looks)
