"""Causes of the residuals: one table of causes, judged by their evidence.

A cause is a group of columns added to those of the geometry, with a prior of unknown
width: the phantom is strained, the object turns while it is exposed or read, beads are elsewhere,
the panel distorts, a tile begins, something moves, priors are too narrow. Every
combination that is tried has its evidence (`fit.evidence`). The most likely is fitted;
the results of all are averaged, so that the sigmas contain what the data leave open; a
cause is named where its odds exceed NAMED_LOG_ODDS.
"""

from flexdt.twin.calibration.diagnose.causes.candidates import Candidates
from flexdt.twin.calibration.diagnose.causes.cause import (
    APART,
    MOTION_OF,
    SHAPES,
    Cause,
    Choice,
    Found,
    Known,
    Refit,
    border_name,
)
from flexdt.twin.calibration.diagnose.causes.explained import (
    LEAST_BEADS,
    explained_by_causes,
    lost_beads,
    motions_alone,
)
from flexdt.twin.calibration.diagnose.causes.left_open import left_open

__all__ = [
    "APART",
    "LEAST_BEADS",
    "MOTION_OF",
    "SHAPES",
    "Candidates",
    "Cause",
    "Choice",
    "Found",
    "Known",
    "Refit",
    "border_name",
    "explained_by_causes",
    "left_open",
    "lost_beads",
    "motions_alone",
]
