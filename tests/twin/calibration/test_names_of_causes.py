"""Every cause of residuals, and every column that one adds, has its words for people."""

from __future__ import annotations

import numpy as np

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.diagnose.causes import (
    MOTION_OF,
    SHAPES,
    Candidates,
    Known,
    border_name,
)
from flexdt.twin.calibration.diagnose.causes.cause import RIVALS
from flexdt.twin.calibration.diagnose.causes.columns import panel_of, with_every_column
from flexdt.twin.calibration.diagnose.named_causes import CAUSE_WORDS, SHAPE_LIKE_CAUSES
from flexdt.twin.calibration.fit.certificate import SOURCES
from flexdt.twin.calibration.fit.fit import estimate_geometry
from flexdt.twin.geometry.panel import Border
from flexdt.twin.geometry.poses import Poses

BEADS = np.array([[9, 4, -20], [-10, 6, -9], [4, -11, 1], [-3, 10, 12], [11, -2, 21.0]])
SHAPE = (760, 956)


def test_every_cause_and_every_column_has_words() -> None:
    turn = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    poses = Poses.upright([0, 0, 0], [0, 600, 0], [0, 1059, 0], 0.1496, turn)
    tracks = poses.cone_vec().project_points(BEADS, SHAPE)
    tracks = tracks + 0.02 * np.random.default_rng(0).normal(size=tracks.shape)
    fit = estimate_geometry(tracks, BeadModel(BEADS, np.full(5, 0.5)), poses, shape=SHAPE)
    problem, x = fit.problem, fit.solution.x
    border = Border(0, 100.0)
    causes = Candidates(
        problem, x, Known((1e-3, 1e-3), None, 1e-3), (border,), repeating=True
    )
    others = {c.name for c in causes.causes} - {border_name(border), *RIVALS}
    others = {name for name in others if not name.startswith(MOTION_OF)}
    assert others == set(CAUSE_WORDS)
    assert set(SHAPE_LIKE_CAUSES) == others - set(SHAPES)

    everything = with_every_column(problem, x, panel_of(problem, (border,)))[0]
    names = everything.layout.names[problem.layout.parameter_count :]
    assert {name.split()[0] for name in names} == set(SOURCES)
    added = {c for cause in causes.causes for c in cause.columns}
    assert added >= set(
        range(problem.layout.parameter_count, len(everything.layout.names))
    )
