"""Predict the counts behind the sample on the stage, for the check and the data set of a scan.

The projector computes the few rays that this needs. A busy projector is waited for: the
link ends the wait when a projector is silent (`SILENT_S` of `server.projector.wire`), and
the prediction then says why it has no shares.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, replace

from flexdt.protocol.rpc_errors import RpcError
from flexdt.runtime.wire_errors import ProjectorUnavailable
from flexdt.server.imaging.radiography import Radiography
from flexdt.server.scans.scan_record import StartConditions
from flexdt.twin.errors import TwinError
from flexdt.twin.findings import Findings
from flexdt.twin.physics.predicted_beam import PredictedExposure
from flexdt.twin.scanner.state import Sample
from flexdt.twin.script import ScanPlan
from flexdt.twin.script.planning.open_beam_findings import open_beam_problems
from flexdt.twin.script.planning.sample_findings import (
    SampleForecast,
    SampleProbe,
    predicted_exposures,
    sample_probes,
    sample_problems,
)


@dataclass(frozen=True)
class Prediction:
    """Predicted counts of a scan's projections.

    Attributes:
        exposures: of each setting of tube and camera, for the data set.
        problems: warnings of pixels behind the sample, for the user who submits.
    """

    exposures: tuple[PredictedExposure, ...]
    problems: Findings


async def predict_counts(
    radiography: Radiography, begin: StartConditions, plan: ScanPlan
) -> Prediction:
    """Predict the counts of a scan's projections, with the physics and sample of its start.

    Without a sample only the open beam is judged.

    `radiography`: how images are made; physics and scatter are those of `begin`. `begin`:
    conditions of the scan. `plan`: of the scan.
    Returns predicted exposures, and problems of the sample beyond those of the open beam.
    """
    chosen = replace(radiography, physics=begin.physics, scatter=begin.scatter)
    forecast = await forecast_sample(chosen, begin.sample, sample_probes(plan))

    def judged() -> Prediction:
        """Return predicted exposures, and problems of the sample beyond those of the open beam."""
        known = open_beam_problems(plan, begin.physics)
        return Prediction(
            predicted_exposures(plan, forecast, begin.physics),
            sample_problems(forecast, known),
        )

    return await asyncio.to_thread(judged)


async def forecast_sample(
    radiography: Radiography, sample: Sample, probes: tuple[SampleProbe, ...]
) -> SampleForecast:
    """Predict the pixels behind a sample for each probe; wait while the projector works.

    A failure is in the result, not raised: errors of the sample are reported by the scan
    itself.

    Args:
        radiography: how images are made.
        sample: that the scan is to show.
        probes: rays to project.

    Returns:
        The shares of each probe's pixels; None for all of them, with the reason, if one
        fails.
    """
    try:
        shares = [await radiography.predicted_shares(sample, one) for one in probes]
    except (ProjectorUnavailable, RpcError, TwinError) as error:
        return SampleForecast(probes, (None,) * len(probes), str(error))
    return SampleForecast(probes, tuple(shares))
