"""Bad data sets on purpose: calibration must reject, name or survive each, and never be wrong.

Each kind spoils a scan of a bead phantom in one way at a random strength; the outcome is judged
against the truth with which the images were made. A confident wrong answer is one reported as
identifiable with a parameter, or one of `image_quantities`, more than four of its sigmas off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from ways_of_spoiling import FRAMES, KINDS, Rng, Spoilt

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.fit.fit import axis_in_image, image_quantities
from flexdt.twin.calibration.frame_source import ArrayFrames
from flexdt.twin.calibration.pipeline import Calibration, Scan, calibrate
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.projection.analytic_solids import Scene
from flexdt_extensions.studies.experiments import SHAPE, scenario
from flexdt_extensions.studies.rendered_runs import Rendering, exposures, line_integrals
from flexdt_extensions.studies.runs import errors_of

WRONG_SIGMAS: Final = 4.0


@dataclass(frozen=True)
class Outcome:
    """Judgement of the calibration of one spoilt scan.

    Attributes:
        kind, seed: which.
        refused: no numbers were offered.
        wrong: numbers were offered, and one is more than four sigmas off.
        worst: largest error of a parameter or of the axis's image in sigmas; nan if refused.
        mae: mean absolute error; nan if refused.
        findings: codes of the calibration's findings.
    """

    kind: str
    seed: int
    refused: bool
    wrong: bool
    worst: float
    mae: float
    findings: tuple[str, ...]


def corrupt(
    kind: str, seed: int, phantom: BeadModel, scene: Scene, other: Scene
) -> Spoilt:
    """Draw a scan, spoil it in one way, and render its images.

    Args:
        kind: one of KINDS.
        seed: of strength, truth and noise.
        phantom, scene: the phantom.
        other: the solids of another phantom, for `wrong_phantom`.
    """
    rng = np.random.default_rng([seed, *kind.encode()])
    nominal, truth = careful_scan(rng, FRAMES)
    scan = Spoilt(
        scene, phantom, scene, phantom, nominal, nominal, truth,
        Rendering(counts=float(rng.uniform(3000, 20000)), blur_px=float(rng.uniform(0.4, 1.0))),
    )  # fmt: skip
    chosen = KINDS[kind]
    if kind == "wrong_phantom":
        scan = replace(scan, scene=other)
    if chosen.before is not None:
        scan = chosen.before(scan, rng)
    assert scan.camera.counts is not None
    images = tuple(
        line_integrals(counts, scan.camera.counts)
        for counts in exposures(
            scan.scene, scan.model, scan.poses.cone_vec(scan.truth), scan.camera,
            [seed, *kind.encode()],
        )
    )  # fmt: skip
    scan = replace(scan, images=images)
    return scan if chosen.after is None else chosen.after(scan, rng)


def careful_scan(rng: Rng, frames: int) -> tuple[Poses, Offsets]:
    """Draw a scan as of a careful operator, in scenario G0's geometry.

    The offsets are drawn evenly within _TRUTH, the start angle is any.

    Returns:
        Nominal poses, and the true offsets.
    """
    nominal, _ = scenario("G0", frames)
    centre = np.array([0.0, 570.0, 22.0])
    nominal = replace(nominal, axis=np.broadcast_to(centre, (frames, 3)))
    edge = {n: float(rng.uniform(-s, s)) for n, s in _TRUTH.items()}
    return nominal, Offsets.from_edge(edge)


_TRUTH = {
    "dO_x": 5.0,
    "dO_y": 5.0,
    "dO_z": 15.0,
    "alpha": 180.0,
    "tau_x": 2.0,
    "tau_z": 2.0,
}


def judge(kind: str, seed: int, spoilt: Spoilt) -> tuple[Outcome, Calibration]:
    """Calibrate a spoilt scan, and compare values and the axis's image with its truth.

    Where something moves during the scan, the right value is the mean over its frames.

    Returns:
        The outcome, wrong beyond WRONG_SIGMAS, and the calibration.
    """
    result = calibrate(
        [Scan(ArrayFrames(spoilt.images, SHAPE), spoilt.nominal, kind)],
        spoilt.believed,
        spoilt.request,
        scene=spoilt.believed_scene,
    )
    codes = tuple(f.code for f in result.findings)
    if not result.identifiable or result.fit is None:
        return Outcome(kind, seed, True, False, math.nan, math.nan, codes), result
    errors = errors_of(result.fit.values, spoilt.truth)
    worst = max(errors[n] / result.fit.sigmas[n] for n in errors)
    # The best determined direction must be right too: priors do not widen it.
    middle = (np.array(SHAPE[::-1]) - 1) / 2
    # Where something moves during the scan, the right value is the mean over its frames.
    moving = [
        axis_in_image(spoilt.poses[i : i + 1], spoilt.truth, middle)
        for i in range(FRAMES)
    ]
    true = np.mean(moving, axis=0)
    for e, value in zip(
        image_quantities(result.fit)[0].values(), true.tolist(), strict=True
    ):
        worst = max(worst, abs(e.value - value) / max(e.sigma, 1e-9))
    return (
        Outcome(
            kind, seed, False, worst > WRONG_SIGMAS, worst, float(np.mean(list(errors.values()))),
            codes,
        ),
        result,
    )  # fmt: skip
