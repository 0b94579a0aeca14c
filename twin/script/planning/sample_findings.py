"""Warn of projections of a plan whose pixels the sample starves, or nothing shades enough.

The plan has no sample: `sample_probes` chooses the rays, the caller projects the sample
along them into a `SampleForecast`, and `predicted_exposures` judges the counts.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from flexdt.twin.findings import Finding, Findings, Place, warning
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.physics.chain import Chain
from flexdt.twin.physics.exposure import WARNING_SHARE, ExposureSettings
from flexdt.twin.physics.predicted_beam import (
    CountShares,
    Physics,
    PredictedExposure,
    counts_behind,
    open_beam_doubt,
)
from flexdt.twin.physics.readout import saturating_counts
from flexdt.twin.script.planning.open_beam_findings import brightest_beam, lit_settings
from flexdt.twin.script.planning.plan import ScanPlan
from flexdt.twin.script.problems import ScriptCode

PROBE_VIEWS: Final = 3
"""Number of views of each setting that are examined."""
PROBE_SETTINGS: Final = 4
"""Number of settings of tube and camera that are examined, the first ones."""
PROBE_RAYS: Final = 128
"""Least number of rays along the longer side of a panel, if it has so many pixels."""
CODE_OF_SHARE: Final = {
    "saturated": ScriptCode.SATURATED_PIXELS,
    "starved": ScriptCode.STARVED_PIXELS,
}
"""Member of `CountShares` -> code of the warning about it."""
UNPREDICTED: Final = "saturated and starved pixels behind the sample are not predicted"
"""Beginning of the warning that gives the reason."""


@dataclass(frozen=True, eq=False)
class SampleProbe:
    """Rays of some views of a setting of tube and camera.

    Attributes:
        line: of the script, that first uses the setting.
        exposure, camera: the setting, of one read-out.
        cone_vec: views of `PROBE_RAYS` a side, with the shape (rows, cols) of the grid of
            rays.
        pixels_a_side: of the camera, for each ray.
        indices: of all images of the setting.
    """

    line: int
    exposure: ExposureSettings
    camera: CameraSettings
    cone_vec: ConeVec
    pixels_a_side: int
    indices: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class SampleForecast:
    """The predicted pixels behind the sample on the stage.

    Attributes:
        probes: from `sample_probes`.
        shares: of the pixels of each probe's views; None where they are not predicted.
        unpredicted: reason for that, in words; empty if all are predicted.
    """

    probes: tuple[SampleProbe, ...]
    shares: tuple[CountShares | None, ...]
    unpredicted: str = ""


def sample_probes(plan: ScanPlan) -> tuple[SampleProbe, ...]:
    """Choose rays from which the exposure of a plan's projections is predicted.

    Args:
        plan: with the saved images, their settings and positions.

    Returns:
        A probe for each of the first `PROBE_SETTINGS` settings with X-rays on: at most
        `PROBE_VIEWS` views, evenly spread, on a grid of rays with about `PROBE_RAYS`
        along the longer side. Empty without projections.
    """
    settings = lit_settings(plan, kinds=("projection",))
    probes: list[SampleProbe] = []
    for (exposure, camera), (line, indices) in list(settings.items())[:PROBE_SETTINGS]:
        some = np.unique(np.linspace(0, len(indices) - 1, PROBE_VIEWS).astype(int))
        chosen = [indices[i] for i in some]
        positions = {name: x[chosen] for name, x in plan.image_positions.items()}
        cone = motor_poses(plan.machine, plan.profile, camera, positions).cone_vec()
        step = min(max(1, max(camera.shape) // PROBE_RAYS), *camera.shape)
        coarse = cone.with_shape(camera.shape).binned(step)
        probes.append(SampleProbe(line, exposure, camera, coarse, step, tuple(indices)))
    return tuple(probes)


def shares_behind(
    chain: Chain, probe: SampleProbe, paths_mm: Float32Array, rows: FloatArray
) -> CountShares:
    """Compute the shares of saturated and starved pixels in a probe's views.

    `paths_mm`: through each material, (m, n, rows, cols); `rows`: cone_vec, (n, 12).
    """
    counts = [
        counts_behind(
            chain, probe.camera, probe.exposure, paths_mm[:, i], view, probe.pixels_a_side
        )
        for i, view in enumerate(rows)
    ]
    return CountShares.of(np.stack(counts), saturating_counts(chain.panel))


def predicted_exposures(
    plan: ScanPlan, forecast: SampleForecast, physics: Physics = "poly"
) -> tuple[PredictedExposure, ...]:
    """Predict each setting of a plan's projections, with what speaks against it.

    In order of the forecast's probes; those without pixels behind the sample have its
    reason.
    """
    made = [
        _predicted(plan, probe, seen, physics)
        for probe, seen in zip(forecast.probes, forecast.shares, strict=True)
    ]
    return tuple(
        one if one.shares else replace(one, unpredicted=forecast.unpredicted)
        for one in made
    )


def _predicted(
    plan: ScanPlan, probe: SampleProbe, seen: CountShares | None, physics: Physics
) -> PredictedExposure:
    """Predict the exposure of one setting: open beam, pixels behind the sample, and doubts about
    both.

    Pixels that are saturated (or starved) as the open beam already is are no further doubt.

    Args:
        plan: of the scan.
        probe: the setting, and its images.
        seen: predicted pixels behind the sample; None if unknown.
        physics: how counts are predicted.

    Returns the prediction; without the open beam's fill if the physics cannot predict it.
    """
    lit = probe.exposure
    made = PredictedExposure(lit.kV, lit.power_W, lit.exposure_ms, shares=seen)
    beam = brightest_beam(plan, lit, probe.camera, list(probe.indices), physics)
    known = ""
    if beam is not None:
        doubt = open_beam_doubt(plan.machine, lit, beam)
        made = replace(
            made, open_beam_fill=beam.fill, doubts=() if doubt is None else (doubt,)
        )
        known = "saturated"
        if not beam.saturated:
            known = "starved" if beam.starved else ""
    doubts = [text for name, text in _sentences(seen) if name != known]
    return replace(made, doubts=(*made.doubts, *doubts))


def sample_problems(forecast: SampleForecast, known: Iterable[Finding] = ()) -> Findings:
    """Warn of settings whose projections have saturated or starved pixels.

    Args:
        forecast: of the pixels behind the sample.
        known: warnings of the open beam, which explain pixels of the same kind at the
            same line.

    Returns:
        Warnings `saturated_pixels` and `starved_pixels`, from a share of `WARNING_SHARE`
        on; one `unpredicted_pixels` with the reason, at the first probe's line, if pixels
        are not predicted.
    """
    found = Findings(
        warning(CODE_OF_SHARE[name], text, place=Place(probe.line))
        for probe, seen in zip(forecast.probes, forecast.shares, strict=True)
        for name, text in _sentences(seen)
    )
    warnings = [*found.unexplained_by(known)]
    if forecast.unpredicted:
        line = min(probe.line for probe in forecast.probes)
        message = f"{UNPREDICTED}: {forecast.unpredicted}"
        warnings.append(
            warning(ScriptCode.UNPREDICTED_PIXELS, message, place=Place(line))
        )
    return Findings(warnings)


def _sentences(seen: CountShares | None) -> list[tuple[str, str]]:
    """List (name, sentence) for each share of pixels of `WARNING_SHARE` or more; [] for None."""
    if seen is None:
        return []
    shares = [(name, getattr(seen, name)) for name in CODE_OF_SHARE]
    return [
        (name, f"about {100 * share:.3g} % of the projections' pixels will be {name}")
        for name, share in shares
        if share >= WARNING_SHARE
    ]
