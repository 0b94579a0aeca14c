"""Scans of one phantom that is placed anew between them: each may move, by itself."""

from __future__ import annotations

import re

import numpy as np
import pytest
from causes_named import scored
from faults_drawn import World, shadows

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.diagnose.table.group import Known
from flexdt.twin.calibration.diagnose.table.groups import moving
from flexdt.twin.calibration.diagnose.table.linearised import (
    Linearised,
    State,
    with_every_column,
)
from flexdt.twin.calibration.diagnose.table.products import Products
from flexdt.twin.calibration.fit.fit import estimate_geometry
from flexdt.twin.geometry.poses import Poses

BEADS = np.array([[9, 4, -20], [-10, 6, -9], [4, -11, 1], [-3, 10, 12], [11, -2, 21.0]])
SHAPE = (760, 956)


def test_a_motion_belongs_to_one_scan() -> None:
    """Its columns are 0 in the other's frames; in its own, a ramp aside is what the shadows
    of a laboratory written elsewhere do."""
    n = 24
    angles = 360.0 * np.arange(n) / n
    poses = Poses.upright(
        [0, 0, 0], [0, 600, 0], [0, 1059, 0], 0.1496, np.radians(angles)
    )
    radii = np.full(5, 1e-3)

    def seen(aside: np.ndarray) -> np.ndarray:
        shown = np.ones((n, 5), dtype=bool)
        spot = np.zeros((n, 3))
        world = World(BEADS, radii, {"dO_x": aside}, angles, spot, shown, 600.0, 1059.0)
        return shadows(world)[0]

    still = seen(np.zeros(n))
    fit = estimate_geometry(
        np.concatenate([still, still]), BeadModel(BEADS, radii),
        Poses.concatenate([poses, poses]), shape=SHAPE, groups=np.repeat([0, 1], n),
        per_group=("alpha", "tau_x", "tau_z"), strain=(1e-3, 1e-3),
    )  # fmt: skip
    problem = fit.problem
    _, x = with_every_column(problem, fit.solution.x)
    table = Linearised(problem, State(x, {}, np.zeros((2 * n, 5, 2))), 1e-3)
    families = list(moving.families(table, Known((1e-3, 1e-3), None, 1e-3)))
    names = {name for f in families for name in f.names}
    for name in moving.MOVERS:
        for scan in (1, 2):
            assert f"{name} wanders in scan {scan}" in names
        # What has a value in each scan cannot differ from scan to scan besides.
        assert (f"{name} differs between scans" in names) == (name != "alpha")
    products = Products(table, families)

    def rows(name: str) -> np.ndarray:
        (f,) = (i for i, one in enumerate(families) if name in one.names)
        found = products.rows(f, families[f].names.index(name))
        return found.reshape(2, 10 * n, -1)

    ramp = rows("dO_x ramps in scan 2")[..., 0]
    assert np.abs(ramp[0]).max() == 0.0
    step = 0.01
    moved = seen(step * ((np.arange(n) + 0.5) / n - 0.5)) - still
    assert ramp[1] == pytest.approx(moved.ravel() / step, abs=3e-3)


@pytest.mark.daily(2)
@pytest.mark.campaign(2)
@pytest.mark.parametrize(
    ("kind", "seed", "said"),
    [
        ("object_jumps@two_placements", 100, "drift.*scan 1"),
        ("object_jumps_along@two_distances", 100, "(of|in) scan 1"),
        # The mean of what jumped is not where it is in the other scan: det_roll, 5.6 sigma.
        ("source_jumps@two_placements", 100, "of scan 1, at frame 1[567]:"),
        # It correlated the residuals, which then were no evidence of it: 4.7 sigma.
        ("panel_jumps@three_placements", 300, "(of|in) scan 1"),
        # Most of a scan was left out, and what moved was not named.
        ("screw@three_placements", 100, "(of|in) scan 2"),
        ("runout@two_distances", 100, "(of|in) scan"),
        # Nor are beads that were left out with the frames.
        ("runout@two_distances", 500, "(of|in) scan 2"),
        # A scan's frames are judged by themselves: its last ones are not those of all.
        ("slip@two_placements", 100, "frames 1. and 1. of scan 2"),
        # A first frame that fits no angle is no evidence on the others'.
        ("object_jumps@two_placements", 200, "(of|in) scan 1"),
        # What moves beside the stated priors is no evidence against them, nor of pixels.
        ("drift_across@two_placements", 200, "(of|in) scan 1"),
        ("drift_across@two_distances", 200, "(of|in) scan 1"),
    ],
)
def test_what_moves_in_one_of_several_scans_is_named(
    kind: str, seed: int, said: str
) -> None:
    result = scored(kind, seed)
    assert result.verdict == "right", result.said
    assert not result.wrong, (result.worst, result.where)
    assert re.search(said, " ".join(result.said)), result.said


@pytest.mark.parametrize("kind", ["as_assumed", "strain_z", "four_tiles"])
def test_several_placements_are_offered_and_right(kind: str) -> None:
    result = scored(f"{kind}@three_placements", 100)
    assert result.verdict == "right", result.said
    assert result.offered, result.said
    assert result.worst < 4.0, (result.worst, result.where)
